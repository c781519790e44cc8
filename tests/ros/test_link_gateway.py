"""Gateways between networks of r2p and an in-memory ROS network."""

import asyncio
from contextlib import AsyncExitStack

import pytest

import r2p
from r2p import BridgeOptions, Module
from r2p.messages import layout
from r2p.msg import Float32, Pose3, String, Velocity3
from r2p.ros.discovery import GATEWAYS
from r2p.ros.middleware import Qos
from r2p.ros.topics import ros_class
from r2p.testing.network import Network, node_in
from tests.ros.fake import FakeRosNetwork

both = pytest.mark.parametrize("version", [1, 2])


class Speed(r2p.Message, name="robot_msgs/Speed"):
    left: r2p.f32 = 0.0
    right: r2p.f32 = 0.0
    mode: r2p.u8 = 0


def gateway(name: str, bus: Network, network: FakeRosNetwork, **options: object) -> Module:
    return Module(name, via=[bus.transport(), network.transport(**options)], bridge=True, watchdog=False)


@both
@pytest.mark.virtual_time
async def test_types_are_those_of_the_modules_behind_the_gateway(version: int) -> None:
    """Their names count: a velocity has the fields of a pose, and becomes another type of ROS."""
    network, bus = FakeRosNetwork(version), Network()
    user = network.node("/user")
    twist, pose = (ros_class(f"geometry_msgs/{name}", version) for name in ("Twist", "Pose"))
    poses = user.subscribe("/pose", pose)
    user.advertise("/cmd_vel", twist)
    assert layout(Pose3).fingerprint == layout(Velocity3).fingerprint
    async with gateway("GW", bus, network), bus.node("BASE") as base, bus.node("ARM") as arm:
        publisher, subscriber = base.advertise("pose", Pose3), base.subscribe("cmd_vel", Velocity3)
        arm.advertise("speed", Speed)
        await asyncio.sleep(2)
        await publisher.publish(Pose3(1.0, 2.0, 0.0))
        user.publish("/cmd_vel", twist())
        assert await subscriber.fetch() == Velocity3(0.0, 0.0, 0.0)
        types = {each.topic: each.type for each in network.graph(user).publishers}
        assert set(network.nodes) == {"/user", "/GW"}
    assert poses[0].position.y == 2.0
    assert types["/speed"] == "robot_msgs/Speed"


