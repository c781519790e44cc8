"""What flows: one published message on its way from a publisher to every queue.

A sample carries the message both as the object that was published and as packed bytes. A local subscriber takes the
object, a link takes the bytes, and a gateway never needs the type.
"""

import enum

import msgspec

from r2p.codecs.attachment import ClockOffset
from r2p.messages import Message


class PublisherClass(enum.IntEnum):
    """The real-time class of a publisher (thesis 5.3.6)."""

    NON_REAL_TIME = 1
    SPORADIC = 2
    PERIODIC = 3


class Source(msgspec.Struct, frozen=True):
    """Where a sample comes from; names that a link can't tell are empty.

    `link` names the link of this module that it came in by; it is empty for a sample published in this module.
    """

    module: str = ""
    node: str = ""
    link: str = ""

    def __str__(self) -> str:
        return "/".join(part for part in (self.module or "?", self.node) if part)


class Sample(msgspec.Struct, gc=False):
    """One published message.

    `stamp` and `deadline` are UTC instants in ns (`deadline` 0: none), by the clock of the computer that stamped it,
    which may show another time than this one's. `expires` is the deadline by the clock here (`protocols.time_left`); 0:
    it is `deadline`. `stamped` says whether the stamp is the sender's, or else the reception's. `sequence` counts the
    messages of one publisher from 1; 0 where the link does not carry it.
    `message` is None until somebody decodes a sample that came over a link. `drop_late`: a link that could not send it
    by its deadline gives it up, and does not send it late. `hops` counts the gateways that it has crossed.

    `clock` is how the time of the network where it was stamped translates to UTC, and how well: `clock.utc(...)` is for
    such times in the payload, which no gateway touches.
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
