"""Ticks by a shared time that is corrected, jumps, comes and goes."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import pytest

from r2p.clock import Clock, ExactAlarm, clock_of
from r2p.runtime.network_time import NetworkClock, NetworkTicker, UtcClock

if TYPE_CHECKING:
    from collections.abc import Callable

    import r2p
    from r2p.runtime.network_time import ClockAlarm

pytestmark = pytest.mark.virtual_time

PERIOD = 10_000_000


class SetClock(NetworkClock):
    """A network whose time a test sets: `offset` ns after the module's monotonic clock; None: unknown."""

    def __init__(self, offset: int | None = 0) -> None:
        super().__init__("set")
        self.offset = offset

    def time(self) -> int | None:
        return None if self.offset is None else clock_of().monotonic() + self.offset

    def instant(self, time: int) -> int:
        assert self.offset is not None
        return time - self.offset

    def monotonic(self, instant: int) -> int:
        return instant

    def alarm(self, callback: Callable[[], object]) -> ClockAlarm:
        return ExactAlarm(asyncio.get_running_loop(), callback)

    def set(self, offset: int, *, jumps: bool = False) -> None:
        self.offset = offset
        self.run += jumps
        self._corrected()


class Space:
    """A module with these clocks of links."""

    def __init__(self, *clocks: NetworkClock) -> None:
        self.loop = asyncio.get_running_loop()
        self.clock: Clock = clock_of()
        self.on_link_added: list[Callable[[], object]] = []
        self.clocks = list(clocks)

    def network_clock(self) -> NetworkClock | None:
        return next((each for each in self.clocks if not each.closed), None)

    def add(self, clock: NetworkClock) -> None:
        self.clocks.append(clock)
        for each in self.on_link_added:
            each()