@both
@pytest.mark.virtual_time
async def test_a_topic_of_unknown_type_is_listed_and_the_option_helps(
    version: int, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    wrong = "r2p_msgs/Float32 has 4 bytes, messages of others 9: give another type"
    for options, expected in (
        ({}, {"raw": "type unknown"}),
        ({"types": {"raw": Speed}}, {}),
        ({"types": {"ra?": Float32}}, {"raw": wrong}),
    ):
        network, bus = FakeRosNetwork(version), Network()
        received = network.node("/user").subscribe("/raw", Speed)
        async with gateway("GW", bus, network, **options) as module, bus.node("BASE") as base:
            publisher = base.advertise("raw", Speed)
            base._space.topics["raw"].layout = None  # as firmware: it announces a size, and no type
            await asyncio.sleep(5)
            await publisher.publish(Speed(1.0))
            await asyncio.sleep(0.1)
            ports = {each.link: each.not_carried for each in module.gateway_statistics().ports}
            link = module.links[1]
            assert ports[link.name] == expected
            assert link.stats.lost["not on ROS"] == len(expected)
        assert received == ([] if expected else [Speed(1.0)])
    assert caplog.text.count("raw is not on ROS: type unknown: give --type raw=TYPE") == 1


@both
@pytest.mark.virtual_time
async def test_a_tool_behind_the_gateway_learns_the_type_of_a_ros_topic(version: int) -> None:
    network, bus = FakeRosNetwork(version), Network()
    user = network.node("/user")
    user.advertise("/chatter", String)
    async with gateway("GW", bus, network), bus.module("PC", observer=True) as tool, node_in(tool) as node:
        await asyncio.sleep(4)
        view = tool.network.topics()["chatter"]
        cls = await tool.network.message_type(view.fingerprint or b"")
        assert cls is not None
        assert layout(cls).name == "std_msgs/String"
        subscriber = node.subscribe("chatter", cls)
        await asyncio.sleep(2)
        user.publish("/chatter", String(data="hello"))
        received = await subscriber.fetch()
    assert received.encode() == String(data="hello").encode()


@both
@pytest.mark.virtual_time
async def test_each_node_behind_the_gateway_as_a_ros_node(version: int) -> None:
    network, bus = FakeRosNetwork(version), Network()
    user = network.node("/user")
    received = user.subscribe("/r1/speed", Speed)
    async with gateway("GW", bus, network, ros_nodes=True, ns="/r1"), bus.node("BASE", name="drive") as base:
        publisher = base.advertise("speed", Speed)
        base.subscribe("goal", Speed)
        await publisher.wait_subscriber()
        await asyncio.sleep(2)
        await publisher.publish(Speed(1.0))
        await asyncio.sleep(0.1)
        graph = network.graph(user)
        async with bus.node("GONE") as other:
            other.advertise("speed", Speed)
            await asyncio.sleep(4)
            assert "/r1/GONE/test" in network.nodes
        await asyncio.sleep(10)
        assert "/r1/GONE/test" not in network.nodes
    assert {"/r1/GW", "/r1/BASE/drive"} <= graph.nodes
    assert ("/r1/BASE/drive", "/r1/speed") in {(each.node, each.topic) for each in graph.publishers}
    assert ("/r1/BASE/drive", "/r1/goal") in {(each.node, each.topic) for each in graph.subscribers}
    assert received == [Speed(1.0)]


@both
@pytest.mark.virtual_time
async def test_two_gateways_between_the_same_networks_do_not_loop_and_one_replaces_the_other(
    version: int, caplog: pytest.LogCaptureFixture
) -> None:
    network, bus = FakeRosNetwork(version), Network()
    user = network.node("/user")
    received = user.subscribe("/speed", Speed)
    async with AsyncExitStack() as stack:
        gateways = [await stack.enter_async_context(gateway(f"GW{number}", bus, network)) for number in range(2)]
        base = await stack.enter_async_context(bus.node("BASE"))
        publisher, goals = base.advertise("speed", Speed), base.subscribe("goal", Speed, queue=50)
        user.advertise("/goal", Speed)
        await asyncio.sleep(5)
        for number in range(20):
            await publisher.publish(Speed(float(number)))
            user.publish("/goal", Speed(float(number)))
            await asyncio.sleep(0.05)
        assert [each.left for each in received] == list(range(20))
        assert [(await goals.fetch()).left for _ in range(len(goals.queue))] == list(range(20))
        assert "carry the name" not in caplog.text
        assert (await gateways[0].network.statistics("GW1")).links  # by the bus, though it is a ROS node as well
        modules = base._space.links[0].discovery.modules
        assert {name for name in modules if modules[name].instance is not None} == {"GW0", "GW1", "user"}
        states = {port.state for each in gateways for port in each.gateway_statistics().ports}
        assert "blocked" in states
        forwarding = next(
            each for each in gateways if all(p.state != "blocked" for p in each.gateway_statistics().ports)
        )
        bus.disconnect(forwarding)
        await asyncio.sleep(5)
        received.clear()
        await publisher.publish(Speed(99.0))
        await asyncio.sleep(0.5)
        assert received == [Speed(99.0)]


@both
@pytest.mark.virtual_time
async def test_gateways_of_two_robots_in_their_namespaces(version: int) -> None:
    network = FakeRosNetwork(version)
    user = network.node("/user")
    twist = ros_class("geometry_msgs/Twist", version)
    async with AsyncExitStack() as stack:
        subscribers = []
        for number, options in enumerate(({"ns": "/robot0"}, {})):
            bus = Network()
            bridge = BridgeOptions(prefix="robot1/" if number else "")
            via = [bus.transport(), network.transport(**options)]
            await stack.enter_async_context(Module(f"GW{number}", via=via, bridge=bridge, watchdog=False))
            base = await stack.enter_async_context(bus.node("BASE"))
            subscribers.append(base.subscribe("cmd_vel", Velocity3))
            base.advertise("battery", Float32)
        user.advertise("/robot0/cmd_vel", twist)
        user.advertise("/robot1/cmd_vel", twist)
        user.advertise("/cmd_vel", twist)
        await asyncio.sleep(4)
        user.publish("/robot1/cmd_vel", twist())
        user.publish("/cmd_vel", twist())
        await asyncio.sleep(0.5)
        topics = {each.topic for each in network.graph(user).publishers if each.topic not in ("/rosout", "/robot1/log")}
        assert [len(each.queue) for each in subscribers] == [0, 1]
    assert topics == {"/robot0/battery", "/robot1/battery", GATEWAYS}


@both
@pytest.mark.virtual_time
async def test_a_subscriber_that_comes_later_gets_its_type(version: int) -> None:
    """Until then the topic has the type of ROS, as nobody behind the gateway knows another one."""
    network, bus = FakeRosNetwork(version), Network()
    user = network.node("/user")
    twist = ros_class("geometry_msgs/Twist", version)
    user.advertise("/cmd_vel", twist)
    async with gateway("GW", bus, network), bus.node("BASE") as base:
        await asyncio.sleep(4)
        subscriber = base.subscribe("cmd_vel", Velocity3)
        await asyncio.sleep(4)
        user.publish("/cmd_vel", twist())
        assert await subscriber.fetch() == Velocity3(0.0, 0.0, 0.0)


@both
@pytest.mark.virtual_time
async def test_a_subscriber_of_a_wrong_type_does_not_take_the_topic_from_the_others(version: int) -> None:
    network, bus = FakeRosNetwork(version), Network()
    user = network.node("/user")
    twist = ros_class("geometry_msgs/Twist", version)
    user.advertise("/cmd_vel", twist)
    async with gateway("GW", bus, network, types={"cmd_vel": Velocity3}) as module, bus.node("BASE") as base:
        subscriber = base.subscribe("cmd_vel", Velocity3)
        await asyncio.sleep(4)
        async with bus.node("ATOOL") as wrong:
            wrong.subscribe("cmd_vel", twist)
            await asyncio.sleep(4)
            user.publish("/cmd_vel", twist())
            assert await subscriber.fetch() == Velocity3(0.0, 0.0, 0.0)
            assert not module.links[1].not_carried()


@both
@pytest.mark.virtual_time
async def test_latched_values_pass_the_gateway(version: int) -> None:
    network, bus = FakeRosNetwork(version), Network()
    user = network.node("/user")
    user.publish("/map", Speed(7.0), Qos(transient_local=True))
    async with gateway("GW", bus, network), bus.node("BASE") as base:
        plan = base.advertise("plan", Speed, latch=True)
        await plan.publish(Speed(1.0))
        await plan.publish(Speed(2.0))
        await asyncio.sleep(4)
        late = user.subscribe("/plan", Speed, Qos(transient_local=True))
        maps = base.subscribe("map", Speed)
        await asyncio.sleep(4)
        assert late == [Speed(2.0)]
        assert await maps.fetch() == Speed(7.0)


@both
@pytest.mark.virtual_time
async def test_a_ros_node_with_the_name_of_a_module_is_not_taken_for_it(
    version: int, caplog: pytest.LogCaptureFixture
) -> None:
    network, bus = FakeRosNetwork(version), Network()
    network.node("/BASE").advertise("/speed", Speed)
    network.node("/lidar").advertise("/scan", Speed)
    async with gateway("GW", bus, network) as module, bus.node("BASE"), bus.module("PC", observer=True) as tool:
        await asyncio.sleep(6)
        assert [each.name for each in tool.network.modules() if each.link] == ["BASE", "GW", "lidar"]
        ros = module.links[1].discovery
        assert set(ros.modules) == {"lidar"}
        assert set(ros.topics) >= {"speed", "scan"}  # its topics are there all the same
    assert "carry the name" not in caplog.text
