"""Topics as channels: their types, who gets their messages, and what of them is told by a status."""

from __future__ import annotations

import asyncio
from typing import Annotated

import pytest

import r2p
from r2p.msg import Header, LaserScan, Led, Log, Odometry, Pose3
from r2p.ros.cdr import cdr
from r2p.testing.network import Network, node_in
from r2p.web import client as web_client
from r2p.web.foxglove import channel_types
from tests.tools.rig import Firmware, keep_types
from tests.web.foxglove.rig import serving, until, viewer

pytestmark = pytest.mark.virtual_time


class Depth(r2p.Message, name="lab/Depth"):
    """A type that only its publisher knows."""

    metres: r2p.f32 = 0.0
    name: Annotated[str, r2p.Max(20)] = ""


async def test_a_topic_is_subscribed_while_a_viewer_wants_it_and_made_once_for_all() -> None:
    network = Network()
    async with network.node("SUB") as node, network.module("PC", observer=True) as pc, serving(pc) as server:
        depths = node.advertise("sea/depth", Depth)
        async with viewer(server) as one, viewer(server) as other:
            await until(lambda: "/sea/depth" in one.channels and "/sea/depth" in other.channels)
            channel = one.channels["/sea/depth"]
            assert (channel["schemaName"], channel["encoding"], channel["schemaEncoding"]) == (
                "lab/msg/Depth",
                "cdr",
                "ros2msg",
            )
            assert channel["schema"] == "float32 metres\nstring name\n"
            await asyncio.sleep(1.0)
            assert not depths.subscribers
            one.subscribe("/sea/depth", 7)
            other.subscribe("/sea/depth", 8)
            await depths.wait_subscriber()
            message = Depth(1.5, "bay")
            await depths.publish(message)
            await until(lambda: one.data and other.data)
            assert one.data[0].subscription == 7
            assert one.data[0].payload == other.data[0].payload == cdr(Depth).encode(message)
            one.say("unsubscribe", subscriptionIds=[7])
            await depths.publish(message)
            await until(lambda: len(other.data) == 2)
            assert len(one.data) == 1
        await until(lambda: not depths.subscribers)


async def test_standard_types_are_those_of_ros_and_poses_are_transforms_too() -> None:
    network = Network()
    async with network.node("BASE") as node, network.module("PC", observer=True) as pc, serving(pc) as server:
        odometry = node.advertise("robot1/odometry", Odometry)
        logs = node.advertise("log", Log)
        async with viewer(server) as one:
            await until(lambda: {"/tf", "/robot1/odometry", "/log"} <= one.channels.keys())
            assert one.channels["/robot1/odometry"]["schemaName"] == "nav_msgs/msg/Odometry"
            assert one.channels["/log"]["schemaName"] == "rcl_interfaces/msg/Log"
            one.subscribe("/tf", 1)
            await odometry.wait_subscriber()
            await odometry.publish(Odometry(Pose3(w=float("inf"))))  # is left out
            await odometry.publish(Odometry(Pose3(1.0, 2.0, 0.0)))
            await until(lambda: one.data)
            (transform,) = one.decoded("/tf")[0].transforms
            assert (transform.header.frame_id, transform.child_frame_id) == ("robot1/odom", "robot1/base_link")
            assert (transform.transform.translation.x, transform.transform.translation.y) == (1.0, 2.0)
            assert server.network.channels.by_number[one.channels["/tf"]["id"]].undecodable == 1
            one.say("unsubscribe", subscriptionIds=[1])
            one.subscribe("/log", 2)
            await logs.wait_subscriber()
            one.connection.sent[:] = [each for each in one.connection.sent if isinstance(each, str)]
            await logs.publish(Log(level=30, module="BASE", node="test", text="careful"))
            await until(lambda: one.data)
            (record,) = one.decoded("/log")
            assert (record.level, record.msg) == (30, "careful")
            node.advertise("robot1/tf", r2p.msg.Text)  # of its own: then none is made
            await until(lambda: "/tf" not in one.channels)


async def test_without_the_definitions_of_ros_topics_have_the_types_of_r2p(monkeypatch: pytest.MonkeyPatch) -> None:
    def conversion(*_args: object) -> None:
        raise r2p.MessageError("the definitions of ROS are in rosbags: pip install 'r2p[ros]'")

    monkeypatch.setattr(channel_types, "conversion", conversion)
    network = Network()
    async with network.node("BASE") as node, network.module("PC", observer=True) as pc, serving(pc) as server:
        odometry = node.advertise("odometry", Odometry)
        async with viewer(server) as one:
            await until(lambda: "/odometry" in one.channels and one.status)
            assert one.channels["/odometry"]["schemaName"] == "r2p_msgs/msg/Odometry"
            expected = "odometry has the type r2p_msgs/Odometry here, not nav_msgs/Odometry: the definitions of ROS are"
            assert any(each.startswith(expected) for each in one.status)
            one.subscribe("/odometry", 1)
            await odometry.wait_subscriber()
            await odometry.publish(Odometry(Pose3(x=1.0)))
            await until(lambda: one.data)
            assert one.decoded("/odometry")[0].pose.x == 1.0


