"""r2p as a ROS 1 node among programs that take long to start: Debian's tools, and peers that are killed."""

from __future__ import annotations

import asyncio
import contextlib
import signal
import struct
from typing import TYPE_CHECKING, Any

import pytest

from r2p.errors import NoServer, ServiceError
from r2p.ros.middleware import Qos, RosServer
from r2p.ros.ros1 import publishers, subscribers
from r2p.ros.ros1.master import MasterClient
from r2p.ros.ros1.tcpros import frame
from r2p.ros.ros1.xmlrpc import XmlRpcClient
from tests.ros.ros1.recorder import ANY, INT, SET_BOOL, running, talk

if TYPE_CHECKING:
    from r2p.ros.ros1.middleware import Ros1Middleware
    from tests.ros.ros1.programs import Ros1

pytestmark = [pytest.mark.xdist_group("ros1"), pytest.mark.processes, pytest.mark.anyio]

LIMIT = 30.0
"""Seconds after which a test has failed."""


@pytest.fixture(scope="module")
def anyio_backend() -> tuple[str, dict[str, Any]]:
    return "asyncio", {"use_uvloop": True}


async def has_service(ros1: Ros1, name: str) -> None:
    """Wait until the master knows the service."""
    client = XmlRpcClient()
    try:
        while name not in (await MasterClient(client, ros1.uri).get_system_state("/test")).services:
            pass
    finally:
        client.close()


async def test_tools_of_ros_see_and_use_a_node(ros1: Ros1) -> None:
    async with running(ros1) as (middleware, user):
        middleware.advertise(talk("/tools/chat", qos=Qos(transient_local=True)))
        middleware.subscribe(talk("/tools/in"))
        middleware.serve(RosServer("/blink", "/set", SET_BOOL))
        middleware.publish("/blink", "/tools/chat", frame(b"latched"), 0)
        user.serve = lambda request: b"\1" + frame(b"on" if request == b"\1" else b"off")
        await has_service(ros1, "/set")
        async with ros1.running("rostopic", "pub", "/tools/in", "std_msgs/String", "hello"):
            echo, info, call, node = await asyncio.gather(
                ros1.run("rostopic", "echo", "-n", "1", "/tools/chat"),
                ros1.run("rosservice", "info", "/set"),
                ros1.run("rosservice", "call", "/set", "true"),
                ros1.run("rosnode", "info", "/blink"),
            )
            await user.until(lambda: user.data("/tools/in"))
        assert 'data: "latched"' in echo.output
        assert "Type: std_srvs/SetBool" in info.output
        assert 'message: "on"' in call.output
        assert " * /tools/chat [std_msgs/String]" in node.output
        assert user.data("/tools/in") == [frame(b"hello")]


async def test_the_cpp_relay_and_a_bag_carry_any_type(ros1: Ros1, tmp_path: object) -> None:
    async with running(ros1) as (middleware, user):
        middleware.advertise(talk("/numbers", kind=INT))
        middleware.subscribe(talk("/relayed", kind=ANY))
        middleware.subscribe(talk("/played", kind=INT))
        bag = f"{tmp_path}/numbers.bag"
        async with (
            ros1.running("topic_tools/relay", "/numbers", "/relayed"),
            ros1.running("rosbag", "record", "--output-name", bag, "--limit", "5", "/numbers") as record,
        ):
            await user.until(lambda: user.log.count(("subscriber joined", "/numbers")) == 2)
            for number in range(5):
                middleware.publish("/blink", "/numbers", struct.pack("<i", number), 0)
            async with asyncio.timeout(LIMIT):
                await record.wait()
            # The relay advertises at its first message: what is published until r2p is connected is not for it.
            while not user.data("/relayed"):
                middleware.publish("/blink", "/numbers", struct.pack("<i", 7), 0)
                with contextlib.suppress(TimeoutError):
                    await user.until(lambda: user.data("/relayed"), 0.05)
            found = [entry for entry in user.log if entry[:2] == ("publisher found", "/relayed")]
            assert [entry[3] for entry in found] == ["std_msgs/Int32"]
        played = await ros1.run("rosbag", "play", "--delay", "1", bag, "/numbers:=/played")
        assert played.code == 0, played.output
        await user.until(lambda: len(user.data("/played")) == 5)
        assert user.data("/played") == [struct.pack("<i", number) for number in range(5)]


