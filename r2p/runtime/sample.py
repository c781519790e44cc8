"""A sample: one published message on its way from a publisher to every queue.

It carries the message both as the object that was published and as packed bytes. A local subscriber gets the object, a
link sends the bytes, and a gateway never needs the type.

Duplicates, after a repetition, by another link or by another gateway, are recognised by sequence number and stamp, as a
restarted publisher counts anew. `LastReceived` is for a publisher whose start is known, so its messages never go back:
any that is not newer than the last one is dropped, and order is kept. A gateway does not know the start, and the clock
of a module without a battery may go back with it, so `DuplicateFilter` drops only messages that it has seen: otherwise
all messages of such a module would be lost behind the gateway.
"""

from typing import TYPE_CHECKING, Generic

import msgspec

from r2p.codecs import PublisherClass as PublisherClass  # a part of each sample: imported from here
from r2p.messages import ClockOffset, Message

if TYPE_CHECKING:
    from typing_extensions import TypeVar  # in `typing` from Python 3.13 on

    T = TypeVar("T", default=Message | None, covariant=True)
else:
    from typing import TypeVar

    T = TypeVar("T")

_KEPT_MAX = 64  # messages of each publisher
_PUBLISHERS_MAX = 1024  # of a topic; with one more all are forgotten


class Source(msgspec.Struct, frozen=True):
    """The origin of a sample; names that the link does not carry are empty.

    `link` names the link of this module that received the sample; it is empty for a sample of this module.
    """

    module: str = ""
    node: str = ""
    link: str = ""

    def __str__(self) -> str:
        return "/".join(part for part in (self.module or "?", self.node) if part)


class Sample(msgspec.Struct, Generic[T], gc=False):
    """One published message, with its stamp, deadline and source.

    `data` are the packed bytes. `message` is None until a subscriber decodes a sample that came over a link: never in
    what `Subscriber.samples()` of a type yields, where `Sample[Led]` is a sample whose message is a `Led`.

    `stamp` and `deadline` are UTC instants in ns (`deadline` 0: none) by the clock of the computer that stamped the
    sample, which may differ from this computer's. `expires` is the deadline by the clock here; 0: the same as
    `deadline`. `stamped` says whether the stamp is the sender's; otherwise it is the time of reception.

    `sequence` counts the messages of one publisher from 1; 0 where the link does not carry it. `drop_late`: a link that
    misses the deadline drops the sample instead of sending it late. `hops` counts the gateways on its way.

    `clock` translates the time of the network where the sample was stamped to UTC, and says how accurately:
    `clock.utc(...)` is for such times in the payload, which gateways don't change.
    """

    data: bytes
    source: Source
    stamp: int
    deadline: int = 0
    sequence: int = 0
    publisher_class: PublisherClass = PublisherClass.NON_REAL_TIME
    message: T = None  # type: ignore[assignment]  # where T is its default; else `samples()` sees to it
    stamped: bool = True
    drop_late: bool = True
    hops: int = 0
    clock: ClockOffset | None = None
    expires: int = 0

    @property
    def due(self) -> int:
        """The deadline by the clock here; 0: none."""
        return self.expires or self.deadline


class DirectedSample(Sample, gc=False):
    """A sample for one module, `to` (its instance), as an answer to a call.

    A link that can send to one module alone does so; on others all subscribers receive it, and leave it to that one.
    """

    to: int = 0


class LastReceived(msgspec.Struct, eq=False, weakref=True):
    """The last message of a remote publisher, from any link."""

    sequence: int = 0
    stamp: int = 0

    def accept(self, sequence: int, stamp: int) -> bool:
        """Enter a message; return False if it, or a later one, was here before. Without a number, all are new."""
        if sequence and sequence <= self.sequence and stamp <= self.stamp:
            return False
        self.sequence = sequence
        self.stamp = stamp
        return True


class DuplicateFilter:
    """The last messages of all publishers of a topic, by number and stamp."""

    def __init__(self) -> None:
        self._last: dict[tuple[str, str], list[tuple[int, int]]] = {}

    def accept(self, sample: Sample) -> bool:
        """Enter a message with a number; return False if it was here before."""
        source = sample.source
        key = (source.module, source.node)
        last = self._last.get(key)
        if last is None:
            if len(self._last) >= _PUBLISHERS_MAX:
                self._last.clear()
            last = self._last[key] = [(0, 0)] * _KEPT_MAX
        place, message = sample.sequence % _KEPT_MAX, (sample.sequence, sample.stamp)
        if last[place] == message:
            return False
        last[place] = message
        return True
