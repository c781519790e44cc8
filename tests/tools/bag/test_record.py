"""`r2p bag record`."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
import typer

import r2p
from r2p.codecs.can_bits import Frame
from r2p.errors import TransportError
from r2p.msg import Led
from r2p.recording.bag import Bag
from r2p.recording.frame_reader import BusReader
from r2p.ros.std_srvs import Trigger
from r2p.sim.can import CanNode
from r2p.sim.transport import can_bus
from r2p.tools.bag.record import SNAPSHOT_SERVICE, check, has_topics, record
from r2p.tools.options import byte_size, long_seconds
from r2p.tools.session import Settings, UsageError, join
from tests.tools.rig import PUBLISH, VIA, listening, printed, process, robot, tool

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterator

GIVEN: dict[str, Any] = {
    **dict.fromkeys(("topics", "exclude", "type", "output", "max_size", "max_duration", "max_total", "min_free")),
    "all": False,
    "frames": False,
    "split": False,
    "snapshot": None,
}


async def leds(node: r2p.Node) -> None:
    publisher = node.advertise("leds", Led)
    async for _ in node.every(0.1):
        await publisher.publish(Led(led=publisher.sent, value=1))


@contextlib.asynccontextmanager
async def recording(*args: Any, **options: Any) -> AsyncIterator[None]:
    """`r2p bag record` in the block, ended as by Ctrl-C."""
    task = asyncio.create_task(record(*args, **options))
    await asyncio.sleep(0)
    try:
        yield
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task


def values(path: Path) -> list[int]:
    with Bag(path) as bag:
        return [sample.message.led for sample in bag.samples("leds")]


@pytest.mark.virtual_time
async def test_all_topics_are_recorded_until_a_signal(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "one.mcap"
    async with robot(leds), tool() as session, recording(session, all=True, output=path):
        await asyncio.sleep(2.0)
    recorded = values(path)
    assert recorded == list(range(recorded[0], recorded[0] + len(recorded)))
    assert len(recorded) >= 15
    assert printed(capsys)[0] == {"topic": "leds", "messages": len(recorded), "dropped": 0, "missed": 0}


@pytest.mark.virtual_time
async def test_frames_alone_are_recorded_without_joining_the_bus(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, bus = tmp_path / "one.mcap", can_bus("lab")
    a, _ = (bus.bus.attach(CanNode(name)) for name in "AB")
    settings = Settings(via=["sim:lab"])
    given = GIVEN | {"frames": True}
    check(settings, given)
    async with join(settings, alone=not has_topics(given)) as session, recording(session, frames=True, output=path):
        await asyncio.sleep(1.0)
        a.request(Frame(0x123, b"abc"))
        await asyncio.sleep(1.0)
    with Bag(path) as bag:
        assert [(each.id, each.data) for each in BusReader(bag).read("lab")] == [(0x123, b"abc")]
    assert printed(capsys) == [{"topic": "/lab/frames", "messages": 1, "dropped": 0, "missed": 0}]


def test_there_is_no_file_of_a_bus_that_can_not_be_opened(tmp_path: Path) -> None:
    async def run() -> None:
        async with join(Settings(via=["rtcan:nothing0"]), alone=True) as session:
            await record(session, frames=True, output=tmp_path / "one.mcap")

    with pytest.raises(TransportError, match="rtcan:nothing0: "):
        asyncio.run(run())
    assert not list(tmp_path.iterdir())


def test_an_adapter_that_can_be_opened_once_is_not_for_both() -> None:
    settings = Settings(via=["rtcan:slcan:/dev/ttyACM0"])
    check(settings, GIVEN | {"frames": True})
    with pytest.raises(UsageError, match="can be opened once"):
        check(settings, GIVEN | {"frames": True, "all": True})


@pytest.mark.virtual_time
async def test_it_ends_at_a_limit_and_names_topics_without_a_publisher(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "one.mcap"
    async with robot(leds), tool() as session:
        await record(session, ["leds", "led"], output=path, max_duration=3.0)
    output = capsys.readouterr()
    assert "led has no publisher yet; did you mean leds?" in output.err
    recorded = values(path)
    assert 20 <= len(recorded) <= 30
    assert f'"topic": "leds", "messages": {len(recorded)}, "dropped": 0' in output.out


@pytest.mark.virtual_time
async def test_a_service_writes_the_last_seconds(tmp_path: Path) -> None:
    path = tmp_path / "last.mcap"
    async with robot(leds) as bot, tool() as session, recording(session, all=True, output=path, snapshot=1.0):
        await asyncio.sleep(10.0)
        answers: list[Trigger.Response] = []

        async def ask(node: r2p.Node) -> None:
            answers.append(await node.client(SNAPSHOT_SERVICE, Trigger).call(Trigger.Request(), timeout=5.0))

        bot.start(ask)
        await asyncio.sleep(2.0)
    assert answers == [Trigger.Response(success=True, message=f"{tmp_path}/last-0001.mcap")]
    assert 8 <= len(values(tmp_path / "last-0001.mcap")) <= 20


@pytest.mark.virtual_time
async def test_a_place_for_snapshots_that_can_not_be_written_is_said_at_once(tmp_path: Path) -> None:
    path = tmp_path / f"{'x' * 250}.mcap"  # the names of snapshots are longer
    async with robot(leds), tool() as session, asyncio.timeout(5.0):
        with pytest.raises(r2p.Error, match=r"can't write .*x\.mcap: File name too long"):
            await record(session, all=True, output=path, snapshot=1.0)
    assert not list(tmp_path.iterdir())  # noqa: ASYNC240


@pytest.mark.virtual_time
async def test_a_snapshot_that_can_not_be_written_ends_in_an_error(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "place" / "last.mcap"
    path.parent.mkdir()
    answers: list[Trigger.Response] = []

    async def ask(node: r2p.Node) -> None:
        answers.append(await node.client(SNAPSHOT_SERVICE, Trigger).call(Trigger.Request(), timeout=5.0))

    async with robot(leds) as bot, tool() as session:
        task = asyncio.create_task(record(session, all=True, output=path, snapshot=1.0))
        await asyncio.sleep(3.0)
        path.parent.rmdir()
        bot.start(ask)
        await asyncio.sleep(2.0)
        task.cancel()
        with pytest.raises(r2p.Error, match="1 snapshot could not be written"):
            await task
    why = f"can't write {path.parent}/last-0001.mcap: No such file or directory"
    assert answers == [Trigger.Response(success=False, message=why[-160:])]
    assert f"no snapshot: {why}; the last seconds are still kept: try again" in capsys.readouterr().err


@pytest.fixture
def hangup_ends() -> Iterator[None]:
    """Processes that are started now end at SIGHUP, also if the tests were started with `nohup`."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)


