"""Listening to an RTCAN bus: every frame in words, the true load, the use of the slots. Nothing is ever sent.

    from r2p.bus import BusMonitor

    async with BusMonitor("rtcan:can0") as bus:
        async for seen in bus:
            print(seen.kind.value, seen.topic, seen.frame.data.hex())

`Calendar` is the master's own: it plans reservations without a bus.

The port is the same that a module would use; behind it is a monitor instead of an engine.
"""

import asyncio
from collections import deque
from collections.abc import AsyncIterator, Callable
from types import TracebackType
from typing import TYPE_CHECKING, Self

from r2p.clock import clock_of
from r2p.codecs.rtcan import Frame, OtherFrame
from r2p.durations import SHORTEST, seconds
from r2p.protocols.rtcan.calendar import Calendar, Refusal, Reservation, occupied
from r2p.protocols.rtcan.cycle import Timing, timing
from r2p.protocols.rtcan.events import Mailbox, Outcome
from r2p.protocols.rtcan.monitor import BusLoad, BusSlot, FrameKind, Monitor, SeenFrame
from r2p.transports.stats import LoggedCounter
from r2p.transports.url import parse

if TYPE_CHECKING:
    from r2p.transports.can.port import CanPort

__all__ = [
    "BusLoad",
    "BusMonitor",
    "BusSlot",
    "Calendar",
    "FrameKind",
    "Refusal",
    "Reservation",
    "SeenFrame",
    "Timing",
    "occupied",
    "timing",
]

QUEUE = 8192
"""Frames that wait for the iteration before the oldest are lost, counted."""

_SECOND = 1_000_000_000
_LOOK = 10_000_000  # ns between two looks whether frames of a period that is over are still to be read
_QUIET = 4  # looks without any, after which there are none
_LATE = 500_000_000  # ns: more than a busy computer takes
_STOPPED = 40_000_000  # ns that a look took longer: the process stood still, what came meanwhile is not read yet


