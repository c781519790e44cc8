"""What a program has of a simulated bus: one controller, which any thread may use, with calls that wait.

`python_can` puts python-can's interface around a `BusAttachment`. There are two kinds: `local` to a bus of this
process, `served` to one of another process. Neither knows python-can.
"""

import asyncio
from abc import ABC, abstractmethod
from collections.abc import Sequence

import msgspec

from r2p.clock import SystemClock
from r2p.codecs.can_bits import AnyFrame
from r2p.errors import MessageError
from r2p.sim.can import ControllerState, ErrorKind
from r2p.units import SECOND

TX_QUEUE = 128
"""Frames that wait for the wire in an attachment; those that the controller holds count as well."""

RX_QUEUE = 10_000
"""Frames that wait for `receive`, unless the options say otherwise: half a second of the shortest ones at 1 Mbit/s."""

BITRATE = 1_000_000
"""Bit/s of a bus that is made by an attachment which asks for no bit rate."""

FILTERS_MAX = 512
"""Filters of an attachment, at most: as many as Linux allows."""

_TIMEOUT_MAX = 1e9  # s
_IDENTIFIER_MAX = (1 << 32) - 1
_DRIFT_BELOW = 1_000_000  # ppm: a clock that goes backwards, or twice as fast
_OFFSET_MAX = 1_000_000_000 * SECOND  # some thirty years: stamps have 64 bits
_clock = SystemClock()


class BusFilter(msgspec.Struct, frozen=True):
    """Passes frames with `id & mask == value & mask`; `extended` chooses 29 bits, or 11, None takes both."""

    value: int
    mask: int
    extended: bool | None = None

    def __post_init__(self) -> None:
        numbers: tuple[object, ...] = self.value, self.mask
        for number in numbers:
            if not isinstance(number, int) or not 0 <= number <= _IDENTIFIER_MAX:
                raise MessageError(f"a filter has an identifier and a mask of at most 32 bits, not {number!r}")
        if self.extended not in (None, False, True):
            raise MessageError(f"a filter chooses extended identifiers by True, False or None, not {self.extended!r}")

    def passes(self, frame: AnyFrame) -> bool:
        """Return whether a frame passes."""
        return not (frame.id ^ self.value) & self.mask and self.extended in (None, frame.extended)


class AttachmentOptions(msgspec.Struct, frozen=True, kw_only=True):
    """How to attach to a bus.

    For the bus, if this attachment makes it: `noise`, the share of frames with a bit error, and `seed`. `bitrate`
    (bit/s) is that of the bus that is made; if there is one already, its bit rate has to be this one. None: any.

    For the node, as in `CanNode`: `name` (followed by a number if it is in use), `one_shot`, `offset` (ns) and
    `drift_ppm` of its clock, `loss`. `recovery`: it leaves bus-off by itself. `listen_only`: it sends nothing, no
    acknowledge either, so that the bus is as it is without it.

    For what is received: `own` frames too, when they have been sent; `states`: changes of the controller's state;
    `errors`: each attempt to send that was destroyed, also those of other nodes (a node that is alone on a bus has one
    after the other); `filters`: frames that pass one of them, or all if there is none; `rx_queue`: how many events
    wait, at most, and the oldest ones are dropped for newer ones.

    `served`: True takes a bus of another process only, False none of another process. None: whichever there is.
    """

    bitrate: int | None = None
    noise: float = 0.0
    seed: int | None = None
    name: str = "python-can"
    one_shot: bool = False
    offset: int = 0
    drift_ppm: float = 0.0
    loss: float = 0.0
    recovery: bool = False
    listen_only: bool = False
    own: bool = False
    states: bool = True
    errors: bool = False
    filters: tuple[BusFilter, ...] = ()
    rx_queue: int = RX_QUEUE
    served: bool | None = None

    def __post_init__(self) -> None:
        if self.bitrate is not None and (self.bitrate <= 0 or 1_000_000_000 % self.bitrate):
            raise MessageError(f"at {self.bitrate} bit/s a bit does not take whole nanoseconds")
        for name, share in (("noise", self.noise), ("loss", self.loss)):
            if not 0.0 <= share <= 1.0:
                raise MessageError(f"{name} is a share, 0.0 to 1.0, not {share}")
        if self.rx_queue < 1:
            raise MessageError(f"at least one frame has to fit the queue of received frames, not {self.rx_queue}")
        if not abs(self.drift_ppm) < _DRIFT_BELOW:
            raise MessageError(f"a clock drifts by less than {_DRIFT_BELOW} ppm, not {self.drift_ppm}")
        if abs(self.offset) > _OFFSET_MAX:
            raise MessageError(f"a clock's offset is at most {_OFFSET_MAX // SECOND} s")
        check_filters(self.filters)


