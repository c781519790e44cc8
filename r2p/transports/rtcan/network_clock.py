"""The network time of one RTCAN link, for ticks and hooks of nodes: a line through its syncs, by the port's clock."""

from collections.abc import Callable
from typing import Protocol

from r2p.protocols.rtcan.events import SyncSeen
from r2p.protocols.rtcan.time_fit import NetworkTimeFit
from r2p.runtime.network_time import ClockAlarm, NetworkClock, Sync
from r2p.transports.rtcan.driver import EngineDriver
from r2p.units import SECOND

COASTING = 3 * SECOND
"""Ns without a sync for which ticks are taken to be aligned: an election takes a tenth of that, and the line through
the last syncs is off by some 2 ppm then, so by a few us.
"""


_WAIT = 5 * SECOND  # ns for the first sync, before the user hears of it: twice what a module takes to join a bus


class ClockNotice(Protocol):
    """Reports something about the clock to the user."""

    def __call__(self, kind: str, text: str, *, trouble: bool) -> None: ...


class RtcanClock(NetworkClock):
    """The network time of one link. `on_sync` is called with each sync while there are users."""

    def __init__(self, name: str, driver: EngineDriver, notice: ClockNotice) -> None:
        super().__init__(name)
        self._driver = driver
        self._port = driver.port
        self._engine = driver.engine
        self._notice = notice
        self._fit = NetworkTimeFit()
        self._alarm = self._port.alarm(self._on_silence)
        self._cycle = self._engine.timing.cycle
        self._counter = 0  # of the last sync
        self._master: int | None = None  # its id8
        self._used = False
        self._missed = False  # the last notice was that there is no sync

    def time(self) -> int | None:
        return self._fit.time(self._driver.now()) if self._fit.known else None

    def instant(self, time: int) -> int:
        return self._fit.instant(time)

    def monotonic(self, instant: int) -> int:
        return self._port.monotonic(instant)

    def alarm(self, callback: Callable[[], object]) -> ClockAlarm:
        return self._port.alarm(callback)

    def close(self) -> None:
        self._alarm.close()
        super().close()

    def on_sync(self, seen: SyncSeen) -> None:
        """Call the hooks, then correct the time."""
        epoch = self._engine.network.epoch or 0
        time = seen.counter * self._cycle
        same_run = self._fit.known and epoch == self.epoch
        if not same_run:
            self._counter = seen.counter - 1
        if seen.end:
            skipped, self._counter = seen.counter - self._counter - 1, seen.counter
            late = (self._driver.now() - seen.end) / SECOND
            sync = Sync(time + seen.length, epoch, self.monotonic(seen.end), late, skipped)
            for hook in list(self._hooks):
                hook(sync)
        if same_run and abs(self._fit.time(seen.start) - time) <= self._cycle:
            changed = not self.aligned or self._engine.network.master != self._master
            self._fit.add(seen.start, time, changed=changed)
        else:
            self._fit.begin(seen.start, time)
            self.run += 1
            self.epoch = epoch
        self._master = self._engine.network.master
        self._alarm.set(seen.start + COASTING)
        self.aligned = True
        if self._missed:
            self._missed = False
            self._notice("network time", "there are syncs: ticks by network time follow the master", trouble=False)
        self._corrected()

    def _on_silence(self) -> None:
        """Report that there was no sync for too long, or none at all so far."""
        self._missed = True
        if not self._fit.known:
            text = "no sync so far, so ticks by network time wait: there is no master on this bus"
            self._notice("no network time", text, trouble=True)
            return
        self.aligned = False
        self._engine.counts["network time lost"] += 1
        text = f"no sync for {COASTING // SECOND} s: ticks by network time go on by this module's own clock"
        self._notice("no network time", text, trouble=True)
        self._corrected()

    def _users_changed(self) -> None:
        used = bool(self._followers)  # hooks follow as well
        if used == self._used or self.closed:
            return
        self._used = used
        self._engine.report_syncs(used)
        # The line would be an old one at the next use.
        self._fit, self.aligned, self._missed = NetworkTimeFit(), True, False
        self._alarm.set(self._driver.now() + _WAIT if used else None)
