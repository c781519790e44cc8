"""The values of a simulated bus: the settings of a node, states, records of frames, and counts."""

from __future__ import annotations

from collections import defaultdict
from enum import Enum
from typing import TYPE_CHECKING

import msgspec

from r2p.codecs.can_bits import INTERMISSION
from r2p.codecs.rtcan import message_of

if TYPE_CHECKING:
    import random
    from collections.abc import Callable

    from r2p.codecs.can_bits import AnyFrame, FrameField


class ControllerState(Enum):
    """The error state of a controller (ISO 11898), or that it has no power."""

    ACTIVE = "error active"
    PASSIVE = "error passive"  # a counter over 127: its error flags destroy no frame, and it waits longer to send
    BUS_OFF = "bus off"  # the transmit counter over 255: it neither sends nor receives
    DOWN = "down"  # no power


class ErrorKind(Enum):
    """The reason why a frame was not transmitted, or what a controller detected."""

    ACK = "no acknowledge"  # no other node is on the bus
    BIT = "bit error"  # the bus had another level than the sender: noise, or a second sender
    STUFF = "stuff error"  # six equal bits: the sender lost power in the middle of the frame, or an error flag
    FORM = "form error"  # a dominant bit after the CRC: an error flag, as the other controllers see it
    CRC = "CRC error"  # a wrong bit that only a receiver has seen which must not destroy the frame
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

    def sampler(self, numbers: random.Random) -> Callable[[], int] | None:
        """Return a function that draws a random delay (ns), or None if all delays are `nominal`."""
        if not self.jitter:
            return None
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
      which only this node sees a bit error; while it is error active, it then destroys the frame for all. Otherwise it
      loses the frame alone.
    - `recovery`: a controller in bus-off recovers by itself, after 128 times 11 recessive bits.
    - `listen_only`: the controller puts no dominant bit on the bus (bus monitoring mode): it neither sends nor
      acknowledges, an error that only it sees destroys no frame, and its error counters stay 0.
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
    listen_only: bool = False


class FrameRecord(msgspec.Struct, frozen=True, gc=False):
    """An event on the wire: one frame, or one attempt that ended with an error frame.

    `start` and `end` are true time, in ns: start of frame, and end of the frame or of the error frame; `bits` lie
    between them. With several senders, they sent the same bits or collided.
    """

    start: int
    end: int
    frame: AnyFrame
    senders: tuple[str, ...]
    bits: int
    error: ErrorKind | None


class BusError(msgspec.Struct, frozen=True):
    """An error frame, as one controller sees its beginning.

    `kind`: what this controller has detected; those that did not detect the error itself see the error flag of the
    others, a stuff error or a form error. `bit`: the number of the bit, from the start of frame on, counted from 1,
    with stuff bits; it lies in `field`. `sending`: this controller was sending the frame.
    """

    kind: ErrorKind
    bit: int
    field: FrameField
    sending: bool


class ArbitrationLoss(msgspec.Struct, frozen=True, gc=False):
    """An arbitration that a node lost: its frame, the start of frame, and when the node gave up (true time, ns)."""

    start: int
    end: int
    frame: AnyFrame
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
    """Totals, and counts by identifier and by node. A frame that several nodes sent as one counts for each of them.

    Frames with 29-bit identifiers are counted by the message id that RTCAN has in them, so there are at most 65536
    counts of them; those with 11-bit identifiers by the whole identifier. Remote frames count for their identifier.
    """

    def __init__(self, bit: int, since: int) -> None:
        """`bit`: the length of a bit in ns. `since`: the instant from which the load counts, in ns."""
        self.since = since
        self._bit = bit
        # by message id and senders; an 11-bit identifier as its complement, which is negative
        self._counts: defaultdict[tuple[int, tuple[str, ...]], Count] = defaultdict(Count)

    @property
    def total(self) -> Count:
        total = Count()
        for count in self._counts.values():
            total.add(count)
        return total

    @property
    def by_message(self) -> dict[int, Count]:
        """Counts of frames with 29-bit identifiers, by message id."""
        return self._by_key(lambda key: key if key >= 0 else None)

    @property
    def by_standard_id(self) -> dict[int, Count]:
        """Counts of frames with 11-bit identifiers, by identifier."""
        return self._by_key(lambda key: ~key if key < 0 else None)

    @property
    def by_node(self) -> dict[str, Count]:
        counts: defaultdict[str, Count] = defaultdict(Count)
        for (_, senders), count in self._counts.items():
            for name in senders:
                counts[name].add(count)
        return dict(counts)

    def add(self, record: FrameRecord) -> None:
        """Count a frame or a failed attempt."""
        frame = record.frame
        count = self._counts[message_of(frame.id) if frame.extended else ~frame.id, record.senders]
        if record.error is None:
            count.frames += 1
            count.bits += record.bits
        else:
            count.errors += 1
            count.error_bits += record.bits

    def add_lost(self, name: str, frame: AnyFrame) -> None:
        """Count an arbitration that this node lost with this frame."""
        self._counts[message_of(frame.id) if frame.extended else ~frame.id, (name,)].lost += 1

    def load(self, now: int) -> float:
        """Return the share of the time up to `now` (ns) in which the bus was occupied: 1.0 is saturated."""
        elapsed = now - self.since
        return self.total.occupied * self._bit / elapsed if elapsed > 0 else 0.0

    def _by_key(self, shown: Callable[[int], int | None]) -> dict[int, Count]:
        counts: defaultdict[int, Count] = defaultdict(Count)
        for (key, _), count in self._counts.items():
            number = shown(key)
            if number is not None:
                counts[number].add(count)
        return dict(counts)
