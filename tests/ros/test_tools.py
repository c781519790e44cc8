"""Commands of r2p on a ROS network: each is a ROS node of its own, and sees ROS nodes as such."""

import asyncio

import pytest

import r2p
from r2p.msg import Float32, String
from r2p.ros.background import BackgroundResults
from r2p.ros.topics import ros_class
from r2p.testing.network import node_in
from r2p.tools.config import Settings
from r2p.tools.param import targets
from r2p.tools.session import Session
from r2p.tools.types import Types
from tests.ros.fake import FakeRosNetwork

both = pytest.mark.parametrize("version", [1, 2])


@both
@pytest.mark.virtual_time
async def test_two_tools_do_not_take_each_others_names(version: int) -> None:
    network = FakeRosNetwork(version)
    talker = network.node("/talker")
    talker.advertise("/chatter", String)
    async with (
        r2p.Module("_aaaaaa", via=network.transport(), observer=True) as one,
        r2p.Module("_bbbbbb", via=network.transport(), observer=True) as other,
        r2p.Module("PC1", via=network.transport()) as program,
        node_in(one, name="echo") as first,
        node_in(other, name="echo") as second,
    ):
        texts = [node.subscribe("chatter", String) for node in (first, second)]
        await asyncio.sleep(1)
        talker.publish("/chatter", String("hello"))
        assert [await each.fetch() for each in texts] == [String("hello")] * 2
        graph = network.graph(talker)
        seen = {view.name: (view.kind, view.state) for view in program.network.modules()}
        with pytest.raises(r2p.Error, match="talker is a ROS node, which knows nothing of r2p's modules"):
            await program.network.statistics("talker")
    assert {each.node for each in graph.subscribers} == {"/r2p_tool_echo_aaaaaa", "/r2p_tool_echo_bbbbbb"}
    assert seen["talker"] == ("ROS", "running")
    assert seen["r2p_tool_echo_aaaaaa"] == ("ROS", "observer")
    assert seen["PC1"] == ("r2p", "running")


@both
@pytest.mark.virtual_time
async def test_a_topic_has_the_type_that_ros_nodes_call_it_by(version: int) -> None:
    """std_msgs/Float32 and r2p_msgs/Float32 have the same fields."""
    network = FakeRosNetwork(version)
    thermometer = network.node("/thermometer")
    thermometer.advertise("/temperature", ros_class("std_msgs/Float32", version))
    async with r2p.Module("PC1", via=network.transport()) as program:
        await asyncio.sleep(1)
        view = program.network.topics()["temperature"]
        shown = Types(Settings()).describe(view)
        thermometer.close()
        await asyncio.sleep(1)
        later = program.network.topics().get("temperature")
    assert view.fingerprint == r2p.layout(Float32).fingerprint
    assert (view.ros_type, shown["type"]) == ("std_msgs/Float32", "std_msgs/Float32")
    assert later is None


@both
@pytest.mark.virtual_time
async def test_a_list_waits_until_types_are_made(
    version: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """On a busy computer that takes long, and a topic has no size before."""
    network, loop = FakeRosNetwork(version), asyncio.get_running_loop()
    network.node("/talker").advertise("/chatter", String)
    made_at = loop.time() + 4
    monkeypatch.setattr(BackgroundResults, "is_busy", property(lambda _: loop.time() < made_at))
    async with r2p.Module("_tool", via=network.transport(), observer=True) as module:
        await Session(module, Settings(via=[f"ros{version}:"])).settle()
    assert made_at < loop.time() < made_at + 1
    assert capsys.readouterr().err == ""


@both
@pytest.mark.virtual_time
async def test_ros_nodes_are_not_asked_for_parameters_of_r2p(version: int) -> None:
    network = FakeRosNetwork(version)
    talker = network.node("/talker")
    talker.advertise("/chatter", String)
    settings = Settings(via=[f"ros{version}:"])
    async with r2p.Module("_tool", via=network.transport(), observer=True) as module:
        session = Session(module, settings)
        with pytest.raises(r2p.Error, match=f"only ROS nodes on ros{version}:: talker; .* rosparam and ros2 param"):
            await targets.find(session, None)
        with pytest.raises(r2p.Error, match="talker is a ROS node, which knows nothing of r2p's modules"):
            await targets.find(session, "talker")