def check_filters(filters: Sequence[BusFilter]) -> tuple[BusFilter, ...]:
    """Return these filters. Raises `MessageError` if there are too many."""
    if len(filters) > FILTERS_MAX:
        raise MessageError(f"{len(filters)} filters, of {FILTERS_MAX} at most: give some of them one mask")
    return tuple(filters)


def deadline_of(timeout: float | None) -> int | None:
    """Return when a call gives up that may take `timeout` seconds: by the system's monotonic clock, in ns; None: never.

    What is below 0, or not a number, is 0.
    """
    if timeout is None:
        return None
    return _clock.monotonic() + round(max(0.0, min(timeout, _TIMEOUT_MAX)) * SECOND)  # in this order: max(0, nan) is 0


class BusFrame(msgspec.Struct, frozen=True, gc=False):
    """An event on the bus, as an attachment receives it.

    With a `frame`: a good one; `own`, if this attachment has sent it. With `error`: an error frame, as this controller
    sees it, `own` if it was sending; `place` is the number that SocketCAN has for the field of the frame in which the
    error was (`FrameField`), 0 if it is not known. With `state`: this controller's state is another one.

    `end` is the end of the frame, or the detection of the error, by the clock of this node (ns), and `utc` the same
    since 1970: of one bus, differences of both are exact. The error counters are this controller's; they count where
    there is an error or a state.
    """

    frame: AnyFrame | None
    end: int
    utc: int
    own: bool = False
    error: ErrorKind | None = None
    place: int = 0
    state: ControllerState | None = None
    tx_errors: int = 0
    rx_errors: int = 0


class BusClock:
    """The clock of a bus, which was at `now` at the instant `since` of the computer's monotonic clock (both ns)."""

    def __init__(self, now: int, since: int, speed: float = 1.0) -> None:
        self.speed = speed
        """How many times as fast as real time it goes."""
        self.at, self.since = now, since

    def now(self) -> int:
        """Return the time on the bus (ns). All processes have the computer's monotonic clock."""
        elapsed = _clock.monotonic() - self.since
        return self.at + (elapsed if self.speed == 1.0 else round(elapsed * self.speed))


class BusAttachment(ABC):
    """One controller at a bus. All methods may be called from any thread, at once.

    They raise `Closed` after `close`, and `TransportError` with the reason when the bus has ended.
    """

    description: str
    """Where the bus is, for people: "lab: a bus of this process, 1000000 bit/s"."""
    bitrate: int
    """Bit/s."""
    clock: BusClock
    """The clock of the bus; that of a bus under virtual time does not say anything."""

    @abstractmethod
    def send(self, frame: AnyFrame, timeout: float | None = None) -> None:
        """Put a frame into the queue of `TX_QUEUE` frames, which leave it in this order; wait for room.

        `timeout` in seconds, 0 does not wait; None waits as long as frames leave the queue at all. Raises TimeoutError
        when there is no room in time, `TransportError` in bus-off, and if the attachment is listen-only.
        """

    @abstractmethod
    def receive(self, timeout: float | None = None) -> BusFrame | None:
        """Wait up to `timeout` seconds (None: forever) for the next event, and return it, or None if none came.

        In the thread of the event loop that runs the bus, no frame would arrive while this waits, so a timeout other
        than 0 raises `Error` there if the queue is empty.
        """

    @abstractmethod
    def set_filters(self, filters: Sequence[BusFilter]) -> None:
        """From now on, receive only frames that pass one of these filters; without filters, all. Errors always pass.

        Raises `MessageError` for more than `FILTERS_MAX`.
        """

    @property
    @abstractmethod
    def state(self) -> ControllerState:
        """The state of the controller."""

    @property
    @abstractmethod
    def error_counters(self) -> tuple[int, int]:
        """The transmit and receive error counters of the controller."""

    @property
    @abstractmethod
    def lost(self) -> int:
        """Frames that were dropped because nothing received them in time; the log reports the first one."""

    @abstractmethod
    def flush(self) -> None:
        """Drop the frames that wait for the wire; one whose start of frame has begun is sent."""

    @abstractmethod
    def restart(self) -> None:
        """Leave bus-off, after 128 times 11 recessive bits. Nothing happens in another state."""

    def here(self) -> asyncio.AbstractEventLoop | None:
        """Return the event loop that runs the bus, if it is that of this thread."""
        return None

    @abstractmethod
    def fileno(self) -> int:
        """Return a descriptor that is readable while `receive(0)` has an event or raises an error.

        After `close` it is never readable. It exists as long as the attachment does: an event loop that still watches
        it must not find another file of the same number.
        """

    @abstractmethod
    def close(self) -> None:
        """Leave the bus; may be called again. Calls that wait raise `Closed`.

        Frames that wait are still sent, if that takes no longer than a second, and if somebody else is on the bus.
        """
