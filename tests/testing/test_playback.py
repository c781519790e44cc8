"""A recording drives nodes under virtual time: the same outputs, bit for bit, each time."""

import asyncio
from pathlib import Path

import pytest

import r2p
import r2p.sim
import r2p.testing
from r2p.msg import Encoder, Led, Odometry, Speed3
from r2p.recording.recorder import Recorder
from r2p.sim.robots.emulated import Triskar2
from r2p.sim.robots.triskar2 import forward_kinematics, square
from r2p.testing.network import Network, node_in
from r2p.units import SECOND

SECONDS = 3.0


async def record_drive(path: Path) -> None:
    """Record the emulated robot while it drives along a square."""
    async with (
        Triskar2("memory:robot", seed=1) as robot,
        r2p.Module("PC1", via="memory:robot", watchdog=False) as pc,
    ):
        await robot.ready()
        await asyncio.sleep(1)  # until fwdkin waits for the encoders, and none of them is behind
        async with Recorder(pc, path):
            await asyncio.sleep(0.5)
            pc.start(square, 0.5, 0.5, 1.0)
            await asyncio.sleep(SECONDS)


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("drive") / "drive.mcap"
    r2p.sim.run(lambda: record_drive(path))
    return path


def played(drive: Path, start: float = 0.0) -> r2p.testing.Playback:
    return r2p.sim.run(lambda: r2p.testing.play(drive, forward_kinematics, start=start))


def test_the_drive_of_a_robot_has_the_same_outputs_each_time(drive: Path) -> None:
    first, second = played(drive), played(drive)
    assert list(first.outputs) == ["odometry"]
    assert {name for name in first.played if name.startswith("encoder")} == {"encoder1", "encoder2", "encoder3"}
    assert "odometry" not in first.played
    assert first.missed == {}
    assert len(first.outputs["odometry"]) > 30
    assert first == second


def test_and_they_are_those_of_the_robot(drive: Path) -> None:
    with r2p.Bag(drive) as bag:  # from an odometry on, while it still stands
        after = (next(bag.records(["odometry"])).log_time + 1 - bag.start) / SECOND
    playback = played(drive, after)
    recorded = playback.recorded["odometry"]
    outputs = playback.outputs["odometry"][: len(recorded)]  # the last one may be later than the end
    assert [each.data for each in outputs] == [each.data for each in recorded]
    assert [(each.stamp, each.deadline) for each in outputs] == [(each.stamp, each.deadline) for each in recorded]
    assert Odometry.decode(outputs[-1].data).pose.x > 0.2


@pytest.mark.virtual_time
async def test_a_recording_made_live_is_played_by_its_own_clock(tmp_path: Path) -> None:
    path = tmp_path / "live.mcap"
    await asyncio.to_thread(asyncio.run, _record_live(path))
    seen: list[tuple[int, int]] = []

    async def follow(node: r2p.Node) -> None:
        speeds = node.advertise("speed", Speed3)
        async for sample in node.subscribe("leds", Led).samples():
            seen.append((node.now(), sample.stamp))
            await speeds.publish(Speed3((float(sample.message.value), 0.0, 0.0)))

    playback = await r2p.testing.play(path, follow)
    with r2p.Bag(path) as bag:
        records = list(bag.records(["leds"]))
    assert len(records) == 5
    assert seen == [(each.log_time, each.sample.stamp) for each in records]
    assert [Speed3.decode(each.data).value[0] for each in playback.outputs["speed"]] == [0, 1, 2, 3, 4]
    assert playback.recorded == {"speed": []}


async def _record_live(path: Path) -> None:
    async def blink(node: r2p.Node) -> None:
        leds = node.advertise("leds", Led)
        await leds.wait_subscriber()
        for i in range(5):
            await leds.publish(Led(1, i))

    network = Network()
    async with (
        network.module("IMU") as imu,
        network.module("PC1") as pc,
        Recorder(pc, path, ["leds"]),
        node_in(pc) as node,
    ):
        leds = node.subscribe("leds", Led)
        imu.start(blink)
        assert [(await leds.fetch()).value for _ in range(5)] == [0, 1, 2, 3, 4]


@pytest.mark.virtual_time
async def test_modules_of_the_test_take_part(drive: Path, r2p_network: Network) -> None:
    heard: list[Encoder] = []
    async with r2p_network.node("PC1") as node:
        encoders = node.subscribe("left", Encoder, queue=1000)
        playback = await r2p.testing.play(
            drive, network=r2p_network, topics=["encoder*"], exclude=["encoder3"], remap={"encoder1": "left"}, end=1.0
        )
        heard += [Encoder.decode(each.data) for each in encoders.queue]
    assert playback.played == {"left": len(heard), "encoder2": len(heard)}
    assert 40 < len(heard) < 60
    assert playback.outputs == {}


def test_it_needs_virtual_time_and_a_recording(drive: Path) -> None:
    with pytest.raises(r2p.Error, match=r"mark the test with @pytest\.mark\.virtual_time"):
        asyncio.run(r2p.testing.play(drive, forward_kinematics))
    with pytest.raises(r2p.BagError, match=r"no topic of .* is meant; it has battery"):
        r2p.sim.run(lambda: r2p.testing.play(drive, topics=["nothing"]))
    with pytest.raises(r2p.BagError):
        r2p.sim.run(lambda: r2p.testing.play(drive.parent / "none.mcap"))


def test_a_node_that_crashes_fails_the_test(drive: Path) -> None:
    async def crash(node: r2p.Node) -> None:
        await node.subscribe("encoder1", Encoder).fetch()
        raise ValueError("too fast")

    with pytest.raises(r2p.NodeCrashed):
        r2p.sim.run(lambda: r2p.testing.play(drive, crash))