@pytest.mark.processes
@pytest.mark.usefixtures("hangup_ends")
def test_a_process_ends_its_file_and_writes_snapshots_at_signals(tmp_path: Path) -> None:
    path = tmp_path / "one.mcap"
    with process(*PUBLISH) as robot:
        arguments = ("bag", "record", "leds", "-o", str(path), "--via", listening(robot))
        with process(*arguments, "--snapshot", "1m", "--min-free", "0") as child:
            assert child.stderr is not None
            assert "keeping the last seconds" in child.stderr.readline()
            priority = os.getpriority(os.PRIO_PROCESS, child.pid)
            assert priority == max(5, os.getpriority(os.PRIO_PROCESS, 0))
            child.send_signal(signal.SIGUSR1)
            assert f"snapshot: {tmp_path}/one-0001.mcap" in child.stderr.readline()
            child.send_signal(signal.SIGHUP)  # the terminal is closed
            assert child.wait() == 0
        with process(*arguments, "--max-duration", "1", "--min-free", "0") as child:
            output, _ = child.communicate()
            assert child.returncode == 0
    assert '"topic": "leds"' in output
    assert values(path)


@pytest.mark.parametrize(
    ("given", "error"),
    [
        ({}, "name topics, such as odometry or 'camera/\\*', or give -a"),
        ({"topics": ["leds"], "all": True}, "leave out either -a or the topics"),
        ({"topics": ["no topic"]}, "TOPIC: no topic can match 'no topic'"),
        ({"all": True, "exclude": ["a b"]}, "--exclude: no topic can match"),
        ({"all": True, "type": ["Led"]}, "write it as TOPIC=TYPE"),
        ({"all": True, "type": ["leds=Lead"]}, "no message class 'Lead'"),
        ({"frames": True}, "give --via rtcan:can0"),
        ({"all": True, "split": True}, "--split needs a --max-size"),
        ({"all": True, "max_total": 9}, "--max-total deletes .*: it needs --split"),
        ({"all": True, "output": Path("leds.bag")}, "r2p bag convert makes .bag of it"),
    ],
)
def test_what_makes_no_sense_is_refused(given: dict[str, Any], error: str) -> None:
    with pytest.raises(UsageError, match=error):
        check(Settings(via=[VIA]), GIVEN | given)


def test_it_needs_a_network() -> None:
    with pytest.raises(UsageError, match="no network to record"):
        check(Settings(), GIVEN | {"all": True})


def test_an_existing_file_is_refused_at_once(tmp_path: Path) -> None:
    path = tmp_path / "one.mcap"
    path.touch()
    with pytest.raises(UsageError, match="exists, and is never overwritten"):
        check(Settings(via=[VIA]), GIVEN | {"all": True, "output": path})
    with pytest.raises(UsageError, match="no directory"):
        check(Settings(via=[VIA]), GIVEN | {"all": True, "output": tmp_path / "no" / "one.mcap"})


def test_sizes_and_times_have_units() -> None:
    assert [byte_size(text) for text in ("7", "500k", "1.5G", "64KiB", "2 MB")] == [
        7,
        500_000,
        1_500_000_000,
        65_536,
        2_000_000,
    ]
    assert [long_seconds(text) for text in ("90", "500ms", "10m", "2h")] == [90.0, 0.5, 600.0, 7200.0]
    for text in ("", "G", "-1", "1iB", "1e3"):
        with pytest.raises(typer.BadParameter):
            byte_size(text)
