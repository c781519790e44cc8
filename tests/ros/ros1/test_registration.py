"""Registrations with a real rosmaster, seen by Debian's tools and by rospy."""

from __future__ import annotations

import asyncio
from collections import Counter
from typing import TYPE_CHECKING

import pytest

from r2p.errors import Broken, NoServer
from r2p.ros.middleware import RosPeerEndpoint
from r2p.ros.ros1 import registration
from r2p.ros.ros1.environment import RosAddress
from r2p.ros.ros1.master import MasterClient, MasterError
from r2p.ros.ros1.registration import MasterSession
from r2p.ros.ros1.slave import BusConnection, request_topic
from r2p.ros.ros1.xmlrpc import XmlRpcClient, XmlRpcError
from tests.ports import free_port
from tests.ros.ros1.session import Recorder, running

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from tests.ros.ros1.programs import Ros1, RospyPeer

pytestmark = [
    pytest.mark.xdist_group("ros1"),
    pytest.mark.processes,
    pytest.mark.anyio,
    pytest.mark.parametrize("anyio_backend", [("asyncio", {"use_uvloop": True})], ids=["uvloop"]),
]

STRING = "std_msgs/String"


@pytest.fixture(autouse=True)
def looks_often(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registration, "POLL_S", 0.1)


@pytest.fixture
async def master(ros1: Ros1) -> AsyncIterator[MasterClient]:
    client = XmlRpcClient()
    yield MasterClient(client, ros1.uri)
    client.close()


async def test_tools_see_a_node_with_what_it_has(ros1: Ros1) -> None:
    """Of a topic without publishers `rosnode` never knows the type."""
    async with running(ros1.uri, "/robot/arm") as (session, recorder):
        session.advertise("/robot/arm", "/pose", STRING)
        session.subscribe("/robot/arm", "/robot/arm/velocity", "geometry_msgs/Twist")
        session.serve("/robot/arm", "/reset", 7)
        recorder.bus = [BusConnection(3, "/pose", "/viewer", "o", True, 120, 2, "TCPROS connection to viewer")]
        await recorder.event("up")
        pinged, info, nodes, topics = await asyncio.gather(
            ros1.run("rosnode", "ping", "-c", "1", "/robot/arm"),
            ros1.run("rosnode", "info", "/robot/arm"),
            ros1.run("rosnode", "list"),
            ros1.run("rostopic", "info", "/robot/arm/velocity"),
        )
    assert "xmlrpc reply from http://127.0.0.1:" in pinged.output
    for line in ("* /pose [std_msgs/String]", "* /robot/arm/velocity [unknown type]", "* /reset", "* to: /viewer"):
        assert line in info.output
    assert "/robot/arm" in nodes.output.split()
    assert "Subscribers: \n * /robot/arm (http://127.0.0.1:" in topics.output
    gone = await ros1.run("rosnode", "list")
    assert "/robot/arm" not in gone.output


async def test_publishers_come_and_go(ros1: Ros1, rospy_peer: RospyPeer) -> None:
    """A node's own publisher, and those of other nodes of this process, are not among them."""
    async with running(ros1.uri, "/one", "/two") as (session, recorder):
        session.subscribe("/one", "/chat", STRING)
        session.advertise("/two", "/chat", STRING)
        assert (await recorder.event("publishers", "/one", "/chat"))[3] == []
        await rospy_peer.do("advertise", topic="/chat", type=STRING)
        while not (uris := (await recorder.event("publishers", "/one", "/chat"))[3]):
            pass
        address = await request_topic(session.client, uris[0], "/one", "/chat", 5.0)
        assert address[0] == "127.0.0.1"
        with pytest.raises(XmlRpcError, match=r"publisher of /no at http.* refuses the connection: Not a publisher of"):
            await request_topic(session.client, uris[0], "/one", "/no", 5.0)
        expected = RosPeerEndpoint("/peer", "/chat", STRING)
        await recorder.until(lambda: recorder.graph and expected in recorder.graph.publishers)
        assert recorder.graph
        assert not {"/one", "/two"} & recorder.graph.nodes
        await rospy_peer.do("unadvertise", topic="/chat")
        while uris := (await recorder.event("publishers", "/one", "/chat"))[3]:
            pass


