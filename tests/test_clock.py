"""Clocks, timers, and durations: numbers of seconds; everything else is refused at once, with what to write instead."""

from __future__ import annotations

import asyncio
import errno
import itertools
import math
import random
import subprocess
import sys
import time
from textwrap import dedent
from typing import TYPE_CHECKING, Any, NoReturn

import pytest

import r2p
import r2p.clock
import r2p.sim
from r2p.bus import BusMonitor
from r2p.clock import Alarm, ExactAlarm, SystemClock, Ticker, clock_of, random_of
from r2p.msg import Led
from r2p.sim import VirtualLoop, run
from r2p.sim.robots.emulated import Triskar2
from r2p.testing.network import Network
from tests.bench import local, pair

if TYPE_CHECKING:
    from collections.abc import Callable

MS = 1_000_000
SECOND = 1_000_000_000

Tick = tuple[int, int, int]


class Hands:
    """Clocks set by hand: UTC and the monotonic one."""

    def __init__(self) -> None:
        self.utc = 1000 * SECOND
        self.monotonic = 5 * SECOND
        self.clock = SystemClock(lambda: self.utc, lambda: self.monotonic)

    def wait(self, ns: int) -> int:
        self.utc += ns
        self.monotonic += ns
        return self.clock.now()


def test_utc_goes_on_at_half_speed_after_it_was_set_back() -> None:
    hands = Hands()
    before = hands.clock.now()
    hands.utc -= 10 * SECOND
    assert hands.clock.now() == before
    assert hands.wait(4 * SECOND) == before + 2 * SECOND
    assert hands.wait(4 * SECOND) == before + 4 * SECOND
    assert hands.wait(12 * SECOND) == before + 10 * SECOND == hands.utc
    assert hands.wait(1 * SECOND) == before + 11 * SECOND == hands.utc


def test_a_clock_that_is_set_back_is_logged_once(caplog: pytest.LogCaptureFixture) -> None:
    hands = Hands()
    hands.clock.now()
    hands.utc -= SECOND // 20  # what a time server does all day
    hands.clock.now()
    assert not caplog.messages
    hands.utc -= 3600 * SECOND
    hands.clock.now()
    for _ in range(10):
        hands.wait(SECOND)
    (message,) = caplog.messages
    assert message.startswith("the computer's clock was set back by 3600.1 s: r2p's goes on at half speed for 7200 s")
    hands.utc -= 60 * SECOND
    hands.clock.now()
    assert caplog.messages[1].startswith("the computer's clock was set back by 3655.1 s")
    hands.wait(8000 * SECOND)
    hands.utc -= SECOND
    hands.clock.now()
    assert "set back by 1.0 s" in caplog.messages[2]


def test_utc_may_be_set_back_again_and_again() -> None:
    hands = Hands()
    told = [hands.clock.now()]
    for step in (10, 3, 0, 40, 0, 0, 2):
        hands.utc -= step * SECOND
        told += [hands.clock.now(), hands.wait(2 * SECOND), hands.wait(3 * SECOND)]
    assert told == sorted(told)
    assert all(later - earlier <= 3 * SECOND for earlier, later in itertools.pairwise(told))
    hands.wait(200 * SECOND)
    assert hands.clock.now() == hands.utc


def test_half_speed_begins_anew_when_full_speed_was_in_between() -> None:
    hands = Hands()
    hands.clock.now()
    hands.utc -= 2 * SECOND
    hands.clock.now()
    before = hands.wait(1000 * SECOND)
    hands.utc -= 2 * SECOND
    hands.clock.now()
    assert hands.wait(1 * SECOND) == before + SECOND // 2


def test_utc_set_forward_is_followed_at_once() -> None:
    hands = Hands()
    hands.clock.now()
    hands.utc += 3600 * SECOND
    assert hands.clock.now() == hands.utc


def test_without_a_loop_time_and_random_numbers_are_the_computers() -> None:
    clock = clock_of()
    assert not clock.virtual
    assert abs(clock.now() - time.time_ns()) < 60 * SECOND
    assert clock.monotonic() <= time.monotonic_ns()
    assert random_of() is random_of()


