"""The order of events on a bus, and of the timers of its nodes: a list of instants under one timer of the loop.

Turning asyncio's loop for each event would cost more than the event. So under virtual time the loop runs ahead through
this list, for as long as nothing else is due: the same events at the same instants, only faster. On an ordinary loop
what has become due is carried out; an event that the loop made late still has its own instant, `now()`.
"""

from __future__ import annotations

from bisect import insort
from typing import TYPE_CHECKING, Any, Protocol

from r2p.clock import Alarm, clock_of
from r2p.sim.loop import VirtualLoop

if TYPE_CHECKING:
    import asyncio
    from collections.abc import Callable

    from r2p.sim.loop import Event


class TimelineTimer:
    """One call in the future, which can be cancelled."""

    __slots__ = ("_args", "_callback")

    def __init__(self, callback: Callable[..., object], args: tuple[Any, ...]) -> None:
        self._callback: Callable[..., object] | None = callback
        self._args = args

    def cancel(self) -> None:
        """Let it not happen, unless it has."""
        self._callback = None

    def fire(self) -> None:
        """Call it now, once."""
        callback, self._callback = self._callback, None
        if callback is not None:
            callback(*self._args)


class TimelineSource(Protocol):
    """A clock that can be read."""

    @property
    def elapsed(self) -> int:
        """Monotonic ns."""
        ...


class Timeline:
    """Calls at instants of the loop's monotonic clock, in ns; those of one instant in the order they were made."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self.clock = clock_of(loop)
        self._events: list[Event] = []  # sorted: there are a few for each node, so few that a heap takes longer
        self._number = 0
        self._alarm = Alarm(loop, self._run, background=True)
        self._virtual = loop if isinstance(loop, VirtualLoop) and loop.clock.virtual else None
        self._running = False
        self._now = 0
        self.source: TimelineSource = self if self._virtual is None else self._virtual.clock
        """Where `now` comes from, for those who ask often: `elapsed` is the same without a call."""
        self.now: Callable[[], int] = self.clock.monotonic if self._virtual else self._present
        """The instant of the event that is being carried out; else what the clock says."""

    @property
    def elapsed(self) -> int:
        """As `now()`, on an ordinary loop."""
        return self._present()

    def at(self, when: int, callback: Callable[..., object], *args: Any) -> None:
        """Call it at `when`; an instant that is over is now."""
        self._number = number = self._number + 1
        insort(self._events, (when, number, callback, args))
        if not self._running and self._events[0][1] == number:
            self._alarm.set(when)

    def timer(self, when: int, callback: Callable[..., object], *args: Any) -> TimelineTimer:
        """As `at`, and can be cancelled."""
        timer = TimelineTimer(callback, args)
        self.at(when, timer.fire)
        return timer

    def catch_up(self) -> None:
        """On an ordinary loop, carry out what is due: for whoever is about to act in the present."""
        if self._virtual is None and not self._running:
            self._run()

    def close(self) -> None:
        """Nothing happens any more, until the next `at`."""
        self._events.clear()
        self._alarm.close()

    def _run(self) -> None:
        self._running = True
        try:
            if self._virtual:
                self._virtual.run_ahead(self._events)
            else:
                self._run_due(self.clock.monotonic())
        finally:  # an event that raises goes to the loop's exception handler; the next one comes all the same
            self._running = False
            self._now = 0
            if self._events:
                self._alarm.set(self._events[0][0])

    def _present(self) -> int:
        return self._now or self.clock.monotonic()

    def _run_due(self, present: int) -> None:
        events = self._events
        while events and events[0][0] <= present:
            when, _, callback, args = events.pop(0)
            self._now = max(self._now, when)
            callback(*args)