async def test_services_are_found(ros1: Ros1, rospy_peer: RospyPeer) -> None:
    await rospy_peer.do("serve", service="/set", type="std_srvs/SetBool")
    async with running(ros1.uri, "/one") as (session, _):
        host, port = await session.find_service("/one", "/set", 5.0)
        assert (host, port > 0) == ("127.0.0.1", True)
        with pytest.raises(NoServer, match="no ROS node serves /nothing"):
            await session.find_service("/one", "/nothing", 5.0)
    await rospy_peer.do("unserve", service="/set")


async def test_another_node_takes_the_name(ros1: Ros1, master: MasterClient) -> None:
    """What was registered is gone then, and is not unregistered: it might be the other's."""
    async with running(ros1.uri, "/twin") as (session, recorder):
        session.advertise("/twin", "/spin", STRING)
        await recorder.event("up")
        async with running(ros1.uri, "/twin") as (other, other_recorder):
            other.advertise("/twin", "/spin", STRING)
            await other_recorder.event("up")
            _, node, reason = await recorder.event("shut_down")
            assert (node, reason.partition(" (process ")[0]) == (
                "/twin",
                f"another node has taken its name, at {other.slave_uri('/twin')}",
            )
            assert await master.lookup_node("/test", "/twin") == other.slave_uri("/twin")
            session.add_node("/other")
            session.advertise("/other", "/spin", STRING)
            await other_recorder.until(lambda: other_recorder.graph and "/other" in other_recorder.graph.nodes)
            state = await master.get_system_state("/test")
            assert state.publishers["/spin"] == ["/twin", "/other"]


async def test_rosnode_kill(ros1: Ros1, master: MasterClient) -> None:
    async with running(ros1.uri, "/victim") as (session, recorder):
        session.advertise("/victim", "/spin", STRING)
        await recorder.event("up")
        done = await ros1.run("rosnode", "kill", "/victim")
        assert "killed" in done.output
        assert await recorder.event("shut_down") == ("shut_down", "/victim", "/rosnode asked for it: user request")
        while "/spin" in (await master.get_system_state("/test")).publishers:
            pass


async def test_a_program_with_nothing_but_a_node_ends_with_that(ros1: Ros1) -> None:
    recorder = Recorder()
    session = MasterSession(RosAddress(ros1.uri, "127.0.0.1", "127.0.0.1"), recorder, Counter())
    session.ends_without_nodes = lambda: True
    session.add_node("/victim")
    session.advertise("/victim", "/spin", STRING)
    running_session = asyncio.create_task(session.run(recorder, lambda: None))
    await recorder.event("up")
    session.shutdown_asked("/victim", "/rosnode", "user request")
    with pytest.raises(Broken, match="/victim is no longer a ROS node: /rosnode asked for it"):
        await running_session


async def test_a_master_that_dies_and_returns(own_ros1: Ros1) -> None:
    async with running(own_ros1.uri, "/one") as (session, recorder):
        session.advertise("/one", "/spin", STRING)
        session.watch_parameters("/one", recorder.parameter_changed)
        await recorder.event("up")
        own_ros1.close()
        _, text, trouble = await recorder.event("notice")
        assert (trouble, text.partition(" (")[0]) == (True, f"no ROS master at {own_ros1.uri}")
        own_ros1.restart()
        assert await recorder.event("notice") == (
            "notice",
            f"the ROS master at {own_ros1.uri} is back: everything is registered again",
            False,
        )
        master = MasterClient(session.client, own_ros1.uri)
        assert (await master.get_system_state("/test")).publishers == {"/spin": ["/one"]}
        await master.set_param("/test", "/one/gain", 2.5)
        assert await recorder.event("parameter", "/one/gain") == ("parameter", "/one/gain", 2.5)
        assert session.lost == {"ROS master gone": 1}


async def test_no_master_yet(ros1_usr: object) -> None:
    uri = f"http://127.0.0.1:{free_port()}"
    async with running(uri, "/one") as (session, recorder):
        _, reason = await recorder.event("waits")
        assert reason.startswith(f"no ROS master at {uri} (")
        assert reason.endswith("): start roscore, or set ROS_MASTER_URI to another one")
        with pytest.raises(NoServer, match="/reset can't be found: no ROS master at"):
            await session.find_service("/one", "/reset", 5.0)


