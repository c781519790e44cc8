"""The time that the nodes of a network share: ticks by it, and the instants of its syncs.

    RtcanClock (a link's)  --corrected, closed-->  NetworkTicker  -->  node.every(period, clock="network")
    UtcClock (without one) --sync--------------->  SyncHook       -->  node.on_sync(callback)

A `NetworkClock` is the shared time as one module has it: by a local clock, corrected now and then. Ticks are due at
whole multiples of the period in that time, so at the same instants on all modules. All of this exists from its first
use on: a module that does not use it pays nothing.
"""

import abc
import asyncio
import inspect
from collections.abc import AsyncIterator, Callable, Hashable
from typing import ClassVar, NamedTuple, Protocol

from r2p.clock import Alarm, Clock, ExactAlarm
from r2p.errors import Error, TransportError
from r2p.log_lines import NodeLogger
from r2p.runtime.ticks import Closable
from r2p.units import SECOND

_LONG_PERIOD = SECOND
_UTC_STEP = SECOND // 10  # by which UTC may be set before ticks begin anew; less is made up for as by a late loop
_UTC_LOOK = SECOND // 2  # ns between two looks at UTC, which may be slewed while a tick is waited for


class NetworkTick(NamedTuple):
    """One period of `Node.every` by network time.

    `due` (monotonic ns), `late` (s) and `skipped` are as in `Tick`. `time` is the instant in network time (ns), a whole
    multiple of the period, and `epoch` the run of the network in which it counts: 0 by UTC. It is the same instant on
    all modules while they are `aligned`, which is False when there was no sync for 3 s.
    """

    due: int
    late: float
    skipped: int
    time: int
    epoch: int
    aligned: bool


class Sync(NamedTuple):
    """One sync of an RTCAN network, as `Node.on_sync` reports it.

    `time` is the end of the sync frame in network time (ns): the same number on all modules, in the run `epoch` of the
    network. `due` is that instant by the module's clock (monotonic ns), and `late` by how much later the callback is
    called (s): on a microcontroller the latency of its interrupt. `skipped` counts the cycles just before this one of
    which the module has seen no sync.
    """

    time: int
    epoch: int
    due: int
    late: float
    skipped: int


class ClockAlarm(Protocol):
    """One timer on the local clock of a `NetworkClock`."""

    def set(self, deadline: int | None) -> None:
        """Go off once at this instant, at once if it has passed; None switches it off."""

    def close(self) -> None:
        """Never go off again."""


class NetworkClock(abc.ABC):
    """The time of one network by a module's local clock. Instants are ns of that clock, times ns of the network."""

    is_utc: ClassVar[bool] = False

    def __init__(self, name: str) -> None:
        self.name = name
        """For people: the link's name, or UTC."""
        self.epoch = 0
        self.run = 0
        """Changes when time goes on somewhere else: in another run of the network, or after a jump."""
        self.aligned = True
        """False while the local clock has gone on alone for too long."""
        self.closed = False
        """True if the link is closed: the local clock goes on alone for ever."""
        self._followers: dict[Callable[[], object], None] = {}
        self._hooks: dict[Callable[[Sync], object], None] = {}

    @abc.abstractmethod
    def time(self) -> int | None:
        """Return network time now; None while it is unknown, which it is only at first."""

    @abc.abstractmethod
    def instant(self, time: int) -> int:
        """Return when it is this time, or when to look again, if that may be known better before."""

    @abc.abstractmethod
    def monotonic(self, instant: int) -> int:
        """Translate an instant of the local clock to the module's monotonic clock."""

    @abc.abstractmethod
    def alarm(self, callback: Callable[[], object]) -> ClockAlarm:
        """Return a timer on the local clock, which is never early."""

    def follow(self, corrected: Callable[[], object]) -> None:
        """Call `corrected()` whenever the time was corrected, and when the clock is closed."""
        self._followers[corrected] = None
        self._users_changed()

    def hook(self, on_sync: Callable[[Sync], object], closed: Callable[[], object]) -> None:
        """Call `on_sync(sync)` at each sync, and `closed()` as in `follow`."""
        self._hooks[on_sync] = None
        self.follow(closed)

    def leave(self, user: Callable[..., object]) -> None:
        """Call this function no longer."""
        self._followers.pop(user, None)
        self._hooks.pop(user, None)
        self._users_changed()

    def close(self) -> None:
        """Note that the link is closed."""
        self.closed = True
        self._corrected()

    def _corrected(self) -> None:
        for follower in list(self._followers):
            follower()

    def _users_changed(self) -> None:
        """Start or stop to listen to syncs."""