async def test_a_header_without_a_stamp_gets_that_of_the_message() -> None:
    network = Network()
    async with network.node("LIDAR") as node, network.module("PC", observer=True) as pc, serving(pc) as server:
        scans = node.advertise("scan", LaserScan)
        async with viewer(server) as one:
            await until(lambda: "/scan" in one.channels)
            one.subscribe("/scan", 1)
            await scans.wait_subscriber()
            stamp = node.now()
            await scans.publish(LaserScan(Header(frame_id="laser"), ranges=r2p.Array([1.0, 2.0])))
            await until(lambda: one.data)
            (scan,) = one.decoded("/scan")
            assert (scan.header.stamp.ns, scan.header.frame_id, list(scan.ranges)) == (stamp, "laser", [1.0, 2.0])


async def test_latched_messages_reach_later_viewers_too() -> None:
    network = Network()
    async with network.node("MAP") as node, network.module("PC", observer=True) as pc, serving(pc) as server:
        leds = node.advertise("leds", Led, latch=True)
        await leds.publish(Led(3))
        async with viewer(server) as one, viewer(server) as other:
            await until(lambda: "/leds" in one.channels)
            one.subscribe("/leds", 1)
            await until(lambda: one.data)
            other.subscribe("/leds", 2)
            await until(lambda: other.data)
            await asyncio.sleep(1.0)
            assert (len(one.data), len(other.data)) == (1, 1)


async def test_a_topic_of_unknown_type_is_shown_as_bytes_until_its_type_is_known() -> None:
    network = Network()
    async with network.module("SUB") as sub, network.module("PC", observer=True) as pc, serving(pc) as server:
        handlers = dict(sub._opened.own_services._handlers)
        keep_types(sub)
        async with node_in(sub) as node, viewer(server) as one:
            depths = node.advertise("depth", Depth)
            await until(lambda: "/depth" in one.channels)
            assert one.channels["/depth"]["schemaName"] == "r2p_msgs/msg/Untyped"
            assert any("the type of depth is unknown" in each for each in one.status)
            one.subscribe("/depth", 1)
            await depths.wait_subscriber()
            await depths.publish(Depth(1.0, "x"))
            await until(lambda: one.data)
            (shown,) = one.decoded("/depth")
            assert bytes(shown.data) == Depth(1.0, "x").encode()
            sub._opened.own_services._handlers.update(handlers)
            await until(lambda: one.channels["/depth"]["schemaName"] == "lab/msg/Depth")
            assert [each["statusIds"] for each in one.got("removeStatus")] == [["type /depth"]]


async def test_firmware_whose_type_the_user_states_is_typed() -> None:
    async with (
        r2p.Module("PC", via="memory:lab", observer=True, watchdog=False) as pc,
        serving(pc, types={"led": Led}) as server,
    ):
        firmware = Firmware()
        firmware.alive()
        firmware.advertise("led", 1)
        firmware.advertise("other", 3)
        async with viewer(server) as one:
            await until(lambda: {"/led", "/other"} <= one.channels.keys())
            assert one.channels["/led"]["schemaName"] == "r2p_msgs/msg/Led"
            assert one.channels["/other"]["schemaName"] == "r2p_msgs/msg/Untyped"


async def test_a_topic_that_gets_another_type_is_a_new_channel() -> None:
    network = Network()
    async with network.module("PC", observer=True) as pc, serving(pc) as server, viewer(server) as one:
        async with network.node("A") as node:
            node.advertise("value", Led)
            await until(lambda: "/value" in one.channels)
            before = one.channels["/value"]
            one.subscribe("/value", 1)
        await asyncio.sleep(5.0)
        assert one.channels["/value"] == before  # as long as nothing is known of another type
        async with network.node("A") as node:
            texts = node.advertise("value", r2p.msg.Text)
            await until(lambda: "/value" in one.channels and one.channels["/value"]["id"] != before["id"])
            assert one.channels["/value"]["schemaName"] == "std_msgs/msg/String"
            one.subscribe("/value", 1)  # the number is free again
            await texts.wait_subscriber()
            await texts.publish(r2p.msg.Text("hello"))
            await until(lambda: one.data)
            assert one.decoded("/value")[0].data == "hello"


async def test_a_slow_viewer_loses_its_oldest_messages_and_is_told_how_many(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(web_client, "QUEUE_BYTES", 20_000)
    network = Network()
    async with network.node("SUB") as node, network.module("PC", observer=True) as pc, serving(pc) as server:
        depths = node.advertise("depth", Depth)
        async with viewer(server) as slow, viewer(server) as quick:
            await until(lambda: "/depth" in slow.channels and "/depth" in quick.channels)
            slow.subscribe("/depth", 1)
            quick.subscribe("/depth", 1)
            await depths.wait_subscriber()
            slow.connection.reads.clear()
            for number in range(2000):
                await depths.publish(Depth(number))
            await until(lambda: len(quick.data) == 2000)
            slow.connection.reads.set()
            await until(lambda: any(each.startswith("/depth: ") for each in slow.status))
            lost = 2000 - len(slow.data)
            assert f"/depth: {lost} messages lost" in slow.status[-1]
            assert slow.decoded("/depth")[-1].metres == 1999.0
            assert slow.got("status")[-1]["id"] == "lost /depth"