async def test_what_the_master_has_lost_is_registered_again(ros1: Ros1, master: MasterClient) -> None:
    """As `rosnode cleanup` does it to a node that did not answer for a while."""
    async with running(ros1.uri, "/one") as (session, recorder):
        session.advertise("/one", "/spin", STRING)
        await recorder.event("up")
        assert await master.unregister_publisher("/one", "/spin", session.slave_uri("/one")) == 1
        while "/spin" not in (await master.get_system_state("/test")).publishers:
            pass
        assert session.lost == {"registrations that the ROS master had lost": 1}


async def test_a_service_that_another_node_takes(ros1: Ros1, rospy_peer: RospyPeer) -> None:
    async with running(ros1.uri, "/one") as (session, recorder):
        session.serve("/one", "/reset", 7)
        await recorder.event("up")
        await rospy_peer.do("serve", service="/reset", type="std_srvs/Trigger")
        _, text, trouble = await recorder.event("notice")
        assert (text, trouble) == ("the service /reset of /one is now that of /peer, which was started later", True)
    await rospy_peer.do("unserve", service="/reset")


async def test_an_end_that_the_master_has_not_asked_for(ros1: Ros1) -> None:
    """Anybody can call a node; and its port may have been that of another node, whose end the master wants."""
    async with running(ros1.uri, "/one") as (session, recorder):
        session.advertise("/one", "/spin", STRING)
        await recorder.event("up")
        for name in ("/one", "/other"):
            reason = f"[{name}] Reason: new node registered with same name"
            answer = await session.client.call(session.slave_uri("/one"), "shutdown", "/master", reason)
            assert answer == [1, "shutdown", 0]
        await session.master.get_pid("/one")  # the session has asked the master before
        session.advertise("/one", "/more", STRING)
        done = await ros1.run("rostopic", "info", "/more")
        assert "* /one (http://127.0.0.1:" in done.output
        assert not [event for event in recorder.events if event[0] == "shut_down"]


async def test_more_publishers_than_a_node_connects_to(ros1: Ros1, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registration, "PUBLISHERS_MAX", 2)
    async with running(ros1.uri, "/one") as (session, recorder):
        session.subscribe("/one", "/chat", STRING)
        await recorder.event("publishers")
        uris = ["http://a:1/", "http://b:1/", "http://a:1/", "http://c:1/", session.slave_uri("/one")]
        await session.client.call(session.slave_uri("/one"), "publisherUpdate", "/master", "/chat", uris)
        assert (await recorder.event("publishers"))[3] == ["http://a:1/", "http://b:1/"]
        assert session.lost == {"publishers over the limit": 1}


async def test_what_the_master_refuses_is_said(ros1: Ros1) -> None:
    async with running(ros1.uri, "/one") as (session, recorder):
        session.advertise("/one", "/spin", "noslash")
        _, text, _ = await recorder.event("notice")
        assert text == (
            "the ROS master refuses the publisher /spin of /one: "
            "ERROR: parameter [topic_type] is not a valid package resource name"
        )
        session.advertise("/one", "/spin", STRING)
        await recorder.event("up")


async def test_parameters_that_are_watched(ros1: Ros1, master: MasterClient) -> None:
    await master.set_param("/test", "/one/kp", 1.0)
    async with running(ros1.uri, "/one") as (session, recorder):
        session.watch_parameters("/one", recorder.parameter_changed)
        assert await recorder.event("parameter") == ("parameter", "/one", {"kp": 1.0})
        assert (await ros1.run("rosparam", "set", "/one/kp", "0.7")).code == 0
        assert await recorder.event("parameter") == ("parameter", "/one/kp", 0.7)
        assert (await ros1.run("rosparam", "delete", "/one/kp")).code == 0
        assert await recorder.event("parameter") == ("parameter", "/one/kp", None)
    with pytest.raises(MasterError, match="is not set"):
        await master.get_param("/test", "/one/kp")


async def test_many_nodes(ros1: Ros1, master: MasterClient) -> None:
    names = [f"/many{i}" for i in range(20)]
    async with running(ros1.uri, *names) as (session, recorder):
        for name in names:
            session.advertise(name, "/spin", STRING)
            session.subscribe(name, "/turn", STRING)
        await recorder.event("up")
        assert sorted((await master.get_system_state("/test")).publishers["/spin"]) == sorted(names)
        assert len({session.slave_uri(name) for name in names}) == len(names)
    assert "/spin" not in (await master.get_system_state("/test")).publishers
