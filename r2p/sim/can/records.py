"""The values of a simulated bus: the settings of a node, states, records of frames, and counts."""

from __future__ import annotations

from collections import defaultdict
from enum import Enum
from typing import TYPE_CHECKING

import msgspec

from r2p.codecs.can_bits import INTERMISSION, Frame
from r2p.codecs.rtcan import message_of

if TYPE_CHECKING:
    import random
    from collections.abc import Callable


class ControllerState(Enum):
    """The error state of a controller (ISO 11898), or that it has no power."""

    ACTIVE = "error active"
    PASSIVE = "error passive"  # a counter over 127: its error flags destroy no frame, and it waits longer to send
    BUS_OFF = "bus off"  # the transmit counter over 255: it neither sends nor receives
    DOWN = "down"  # no power


class ErrorKind(Enum):
    """The reason why a frame was not transmitted."""

    ACK = "no acknowledge"  # no other node is on the bus
    BIT = "bit error"  # the bus had another level than the sender: noise, or a second sender
    STUFF = "stuff error"  # the sender lost power in the middle of the frame
    BUS_OFF = "bus off"  # the sender's controller went to bus-off while the frame waited in its mailbox


class Latency(msgspec.Struct, frozen=True):
    """A delay of `nominal` ns, plus or minus up to `jitter` ns, uniformly distributed; `jitter` <= `nominal`."""

    nominal: int = 0
    jitter: int = 0

    def __post_init__(self) -> None:
        if not 0 <= self.jitter <= self.nominal:
            raise ValueError(
                f"the jitter ({self.jitter} ns) must be between 0 and the nominal delay ({self.nominal} ns)"
            )

    def sampler(self, numbers: random.Random) -> Callable[[], int]:
        """A function that returns one random delay after the other, in ns."""
        if not self.jitter:
            return lambda: self.nominal
        shortest, span, draw = self.nominal - self.jitter, 2 * self.jitter + 1, numbers.random
        return lambda: shortest + int(draw() * span)


class CanNode(msgspec.Struct, frozen=True):
    """The settings of one node.

    - `one_shot`: a frame that loses arbitration or is destroyed is given up and reported. Otherwise it is sent again.
    - `mailboxes`: how many frames the controller holds; it sends the one with the lowest identifier first.
    - `offset` (ns) and `drift_ppm`: how the node's clock differs from true time, which is that of the loop.
    - `transmit`: from the request until the controller is ready to send. `receive`: from the end of a frame (or the
      lost arbitration, or the error) until the node's software is called; it stamps the frame at that moment.
    - `loss`: the share of received frames that the node's software loses. `noise`: the share of received frames in
      which only this node sees a bit error; while it is error active, it then destroys the frame for all.
    - `recovery`: a controller in bus-off recovers by itself, after 128 times 11 recessive bits.
    """

    name: str
    one_shot: bool = False
    mailboxes: int = 3
    offset: int = 0
    drift_ppm: float = 0.0
    transmit: Latency = Latency()
    receive: Latency = Latency()
    loss: float = 0.0
    noise: float = 0.0
    recovery: bool = True


class FrameRecord(msgspec.Struct, frozen=True, gc=False):
    """An event on the wire: one frame, or one attempt that ended with an error frame.

    `start` and `end` are true time, in ns: start of frame, and end of the frame or of the error frame; `bits` lie
    between them. With several senders, they sent the same bits or collided.
    """

    start: int
    end: int
    frame: Frame
    senders: tuple[str, ...]
    bits: int
    error: ErrorKind | None


class ArbitrationLoss(msgspec.Struct, frozen=True, gc=False):
    """An arbitration that a node lost: its frame, the start of frame, and when the node gave up (true time, ns)."""

    start: int
    end: int
    frame: Frame
    node: str


class Count(msgspec.Struct, eq=False):
    """Frames that were sent, with their bits (stuff bits included, intermission not), and what was not sent."""

    frames: int = 0
    bits: int = 0
    errors: int = 0  # attempts that ended with an error frame
    error_bits: int = 0  # ... and the bits they took, error frame included
    lost: int = 0  # arbitrations lost

    def add(self, other: Count) -> None:
        """Add the numbers of another counter."""
        for name in self.__struct_fields__:
            setattr(self, name, getattr(self, name) + getattr(other, name))

    @property
    def occupied(self) -> int:
        """Bit times in which the bus was not free: all bits, with the intermission that follows."""
        return self.bits + self.error_bits + INTERMISSION * (self.frames + self.errors)


class Statistics:
    """Totals, and counts by message id and by node. A frame that several nodes sent as one counts for each of them."""

    def __init__(self, bit: int, since: int) -> None:
        """`bit`: the length of a bit in ns. `since`: the instant from which the load counts, in ns."""
        self.since = since
        self._bit = bit
        self._counts: defaultdict[tuple[int, tuple[str, ...]], Count] = defaultdict(Count)  # by message id and senders

    @property
    def total(self) -> Count:
        total = Count()
        for count in self._counts.values():
            total.add(count)
        return total

    @property
    def by_message(self) -> dict[int, Count]:
        counts: defaultdict[int, Count] = defaultdict(Count)
        for (message, _), count in self._counts.items():
            counts[message].add(count)
        return dict(counts)

    @property
    def by_node(self) -> dict[str, Count]:
        counts: defaultdict[str, Count] = defaultdict(Count)
        for (_, senders), count in self._counts.items():
            for name in senders:
                counts[name].add(count)
        return dict(counts)

    def add(self, record: FrameRecord) -> None:
        """Count a frame or a failed attempt."""
        count = self._counts[message_of(record.frame.id), record.senders]
        if record.error is None:
            count.frames += 1
            count.bits += record.bits
        else:
            count.errors += 1
            count.error_bits += record.bits

    def add_lost(self, name: str, identifier: int) -> None:
        """Count an arbitration that this node lost with this identifier."""
        self._counts[message_of(identifier), (name,)].lost += 1

    def load(self, now: int) -> float:
        """Return the share of the time up to `now` (ns) in which the bus was occupied: 1.0 is saturated."""
        elapsed = now - self.since
        return self.total.occupied * self._bit / elapsed if elapsed > 0 else 0.0