@pytest.mark.processes
@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no fork")
def test_a_fork_has_random_numbers_of_its_own() -> None:
    program = """
        import os
        from r2p.clock import random_of

        pid = os.fork()
        os.write(1, f"{random_of().getrandbits(64)}\\n".encode())
        if pid:
            os.waitpid(pid, 0)
    """
    done = subprocess.run([sys.executable, "-c", dedent(program)], capture_output=True, text=True, check=True)
    assert len(set(done.stdout.split())) == 2


def test_a_loop_may_bring_its_own_time_and_random_numbers() -> None:
    async def main() -> tuple[bool, float]:
        return clock_of().virtual, random_of().random()

    assert run(main, seed=3) == (True, random.Random(3).random())
    with asyncio.Runner(loop_factory=VirtualLoop) as runner:
        assert clock_of(runner.get_loop()) is runner.get_loop().clock  # type: ignore[attr-defined]  # of VirtualLoop


# Alarm


class Rings:
    def __init__(self) -> None:
        self.clock = clock_of()
        self.at: list[int] = []
        self.alarm = Alarm(asyncio.get_running_loop(), lambda: self.at.append(self.clock.monotonic()))


@pytest.mark.virtual_time
async def test_alarm_goes_off_once_at_its_deadline() -> None:
    rings = Rings()
    rings.alarm.set(333_333_333)
    await asyncio.sleep(10)
    assert rings.at == [333_333_333]


@pytest.mark.virtual_time
@pytest.mark.parametrize(
    ("deadlines", "expected"),
    [
        ([2 * SECOND, 3 * SECOND], [3 * SECOND]),
        ([3 * SECOND, 2 * SECOND], [2 * SECOND]),
        ([2 * SECOND, 4 * SECOND, 3 * SECOND], [3 * SECOND]),
        ([2 * SECOND, None], []),
        ([2 * SECOND, None, 1 * SECOND], [1 * SECOND]),
        ([-5 * SECOND], [0]),
        ([None], []),
    ],
    ids=str,
)
async def test_the_last_deadline_counts(deadlines: list[int | None], expected: list[int]) -> None:
    rings = Rings()
    for deadline in deadlines:
        rings.alarm.set(deadline)
    await asyncio.sleep(10)
    assert rings.at == expected


@pytest.mark.virtual_time
async def test_alarm_is_set_again_in_its_own_callback() -> None:
    def again() -> None:
        at.append(clock_of().monotonic())
        alarm.set(at[-1] + SECOND if len(at) < 3 else None)

    at: list[int] = []
    alarm = Alarm(asyncio.get_running_loop(), again)
    alarm.set(SECOND)
    await asyncio.sleep(10)
    assert at == [1 * SECOND, 2 * SECOND, 3 * SECOND]


@pytest.mark.virtual_time
async def test_a_closed_alarm_is_silent() -> None:
    rings = Rings()
    rings.alarm.set(SECOND)
    rings.alarm.close()
    rings.alarm.close()
    await asyncio.sleep(10)
    assert rings.at == []


@pytest.mark.anyio
@pytest.mark.parametrize("kind", [Alarm, ExactAlarm])
@pytest.mark.parametrize("delay", [0, 300_000, 1_400_000, 2_490_000])
async def test_alarm_is_never_early_on_a_real_loop(delay: int, kind: type[Alarm]) -> None:
    loop = asyncio.get_running_loop()
    went_off = asyncio.Event()
    deadline = clock_of().monotonic() + delay
    alarm = kind(loop, went_off.set)
    alarm.set(deadline)
    await went_off.wait()
    assert clock_of().monotonic() >= deadline
    alarm.close()