async def test_peers_that_are_killed_are_replaced_by_new_ones(ros1: Ros1, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(subscribers, "REPORT_S", 0.2)
    async with running(ros1) as (middleware, user):
        middleware.advertise(talk("/mortal/out"))
        middleware.subscribe(talk("/mortal/in"))
        for attempt in (1, 2):
            with ros1.peer("mortal") as peer:
                await peer.do("subscribe", topic="/mortal/out", type="std_msgs/String")
                await peer.do("advertise", topic="/mortal/in", type="std_msgs/String", latch=True)
                await peer.do("publish", topic="/mortal/in", fields={"data": str(attempt)})
                await user.until(lambda: len(user.data("/mortal/in")) == attempt)  # noqa: B023
                await user.until(lambda: user.log.count(("subscriber joined", "/mortal/out")) == attempt)  # noqa: B023
                middleware.publish("/blink", "/mortal/out", frame(b"hello"), 0)
                await peer.do("messages", topic="/mortal/out")
                peer.kill()
                await user.until(lambda: user.log.count(("subscribers gone", "/mortal/out")) == attempt)  # noqa: B023
                await user.until(lambda: user.log.count(("publisher gone", "/mortal/in", "/mortal")) == attempt)  # noqa: B023
        await user.until(lambda: "no connection: /mortal/in" in user.notices)
        assert "rosnode cleanup" in user.notices["no connection: /mortal/in"]


async def test_a_subscriber_that_stands_still_makes_publishers_wait_for_a_moment_and_then_loses_messages(
    ros1: Ros1, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(publishers, "SLOW_S", 0.2)
    async with running(ros1) as (middleware, user):
        middleware.advertise(talk("/stuck/out", qos=Qos(depth=2)))
        with ros1.peer("stuck") as peer:
            await peer.do("subscribe", topic="/stuck/out", type="std_msgs/String")
            await user.until(lambda: ("subscriber joined", "/stuck/out") in user.log)
            peer.process.send_signal(signal.SIGSTOP)
            long = frame(b"x" * 100_000)
            while "slow subscriber: /stuck/out" not in user.notices:
                if not middleware.full:  # the buffers of both sockets hold some megabytes, and may have room again
                    middleware.publish("/blink", "/stuck/out", long, 0)
                await asyncio.sleep(0)
            assert ("made room",) in user.log
            assert "/stuck reads [/stuck/out] too slowly" in user.notices["slow subscriber: /stuck/out"]
            for number in range(5):
                middleware.publish("/blink", "/stuck/out", frame(b"%d" % number), 0)
                assert not middleware.full
            assert middleware.lost["ROS subscriber too slow"] == 5
            peer.process.send_signal(signal.SIGCONT)
            heard = ""
            while heard != "4":  # of those that waited, the last two are left
                (message,) = await peer.do("messages", topic="/stuck/out")
                heard = message["message"]["data"]
                assert heard[0] in "x34"


async def test_a_server_that_is_killed_is_named_and_its_successor_is_called(ros1: Ros1) -> None:
    async with running(ros1) as (middleware, _user):
        for success in (True, False):
            with ros1.peer("mortal_server") as peer:
                fields = {"success": success, "message": "done"}
                await peer.do("serve", service="/mortal/set", type="std_srvs/SetBool", fields=fields)
                response = await middleware.call("/blink", "/mortal/set", SET_BOOL, b"\1", LIMIT)
                assert response == bytes([success]) + frame(b"done")
                peer.kill()
                peer.process.wait()
                with pytest.raises(NoServer, match=r"registered at 127\.0\.0\.1:.*its node has died"):
                    await call_until_unanswered(middleware)


async def call_until_unanswered(middleware: Ros1Middleware) -> None:
    """Call until the connection that was kept is gone, too."""
    for _ in range(2):
        with contextlib.suppress(ServiceError):
            await middleware.call("/blink", "/mortal/set", SET_BOOL, b"\1", LIMIT)


async def test_messages_go_on_without_the_master_and_new_peers_come_with_its_successor(own_ros1: Ros1) -> None:
    async with running(own_ros1) as (middleware, user):
        middleware.advertise(talk("/out"))
        middleware.subscribe(talk("/in"))
        with own_ros1.peer("old") as old:
            await old.do("subscribe", topic="/out", type="std_msgs/String")
            await old.do("advertise", topic="/in", type="std_msgs/String")
            await user.until(lambda: ("subscriber joined", "/out") in user.log)  # rospy counts it before it connects
            await old.do("connected", topic="/in")
            own_ros1.close()
            await user.until(lambda: any("topics that are connected go on" in each for each in user.notices.values()))
            middleware.publish("/blink", "/out", frame(b"still here"), 0)
            await old.do("messages", topic="/out")
            await old.do("publish", topic="/in", fields={"data": "here, too"})
            await user.until(lambda: user.data("/in") == [frame(b"here, too")])
            own_ros1.restart()
            with own_ros1.peer("new") as new:
                await new.do("subscribe", topic="/out", type="std_msgs/String")
                await user.until(lambda: user.log.count(("subscriber joined", "/out")) == 2)
                middleware.publish("/blink", "/out", frame(b"again"), 0)
                (heard,) = await new.do("messages", topic="/out")
                assert heard["message"] == {"data": "again"}