class Ticking:
    """A ticker, and its ticks: time, skipped, and when they came."""

    def __init__(self, space: Space, period: int = PERIOD) -> None:
        self.ticks: list[r2p.NetworkTick] = []
        self.at: list[int] = []
        self.ticker = NetworkTicker(space, period, self.note)
        self.ticker.start()

    def note(self, tick: r2p.NetworkTick) -> None:
        self.ticks.append(tick)
        self.at.append(clock_of().monotonic())

    @property
    def times(self) -> list[int]:
        return [tick.time // PERIOD for tick in self.ticks]

    @property
    def skipped(self) -> list[int]:
        return [tick.skipped for tick in self.ticks]


async def test_ticks_wait_for_the_time() -> None:
    clock = SetClock(None)
    ticking = Ticking(Space(clock))
    await asyncio.sleep(1.0)
    assert not ticking.ticks
    clock.set(5_000_000)
    await asyncio.sleep(0.021)
    assert ticking.times == [101, 102]
    assert ticking.at == [tick.due for tick in ticking.ticks] == [1_005_000_000, 1_015_000_000]


@pytest.mark.parametrize("off", [-2_000, 2_000])
async def test_a_correction_just_after_a_tick_does_not_repeat_or_skip_it(off: int) -> None:
    clock = SetClock()
    ticking = Ticking(Space(clock))
    for number in range(1, 20):
        await asyncio.sleep(0.01 - 1e-6 if number == 1 else 0.01)
        clock.set(off * (number % 2))  # 1 us before each tick
    assert ticking.times == sorted(set(ticking.times))
    assert len(ticking.times) >= 18
    assert not any(ticking.skipped)


async def test_a_correction_over_a_tick_makes_it_late() -> None:
    clock = SetClock()
    ticking = Ticking(Space(clock))
    await asyncio.sleep(0.018)
    clock.set(3_000_000)
    await asyncio.sleep(0.01)
    assert ticking.times == [1, 2, 3]
    assert ticking.at == [10_000_000, 18_000_000, 27_000_000]
    assert ticking.ticks[1].due == 17_000_000


async def test_time_that_is_set_back_within_a_run_repeats_no_tick() -> None:
    clock = SetClock()
    ticking = Ticking(Space(clock))
    await asyncio.sleep(0.025)
    clock.set(-20_000_000)
    await asyncio.sleep(0.03)
    assert ticking.times == [1, 2, 3]
    assert ticking.at[-1] == 50_000_000


@pytest.mark.parametrize("offset", range(-1_000_000_000, 1_000_000_001, 123_456_789))
async def test_another_run_repeats_no_tick_and_counts_the_skipped_ones(offset: int) -> None:
    clock = SetClock()
    ticking = Ticking(Space(clock))
    await asyncio.sleep(0.052)
    clock.set(offset, jumps=True)
    await asyncio.sleep(0.05)
    gaps = [after - before for before, after in zip(ticking.at, ticking.at[1:], strict=False)]
    assert min(gaps) >= PERIOD // 2
    assert max(gaps) < 3 * PERIOD // 2
    assert not any(ticking.skipped)
    assert {(at + offset) % PERIOD for at in ticking.at[5:]} == {0}


async def test_a_closed_clock_goes_on_alone_until_another_link_has_one() -> None:
    clock, other = SetClock(), SetClock(4_000_000)
    space = Space(clock)
    ticking = Ticking(space)
    await asyncio.sleep(0.015)
    clock.close()
    await asyncio.sleep(0.02)
    assert ticking.times == [1, 2, 3]
    space.add(other)
    await asyncio.sleep(0.02)
    assert [at % PERIOD for at in ticking.at] == [0, 0, 0, 6_000_000, 6_000_000]


async def test_the_first_link_s_clock_is_used_while_it_is_there() -> None:
    first, second = SetClock(), SetClock(4_000_000)
    space = Space(first, second)
    ticking = Ticking(space)
    space.add(SetClock(7_000_000))
    await asyncio.sleep(0.015)
    first.close()
    await asyncio.sleep(0.02)
    assert [at % PERIOD for at in ticking.at] == [0, 6_000_000, 6_000_000]


async def test_ticks_by_utc_go_over_to_a_link_that_is_added() -> None:
    space = Space()
    ticking = Ticking(space)
    await asyncio.sleep(0.015)
    assert ticking.ticks[0].time == space.clock.now() - 5_000_000
    space.add(SetClock(4_000_000))
    await asyncio.sleep(0.02)
    assert [at % PERIOD for at in ticking.at] == [0, 6_000_000, 6_000_000]


async def test_a_clock_that_never_knew_its_time_gives_way_to_utc() -> None:
    clock = SetClock(None)
    ticking = Ticking(Space(clock))
    await asyncio.sleep(0.1)
    clock.close()
    await asyncio.sleep(0.015)
    assert len(ticking.ticks) == 1


async def test_nothing_comes_after_the_end() -> None:
    space = Space(SetClock())
    ticking = Ticking(space)
    await asyncio.sleep(0.015)
    ticking.ticker.close()
    ticking.ticker.close()
    space.add(SetClock())
    await asyncio.sleep(0.1)
    assert len(ticking.ticks) == 1
    assert not space.on_link_added


class SetUtc:
    """A computer's clock whose UTC is set by the test."""

    virtual = False

    def __init__(self) -> None:
        self.offset = 1_000_000_000

    def monotonic(self) -> int:
        return clock_of().monotonic()

    def now(self) -> int:
        return self.monotonic() + self.offset


async def test_utc_that_is_set_begins_anew_and_is_looked_at_while_a_tick_is_waited_for() -> None:
    utc = SetUtc()
    space = Space()
    space.clock = utc
    ticking = Ticking(space, 10 * 1_000_000_000)
    await asyncio.sleep(5.0)
    utc.offset -= 3_700_000  # slewed
    await asyncio.sleep(5.0)
    assert ticking.at == [9_003_700_000]
    utc.offset += 3600 * 1_000_000_000
    await asyncio.sleep(20.0)
    assert [each.skipped for each in ticking.ticks] == [0] * 3


async def test_utc_clock_says_what_it_is() -> None:
    clock = UtcClock(asyncio.get_running_loop(), clock_of())
    assert (clock.name, clock.is_utc, clock.epoch, clock.aligned) == ("UTC", True, 0, True)
