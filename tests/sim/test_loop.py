from __future__ import annotations

import asyncio
import contextlib
import itertools
import signal
import socket
import threading
from typing import TYPE_CHECKING, cast

import pytest
from hypothesis import given
from hypothesis import strategies as st

import r2p
import r2p.sim.loop
from r2p.clock import clock_of, random_of
from r2p.errors import Deadlock
from r2p.msg import Led
from r2p.sim import run

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from r2p.sim import VirtualLoop
    from r2p.sim.loop import Event

SECOND = 1_000_000_000
HORIZON = 2**22 * SECOND


async def forever() -> None:
    await asyncio.Event().wait()


# The clock


def test_a_day_passes_at_once() -> None:
    async def main() -> tuple[int, int]:
        await asyncio.sleep(86_400)
        return clock_of().monotonic(), clock_of().now()

    assert run(main()) == (86_400 * SECOND, (1_356_998_400 + 86_400) * SECOND)


@pytest.mark.virtual_time
async def test_many_sleeps_do_not_drift() -> None:
    for _ in range(10_000):
        await asyncio.sleep(0.1)
    assert clock_of().monotonic() == 1000 * SECOND


@given(st.integers(0, HORIZON - 2))
def test_each_nanosecond_has_its_own_instant(instant: int) -> None:
    async def main() -> None:
        loop = asyncio.get_running_loop()
        for at in (instant + 1, instant):
            loop.call_at(at / SECOND, lambda: seen.append(clock_of().monotonic()))
        await asyncio.sleep((instant + 1) / SECOND)

    seen: list[int] = []
    run(main)
    assert seen == [instant, instant + 1]


@given(st.floats(0, 2**22 - 1))
def test_any_float_is_an_instant(when: float) -> None:
    async def main() -> float:
        await asyncio.sleep(when)
        return asyncio.get_running_loop().time()

    assert abs(run(main) - when) <= 1e-9


@pytest.mark.virtual_time
async def test_time_stands_still_while_code_runs() -> None:
    before = clock_of().monotonic()
    for _ in range(100):
        await asyncio.sleep(0)
    assert clock_of().monotonic() == before


@pytest.mark.virtual_time
async def test_timers_of_one_instant_go_off_in_order() -> None:
    loop = asyncio.get_running_loop()
    seen: list[int] = []
    for number in range(50):
        loop.call_later(1, seen.append, number)
    await asyncio.sleep(1)
    assert seen == list(range(50))


@pytest.mark.virtual_time
async def test_cancelled_timers_do_not_move_the_clock() -> None:
    loop = asyncio.get_running_loop()
    for number in range(500):
        loop.call_later(1 + number, pytest.fail).cancel()
    await asyncio.sleep(1000)
    assert clock_of().monotonic() == 1000 * SECOND


# What asyncio offers works unchanged


@pytest.mark.virtual_time
async def test_timeouts() -> None:
    with pytest.raises(TimeoutError):
        async with asyncio.timeout(2):
            await forever()
    with pytest.raises(TimeoutError):
        await asyncio.wait_for(forever(), 3)
    assert clock_of().monotonic() == 5 * SECOND


@pytest.mark.virtual_time
async def test_tasks_and_queues() -> None:
    async def produce() -> None:
        for number in range(5):
            await asyncio.sleep(1)
            await queue.put(number)

    queue: asyncio.Queue[int] = asyncio.Queue(1)
    async with asyncio.TaskGroup() as group:
        group.create_task(produce())
        got = [await queue.get() for _ in range(5)]
    assert got == [0, 1, 2, 3, 4]
    assert clock_of().monotonic() == 5 * SECOND


@pytest.mark.virtual_time
async def test_real_descriptors_are_polled() -> None:
    loop = asyncio.get_running_loop()
    near, far = socket.socketpair()
    readable = asyncio.Event()
    loop.add_reader(near, readable.set)
    loop.call_later(1, far.send, b"x")
    await readable.wait()
    loop.remove_reader(near)
    near.close()
    far.close()
    assert clock_of().monotonic() == 1 * SECOND


@pytest.mark.virtual_time
async def test_a_descriptor_that_is_always_ready_does_not_stop_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(r2p.sim.loop, "_BUSY", 100)
    loop = asyncio.get_running_loop()
    near, far = socket.socketpair()
    turns = itertools.count()
    loop.add_writer(near, next, turns)
    await asyncio.sleep(1)
    loop.remove_writer(near)
    near.close()
    far.close()
    assert 98 <= next(turns) <= 102


# Threads


@pytest.mark.virtual_time
async def test_time_waits_for_a_job_in_a_thread() -> None:
    ran_ahead = threading.Event()
    loop = asyncio.get_running_loop()
    loop.call_later(1, ran_ahead.set)
    assert not await asyncio.to_thread(ran_ahead.wait, 0.02)
    assert clock_of().monotonic() == 0
    await asyncio.sleep(1)
    assert ran_ahead.is_set()


