"""Links over DDS with real ROS 2: rclpy over Fast DDS, as it is by default."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

import pytest

import r2p
from r2p.msg import String
from r2p.ros.cdr import cdr
from r2p.ros.classes import RosTypes
from r2p.ros.library import definitions_of_ros
from r2p.ros.middleware import Qos, RosType
from r2p.ros.topics import ros_type
from r2p.testing.network import node_in
from r2p.units import SECOND
from tests.ros.dds.test_middleware import endpoint, participant
from tests.ros.rclpy.peer import LIMIT, Event, RclpyPeer

if TYPE_CHECKING:
    from collections.abc import Callable

pytestmark = [pytest.mark.xdist_group("rclpy"), pytest.mark.processes, pytest.mark.anyio]

TYPES = ("sensor_msgs/Imu", "sensor_msgs/Image", "sensor_msgs/JointState", "test_msgs/BasicTypes")
"""Types with arrays and nested types, whose descriptions Cyclone DDS can't compare with those of Fast DDS."""


LATCHED = {"transient_local": True}


@pytest.fixture(scope="module")
def anyio_backend() -> tuple[str, dict[str, Any]]:
    return "asyncio", {"use_uvloop": True}


def load(name: str) -> type[r2p.Message]:
    return RosTypes(2, definitions_of_ros(name, 2)).load(name)


async def arrival(peer: RclpyPeer, topic: str, publish: Callable[[], object]) -> Event:
    """Publish until a message arrives: the subscriber may not know of the publisher yet that has found it."""
    arriving = asyncio.create_task(peer.event(topic=topic))
    while not arriving.done():
        publish()
        await asyncio.wait([arriving], timeout=1.0)
    return arriving.result()


async def test_a_node_talks_with_nodes_of_rclpy(rclpy_peer: RclpyPeer) -> None:
    peer, url = rclpy_peer, f"dds:?domain={rclpy_peer.domain},interface=lo"
    imu = load("sensor_msgs/Imu")
    peer.ask("node", name="listener", namespace="/robot1")
    peer.ask("subscribe", node="listener", topic="/chatter", type="std_msgs/msg/String", decode=True)
    peer.ask("advertise", node="listener", topic="/imu", type="sensor_msgs/msg/Imu")
    async with r2p.Module("PC1", via=url) as module, node_in(module, name="talker") as talker:
        chatter, readings = talker.advertise("chatter", String), talker.subscribe("imu", imu)
        await chatter.wait_subscriber()
        said = await arrival(peer, "/chatter", lambda: chatter.publish_nowait(String(data="grüße")))
        assert said["value"] == {"data": "grüße"}
        peer.ask("talk", node="listener", topic="/imu", value={"header": {"frame_id": "base"}})
        reading: Any = await readings.fetch(LIMIT)
        assert (reading.header.frame_id, reading.orientation.w) == ("base", 1.0)
        nodes = peer.ask("graph", node="listener")["nodes"]
        assert {"/robot1/listener", "/talker"} <= set(nodes)  # and maybe those of other tests, which are about to leave
        assert peer.ask("topics_of", node="listener", of="/talker") == {
            "publishers": {"/chatter": ["std_msgs/msg/String"], "/rosout": ["rcl_interfaces/msg/Log"]},
            "subscribers": {"/imu": ["sensor_msgs/msg/Imu"]},
        }
        (shown,) = peer.ask("endpoints", node="listener", topic="/chatter")["publishers"]
    assert (shown["type"], shown["hash"]) == ("std_msgs/msg/String", ros_type(String, 2).checksum)


