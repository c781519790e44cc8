"""A group of commands under virtual time: order, restarts, ends and exit codes."""

from __future__ import annotations

import asyncio
import itertools
import signal
from typing import TYPE_CHECKING, Any

import pytest

from r2p.tools.launch.entries import Entry
from r2p.tools.launch.group import Group, RunningCommand

if TYPE_CHECKING:
    from collections.abc import Callable

pytestmark = pytest.mark.virtual_time

FOR_EVER = 1e6
Life = tuple[float, int]
"""For how many seconds a command runs, and its exit code."""


class World:
    """Commands that are not processes: each start of an entry takes the next of its lives, the last one repeatedly.

    `stubborn` entries ignore SIGTERM, others end with 0 or one of `stop_codes`; `ready_after` are the seconds until the
    condition of an entry is true.
    """

    def __init__(self, stubborn: tuple[str, ...] = (), **lives: list[Life]) -> None:
        self.log: list[tuple[float, str]] = []
        self.ready_after: dict[str, float] = {}
        self.stop_codes: dict[str, int] = {}
        self._stubborn = stubborn
        self._lives = lives

    def start(self, entry: Entry) -> RunningCommand:
        loop = asyncio.get_running_loop()
        lives = self._lives.get(entry.name, [(FOR_EVER, 0)])
        seconds, code = lives.pop(0) if len(lives) > 1 else lives[0]
        ended: asyncio.Future[int] = loop.create_future()

        def end(code: int) -> None:
            if not ended.done():
                timer.cancel()
                ended.set_result(code)

        def send(number: int) -> None:
            self._note(f"{signal.Signals(number).name} {entry.name}")
            if number == signal.SIGKILL:
                end(128 + number)
            elif entry.name not in self._stubborn:
                loop.call_later(0.5, end, self.stop_codes.get(entry.name, 0))

        timer = loop.call_later(seconds, end, code)
        self._note(f"start {entry.name}")
        return RunningCommand(ended, send)

    async def wait_ready(self, entry: Entry) -> None:
        await asyncio.sleep(self.ready_after.get(entry.name, 0.0))

    def _note(self, what: str) -> None:
        self.log.append((round(asyncio.get_running_loop().time() - self._zero, 3), what))

    async def run(self, *entries: Entry, at: dict[float, Callable[[Group], object]] | None = None) -> int:
        """Run a group, and call functions with it at certain times; returns the exit code."""
        loop = asyncio.get_running_loop()
        self._zero = loop.time()
        group = Group(entries, self.start, self.wait_ready)
        timers = [loop.call_later(time, call, group) for time, call in (at or {}).items()]
        try:
            return await group.run()
        finally:
            for timer in timers:
                timer.cancel()


def entry(name: str, *after: str, **options: Any) -> Entry:
    return Entry(name=name, arguments=("sim",), after=after, **options)


def ctrl_c(group: Group) -> None:
    group.stop("SIGINT")