class UtcClock(NetworkClock):
    """UTC as the time of modules without an RTCAN link, such as those of one computer, or of several with NTP."""

    is_utc = True

    def __init__(self, loop: asyncio.AbstractEventLoop, clock: Clock) -> None:
        super().__init__("UTC")
        self._loop = loop
        self._clock = clock
        self._offset = clock.now() - clock.monotonic()

    def time(self) -> int:
        now = self._clock.now()
        offset = now - self._clock.monotonic()
        if abs(offset - self._offset) > _UTC_STEP:
            self.run += 1
        self._offset = offset
        return now

    def instant(self, time: int) -> int:
        now = self._clock.monotonic()
        wait = time - self._clock.now()
        return now + (wait if wait <= _UTC_LOOK or self._clock.virtual else _UTC_LOOK)

    def monotonic(self, instant: int) -> int:
        return instant

    def alarm(self, callback: Callable[[], object]) -> ClockAlarm:
        return ExactAlarm(self._loop, callback)


class NetworkClocks(Protocol):
    """The module: what chooses its clock, and the clocks of its own."""

    loop: asyncio.AbstractEventLoop
    clock: Clock
    on_link_added: list[Callable[[], object]]
    """Called after a link was added."""

    def network_clock(self) -> NetworkClock | None:
        """Return the clock of the first link that has one."""


class NetworkTicker:
    """Calls `callback(tick)` at whole multiples of `period` (ns) in network time, from when this is known.

    A correction moves the next tick, and never repeats one. Where time goes on somewhere else, as in another run of the
    network, the next tick is due at least half a period after the last one, and `skipped` counts the whole periods in
    between. While there is no sync, ticks go on by the local clock.
    """

    def __init__(self, space: NetworkClocks, period: int, callback: Callable[[NetworkTick], object]) -> None:
        self._space = space
        self._period = period
        self._callback = callback
        self._clock: NetworkClock | None = None
        self._alarm: ClockAlarm | None = None
        self._run: Hashable = None  # the clock and its run in which ticks are counted
        self._next = 0  # the number of the next tick: its time in periods
        self._last: int | None = None  # when the last one was due (monotonic ns)
        self._resumed = False  # no tick yet since time went on somewhere else
        # The events of a simulated bus keep no virtual time going, but a tick that is waited for does.
        self._awake = Alarm(space.loop, lambda: None)

    def start(self) -> None:
        """Start with the first tick after now."""
        self._space.on_link_added.append(self._corrected)
        self._corrected()

    def close(self) -> None:
        """Stop the ticks."""
        if self._corrected in self._space.on_link_added:
            self._space.on_link_added.remove(self._corrected)
        self._awake.close()
        self._use(None)

    def _corrected(self) -> None:
        self._choose()
        self._arm()

    def _choose(self) -> None:
        """Use the clock of the first link that has one, until that link is closed; UTC while no link has one."""
        clock = self._clock
        if clock is not None and not clock.closed and not clock.is_utc:
            return
        found = self._space.network_clock()
        if found is not None:
            if found is not clock:
                self._use(found)
        elif clock is None or (clock.closed and clock.time() is None):
            self._use(UtcClock(self._space.loop, self._space.clock))

    def _use(self, clock: NetworkClock | None) -> None:
        if self._clock is not None and self._alarm is not None:
            self._clock.leave(self._corrected)
            self._alarm.close()
        self._clock = clock
        if clock is not None:
            self._alarm = clock.alarm(self._fire)
            clock.follow(self._corrected)

    def _arm(self) -> None:
        """Set the alarm to the next tick."""
        clock, alarm = self._clock, self._alarm
        if clock is None or alarm is None or (time := clock.time()) is None:
            return
        if (clock, clock.run) != self._run:
            self._begin(clock, time)
        instant = clock.instant(self._next * self._period)
        alarm.set(instant)
        if self._period >= _LONG_PERIOD:
            self._awake.set(clock.monotonic(instant))

    def _begin(self, clock: NetworkClock, time: int) -> None:
        """Count ticks in a time that has just become known, or goes on somewhere else."""
        self._run = clock, clock.run
        self._resumed = True
        self._next = time // self._period + 1
        if self._last is not None:
            now = self._space.clock.monotonic()
            if now + self._next * self._period - time < self._last + self._period // 2:
                self._next += 1

    def _fire(self) -> None:
        clock = self._clock
        if clock is None or (time := clock.time()) is None:
            return
        number = time // self._period
        if (clock, clock.run) != self._run or number < self._next:
            self._arm()
            return
        scheduled = number * self._period
        now = self._space.clock.monotonic()
        due = now - (time - scheduled)
        skipped = number - self._next
        if self._resumed and self._last is not None:
            skipped = max(0, round((due - self._last) / self._period) - 1)
        self._resumed = False
        self._next, self._last = number + 1, due
        self._arm()
        self._callback(NetworkTick(due, 0.0, skipped, scheduled, clock.epoch, clock.aligned))