class BusMonitor:
    """A silent listener on a CAN bus.

    `via` is an rtcan: URL, or a port; the options `bitrate`, `slots` and `cycle` matter until the master has told its
    own. `on_news` gets what happens to the interface, in words. Instants are ns of the port's clock.
    """

    def __init__(self, via: "str | CanPort", *, on_news: Callable[[str], object] | None = None) -> None:
        self.via = via if isinstance(via, str) else via.name
        self.since = 0
        """When it was opened."""
        self.lost = 0
        """Frames that the iteration was too slow for."""
        self._port = None if isinstance(via, str) else via
        self._tell = on_news or (lambda _text: None)
        self._queue: deque[SeenFrame] = deque(maxlen=QUEUE)
        self._wanted = False
        self._trouble = ""
        self._arrived = asyncio.Event()
        self._synced = asyncio.Event()
        self._running: asyncio.Task[None] | None = None

    async def __aenter__(self) -> Self:
        """Open the bus. Raises TransportError for a URL that can't work; an interface that is down is waited for."""
        from r2p.transports.rtcan import open_port  # not at the top: only who listens to a bus needs it
        from r2p.transports.rtcan.options import RtcanOptions

        if self._port is None:
            port, options = open_port(parse(self.via))
        else:
            port, options = self._port, RtcanOptions()
        self._errors = LoggedCounter(self.via, clock_of())
        self._now = port.now
        self.since = self._now()
        self._monitor = Monitor(options.timing)
        self._monitor.reset(self.since)
        port.set_filters(None)
        opened = asyncio.Event()
        self._running = asyncio.create_task(port.run(self, opened.set), name=f"listen {self.via}")
        self._running.add_done_callback(self._wake)
        waiting = asyncio.create_task(opened.wait())
        try:
            await asyncio.wait([waiting, self._running], return_when=asyncio.FIRST_COMPLETED)
            self._check()
        except BaseException:  # cancelled, too: who does not come to the block does not leave it either
            await self._close()
            raise
        finally:
            waiting.cancel()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close it, and wait for the end."""
        await self._close()

    async def _close(self) -> None:
        if self._running is not None:
            self._running.cancel()
            await asyncio.wait([self._running])

    def _check(self) -> None:
        """Raise what ended the port."""
        if self._running is not None and self._running.done() and not self._running.cancelled():
            self._running.result()

    def _wake(self, _done: object) -> None:
        self._arrived.set()
        self._synced.set()

    # What is known

    @property
    def timing(self) -> Timing:
        """The slots of the cycle: as the master tells, else as the URL says."""
        return self._monitor.census.timing

    @property
    def slots(self) -> list[BusSlot]:
        """The use of each slot, over `slot_cycles` whole cycles."""
        return self._monitor.slots

    @property
    def slot_cycles(self) -> int:
        return self._monitor.cycles

    async def __aiter__(self) -> AsyncIterator[SeenFrame]:
        """Every frame, from now on."""
        self._wanted = True
        while True:
            while self._queue:
                yield self._queue.popleft()
            self._check()
            self._arrived.clear()
            await self._arrived.wait()

    async def loads(self, period: float) -> AsyncIterator[BusLoad]:
        """What the bus carried, every `period` seconds; by the time at which it did, also when this program is late.

        Raises MessageError for what is not a number of seconds.
        """
        seconds("the period of loads", period, least=SHORTEST)
        length = round(period * _SECOND)
        end = self._now()
        self._monitor.begin(end, length)
        while True:
            end += length
            await self._read_until(end)
            self._check()
            yield self._monitor.next_load()

    async def _read_until(self, end: int) -> None:
        """Wait until all frames are read that were on the bus until then."""
        if (left := end - self._now()) > 0:
            await self._sleep(left)
        quiet = 0
        while self._monitor.heard < end and quiet < _QUIET:
            heard, before = self._monitor.heard, self._now()
            late = await self._sleep(_LOOK)
            quiet = quiet + 1 if self._monitor.heard == heard and before >= end and late < _STOPPED else 0

    async def _sleep(self, duration: int) -> int:
        """Sleep for so many ns, and return how many it took longer."""
        due = self._now() + duration
        await asyncio.sleep(duration / _SECOND)
        late = self._now() - due
        if late > _LATE:
            self._tell(f"this program stood still for {late / _SECOND:.1f} s: frames that were not kept are missing")
        return late

    async def cycles(self, count: int, patience: float) -> bool:
        """Watch so many whole cycles. False: there was no sync for `patience` seconds.

        Raises MessageError for what is not a number of seconds.
        """
        seconds("the patience of cycles", patience, least=0.0)
        self._monitor.reset(self._now())
        while self._monitor.cycles < count:
            self._synced.clear()
            try:
                async with asyncio.timeout(patience):
                    await self._synced.wait()
            except TimeoutError:
                return False
            self._check()
        return True

    # For the port

    def received(self, frame: Frame, stamp: int) -> None:
        """A frame was on the bus until `stamp`."""
        self._saw(self._monitor.frame(frame, stamp))

    def other(self, frame: OtherFrame, stamp: int) -> None:
        """A frame that RTCAN does not use was on the bus until `stamp`."""
        self._saw(self._monitor.other(frame, stamp))

    def _saw(self, seen: SeenFrame) -> None:
        if seen.kind is FrameKind.SYNC:
            self._synced.set()
        if self._wanted:
            self.lost += len(self._queue) == QUEUE
            self._queue.append(seen)
            self._arrived.set()

    def confirmed(self, mailbox: Mailbox, outcome: Outcome, at: int) -> None:
        """Nothing is sent, so nothing is confirmed."""

    def up(self) -> None:
        """The bus can be used."""
        self._trouble = ""
        self._tell(f"{self.via} is up")

    def down(self, reason: str) -> None:
        """It can't any more."""
        self._tell(f"{self.via} is down: {reason}")

    def waits(self, reason: str) -> None:
        """It can't yet: told once for each reason."""
        if reason != self._trouble:
            self._trouble = reason
            self._tell(f"{self.via}: {reason}; trying again")

    def fault(self, kind: str) -> None:
        """An error frame."""
        self._monitor.fault(kind)

    def internal_error(self, error: Exception) -> None:
        """A frame raised: it is logged, and the next one follows."""
        self._errors.internal_error(error)