@pytest.mark.parametrize("name", TYPES)
async def test_bytes_pass_unchanged(rclpy_peer: RclpyPeer, name: str) -> None:
    peer, full = rclpy_peer, name.replace("/", "/msg/")
    if name.startswith("test_msgs"):
        type_hash = peer.ask("type_hash", type=full)
        kind, data = (name, type_hash), bytes.fromhex(peer.ask("serialize", type=full, value={"int64_value": -2}))
    else:
        cls = load(name)
        own = ros_type(cls, 2)
        kind, data = (own.name, own.checksum), cdr(cls).encode(cls())
    peer.ask("node", name="echo")
    peer.ask("subscribe", node="echo", topic="/there", type=full, qos=LATCHED)
    peer.ask("advertise", node="echo", topic="/back", type=full, qos=LATCHED)
    assert peer.ask("type_hash", type=full) == kind[1]
    async with participant(peer.domain) as (middleware, user):
        kind_here = RosType(*kind)
        middleware.add_node("/a")
        middleware.advertise(endpoint("/there", type=kind_here, transient_local=True))
        middleware.subscribe(endpoint("/back", type=kind_here, transient_local=True))
        sent = await arrival(peer, "/there", lambda: middleware.publish("/a", "/there", data, 0))
        there = bytes.fromhex(sent["data"])
        assert there[: len(data)] == data
        peer.ask("publish", node="echo", topic="/back", data=there.hex())
        await user.until(lambda: user.arrivals)
        assert user.arrivals[0].data[: len(data)] == data
        assert user.arrivals[0].stamp
        assert len(user.arrivals[0].gid) == 16


async def test_the_quality_of_service_is_that_of_ros(rclpy_peer: RclpyPeer) -> None:
    peer, kind = rclpy_peer, ros_type(String, 2)
    kept = cdr(String).encode(String(data="kept"))
    peer.ask("node", name="qos")
    peer.ask("advertise", node="qos", topic="/map", type="std_msgs/msg/String", qos=LATCHED)
    peer.ask("publish", node="qos", topic="/map", value={"data": "kept"})
    peer.ask("advertise", node="qos", topic="/scan", type="std_msgs/msg/String", qos={"reliable": False})
    async with participant(peer.domain) as (middleware, user):
        middleware.add_node("/robot1/latch")
        latched = endpoint("/plan", "/robot1/latch", kind, transient_local=True, depth=1, lifespan=60 * SECOND)
        middleware.advertise(latched)
        middleware.advertise(endpoint("/pose", "/robot1/latch", kind, deadline=10**8))
        middleware.subscribe(endpoint("/map", "/robot1/latch", kind, transient_local=True))
        middleware.subscribe(endpoint("/scan", "/robot1/latch", kind))
        middleware.publish("/robot1/latch", "/plan", kept, 0)
        await user.until(lambda: user.data("/map"))  # sent before this subscriber was there
        assert user.data("/map")[0][: len(kept)] == kept
        peer.ask("subscribe", node="qos", topic="/plan", type="std_msgs/msg/String", qos=LATCHED)
        assert bytes.fromhex((await peer.event(topic="/plan"))["data"])[: len(kept)] == kept
        await user.until(lambda: "qos /scan" in user.notices)
        assert "a publisher of /scan does not offer reliable delivery" in user.notices["qos /scan"]
        seen = {each.topic: each for each in user.graph.publishers}
        assert (seen["/scan"].qos, seen["/map"].qos) == (Qos(reliable=False), Qos(transient_local=True))
        assert seen["/map"].checksum == kind.checksum
        (plan,) = peer.ask("endpoints", node="qos", topic="/plan")["publishers"]
        (pose,) = peer.ask("endpoints", node="qos", topic="/pose")["publishers"]
        peer.ask("subscribe", node="qos", topic="/pose", type="std_msgs/msg/String", qos={"deadline": 10**7})
        await user.until(lambda: "qos /pose" in user.notices)
        assert "asks for a deadline" in user.notices["qos /pose"]
        await user.until(lambda: {each.node for each in user.graph.publishers if each.topic == "/map"} == {"/qos"})
        peer.ask("destroy", node="qos")
        await user.until(lambda: not any(each.topic == "/map" for each in user.graph.publishers))
        await user.until(lambda: any(each[:2] == ("publisher gone", "/map") for each in user.log))
    assert (plan["transient_local"], plan["lifespan"], plan["reliable"]) == (True, 60 * SECOND, True)
    assert (pose["transient_local"], pose["deadline"]) == (False, 10**8)
