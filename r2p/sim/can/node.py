"""What a node on the bus is: its controller's settings, its clock, its delays, its bad luck."""

from __future__ import annotations

from enum import Enum
from typing import TYPE_CHECKING, Final

import msgspec

from r2p.codecs.rtcan import Frame  # noqa: TC001 - msgspec looks up the types of fields

if TYPE_CHECKING:
    import random
    from collections.abc import Callable

    from r2p.sim.can.timeline import Timeline

NEVER: Final = 1 << 63
_BILLION: Final = 1_000_000_000


class ControllerState(Enum):
    """How far a controller trusts itself (its error counters say so), and whether it has power."""

    ACTIVE = "error active"
    PASSIVE = "error passive"  # over 127: its error flags destroy nobody's frame, and it waits longer between frames
    BUS_OFF = "bus off"  # over 255: it takes no part
    DOWN = "down"  # no power


class ErrorKind(Enum):
    """Why a frame did not get through."""

    ACK = "no acknowledge"  # nobody else is there
    BIT = "bit error"  # the bus had another level than the sender: noise, or another sender
    STUFF = "stuff error"  # the sender died in the middle
    BUS_OFF = "bus off"  # the sender's controller gave up; this frame waited


class Latency(msgspec.Struct, frozen=True):
    """A delay of `nominal` ns, off by up to `jitter` ns either way, evenly spread; `jitter` is at most `nominal`."""

    nominal: int = 0
    jitter: int = 0

    def __post_init__(self) -> None:
        if not 0 <= self.jitter <= self.nominal:
            raise ValueError(f"{self.nominal} ns with a jitter of {self.jitter} ns: a delay is never negative")

    def drawer(self, numbers: random.Random) -> Callable[[], int]:
        """What gives one delay after the other, in ns."""
        if not self.jitter:
            return lambda: self.nominal
        shortest, span, draw = self.nominal - self.jitter, 2 * self.jitter + 1, numbers.random
        return lambda: shortest + int(draw() * span)


class CanNode(msgspec.Struct, frozen=True):
    """The settings of one node.

    - `one_shot`: a frame that loses arbitration, or is destroyed, is given up and reported. Else it is sent again.
    - `mailboxes`: how many frames the controller holds; of those it tries the lowest identifier first.
    - `offset` (ns) and `drift_ppm`: how the node's clock differs from true time, which is that of the loop.
    - `transmit`: from the request to the moment when the controller is ready to send. `receive`: from the end of a
      frame (or the loss, or the error) to the moment when the node hears of it, and stamps it.
    - `loss`: the share of received frames that its software loses. `noise`: the share of received frames in which this
      node alone sees a bit error; while it is error active, it then destroys the frame for all.
    - `recovery`: a controller in bus-off comes back by itself, after 128 times 11 recessive bits.
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
    """What really happened: one frame, or an attempt at one.

    `start` and `end` are true time, in ns: start of frame, and end of frame or of the error frame; `bits` lie between
    them. More than one sender: they sent the same bits, or collided.
    """

    start: int
    end: int
    frame: Frame
    senders: tuple[str, ...]
    bits: int
    error: ErrorKind | None


class LocalClock:
    """A node's clock: runs too fast by `drift_ppm`, and was set `offset` ns ahead at true time 0."""

    def __init__(self, timeline: Timeline, offset: int, drift_ppm: float) -> None:
        self.virtual = timeline.clock.virtual
        self._timeline = timeline
        self._source = timeline.source
        self._offset = offset
        self._drift = round(drift_ppm * 1000)  # ns a second
        self._second = _BILLION + self._drift  # what it shows of a true one
        self._true = self._local = -1  # the latest conversion: what happens at one instant asks again and again

    def monotonic(self) -> int:
        """What this clock shows now, in ns."""
        true = self._source.elapsed
        return self._local if true == self._true else self.local(true)

    def now(self) -> int:
        """UTC in ns, as this node has it."""
        true = self._source.elapsed
        ahead = self.local(true) - true
        return self._timeline.clock.now() + ahead

    def local(self, true: int) -> int:
        """What this clock shows at that true instant."""
        if true != self._true:
            self._true = true
            self._local = true + self._offset + true * self._drift // _BILLION
        return self._local

    def true(self, local: int) -> int:
        """The first true instant at which this clock shows `local`, or more."""
        since = local - self._offset
        return since - since * self._drift // self._second


class LocalAlarm:
    """One timer that can be moved, on a node's clock: calls `callback()` when that shows the deadline, or more.

    Putting it off costs nothing: when it goes off too early, it looks again.
    """

    def __init__(self, timeline: Timeline, clock: LocalClock, callback: Callable[[], object]) -> None:
        self._timeline = timeline
        self._clock = clock
        self._callback = callback
        self._deadline: int | None = None
        self._due = 0  # the true instant of the deadline
        self._armed = NEVER  # when it looks; may be earlier

    def set(self, deadline: int | None) -> None:
        """Move to this local instant, in ns; what is over is now. None: off."""
        if deadline == self._deadline:
            return
        self._deadline = deadline
        if deadline is not None:
            self._due = due = self._clock.true(deadline)
            if due < self._armed:
                self._armed = due
                self._timeline.at(due, self._look, due)

    def close(self) -> None:
        """Switch it off."""
        self._deadline = None

    def _look(self, armed: int) -> None:
        if armed != self._armed:
            return  # it was armed for an earlier instant since
        self._armed = NEVER
        if self._deadline is None:
            return
        if self._due > armed:
            self._armed = self._due
            self._timeline.at(self._due, self._look, self._due)
            return
        self._deadline = None
        self._callback()