async def test_starts_in_order_and_stops_in_reverse_order(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO", "r2p.launch")
    world = World()
    world.ready_after = {"gateway": 2.0, "camera": 5.0}
    code = await world.run(
        entry("gateway", seen=(("module", "GW"),)),
        entry("wheels", "gateway"),
        entry("camera", seen=(("topic", "image"),)),
        entry("planner", "wheels", "camera"),
        at={10.0: ctrl_c},
    )
    assert code == 0
    assert world.log == [
        (0.0, "start gateway"),
        (0.0, "start camera"),
        (2.0, "start wheels"),
        (5.0, "start planner"),
        (10.0, "SIGTERM planner"),
        (10.5, "SIGTERM wheels"),
        (11.0, "SIGTERM camera"),
        (11.5, "SIGTERM gateway"),
    ]
    assert caplog.messages == [
        "waiting for gateway: module GW",
        "waiting for camera: topic image",
        "gateway is ready after 2.0 s: module GW",
        "camera is ready after 5.0 s: topic image",
        "SIGINT: stopping planner, wheels, camera, gateway",
    ]


async def test_runs_until_all_have_ended_and_returns_the_first_failure(caplog: pytest.LogCaptureFixture) -> None:
    world = World(a=[(3.0, 0)], b=[(1.0, 0)], c=[(2.0, 7)], d=[(2.5, 139)])
    assert await world.run(*map(entry, "abcd")) == 7
    assert caplog.messages == ["c ended with exit code 7", "d ended with SIGSEGV"]


async def test_preparations_end_before_the_others_start() -> None:
    world = World(prepare=[(4.0, 0)], robot=[(1.0, 0)])
    assert await world.run(entry("prepare", ends=True), entry("robot", "prepare")) == 0
    assert world.log == [(0.0, "start prepare"), (4.0, "start robot")]


@pytest.mark.parametrize(
    ("restart", "lives", "starts", "code"),
    [
        ("never", [(1.0, 1)], 1, 1),
        ("on-failure", [(1.0, 1), (1.0, 1), (1.0, 0)], 3, 0),
        ("on-failure", [(1.0, 1), (1.0, 2)], 2, 2),
        ("always", [(1.0, 0), (1.0, 1), (1.0, 2)], 3, 2),
    ],
)
async def test_restarts(restart: Any, lives: list[Life], starts: int, code: int) -> None:
    world = World(wheels=lives)
    assert await world.run(entry("wheels", restart=restart)) == code
    assert len(world.log) == starts


async def test_pauses_before_restarts_grow_and_shrink_again_after_a_minute_without_a_failure() -> None:
    world = World(wheels=[*[(1.0, 1)] * 6, (70.0, 1), (1.0, 1), (1.0, 0)])
    assert await world.run(entry("wheels", restart="on-failure")) == 0
    times = [time for time, _ in world.log]
    pauses = [after - before - 1.0 for before, after in itertools.pairwise(times)]
    assert 4.0 <= pauses[4] <= 8.0
    assert 8.0 <= pauses[5] <= 16.0
    assert pauses[6] - 69.0 <= 0.5
    assert pauses[7] <= 1.0


async def test_a_command_in_the_pause_before_its_restart_is_not_started_again() -> None:
    world = World(wheels=[(1.0, 1)])
    assert await world.run(entry("wheels", restart="on-failure"), at={1.1: ctrl_c}) == 0
    assert world.log == [(0.0, "start wheels")]


@pytest.mark.parametrize(("code", "expected"), [(0, 0), (5, 5)])
async def test_the_end_of_a_required_command_stops_the_others(code: int, expected: int) -> None:
    world = World(test=[(3.0, code)])
    assert await world.run(entry("robot"), entry("test", required=True)) == expected
    assert world.log[-1] == (3.0, "SIGTERM robot")


async def test_a_command_that_is_not_ready_in_time_stops_all(caplog: pytest.LogCaptureFixture) -> None:
    world = World()
    world.ready_after = {"imu": FOR_EVER}
    imu = entry("imu", seen=(("topic", "imu_raw"),), ready_timeout=4.0)
    assert await world.run(entry("gateway"), imu, entry("planner", "imu")) == 3
    assert world.log == [
        (0.0, "start gateway"),
        (0.0, "start imu"),
        (4.0, "SIGTERM imu"),
        (4.5, "SIGTERM gateway"),
    ]
    assert caplog.messages == ["imu is not ready after 4 s: topic imu_raw"]


@pytest.mark.parametrize(("code", "expected"), [(0, 1), (6, 6)])
async def test_a_command_that_ends_before_it_is_ready_stops_all(code: int, expected: int) -> None:
    world = World(imu=[(1.0, code)])
    world.ready_after = {"imu": FOR_EVER}
    imu = entry("imu", seen=(("topic", "imu_raw"),))
    assert await world.run(entry("gateway"), imu, entry("planner", "imu")) == expected
    assert world.log[-1] == (1.0, "SIGTERM gateway")


async def test_a_command_may_fail_a_few_times_before_it_is_ready() -> None:
    world = World(imu=[(1.0, 1), (1.0, 1), (FOR_EVER, 0)])
    world.ready_after = {"imu": 8.0}
    imu = entry("imu", seen=(("topic", "imu_raw"),), restart="on-failure")
    assert await world.run(imu, entry("planner", "imu"), at={20.0: ctrl_c}) == 0
    assert [what for _, what in world.log].count("start imu") == 3
    assert (8.0, "start planner") in world.log


async def test_what_does_not_end_is_killed(caplog: pytest.LogCaptureFixture) -> None:
    world = World(stubborn=("wheels",))
    wheels = entry("wheels", stop_timeout=2.0)
    assert await world.run(entry("gateway"), wheels, at={1.0: ctrl_c}) == 137
    assert world.log[2:] == [(1.0, "SIGTERM wheels"), (3.0, "SIGKILL wheels"), (3.0, "SIGTERM gateway")]
    assert caplog.messages == ["wheels has not ended 2 s after SIGTERM: killed", "wheels ended with SIGKILL"]


async def test_how_commands_end_when_they_are_stopped(caplog: pytest.LogCaptureFixture) -> None:
    world = World()
    world.stop_codes = {"slow": 143, "crashed": 1}
    assert await world.run(entry("slow"), entry("crashed"), at={1.0: ctrl_c}) == 1
    assert caplog.messages == ["crashed ended with exit code 1", "slow was ended by SIGTERM, without its own clean-up"]


async def test_a_second_ctrl_c_kills_all_at_once() -> None:
    world = World(stubborn=("gateway", "wheels"))
    code = await world.run(entry("gateway"), entry("wheels"), at={1.0: ctrl_c, 1.2: Group.kill})
    assert code == 137
    assert world.log[2:] == [(1.0, "SIGTERM wheels"), (1.2, "SIGKILL gateway"), (1.2, "SIGKILL wheels")]


async def test_an_error_of_the_launcher_stops_what_it_has_started(monkeypatch: pytest.MonkeyPatch) -> None:
    world = World()

    async def wait_ready(each: Entry) -> None:
        if each.seen:
            await asyncio.sleep(1)
            raise OSError("no such interface")

    monkeypatch.setattr(world, "wait_ready", wait_ready)
    with pytest.raises(ExceptionGroup) as raised:
        await world.run(entry("gateway"), entry("imu", seen=(("topic", "imu_raw"),)))
    assert raised.value.subgroup(OSError) is not None
    assert [what for _, what in world.log][2:] == ["SIGTERM imu", "SIGTERM gateway"]
