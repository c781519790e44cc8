"""r2p as a ROS 1 node among real ones: rospy, Debian's tools, and the C++ relay."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import pytest

from r2p.errors import NoServer, ServiceError
from r2p.ros.middleware import RosPeerServer, RosServer, RosService
from r2p.ros.ros1.tcpros import frame
from tests.ros.ros1.recorder import DONE, SET_BOOL, running, talk

if TYPE_CHECKING:
    from r2p.ros.ros1.middleware import Ros1Middleware
    from tests.ros.ros1.programs import Ros1, RospyPeer

pytestmark = [pytest.mark.xdist_group("ros1"), pytest.mark.processes, pytest.mark.anyio]

LIMIT = 30.0
"""Seconds after which a test has failed."""


async def test_messages_go_both_ways_with_rospy(ros1: Ros1, rospy_peer: RospyPeer) -> None:
    async with running(ros1) as (middleware, user):
        middleware.advertise(talk("/to_rospy"))
        middleware.subscribe(talk("/from_rospy"))
        await rospy_peer.do("subscribe", topic="/to_rospy", type="std_msgs/String")
        await rospy_peer.do("advertise", topic="/from_rospy", type="std_msgs/String")
        await user.until(lambda: ("subscriber joined", "/to_rospy") in user.log)
        await user.until(lambda: ("publisher found", "/from_rospy", "/peer", "std_msgs/String") in user.log)
        await rospy_peer.do("connected", topic="/from_rospy")  # it answers first, and counts the connection then
        for number in range(100):
            middleware.publish("/blink", "/to_rospy", frame(b"to %d" % number), 0)
        await rospy_peer.do("publish", topic="/from_rospy", fields={"data": "hällo"}, count=100)
        await user.until(lambda: len(user.arrivals) == 100)
        assert set(user.data("/from_rospy")) == {frame("hällo".encode())}
        heard = await rospy_peer.do("messages", topic="/to_rospy", count=100)
        assert [each["message"]["data"] for each in heard] == [f"to {number}" for number in range(100)]
        assert heard[0]["header"]["callerid"] == "/blink"
        await rospy_peer.do("unsubscribe", topic="/to_rospy")
        await rospy_peer.do("unadvertise", topic="/from_rospy")
        await user.until(lambda: ("subscribers gone", "/to_rospy") in user.log)
        await user.until(lambda: ("publisher gone", "/from_rospy", "/peer") in user.log)
        assert set(middleware.lost) <= {"probe of a service unanswered"}  # by servers that other tests killed


async def test_services_go_both_ways_with_rospy(ros1: Ros1, rospy_peer: RospyPeer) -> None:
    async with running(ros1) as (middleware, user):
        user.serve = lambda request: request + frame(b"done")
        middleware.serve(RosServer("/blink", "/blink/set", SET_BOOL))
        for persistent in (False, True):
            response = await rospy_peer.do(
                "call",
                service="/blink/set",
                type="std_srvs/SetBool",
                fields={"data": True},
                count=5,
                persistent=persistent,
            )
            assert response == {"success": True, "message": "done"}
        await rospy_peer.do(
            "serve", service="/turn", type="std_srvs/SetBool", fields={"success": True, "message": "done"}
        )
        turn = RosPeerServer("/peer", "/turn", SET_BOOL.name, SET_BOOL.checksum)
        await user.until(lambda: turn in user.graph.servers)  # as its server was asked for its type
        for _ in range(3):
            assert await middleware.call("/blink", "/turn", SET_BOOL, b"\1", LIMIT) == DONE
        together = [middleware.call("/blink", "/turn", SET_BOOL, b"\0", LIMIT) for _ in range(5)]
        assert await asyncio.gather(*together) == [DONE] * 5
        with pytest.raises(ServiceError, match="md5sums do not match"):
            await middleware.call("/blink", "/turn", RosService("std_srvs/SetBool", "0" * 32), b"\1", LIMIT)
        await rospy_peer.do("unserve", service="/turn")
        with pytest.raises(NoServer, match="no ROS node serves /turn"):
            await middleware.call("/blink", "/turn", SET_BOOL, b"\1", LIMIT)
        await rospy_peer.do("serve", service="/turn", type="std_srvs/SetBool", error="I refuse")
        with pytest.raises(ServiceError, match="I refuse"):
            await middleware.call("/blink", "/turn", SET_BOOL, b"\1", LIMIT)
        await rospy_peer.do("unserve", service="/turn")


async def test_a_wrong_type_is_said_in_words_on_both_sides(ros1: Ros1, rospy_peer: RospyPeer) -> None:
    async with running(ros1) as (middleware, user):
        middleware.advertise(talk("/wrong_out"))
        middleware.subscribe(talk("/wrong_in"))
        await rospy_peer.do("subscribe", topic="/wrong_out", type="std_msgs/Int32")
        await rospy_peer.do("advertise", topic="/wrong_in", type="std_msgs/Int32")
        await user.until(lambda: len(user.notices) == 2)
        ours, theirs = (user.notices[f"connection refused: /wrong_{way}"] for way in ("out", "in"))
        assert "[/peer] wants [/wrong_out] as std_msgs/Int32 (md5 da5909fbe378aeaf85e547e830cc1bb7), but" in ours
        assert "types do not match: [std_msgs/String] vs. [std_msgs/Int32]" in theirs  # in rospy's words
        assert middleware.lost["connection refused"] >= 2
        await rospy_peer.do("unsubscribe", topic="/wrong_out")
        await rospy_peer.do("unadvertise", topic="/wrong_in")


async def publish_again(middleware: Ros1Middleware, topic: str, nodes: list[str]) -> None:
    """Publish as each of these nodes, again and again."""
    while True:
        for node in nodes:
            middleware.publish(node, topic, frame(node.encode()), 0)
        await asyncio.sleep(0.05)


async def test_twenty_nodes_of_one_process_are_twenty_ros_nodes(ros1: Ros1, rospy_peer: RospyPeer) -> None:
    names = [f"/fleet/robot{number}" for number in range(20)]
    async with running(ros1, *names) as (middleware, user):
        for number, name in enumerate(names):
            middleware.advertise(talk("/fleet/chat", name))
            middleware.subscribe(talk(f"/fleet/in{number}", name))
            middleware.subscribe(talk("/fleet/all", name))
        await rospy_peer.do("subscribe", topic="/fleet/chat", type="std_msgs/String")
        await rospy_peer.do("advertise", topic="/fleet/all", type="std_msgs/String")
        publishing = asyncio.ensure_future(publish_again(middleware, "/fleet/chat", names))
        heard: set[str] = set()
        while heard != set(names):  # while nodes register, rospy connects to some of them twice, and to others late
            heard |= {each["header"]["callerid"] for each in await rospy_peer.do("messages", topic="/fleet/chat")}
        publishing.cancel()
        await user.until(lambda: user.log.count(("publisher found", "/fleet/all", "/peer", "std_msgs/String")) == 1)
        await rospy_peer.do("connected", topic="/fleet/all")
        await rospy_peer.do("publish", topic="/fleet/all", fields={"data": "once"})
        await user.until(lambda: user.arrivals)
        listed = await ros1.run("rosnode", "list")
        assert set(names) <= set(listed.output.split())
        assert user.data("/fleet/all") == [frame(b"once")]  # a process receives a topic once
        await rospy_peer.do("unsubscribe", topic="/fleet/chat")
        await rospy_peer.do("unadvertise", topic="/fleet/all")
    listed = await ros1.run("rosnode", "list")
    assert not set(names) & set(listed.output.split())