@pytest.mark.virtual_time
async def test_a_job_may_call_into_the_loop() -> None:
    loop = asyncio.get_running_loop()
    called = threading.Event()
    seen: list[str] = []

    def job() -> bool:
        loop.call_soon_threadsafe(seen.append, "from the thread")
        loop.call_soon_threadsafe(called.set)
        return called.wait(10)

    assert await loop.run_in_executor(None, job)
    assert seen == ["from the thread"]


@pytest.mark.virtual_time
async def test_a_job_may_fail() -> None:
    with pytest.raises(ZeroDivisionError):
        await asyncio.to_thread(divmod, 1, 0)
    await asyncio.sleep(1)


# Deadlock


def test_a_deadlock_names_who_waits_and_where() -> None:
    async def consume(queue: asyncio.Queue[int]) -> None:
        await queue.get()

    async def main() -> None:
        async with asyncio.TaskGroup() as group:
            group.create_task(consume(asyncio.Queue()), name="consumer")

    with pytest.raises(Deadlock) as caught:
        run(main)
    _, first, second = str(caught.value).splitlines()
    assert first.startswith("  Task-1: ")
    assert ".main (test_loop.py:" in first
    assert second.startswith("  consumer: ")
    assert ".consume (test_loop.py:" in second
    assert "> Queue.get (queues.py:" in second


def test_a_deadlock_cleans_up() -> None:
    async def main() -> None:
        try:
            await forever()
        finally:
            await asyncio.sleep(1)
            ended.append(clock_of().monotonic())

    ended: list[int] = []
    with pytest.raises(Deadlock):
        run(main)
    assert ended == [SECOND]


@pytest.mark.parametrize("delay", [float("inf"), 2.0**22])
def test_time_has_an_end(delay: float) -> None:
    with pytest.raises(Deadlock, match="48 days"):
        run(asyncio.sleep(delay))


async def robot() -> None:
    """A test that can't go on: announcements, a periodic publisher and a time-out repeat themselves all the same."""
    async with r2p.Module("A", via="memory:lab") as module, r2p.Module("B", via="memory:lab") as other:
        node, reader = module.start(idle, name="pub"), other.start(idle, name="sub")
        node.advertise("state", Led, r2p.Periodic(0.1, Led))
        unread = reader.subscribe("state", Led, timeout=1.0)
        await unread.wait_publisher()
        async for _ in reader.subscribe("leds", Led):
            raise AssertionError


async def idle(_node: r2p.Node) -> None:
    await forever()


def test_what_only_repeats_itself_keeps_no_program_going() -> None:
    with pytest.raises(Deadlock, match="leads nowhere") as caught:
        run(robot)
    lines = str(caught.value).splitlines()
    assert lines[1].startswith("  Task-1: robot (test_loop.py:")
    assert "> Subscriber._iterate (subscriber.py:" in lines[1]
    assert lines[1].endswith(", topic leds")
    assert not any("guard" in line for line in lines)


def test_a_gateway_and_its_modules_keep_no_program_going() -> None:
    async def main() -> None:
        async with (
            r2p.Module("GW", via=["memory:a", "memory:b"], bridge=True),
            r2p.Module("A", via="memory:a") as module,
            r2p.Module("B", via="memory:b"),
        ):
            module.start(idle)
            await module.wait()

    with pytest.raises(Deadlock, match=r"Module\.wait"):
        run(main)


def test_a_simulated_bus_keeps_no_program_going() -> None:
    async def main() -> None:
        async with r2p.Module("A", via="sim:lab") as module, r2p.Module("B", via="sim:lab"):
            await module.start(idle).subscribe("leds", Led).wait_publisher()

    with pytest.raises(Deadlock, match=r"wait_publisher .*, topic leds"):
        run(main)


def test_what_is_going_to_happen_some_day_is_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    async def main() -> None:
        async with r2p.Module("A", via="memory:lab") as module, r2p.Module("B", via="memory:lab"):
            timed_out: asyncio.Future[None] = asyncio.get_running_loop().create_future()
            module.start(idle).subscribe("a", Led, timeout=60, on_timeout=lambda: timed_out.set_result(None))
            await timed_out
            with pytest.raises(TimeoutError):
                await module.nodes["idle"].node.subscribe("b", Led, timeout=60).fetch()
            await asyncio.sleep(60)

    monkeypatch.setattr("r2p.sim.loop._IDLE_MAX", 20 * SECOND)
    run(main)


