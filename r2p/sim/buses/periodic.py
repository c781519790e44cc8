"""Messages that a program sends again and again by python-can's `send_periodic`, in an event loop or in a thread.

python-can's own task prints a traceback when `send` fails, and ends. Here a message that finds no room within a period
is lost and counted, as Linux's broadcast manager loses it, and the next one is tried; whatever else fails ends the
task, and the log says so in words.
"""

from __future__ import annotations

import threading
from abc import ABC
from typing import TYPE_CHECKING, Final

import can
from can.broadcastmanager import LimitedDurationCyclicSendTaskABC, ModifiableCyclicTaskABC, RestartableCyclicTaskABC

from r2p.clock import SystemClock, in_background
from r2p.log_lines import get_logger
from r2p.units import SECOND

if TYPE_CHECKING:
    import asyncio
    from collections.abc import Callable, Sequence

logger = get_logger("r2p.buses")

_clock: Final = SystemClock()


class PeriodicMessages(LimitedDurationCyclicSendTaskABC, ModifiableCyclicTaskABC, RestartableCyclicTaskABC, ABC):
    """What sends messages periodically, one after the other, for `duration` seconds or until it is stopped."""

    lost: int = 0
    """Messages that found no room in the queue within a period."""

    def __init__(
        self,
        bus: can.BusABC,
        messages: Sequence[can.Message] | can.Message,
        period: float,
        duration: float | None,
        modifier_callback: Callable[[can.Message], None] | None,
    ) -> None:
        if not period > 0:
            raise ValueError(f"a period is more than 0 s, not {period}")
        super().__init__(messages, period, duration)
        self._bus = bus
        self._modify = modifier_callback

    def _over(self, count: int) -> bool:
        """Return whether the duration is over before the `count`-th message, from 0."""
        return bool(self.duration) and count * self.period >= (self.duration or 0.0)

    def _send(self, count: int) -> None:
        """Send the `count`-th message. Raises what `send` does, but for a queue that stays full."""
        message = self.messages[count % len(self.messages)]
        if self._modify is not None:
            self._modify(message)
        try:
            self._bus.send(message, self.period)
        except can.exceptions.CanTimeoutError as error:
            self.lost += 1
            if self.lost == 1:
                logger.warning("%s; messages of send_periodic are lost, and counted in the task's lost", error)

    def _send_or_end(self, count: int, stopped: Callable[[], bool] = lambda: False) -> bool:
        """Send the `count`-th message. If the bus no longer takes it, log that and return False."""
        try:
            self._send(count)
        except (can.CanError, ValueError) as error:
            if not stopped():  # as when the bus is shut down meanwhile
                logger.error("%s; send_periodic has ended", error)
            return False
        return True


class LoopCyclicSendTask(PeriodicMessages):
    """Sends in the event loop that runs the bus, at exact instants under virtual time. Used there only."""

    def __init__(
        self,
        bus: can.BusABC,
        loop: asyncio.AbstractEventLoop,
        messages: Sequence[can.Message] | can.Message,
        period: float,
        duration: float | None,
        modifier_callback: Callable[[can.Message], None] | None,
    ) -> None:
        super().__init__(bus, messages, period, duration, modifier_callback)
        self._loop = loop
        self._timer: asyncio.TimerHandle | None = None
        self._started = 0.0
        self._count = 0

    def start(self) -> None:
        """Send the first message now; nothing happens if it sends already. Raises what `send` does."""
        if self._timer is None:
            self._started, self._count = self._loop.time(), 0
            self._send(0)
            self._next()

    def stop(self) -> None:
        """Send no more."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _next(self) -> None:
        self._count += 1
        self._timer = self._loop.call_at(self._started + self._count * self.period, self._tick)
        in_background(self._timer)

    def _tick(self) -> None:
        self._timer = None
        if not self._over(self._count) and self._send_or_end(self._count):
            self._next()


class ThreadCyclicSendTask(PeriodicMessages):
    """Sends in a thread of its own, for a bus that this thread's event loop does not run."""

    def __init__(
        self,
        bus: can.BusABC,
        messages: Sequence[can.Message] | can.Message,
        period: float,
        duration: float | None,
        modifier_callback: Callable[[can.Message], None] | None,
    ) -> None:
        super().__init__(bus, messages, period, duration, modifier_callback)
        self._stopped = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Send the first message now; nothing happens if it sends already."""
        if not self.thread_runs or self._stopped.is_set():
            self._stopped = threading.Event()
            name = f"send_periodic 0x{self.messages[0].arbitration_id:X}"
            self._thread = threading.Thread(target=self._run, args=(self._stopped,), name=name, daemon=True)
            self._thread.start()

    @property
    def thread_runs(self) -> bool:
        """Whether the task has not ended."""
        return self._thread is not None and self._thread.is_alive()

    def stop(self) -> None:
        """Send no more; a message whose `send` has begun may still be sent."""
        self._stopped.set()

    def _run(self, stopped: threading.Event) -> None:
        started = _clock.monotonic()
        count = 0
        while not stopped.is_set() and not self._over(count) and self._send_or_end(count, stopped.is_set):
            count += 1
            stopped.wait(max(0.0, (started - _clock.monotonic()) / SECOND + count * self.period))
