"""How late a 1 kHz periodic publisher is, beside what the system itself does: a timerfd that a thread waits for."""

import asyncio
import ctypes
import os
import select
import time
from collections.abc import Iterator

import r2p
from benchmarks.delivery import MESSAGE, Pair
from benchmarks.loops import FACTORIES, run_on
from benchmarks.table import Row, p50_p99

PERIOD = 0.001
PERIODS = 4000


async def periodic_lateness() -> list[float]:
    """Seconds that `fill` is called after its period's absolute phase, as the publisher has it."""
    called: list[int] = []
    phase = 0

    def fill() -> Pair:
        called.append(time.monotonic_ns())
        return MESSAGE

    async def produce(node: r2p.Node) -> None:
        nonlocal phase
        node.advertise("warm", Pair, r2p.Periodic(PERIOD, lambda: None)).close()  # whatever happens only once
        publisher = node.advertise("pairs", Pair, r2p.Periodic(PERIOD, fill))
        await asyncio.sleep(PERIOD * PERIODS)
        phase = publisher.phase

    async with r2p.Module("BENCH", via=[], watchdog=False) as module:
        module.start(produce)
        await module.wait()
    return _off_phase(called, phase)


async def sleep_lateness() -> list[float]:
    """The same of a loop that sleeps until its next absolute instant."""
    loop = asyncio.get_running_loop()
    called: list[int] = []
    start, began = loop.time(), time.monotonic_ns()
    for number in range(1, PERIODS):
        await asyncio.sleep(start + number * PERIOD - loop.time())
        called.append(time.monotonic_ns())
    return _off_phase(called, began)


def timerfd_lateness() -> list[float]:
    """The same of a bare timerfd: how late the system wakes a thread."""
    libc, period = ctypes.CDLL(None, use_errno=True), round(PERIOD * 1e9)
    called: list[int] = []
    fd = libc.timerfd_create(time.CLOCK_MONOTONIC, os.O_CLOEXEC)
    try:
        with select.epoll() as poll:
            poll.register(fd, select.EPOLLIN)
            start = time.monotonic_ns() + period
            times = (ctypes.c_long * 4)(0, period, *divmod(start, 10**9))
            libc.timerfd_settime(fd, 1, times, None)  # 1: TFD_TIMER_ABSTIME
            while len(called) < PERIODS:
                poll.poll()
                called.append(time.monotonic_ns())
                os.read(fd, 8)
    finally:
        os.close(fd)
    return _off_phase(called, start)


def _off_phase(called: list[int], phase: int) -> list[float]:
    """How much each call is off its period's phase, too early or too late."""
    period = round(PERIOD * 1e9)
    return [abs((instant - phase + period // 2) % period - period // 2) / 1e9 for instant in called]


def rows() -> Iterator[Row]:
    for loop in FACTORIES:
        bare, bare_worst = p50_p99(run_on(loop, sleep_lateness()))
        system, system_worst = p50_p99(timerfd_lateness())
        median, worst = p50_p99(run_on(loop, periodic_lateness()))
        yield Row(
            f"1 kHz periodic publisher, lateness p50, p99 ({loop})",
            f"{median:.0f} us, {worst:.0f} us",
            f"asyncio.sleep {bare:.0f} us, {bare_worst:.0f} us; a timerfd {system:.0f} us, {system_worst:.0f} us",
            "60 us, 200 us",
            median <= 60 and worst <= 200,
        )
