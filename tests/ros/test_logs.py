"""Logs between r2p's topic `log` and /rosout."""

import asyncio

import pytest

import r2p
from r2p.msg import Log
from r2p.ros.middleware import Qos
from r2p.ros.topics import ros_class
from r2p.testing.network import Network, node_in
from tests.ros.fake import FakeRosNetwork

NAMES = {1: "rosgraph_msgs/Log", 2: "rcl_interfaces/Log"}
LEVELS = {1: {"warning": 4, "error": 8}, 2: {"warning": 30, "error": 40}}
both = pytest.mark.parametrize("version", [1, 2])


@both
@pytest.mark.virtual_time
async def test_logs_of_nodes_are_in_rosout(version: int) -> None:
    """Of this module, and of one behind the gateway; a console of ROS 2 asks for what was logged before."""
    network, bus = FakeRosNetwork(version), Network()
    console = network.node("/rqt_console")
    records = console.subscribe("/rosout", ros_class(NAMES[version], version), Qos(transient_local=version == 2))
    gateway = r2p.Module("GW", via=[bus.transport(), network.transport(ns="/robot1")], bridge=True)
    async with (
        gateway,
        bus.module("MOTOR1") as motor,
        node_in(gateway, name="watch") as watch,
        node_in(motor, name="pid") as pid,
    ):
        await asyncio.sleep(3.0)
        watch.log.warning("hot: %d", 90)
        pid.log.error("stalled")
        await asyncio.sleep(1.0)
    found = {(each.name, each.level, each.msg) for each in records}
    names = {1: ("/robot1/watch", "/robot1/MOTOR1/pid"), 2: ("robot1.watch", "robot1.MOTOR1.pid")}[version]
    level = LEVELS[version]
    assert {(names[0], level["warning"], "hot: 90"), (names[1], level["error"], "stalled")} <= found


@both
@pytest.mark.virtual_time
async def test_rosout_is_the_log_of_a_network(version: int) -> None:
    network = FakeRosNetwork(version)
    cls = ros_class(NAMES[version], version)
    async with r2p.Module("PC1", via=network.transport()) as module, node_in(module) as node:
        logs = node.subscribe("log", Log)
        talker = network.node("/arm/talker")
        talker.advertise("/rosout", cls)
        await asyncio.sleep(1.0)
        talker.publish("/rosout", cls(level=LEVELS[version]["error"], name="/arm/talker", msg="grüße"))
        while (record := await logs.fetch(timeout=5.0)).node != "talker":
            pass
    assert record == Log(record.stamp, 40, "arm", "talker", "gr??e")
