"""A listener on an RTCAN bus: describes every frame, the true load, the use of the slots. It never sends.

    from r2p.bus import BusMonitor

    async with BusMonitor("rtcan:can0") as bus:
        async for seen in bus:
            print(seen.kind.value, seen.topic, seen.frame.data.hex())

`Calendar` is the master's: here it plans reservations without a bus. `PeriodRule` says which periods go together.

The port is that of a module, with a `Monitor` in place of an engine.
"""

import asyncio
from collections import deque
from collections.abc import AsyncIterator, Callable
from typing import TYPE_CHECKING, Self

from r2p.clock import SHORTEST, check_seconds, clock_of
from r2p.codecs import PublisherClass
from r2p.codecs.rtcan import Frame, OtherFrame
from r2p.errors import Closed, Error
from r2p.protocols.can_orders import Mailbox, Outcome
from r2p.protocols.rtcan.calendar import Calendar, PeriodRule, Refusal, Reservation, asked_exactly, occupied
from r2p.protocols.rtcan.cycle import Timing, timing
from r2p.protocols.rtcan.leases import owners_kept
from r2p.protocols.rtcan.monitor import BusLoad, BusSlot, FrameKind, Monitor, SeenFrame
from r2p.transports.stats import LoggedCounter
from r2p.transports.url import parse
from r2p.units import SECOND

if TYPE_CHECKING:
    from r2p.transports.can.port import CanPort

__all__ = [
    "BusLoad",
    "BusMonitor",
    "BusSlot",
    "Calendar",
    "FrameKind",
    "PeriodRule",
    "Refusal",
    "Reservation",
    "SeenFrame",
    "Timing",
    "asked_exactly",
    "occupied",
    "owners_kept",
    "timing",
]

QUEUE_MAX = 8192
"""Unread frames at most: a second of a saturated bus. Then the oldest are dropped and counted."""
_PUBLISHER_CLASSES = frozenset(map(int, PublisherClass))

# After a period, frames of it may still be unread. These decide when none are left.
_CHECK_INTERVAL = 10_000_000  # ns
_QUIET_CHECKS = 4  # checks in a row without a new frame
_STALLED = 40_000_000  # ns by which a check is late when the process stood still, with frames still unread
_STALL_REPORTED = 500_000_000  # ns: longer than a busy computer delays a program