def test_a_program_that_repeats_itself_has_the_time_of_its_limit() -> None:
    async def repeat(node: r2p.Node) -> None:
        async for _ in node.every(1.0):
            pass

    async def main() -> None:
        async with r2p.Module("A", via=[]) as module:
            module.start(repeat)
            try:
                await module.wait()
            finally:
                await asyncio.sleep(1.0)
                ended.append(clock_of().monotonic())

    ended: list[int] = []
    with pytest.raises(Deadlock, match="its limit of 100 s is reached"):
        run(main, limit=100)
    assert ended == [100 * SECOND]  # its last second was the 99th


def test_a_finished_job_wakes_no_other_task() -> None:
    async def main() -> None:
        await asyncio.to_thread(int)
        await forever()

    with pytest.raises(Deadlock):
        run(main)


# run


def test_result_and_exception_come_out() -> None:
    async def fails() -> None:
        raise LookupError("here")

    assert run(asyncio.sleep(1, "result")) == "result"
    with pytest.raises(LookupError, match="here"):
        run(fails)


def test_what_is_left_over_is_cancelled_in_order() -> None:
    async def left_over(number: int) -> None:
        try:
            await forever()
        finally:
            ended.append(number)

    async def main() -> None:
        tasks.extend(asyncio.create_task(left_over(number)) for number in range(20))
        await asyncio.sleep(1)

    ended: list[int] = []
    tasks: list[asyncio.Task[None]] = []
    run(main)
    assert ended == list(range(20))
    assert all(task.cancelled() for task in tasks)


def test_a_failed_group_cancels_in_order() -> None:
    async def child(number: int) -> None:
        with contextlib.suppress(asyncio.CancelledError):
            await forever()
        ended.append(number)

    async def main() -> None:
        async with asyncio.TaskGroup() as group:
            for number in range(20):
                group.create_task(child(number))
            await asyncio.sleep(0)
            raise LookupError

    ended: list[int] = []
    with pytest.raises(ExceptionGroup):
        run(main)
    assert ended == list(range(20))


def test_generators_are_closed() -> None:
    async def numbers() -> AsyncIterator[int]:
        try:
            yield 1
        finally:
            await asyncio.sleep(1)
            closed.append(True)

    async def main() -> None:
        generators.append(numbers())
        await anext(generators[0])

    closed: list[bool] = []
    generators: list[AsyncIterator[int]] = []
    run(main)
    assert closed == [True]


def test_the_same_seed_gives_the_same_numbers() -> None:
    async def main() -> list[float]:
        return [random_of().random() for _ in range(3)]

    assert run(main, seed=1) == run(main, seed=1) != run(main, seed=2)


@pytest.mark.parametrize("delay", [0, 1])
def test_the_first_interrupt_ends_it(delay: float) -> None:
    async def main() -> None:
        for turn in itertools.count():
            await asyncio.sleep(delay)
            if turn == 5:
                signal.raise_signal(signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        run(main)


def test_an_interrupt_ends_the_wait_for_a_job() -> None:
    async def main() -> None:
        loop = asyncio.get_running_loop()
        try:
            await loop.run_in_executor(None, job)
        finally:
            release.set()

    def job() -> None:
        main_thread = threading.main_thread().ident
        assert main_thread is not None
        signal.pthread_kill(main_thread, signal.SIGINT)
        assert release.wait(10)

    release = threading.Event()
    with pytest.raises(KeyboardInterrupt):
        run(main)


def test_a_closed_loop_takes_no_timers() -> None:
    async def main() -> asyncio.AbstractEventLoop:
        return asyncio.get_running_loop()

    loop = cast("VirtualLoop", run(main))
    assert loop.is_closed()
    with pytest.raises(RuntimeError, match="closed"):
        loop.call_later(1, print)


def test_a_task_that_never_waits_does_not_stop_time() -> None:
    turns = 0

    async def busy() -> None:
        nonlocal turns
        while True:
            turns += 1
            await asyncio.sleep(0)

    async def main() -> None:
        task = asyncio.create_task(busy())
        await asyncio.sleep(1.0)
        task.cancel()

    run(main)
    assert 100_000 <= turns < 100_100


# Events of others


@pytest.mark.virtual_time
async def test_events_run_ahead_up_to_the_next_thing_of_the_loop() -> None:
    loop = cast("VirtualLoop", asyncio.get_running_loop())
    seen: list[tuple[str, int]] = []

    def see(name: str) -> None:
        seen.append((name, loop.clock.monotonic() // 1_000_000))

    events: list[Event] = [(at * 1_000_000, number, see, (f"{at} ms",)) for number, at in enumerate((1, 1, 4, 9))]
    loop.call_at(0.004, see, "timer")
    loop.run_ahead(events)
    assert seen == [("1 ms", 1), ("1 ms", 1)]
    await asyncio.sleep(0.004)
    loop.run_ahead(events)
    assert seen[2:] == [("timer", 4), ("4 ms", 5), ("9 ms", 9)]
    assert not events
