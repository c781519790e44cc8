"""Virtual time at a speed, and after another clock: what it waits for, and that real connections work."""

import asyncio
import contextlib
import socket

import pytest

import r2p.sim
from r2p.clock import REAL_TIME, SteeredClock, clock_of
from r2p.sim.clocks import FollowingClock, PacedClock
from r2p.units import SECOND

SIMULATED = 100 * SECOND
"""Some time of a simulator."""


class Real:
    """A computer's clock that the test moves."""

    def __init__(self) -> None:
        self.time = 5 * SECOND

    def __call__(self) -> int:
        return self.time


def test_a_paced_clock_goes_so_many_times_as_fast() -> None:
    real = Real()
    clock = PacedClock(10.0, real)
    real.time += SECOND
    clock.advance(20 * SECOND)
    assert clock.elapsed == 10 * SECOND
    assert clock.delay(30 * SECOND) == 2.0
    clock.advance(9 * SECOND)
    assert clock.elapsed == 10 * SECOND  # never back


def test_what_a_computer_is_too_slow_for_is_not_made_up_for() -> None:
    real = Real()
    clock = PacedClock(10.0, real)
    clock.advance(SECOND)
    real.time += 60 * SECOND  # while callbacks ran, or the computer slept
    clock.advance(SECOND)
    assert clock.elapsed == SECOND
    assert clock.limit() == 2 * SECOND  # a tenth of a real second more


async def _exchange() -> bytes:
    async def answer(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write((await reader.readline()).upper())
        writer.close()

    async with await asyncio.start_server(answer, "127.0.0.1", 0) as server:
        port = server.sockets[0].getsockname()[1]
        async with asyncio.timeout(600.0):  # of virtual time, which a free clock would jump over
            reader, writer = await asyncio.open_connection("localhost", port)
            writer.write(b"hello\n")
            line = await reader.readline()
            writer.close()
            return line


@pytest.mark.parametrize("options", [{"speed": 20.0}, {"follow": True}])
def test_real_sockets_work(options: dict[str, float]) -> None:
    assert r2p.sim.run(_exchange, **options) == b"HELLO\n"  # type: ignore[arg-type] # one of the two


def test_timers_and_jobs_in_threads() -> None:
    async def main() -> list[float]:
        loop = asyncio.get_running_loop()
        due: list[float] = []
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(asyncio.to_thread(socket.gethostname))
            start = loop.time()  # not 0: time goes on while the loop is made
            for delay in (30.0, 10.0, 20.0):
                loop.call_at(start + delay, lambda: due.append(round(loop.time() - start, 6)))
            tasks.create_task(asyncio.sleep(35.0))
        return due

    assert r2p.sim.run(main, speed=2000) == [10.0, 20.0, 30.0]


def test_timers_for_other_programs_are_real() -> None:
    """A time-out of a connection must not be ten times as short, nor wait for a simulator that pauses."""

    async def main() -> list[str]:
        clock, order = clock_of(), []
        assert isinstance(clock, SteeredClock)
        clock.follow(SIMULATED, lambda: True)

        async def connection() -> None:
            REAL_TIME.set(True)
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(0.02):
                    await asyncio.get_running_loop().create_future()
            order.append("time-out")
            asyncio.get_running_loop().call_later(1000.0, order.append, "never").cancel()
            await asyncio.sleep(0.01)
            clock.follow(SIMULATED + SECOND, lambda: True)

        async def node() -> None:
            await asyncio.sleep(1.0)
            order.append("node")

        await asyncio.gather(connection(), node())
        return order

    assert r2p.sim.run(main, follow=True) == ["time-out", "node"]


def test_the_limit_ends_a_program_that_waits_for_others() -> None:
    async def main() -> None:
        await asyncio.get_running_loop().create_future()

    with pytest.raises(r2p.Deadlock, match="its limit of 50 s is reached"):
        r2p.sim.run(main, speed=5000, limit=50)


def test_a_program_follows_another_clock() -> None:
    async def main() -> None:
        loop, clock = asyncio.get_running_loop(), clock_of()
        assert isinstance(clock, SteeredClock)
        is_there = True
        clock.follow(SIMULATED, lambda: is_there)
        assert clock.now() == SIMULATED
        begin, sleeping = loop.time(), asyncio.create_task(asyncio.sleep(3.0))
        await asyncio.sleep(0)  # it begins
        for time in (1.0, 2.999_999_999):
            clock.follow(SIMULATED + round(time * SECOND), lambda: is_there)
            await _turns()
            assert loop.time() - begin == pytest.approx(time, abs=1e-9)
            assert not sleeping.done()
        clock.follow(SIMULATED + 3 * SECOND, lambda: is_there)
        await sleeping
        assert clock.now() == SIMULATED + 3 * SECOND
        sleeping = asyncio.create_task(asyncio.sleep(0.01))
        is_there = False  # the simulator is gone, and real time goes on
        await sleeping
        assert clock.now() >= SIMULATED + 3 * SECOND + SECOND // 100

    r2p.sim.run(main, follow=True)


async def _turns() -> None:
    """Let what is due run, and wait for real events once."""
    ours, theirs = socket.socketpair()
    with ours, theirs:
        ours.setblocking(False)
        theirs.send(b"x")
        await asyncio.get_running_loop().sock_recv(ours, 1)
        await asyncio.sleep(0)


def test_a_clock_that_goes_back_or_far_ahead_runs_no_timers(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    clock = FollowingClock(Real())
    for time in (SIMULATED, SIMULATED - 50 * SECOND, SIMULATED + 900 * SECOND, 0):
        clock.follow(time, lambda: True)
        clock.advance(1000 * SECOND)
        assert (clock.now(), clock.elapsed) == (time, 0)
    for time in (SECOND, SECOND - 1):  # the second one was overtaken
        clock.follow(time, lambda: True)
        clock.advance(1000 * SECOND)
        assert (clock.now(), clock.elapsed) == (SECOND, SECOND)
    assert caplog.messages == ["the time of /clock is followed: it is now 100.0 s"]  # and later ones are too many


def test_jumps_are_logged(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    real = Real()
    clock = FollowingClock(real)
    for time in (SIMULATED, 0):
        clock.follow(time, lambda: True)
        real.time += 2 * SECOND
    assert caplog.messages[1:] == ["the time of /clock goes from 100.0 s to 0.0 s"]


@pytest.mark.parametrize(
    ("options", "error"),
    [
        ({"speed": 0.0}, "how many times as fast as real time"),
        ({"speed": float("nan")}, "how many times as fast"),
        ({"speed": 2.0, "follow": True}, "either a speed or follow=True"),
    ],
)
def test_speeds_that_are_not(options: dict[str, float], error: str) -> None:
    with pytest.raises(r2p.MessageError, match=error):
        r2p.sim.run(_exchange, **options)  # type: ignore[arg-type]
