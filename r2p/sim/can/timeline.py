"""The order of events on a bus in true time, and the clocks of its nodes.

All events of a bus are in one sorted list under one timer of the loop. An iteration of asyncio's loop for each event
would cost more than the event, so under virtual time the loop runs ahead through the list until something else is due:
the same events at the same instants, only faster. On an ordinary loop the events that are due are run; an event that
runs late still has its own instant, `now()`.
"""

from __future__ import annotations

from bisect import insort
from typing import TYPE_CHECKING, Any, Final, Protocol

from r2p.clock import Alarm, clock_of
from r2p.sim.loop import VirtualLoop
from r2p.units import NEVER, SECOND

if TYPE_CHECKING:
    import asyncio
    from collections.abc import Callable

    from r2p.sim.loop import Event


_TURN: Final = 200
"""Events in one turn of an ordinary loop: a bus that it can't keep up with is late, but leaves time for other tasks."""


class TimelineTimer:
    """A call in the future that can be cancelled."""

    __slots__ = ("_args", "_callback")

    def __init__(self, callback: Callable[..., object], args: tuple[Any, ...]) -> None:
        self._callback: Callable[..., object] | None = callback
        self._args = args

    def cancel(self) -> None:
        """Cancel the call, unless it has been made."""
        self._callback = None

    def fire(self) -> None:
        """Make the call now, once."""
        callback, self._callback = self._callback, None
        if callback is not None:
            callback(*self._args)


class TimelineSource(Protocol):
    """A clock with the time as an attribute: the timeline itself, or the clock of a `VirtualLoop`."""

    @property
    def elapsed(self) -> int:
        """Monotonic ns."""


class Timeline:
    """Makes calls at instants of the loop's monotonic clock, in ns; calls of one instant in the order of `at`."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self.clock = clock_of(loop)
        self._events: list[Event] = []  # sorted; a few for each node, and with so few a heap is slower
        self._number = 0
        self._alarm = Alarm(loop, self._run, background=True)
        self._virtual = loop if isinstance(loop, VirtualLoop) and loop.clock.virtual else None
        self._running = False
        self._now = 0
        self.source: TimelineSource = self if self._virtual is None else self._virtual.clock
        """The source of `now`; for hot paths, as `source.elapsed` is the same without a call."""
        self.now: Callable[[], int] = self.clock.monotonic if self._virtual else self._present
        """The instant of the event that is running; between events, the time."""

    @property
    def elapsed(self) -> int:
        """Return the same as `now()`, on an ordinary loop."""
        return self._present()

    def at(self, when: int, callback: Callable[..., object], *args: Any) -> None:
        """Call `callback(*args)` at `when`; as soon as possible if that is in the past."""
        self._number = number = self._number + 1
        insort(self._events, (when, number, callback, args))
        if not self._running and self._events[0][1] == number:
            self._alarm.set(when)

    def timer(self, when: int, callback: Callable[..., object], *args: Any) -> TimelineTimer:
        """Do the same as `at`, with a timer that can be cancelled."""
        timer = TimelineTimer(callback, args)
        self.at(when, timer.fire)
        return timer

    def catch_up(self) -> None:
        """Run due events on an ordinary loop, so that the following code runs in the present."""
        if self._virtual is None and not self._running:
            self._run()

    def close(self) -> None:
        """Drop all events; the next `at` starts anew."""
        self._events.clear()
        self._alarm.close()

    def _run(self) -> None:
        self._running = True
        try:
            if self._virtual:
                self._virtual.run_ahead(self._events)
            else:
                self._run_due(self.clock.monotonic())
        finally:  # an exception goes to the loop's exception handler; the next event still runs
            self._running = False
            self._now = 0
            if self._events:
                self._alarm.set(self._events[0][0])

    def _present(self) -> int:
        return self._now or self.clock.monotonic()

    def _run_due(self, present: int) -> None:
        events = self._events
        for _ in range(_TURN):
            if not events or events[0][0] > present:
                return
            when, _, callback, args = events.pop(0)
            self._now = max(self._now, when)
            callback(*args)


class LocalClock:
    """The clock of a node: too fast by `drift_ppm`, and `offset` ns ahead at true time 0."""

    def __init__(self, timeline: Timeline, offset: int, drift_ppm: float) -> None:
        self.virtual = timeline.clock.virtual
        self._timeline = timeline
        self._source = timeline.source
        self._offset = offset
        self._drift = round(drift_ppm * 1000)  # ns per second
        self._second = SECOND + self._drift  # local ns in a true second
        self._true = self._local = -1  # the latest conversion: at one instant it is needed again and again

    def monotonic(self) -> int:
        """Return the time of this clock, in ns."""
        true = self._source.elapsed
        return self._local if true == self._true else self.local(true)

    def now(self) -> int:
        """Return UTC in ns, as far as this node knows it."""
        true = self._source.elapsed
        ahead = self.local(true) - true
        return self._timeline.clock.now() + ahead

    def local(self, true: int) -> int:
        """Return what this clock shows at a true instant."""
        if true != self._true:
            self._true = true
            self._local = true + self._offset + true * self._drift // SECOND
        return self._local

    def true(self, local: int) -> int:
        """Return the first true instant at which this clock shows `local` or more."""
        since = local - self._offset
        return since - since * self._drift // self._second


class LocalAlarm:
    """A movable timer on a node's clock: calls `callback()` when the clock shows the deadline or more.

    A later deadline costs nothing: the event that was scheduled stays, and schedules another one if it comes too early.
    """

    def __init__(self, timeline: Timeline, clock: LocalClock, callback: Callable[[], object]) -> None:
        self._timeline = timeline
        self._clock = clock
        self._callback = callback
        self._deadline: int | None = None
        self._due = 0  # the true instant of the deadline
        self._armed = NEVER  # the instant of the scheduled event; may be earlier

    def set(self, deadline: int | None) -> None:
        """Set the deadline, in local ns; one in the past is now; None switches the timer off."""
        if deadline == self._deadline:
            return
        self._deadline = deadline
        if deadline is not None:
            self._due = due = self._clock.true(deadline)
            if due < self._armed:
                self._armed = due
                self._timeline.at(due, self._expire, due)

    def close(self) -> None:
        """Switch the timer off."""
        self._deadline = None

    def _expire(self, armed: int) -> None:
        if armed != self._armed:
            return  # another event has been scheduled since, for an earlier instant
        self._armed = NEVER
        if self._deadline is None:
            return
        if self._due > armed:
            self._armed = self._due
            self._timeline.at(self._due, self._expire, self._due)
            return
        self._deadline = None
        self._callback()
