"""Recording on each kind of network: what arrives there has the type and the publisher that it has there."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import pytest

import r2p
from r2p.msg import Led
from r2p.recording.bag import Bag
from r2p.recording.recorder import Recorder
from r2p.ros.std_srvs import SetBool
from tests.ros.fake import FakeRosNetwork
from tests.tools.rig import process

if TYPE_CHECKING:
    from pathlib import Path

    from r2p.recording.bag import RecordedSample
    from r2p.testing.network import Network


class Speed(r2p.Message, name="robot_msgs/Speed"):
    """A type that ROS nodes have."""

    left: r2p.f32 = 0.0
    right: r2p.f32 = 0.0


def records(path: Path, topic: str) -> list[RecordedSample]:
    with Bag(path) as bag:
        return list(bag.records([topic]))


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.virtual_time
async def test_topics_of_ros_nodes_are_recorded_in_their_types(version: int, tmp_path: Path) -> None:
    network, path = FakeRosNetwork(version), tmp_path / "ros.mcap"
    talker = network.node("/talker")
    async with r2p.Module("PC1", via=network.transport()) as module, Recorder(module, path):
        await asyncio.sleep(2.0)
        talker.publish("/speed", Speed(1.0, 2.0))
        await asyncio.sleep(1.0)
        for number in range(4):
            talker.publish("/speed", Speed(3.0, number))
        await asyncio.sleep(0.1)
    found = records(path, "speed")
    assert [each.sample.data for each in found][-4:] == [Speed(3.0, number).encode() for number in range(4)]
    assert {r2p.layout(each.cls).name for each in found if each.cls} == {"robot_msgs/Speed"}
    assert {each.sample.source.module for each in found} <= {"talker", ""}


@pytest.mark.virtual_time
async def test_a_gateway_records_what_it_forwards_and_calls_with_both_of_their_topics(tmp_path: Path) -> None:
    path = tmp_path / "gateway.mcap"

    async def serve(node: r2p.Node) -> None:
        async def enable(request: SetBool.Request) -> SetBool.Response:
            return SetBool.Response(success=request.data)

        node.serve("arm", SetBool, enable)
        leds = node.advertise("leds", Led)
        async for _ in node.every(0.1):
            await leds.publish(Led(leds.sent, 1))

    async def call(node: r2p.Node) -> None:
        arm = node.client("arm", SetBool)
        for value in (True, False):
            await arm.call(SetBool.Request(data=value), timeout=5.0)

    gateway = r2p.Module("GW", via=["memory:robot", "memory:office"], bridge=True)
    robot, office = r2p.Module("BOT", via="memory:robot"), r2p.Module("PC", via="memory:office")
    async with gateway, robot, office, Recorder(gateway, path):
        robot.start(serve)
        await asyncio.sleep(3.0)
        await asyncio.wait_for(_done(office, call), 10.0)
    requests, responses = records(path, "arm_q"), records(path, "arm_r")
    assert [each.sample.source.module for each in (*requests, *responses)] == ["PC", "PC", "BOT", "BOT"]
    assert all(each.cls is not None for each in (*requests, *responses))
    numbers = [each.sample.sequence for each in records(path, "leds")]
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
    assert len(numbers) > 20


@pytest.mark.virtual_time
async def test_a_recording_goes_on_after_an_outage_and_counts_what_it_missed(
    r2p_network: Network, tmp_path: Path
) -> None:
    path = tmp_path / "outage.mcap"

    async def publish(node: r2p.Node) -> None:
        leds = node.advertise("leds", Led)
        async for _ in node.every(0.1):
            await leds.publish(Led(leds.sent, 1))

    async with r2p_network.module("BOT") as robot, r2p_network.module("PC") as module:
        robot.start(publish)
        async with Recorder(module, path) as recorder:
            await asyncio.sleep(2.0)
            r2p_network.disconnect(module)
            await asyncio.sleep(1.0)
            r2p_network.connect(module)
            await asyncio.sleep(2.0)
            missed = recorder.counts()["leds"].missed
    numbers = [each.sample.sequence for each in records(path, "leds")]
    assert missed >= 9
    assert numbers[-1] - numbers[0] + 1 - len(numbers) == missed


@pytest.mark.processes
def test_a_type_that_is_only_in_another_program_is_asked_for_over_zenoh(tmp_path: Path) -> None:
    types, path = tmp_path / "wheels.py", tmp_path / "zenoh.mcap"
    types.write_text("import r2p\nclass Wheel(r2p.Message):\n    speed: r2p.f32 = 0.0\n")
    listen, options = "zenoh:?mode=peer&listen=tcp/127.0.0.1:0&scouting=off", "?scouting=off"
    wheel = ("topic", "pub", "wheel", "speed=1.5", "--type", f"{types}:Wheel", "--rate", "50", "-v", "--via", listen)
    with process(*wheel) as robot:
        assert robot.stderr is not None
        line = next(line for line in robot.stderr if "takes connections at" in line)
        via = f"zenoh:{line.split()[-1]}{options}"
        with process("bag", "record", "-a", "-o", str(path), "--max-duration", "1", "--via", via) as recorder:
            recorder.communicate()
            assert recorder.returncode == 0
    with Bag(path) as bag:
        assert {sample.message.speed for sample in bag.samples("wheel")} == {1.5}


async def _done(module: r2p.Module, function: r2p.NodeFunction) -> None:
    module.start(function)
    await module.wait()
