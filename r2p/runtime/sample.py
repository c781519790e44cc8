"""A sample: one published message on its way from a publisher to every queue.

It carries the message both as the object that was published and as packed bytes. A local subscriber gets the object, a
link sends the bytes, and a gateway never needs the type.
"""

import msgspec

from r2p.codecs.attachment import ClockOffset
from r2p.codecs.attachment import PublisherClass as PublisherClass  # a part of each sample: imported from here
from r2p.messages import Message


class Source(msgspec.Struct, frozen=True):
    """Where a sample comes from; names that the link does not carry are empty.

    `link` names the link of this module by which it came in; it is empty for a sample that was published in this
    module.
    """

    module: str = ""
    node: str = ""
    link: str = ""

    def __str__(self) -> str:
        return "/".join(part for part in (self.module or "?", self.node) if part)


class Sample(msgspec.Struct, gc=False):
    """One published message, with what is known of its publication.

    `data` are the packed bytes; `message` is None until a subscriber decodes a sample that came over a link.

    `stamp` and `deadline` are UTC instants in ns (`deadline` 0: none) by the clock of the computer that stamped it,
    which may differ from this computer's. `expires` is the deadline by the clock here; 0: the same as `deadline`.
    `stamped` says whether the stamp is the sender's; otherwise it is the time of reception.

    `sequence` counts the messages of one publisher from 1; 0 where the link does not carry it. `drop_late`: a link that
    could not send it by its deadline drops it instead of sending it late. `hops` counts the gateways that it crossed.

    `clock` says how the time of the network where it was stamped translates to UTC, and how accurately:
    `clock.utc(...)` is for such times in the payload, which no gateway changes.
    """

    data: bytes
    source: Source
    stamp: int
    deadline: int = 0
    sequence: int = 0
    publisher_class: PublisherClass = PublisherClass.NON_REAL_TIME
    message: Message | None = None
    stamped: bool = True
    drop_late: bool = True
    hops: int = 0
    clock: ClockOffset | None = None
    expires: int = 0

    @property
    def due(self) -> int:
        """The deadline by the clock here; 0: none."""
        return self.expires or self.deadline