@pytest.fixture(params=["timerfd", "no timerfd"])
def exact(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Alarms and tickers with a timerfd, and where there is none."""

    def no_descriptors() -> NoReturn:
        raise OSError(errno.EMFILE, "no descriptor")

    if request.param == "no timerfd":
        monkeypatch.setattr(r2p.clock, "_new_timerfd", no_descriptors)


@pytest.mark.anyio
@pytest.mark.usefixtures("exact")
@pytest.mark.parametrize(
    "delays",
    [(5, 1), (1, 5), (3, None, 2), (2, 4, 3), (-3_000_000_000,)],
    ids=lambda delays: " ".join(map(str, delays)),
)
async def test_the_last_deadline_counts_on_a_real_loop(delays: tuple[int | None, ...]) -> None:
    loop = asyncio.get_running_loop()
    rung: list[int] = []
    both = asyncio.Semaphore(0)

    def ring() -> None:
        rung.append(clock_of().monotonic())
        both.release()

    now = clock_of().monotonic()
    deadlines = [None if delay is None else now + delay * MS for delay in delays]
    last = deadlines[-1]
    assert last is not None
    alarm = ExactAlarm(loop, ring)
    for deadline in deadlines:
        alarm.set(deadline)
    await both.acquire()
    alarm.set(now + 20 * MS)
    await both.acquire()
    alarm.set(now + 40 * MS)
    alarm.close()
    assert last <= rung[0]
    assert now + 20 * MS <= rung[1]
    assert len(rung) == 2


# Ticker


async def ticks(period: int, count: int, work: int = 0) -> list[Tick]:
    """The first `count` callbacks of a ticker; the first one blocks the loop for `work` ns."""
    loop = asyncio.get_running_loop()
    done = loop.create_future()
    seen: list[Tick] = []

    def on_tick(scheduled: int, late: int, skipped: int) -> None:
        seen.append((scheduled, late, skipped))
        if len(seen) == count:
            ticker.close()
            done.set_result(None)
        until = clock_of().monotonic() + work
        while len(seen) == 1 and clock_of().monotonic() < until:
            pass

    ticker = Ticker(loop, period, on_tick)
    ticker.start()
    await done
    return seen


def check_phase(seen: list[Tick], period: int) -> None:
    for (before, _, _), (scheduled, late, skipped) in itertools.pairwise(seen):
        assert scheduled - before == (1 + skipped) * period
        assert 0 <= late < period


@pytest.mark.virtual_time
async def test_ticks_are_exact_under_virtual_time() -> None:
    await asyncio.sleep(0.1234567)
    assert await ticks(333_333, 5000) == [(123_456_700 + k * 333_333, 0, 0) for k in range(1, 5001)]


@pytest.mark.anyio
@pytest.mark.usefixtures("exact")
@pytest.mark.parametrize("period", [2 * MS, 100_000])
async def test_ticks_keep_their_phase_on_a_real_loop(period: int) -> None:
    before = clock_of().monotonic()
    seen = await ticks(period, 20)
    assert seen[0][0] >= before + period
    check_phase(seen, period)


@pytest.mark.anyio
@pytest.mark.usefixtures("exact")
async def test_ticks_are_skipped_while_the_loop_is_blocked() -> None:
    seen = await ticks(1 * MS, 4, work=5 * MS)
    assert seen[1][2] >= 4
    check_phase(seen, 1 * MS)


@pytest.mark.anyio
@pytest.mark.usefixtures("exact")
async def test_the_shortest_period_leaves_the_loop_to_others() -> None:
    ticking = asyncio.create_task(ticks(1000, 500))
    turns = 0
    while not ticking.done():
        await asyncio.sleep(0)
        turns += 1
    check_phase(await ticking, 1000)
    assert turns > 100


@pytest.mark.anyio
@pytest.mark.usefixtures("exact")
async def test_an_exception_is_reported_and_the_ticker_goes_on() -> None:
    loop = asyncio.get_running_loop()
    reported: list[object] = []
    third = asyncio.Event()

    def on_tick(_scheduled: int, _late: int, _skipped: int) -> None:
        if len(reported) == 2:
            ticker.close()
            third.set()
        else:
            raise ValueError("tick")

    handler = loop.get_exception_handler()
    loop.set_exception_handler(lambda _, context: reported.append(context["exception"]))
    ticker = Ticker(loop, MS, on_tick)
    ticker.start()
    await third.wait()
    loop.set_exception_handler(handler)
    assert [str(error) for error in reported] == ["tick", "tick"]


@pytest.mark.virtual_time
async def test_a_ticker_begins_anew_and_ends() -> None:
    at: list[int] = []
    ticker = Ticker(asyncio.get_running_loop(), SECOND, lambda scheduled, *_: at.append(scheduled))
    ticker.start()
    await asyncio.sleep(1.5)
    ticker.start()
    await asyncio.sleep(2.2)
    ticker.close()
    ticker.close()
    await asyncio.sleep(5)
    assert at == [1_000_000_000, 2_500_000_000, 3_500_000_000]


@pytest.mark.virtual_time
async def test_a_period_under_a_microsecond_is_refused() -> None:
    with pytest.raises(ValueError, match="999 ns is too short"):
        Ticker(asyncio.get_running_loop(), 999, print)


# Durations

# What is given as a duration -> what the error says
WRONG: list[tuple[Any, str]] = [
    ("10ms", "not '10ms': write 0.01"),
    ("1.5", "not '1.5': write 1.5"),
    ("soon", "not 'soon'$"),
    (math.nan, "not nan"),
    (math.inf, "not inf"),
    (1e300, "not 1e[+]300"),
    (True, "not True"),
    (b"1", "not b'1'"),
]


@pytest.mark.virtual_time
@pytest.mark.parametrize(("wrong", "text"), WRONG)
async def test_each_duration_is_refused_at_once(wrong: Any, text: str) -> None:
    async with local() as module:
        node, other = pair(module)
        leds = other.subscribe("leds", Led)
        publisher = node.advertise("leds", Led)
        await publisher.publish(Led())  # fetch() could go on with it
        calls: list[Callable[[], Any]] = [
            lambda: node.advertise("a", Led, r2p.NonRealTime(stall=wrong)),
            lambda: node.advertise("a", Led, r2p.Sporadic(deadline=wrong)),
            lambda: node.advertise("a", Led, r2p.Periodic(wrong, Led)),
            lambda: node.advertise("a", Led, r2p.Periodic(1.0, Led, lead=wrong)),
            lambda: node.subscribe("a", Led, max_age=wrong),
            lambda: node.subscribe("a", Led, timeout=wrong),
            lambda: node.every(wrong),
            lambda: r2p.sim.run(local().wait, limit=wrong),
            lambda: Network(delay=wrong),
            lambda: Network(jitter=wrong),
        ]
        for call in calls:
            with pytest.raises(r2p.MessageError, match=text):
                call()
        for wait in (node.spin, leds.fetch, publisher.ready):
            with pytest.raises(r2p.MessageError, match=text):
                await wait(wrong)
        assert not node.subscribers


@pytest.mark.virtual_time
@pytest.mark.parametrize("wrong", [0, -1.0, 1e-9, None])
async def test_a_period_is_a_microsecond_or_more(wrong: Any) -> None:
    async with local() as module:
        node, _ = pair(module)
        with pytest.raises(r2p.MessageError, match=r"period of every.* is in seconds, 1e-06 to 1e[+]09, not"):
            node.every(wrong)


@pytest.mark.virtual_time
@pytest.mark.parametrize("over", [0, 0.0, -1, -1.5, -math.inf])
async def test_a_time_out_that_is_over_is_one(over: float) -> None:
    async with local() as module:
        node, other = pair(module)
        leds = other.subscribe("leds", Led, print)
        with pytest.raises(TimeoutError):
            await leds.fetch(over)
        assert not await other.spin(over)
        node.advertise("leds", Led).publish_nowait(Led(7))
        assert await leds.fetch(over) == Led(7)


@pytest.mark.virtual_time
async def test_watching_a_bus_and_waiting_for_a_robot_take_seconds() -> None:
    with pytest.raises(r2p.MessageError, match=r"write 0\.01"):
        await Triskar2.ready(None, "10ms")  # type: ignore[arg-type]
    with pytest.raises(r2p.MessageError, match=r"write 0\.01"):
        await anext(BusMonitor.loads(None, "10ms"))  # type: ignore[arg-type]
    with pytest.raises(r2p.MessageError, match=r"write 0\.01"):
        await BusMonitor.cycles(None, 1, "10ms")  # type: ignore[arg-type]