class BusMonitor:
    """A silent listener on a CAN bus.

    `via` is an rtcan: URL, or a port. Its options `bitrate`, `slots` and `cycle` matter until the master has announced
    its own. `on_status` is called with a text when the interface goes up or down. Instants are ns of the port's clock.
    """

    def __init__(self, via: "str | CanPort", *, on_status: Callable[[str], object] | None = None) -> None:
        self.via = via if isinstance(via, str) else via.name
        self.since = 0
        """The instant when the bus was opened."""
        self.lost = 0
        """Frames dropped because an iteration was too slow."""
        self._port = None if isinstance(via, str) else via
        self._report = on_status or (lambda _text: None)
        self._queues: list[deque[SeenFrame]] = []  # one for each iteration, while it lasts
        self._waits_for = ""
        self._arrived = asyncio.Event()
        self._synced = asyncio.Event()
        self._running: asyncio.Task[None] | None = None

    async def __aenter__(self) -> Self:
        """Open the bus. Raises TransportError for a URL that can't work, and Error if it was open before.

        Wait for an interface that is down.
        """
        if self._running is not None:
            raise Error(f"the monitor of {self.via} was opened before: make a new one")
        # Not at the top: `Calendar` works without a bus, and the transport takes long to load.
        from r2p.transports.rtcan.transport import RtcanOptions, from_url

        if self._port is None:
            transport = from_url(parse(self.via))
            port, options = transport.make_port(), transport.options
            port.listen_only = True
        else:
            port, options = self._port, RtcanOptions()
        self._errors = LoggedCounter(self.via, clock_of())
        self._now = port.now
        self._monitor = Monitor(options.timing)
        port.set_filters(None)
        opened = asyncio.Event()

        def begin() -> None:
            self.since = self._now()
            self._monitor.reset(self.since)
            opened.set()

        self._running = asyncio.create_task(port.run(self, begin), name=f"listen {self.via}")
        self._running.add_done_callback(self._wake)
        waiting = asyncio.create_task(opened.wait())
        try:
            await asyncio.wait([waiting, self._running], return_when=asyncio.FIRST_COMPLETED)
            self._check()
        except BaseException:  # also when cancelled: `__aexit__` is not called then
            await self._close()
            raise
        finally:
            waiting.cancel()
        return self

    async def __aexit__(self, *_: object) -> None:
        """Close the bus, and wait until it is closed."""
        await self._close()

    async def _close(self) -> None:
        if self._running is not None:
            self._running.cancel()
            await asyncio.wait([self._running])

    def _check(self) -> None:
        """Raise the error that ended the port, or Closed if the monitor is closed."""
        if self._running is None or self._running.cancelled():
            raise self._closed()
        if self._running.done():
            self._running.result()

    def _closed(self) -> Closed:
        return Closed(f"the monitor of {self.via} is not open: use it in an `async with` block")

    def _opened_monitor(self) -> Monitor:
        """Return the monitor, which keeps its results after the bus was closed. Raises Closed before it was opened."""
        if self._running is None:
            raise self._closed()
        return self._monitor

    def _wake(self, _done: object) -> None:
        self._arrived.set()
        self._synced.set()

    # Results

    @property
    def timing(self) -> Timing:
        """The slots of the cycle, as the master announces them, else those of the URL."""
        return self._opened_monitor().directory.timing

    @property
    def slots(self) -> list[BusSlot]:
        """The use of each slot, over `slot_cycles` whole cycles."""
        return self._opened_monitor().slots

    @property
    def slot_cycles(self) -> int:
        """The number of whole cycles in `slots`."""
        return self._opened_monitor().cycles

    @property
    def publishers(self) -> dict[tuple[str, str], PublisherClass]:
        """The classes of publishers, by topic and module, that were announced since the bus was opened."""
        directory = self._opened_monitor().directory
        return {
            (topic, directory.modules.get(id8, f"id {id8}")): PublisherClass(known)
            for (id8, topic), known in directory.publishers.items()
            if known in _PUBLISHER_CLASSES
        }

    async def __aiter__(self) -> AsyncIterator[SeenFrame]:
        """Iterate over every frame from now on. Raises Closed outside of the `async with` block."""
        queue: deque[SeenFrame] = deque(maxlen=QUEUE_MAX)
        self._queues.append(queue)
        try:
            while True:
                while queue:
                    yield queue.popleft()
                self._check()
                self._arrived.clear()
                await self._arrived.wait()
        finally:  # after a `break` frames are neither kept nor counted as lost
            self._queues = [each for each in self._queues if each is not queue]

    async def loads(self, period: float) -> AsyncIterator[BusLoad]:
        """Iterate over the load of the bus in each `period` (seconds).

        Periods follow the frames' stamps, so the loads are right even when this program is late. Raises MessageError
        unless `period` is a number of seconds, and Closed outside of the `async with` block.
        """
        check_seconds("the period of loads", period, least=SHORTEST)
        self._check()
        length = round(period * SECOND)
        end = self._now()
        self._monitor.reset(end, length)
        while True:
            end += length
            await self._read_until(end)
            self._check()
            yield self._monitor.next_load()

    async def _read_until(self, end: int) -> None:
        """Wait until all frames that were on the bus before `end` are read."""
        if (left := end - self._now()) > 0:
            await self._sleep(left)
        quiet = 0
        while self._monitor.last_frame < end and quiet < _QUIET_CHECKS:
            last, before = self._monitor.last_frame, self._now()
            late = await self._sleep(_CHECK_INTERVAL)
            quiet = quiet + 1 if self._monitor.last_frame == last and before >= end and late < _STALLED else 0

    async def _sleep(self, duration: int) -> int:
        """Sleep for so many ns. Return how many ns too late the wake-up was."""
        due = self._now() + duration
        await asyncio.sleep(duration / SECOND)
        late = self._now() - due
        if late > _STALL_REPORTED:
            self._report(f"this program stood still for {late / SECOND:.1f} s: frames that were not kept are missing")
        return late

    async def cycles(self, count: int, timeout: float) -> bool:
        """Watch so many whole cycles. Return False if there was no sync for `timeout` seconds.

        Raises MessageError unless `timeout` is a number of seconds, and Closed outside of the `async with` block.
        """
        check_seconds("the timeout of cycles", timeout, least=0.0)
        self._check()
        self._monitor.reset(self._now())
        while self._monitor.cycles < count:
            self._synced.clear()
            try:
                async with asyncio.timeout(timeout):
                    await self._synced.wait()
            except TimeoutError:
                return False
            self._check()
        return True

    # Called by the port (`CanPortListener`)

    def on_frame(self, frame: Frame, stamp: int) -> None:
        self._saw(self._monitor.frame(frame, stamp))

    def on_other_frame(self, frame: OtherFrame, stamp: int) -> None:
        self._saw(self._monitor.other(frame, stamp))

    def _saw(self, seen: SeenFrame) -> None:
        if seen.kind is FrameKind.SYNC:
            self._synced.set()
        for queue in self._queues:
            self.lost += len(queue) == queue.maxlen
            queue.append(seen)
            self._arrived.set()

    def on_confirmed(self, mailbox: Mailbox, outcome: Outcome, at: int) -> None:
        pass  # nothing is sent, so nothing is confirmed

    def on_up(self) -> None:
        self._waits_for = ""
        self._report(f"{self.via} is up")

    def on_down(self, reason: str) -> None:
        self._report(f"{self.via} is down: {reason}")

    def on_waiting(self, reason: str) -> None:
        if reason != self._waits_for:  # each reason is reported once
            self._waits_for = reason
            self._report(f"{self.via}: {reason}; trying again")

    def on_fault(self, kind: str) -> None:
        self._monitor.fault(kind)

    def internal_error(self, error: Exception) -> None:
        self._errors.internal_error(error)