async def network_ticks(period: float, space: NetworkClocks, tickers: set[Closable]) -> AsyncIterator[NetworkTick]:
    """Yield a tick at each whole multiple of `period` seconds. The ticker is in `tickers` while it runs."""
    waiter: asyncio.Future[None] | None = None
    pending: NetworkTick | None = None

    def on_tick(tick: NetworkTick) -> None:
        nonlocal pending
        if pending is not None:
            tick = tick._replace(skipped=pending.skipped + 1 + tick.skipped)
        pending = tick
        if waiter is not None and not waiter.done():
            waiter.set_result(None)

    ticker = NetworkTicker(space, round(period * SECOND), on_tick)
    tickers.add(ticker)
    ticker.start()
    try:
        while True:
            if pending is None:
                waiter = space.loop.create_future()
                await waiter
            if pending is not None:  # always: the waiter is done by a tick
                tick, pending = pending, None
                yield tick._replace(late=(space.clock.monotonic() - tick.due) / SECOND)
    finally:
        ticker.close()
        tickers.discard(ticker)


class HookOwner(Protocol):
    """The node of a `SyncHook`."""

    name: str
    log: NodeLogger

    @property
    def ending(self) -> bool:
        """Return whether the node's end has begun."""

    def crash(self, error: Exception) -> None:
        """End the node with the error of one of its callbacks."""


class SyncHook:
    """Calls a node's `callback(sync)` at each sync of the module's first RTCAN link, until it is closed.

    Raises TransportError if no link of the module has syncs, and Error for a coroutine function.
    """

    def __init__(self, space: NetworkClocks, node: HookOwner, callback: Callable[[Sync], object]) -> None:
        if inspect.iscoroutinefunction(callback):
            raise Error(
                f"node {node.name}: the callback of on_sync() is called at the instant of the sync, so it can't be a "
                "coroutine function: take the sample there, and publish it elsewhere"
            )
        self._space = space
        self._node = node
        self._callback = callback
        self._clock: NetworkClock | None = None
        self._served = False
        self._choose()
        if self._clock is None:
            raise TransportError(
                f"node {node.name}: on_sync() needs a link with RTCAN, whose master sends syncs; without a CAN bus, "
                'test on a simulated one (via="sim:lab"), or use node.every(period, clock="network")'
            )
        space.on_link_added.append(self._choose)

    def close(self) -> None:
        """Stop the calls."""
        if self._choose in self._space.on_link_added:
            self._space.on_link_added.remove(self._choose)
        self._leave()

    def _choose(self) -> None:
        if self._clock is not None and not self._clock.closed:
            return
        self._leave()
        self._clock = self._space.network_clock()
        if self._clock is not None:
            self._clock.hook(self._on_sync, self._choose)
            self._served = True
        elif self._served:
            self._served = False
            text = "node %s: no link of this module has syncs any more; on_sync() waits for the next one that has"
            self._node.log.warning(text, self._node.name)

    def _leave(self) -> None:
        if self._clock is not None:
            self._clock.leave(self._on_sync)
            self._clock.leave(self._choose)
            self._clock = None

    def _on_sync(self, sync: Sync) -> None:
        if self._node.ending:
            return
        try:
            self._callback(sync)
        except Exception as error:  # noqa: BLE001 - the user's code: whatever it raises crashes its node
            self.close()
            self._node.crash(error)
