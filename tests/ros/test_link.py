"""A link to a ROS network, against plain ROS nodes of an in-memory one."""

import asyncio
from typing import Annotated, Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

import r2p
from r2p.errors import TransportError
from r2p.messages import Timestamp
from r2p.msg import IMU, Header, Log, String, Velocity3
from r2p.names import TOPIC, module_path, node_name, topic_name
from r2p.ros.graph_names import GraphNames
from r2p.ros.link import RosLink
from r2p.ros.middleware import Qos, RosArrival, RosType
from r2p.ros.options import QosChange, RosOptions, namespace, qos_change
from r2p.ros.topics import ros_class
from r2p.ros.transport import ros_transport
from r2p.testing.network import Network, node_in
from tests.ros.fake import FakeRosNetwork

both = pytest.mark.parametrize("version", [1, 2])


class Speed(r2p.Message, name="robot_msgs/Speed"):
    left: r2p.f32 = 0.0
    right: r2p.f32 = 0.0
    mode: r2p.u8 = 0


class Scan(r2p.Message, name="robot_msgs/Scan"):
    header: Header = Header()
    ranges: Annotated[r2p.Array[r2p.f32], r2p.Max(100)] = r2p.Array()


# A module


@both
@pytest.mark.virtual_time
async def test_topics_flow_both_ways(version: int) -> None:
    network = FakeRosNetwork(version)
    listener = network.node("/listener")
    speeds = listener.subscribe("/speed", Speed)
    async with r2p.Module("PC1", via=network.transport()) as module, node_in(module, name="drive") as node:
        publisher, subscriber = node.advertise("speed", Speed), node.subscribe("goal", Speed)
        await publisher.wait_subscriber()
        await publisher.publish(Speed(1.0, 2.0, 3))
        listener.publish("/goal", Speed(4.0, 5.0, 6))
        goal = await subscriber.fetch()
        await asyncio.sleep(0.1)
        graph = network.graph(listener)
    assert (speeds, goal) == ([Speed(1.0, 2.0, 3)], Speed(4.0, 5.0, 6))
    assert {(each.node, each.topic) for each in graph.publishers} == {("/drive", "/speed"), ("/drive", "/rosout")}
    assert {(each.node, each.topic) for each in graph.subscribers} == {("/drive", "/goal")}
    assert not network.graph(listener).nodes


@both
@pytest.mark.virtual_time
async def test_each_node_is_a_ros_node_and_before_there_is_one_the_module(version: int) -> None:
    network = FakeRosNetwork(version)
    async with r2p.Module("PC1", via=network.transport(ns="/robot1")) as module:
        await asyncio.sleep(0.1)
        assert not network.nodes  # programs start their nodes soon
        await asyncio.sleep(1)
        assert set(network.nodes) == {"/robot1/PC1"}
        async with node_in(module, name="eyes") as eyes, node_in(module, name="2nd") as second:
            eyes.advertise("image", Speed)
            eyes.advertise("tf", Speed)
            second.subscribe("image", Speed)
            received = eyes.subscribe("goal", Speed), second.subscribe("goal", Speed)
            await asyncio.sleep(0.1)
            assert set(network.nodes) == {"/robot1/eyes", "/robot1/n2nd"}
            own = {(each.endpoint.node, each.endpoint.topic) for each in network.ports}
            network.node("/robot1/user").publish("/robot1/goal", Speed(1.0))
            await asyncio.sleep(0.1)
            assert [len(each.queue) for each in received] == [1, 1]  # each message once, for two ROS nodes
        await asyncio.sleep(0.1)
        assert set(network.nodes) == {"/robot1/user"}
        await asyncio.sleep(1)
        assert set(network.nodes) == {"/robot1/PC1", "/robot1/user"}
    assert own >= {("/robot1/eyes", "/robot1/image"), ("/robot1/n2nd", "/robot1/image"), ("/robot1/eyes", "/tf")}


@both
@pytest.mark.virtual_time
async def test_messages_of_this_module_do_not_come_back(version: int) -> None:
    network = FakeRosNetwork(version)
    async with r2p.Module("PC1", via=network.transport()) as module, node_in(module) as node:
        publisher, subscriber = node.advertise("speed", Speed), node.subscribe("speed", Speed)
        network.node("/other").subscribe("/speed", Speed)
        await asyncio.sleep(0.1)
        await publisher.publish(Speed(1.0))
        await asyncio.sleep(0.1)
        assert len(subscriber.queue) == 1


@pytest.mark.virtual_time
async def test_a_message_may_come_before_its_publisher_is_seen() -> None:
    """Messages and the graph travel apart from each other; what nobody here subscribes to is counted as ever."""
    network = FakeRosNetwork(1)
    async with r2p.Module("PC1", via=network.transport()) as module, node_in(module) as node:
        subscriber = node.subscribe("goal", Speed)
        await asyncio.sleep(0.1)
        link = module.links[0]
        assert isinstance(link, RosLink)
        link.received([RosArrival(name, Speed(2.0).encode()) for name in (b"/goal", b"/other", b"/\xff")])
        assert await subscriber.fetch() == Speed(2.0)
        assert link.losses == {"not subscribed": 2}


@both
@pytest.mark.virtual_time
async def test_standard_types_become_those_of_ros(version: int) -> None:
    network = FakeRosNetwork(version)
    user = network.node("/user")
    imu, twist = ros_class("sensor_msgs/Imu", version), ros_class("geometry_msgs/Twist", version)
    received = user.subscribe("/imu", imu)
    async with r2p.Module("PC1", via=network.transport()) as module, node_in(module) as node:
        publisher, velocity = node.advertise("imu", IMU), node.subscribe("cmd_vel", Velocity3)
        await publisher.wait_subscriber()
        await publisher.publish(IMU(roll=0.0, pitch=0.0, yaw=0.0))
        empty: Any = twist()
        vector = type(empty.linear)
        user.publish("/cmd_vel", twist(linear=vector(x=1.0, y=2.0), angular=vector(z=0.5)))
        assert await velocity.fetch() == Velocity3(1.0, 2.0, 0.5)
        await asyncio.sleep(0.1)
        stamp = node.now()
    assert received[0].orientation.w == 1.0
    assert 0 <= stamp - received[0].header.stamp.ns < 1_000_000_000


@both
@pytest.mark.virtual_time
async def test_stamps_of_headers_are_filled_and_are_those_of_samples(version: int) -> None:
    network = FakeRosNetwork(version)
    user = network.node("/user")
    received = user.subscribe("/scan", Scan)
    async with r2p.Module("PC1", via=network.transport()) as module, node_in(module) as node:
        publisher, scans = node.advertise("scan", Scan), node.subscribe("other", Scan)
        await publisher.wait_subscriber()
        await publisher.publish(Scan(ranges=r2p.Array([1.0])))
        await publisher.publish(Scan(Header(stamp=Timestamp(1_800_000_000, 5)), r2p.Array([2.0])))
        user.publish("/other", Scan(Header(stamp=Timestamp(1_800_000_001, 7))))
        user.publish("/other", Scan())  # a simulation's, or none
        samples = scans.samples()
        stamps = [await anext(samples), await anext(samples)]
        await asyncio.sleep(0.1)
        now = node.now()
    assert 0 <= now - received[0].header.stamp.ns < 1_000_000_000
    assert received[1].header.stamp == Timestamp(1_800_000_000, 5)
    assert stamps[0].stamp == 1_800_000_001_000_000_007
    assert stamps[0].stamped
    assert not stamps[1].stamped


@both
@pytest.mark.virtual_time
async def test_a_type_of_the_ros_nodes_or_of_the_user_is_taken_where_it_converts(version: int) -> None:
    network = FakeRosNetwork(version)
    user = network.node("/user")
    stamped, plain = (ros_class(f"geometry_msgs/{name}", version) for name in ("TwistStamped", "Vector3"))
    by_peer = user.subscribe("/by_peer", stamped)
    by_user = user.subscribe("/by_user", plain, type=None)
    link = network.transport(ros_types={"by_user": "geometry_msgs/msg/Vector3", "nonsense": "std_msgs/String"})
    async with r2p.Module("PC1", via=link) as module, node_in(module) as node:
        one, other = node.advertise("by_peer", Velocity3), node.advertise("by_user", Point)
        node.advertise("nonsense", Velocity3)
        await one.wait_subscriber()
        await other.wait_subscriber()
        await one.publish(Velocity3(1.0, 0.0, 0.0))
        await other.publish(Point(1.0, 2.0, 3.0))
        await asyncio.sleep(4)
        lost = module.links[0].not_carried()
        counted = module.links[0].stats.lost["not on ROS"]
    assert by_peer[0].twist.linear.x == 1.0
    assert by_user == [plain(1.0, 2.0, 3.0)]
    assert lost == {
        "nonsense": "r2p_msgs/Velocity3 can't become std_msgs/String: r2p has no conversion between the two"
    }
    assert counted == 1


class Point(r2p.Message, name="robot_msgs/Point"):
    x: r2p.f64 = 0.0
    y: r2p.f64 = 0.0
    z: r2p.f64 = 0.0


@both
@pytest.mark.virtual_time
async def test_latched_values_reach_later_subscribers_on_both_sides(version: int) -> None:
    network = FakeRosNetwork(version)
    user = network.node("/user")
    user.publish("/map", Speed(7.0), Qos(transient_local=True))
    async with r2p.Module("PC1", via=network.transport()) as module, node_in(module) as node:
        publisher = node.advertise("plan", Speed, latch=True)
        for number in range(3):
            await publisher.publish(Speed(float(number)))
        first = node.subscribe("map", Speed)
        assert await first.fetch() == Speed(7.0)
        second = node.subscribe("map", Speed)
        assert await second.fetch() == Speed(7.0)
        late = user.subscribe("/plan", Speed, Qos(transient_local=True))
        await asyncio.sleep(0.1)
    assert late == [Speed(2.0)]


@pytest.mark.virtual_time
async def test_quality_of_service() -> None:
    network = FakeRosNetwork()
    user = network.node("/user")
    user.advertise("/image", Speed, Qos(reliable=False))
    user.advertise("/map", Speed, Qos(transient_local=True))
    changed = {"changed": QosChange(reliable=False, depth=3)}
    async with r2p.Module("PC1", via=network.transport(qos=changed)) as module, node_in(module) as node:
        node.advertise("periodic", Speed, r2p.Periodic(0.1, Speed))
        node.advertise("sporadic", Speed, r2p.Sporadic(0.02))
        node.advertise("latched", Speed, latch=True)
        node.advertise("changed", Speed)
        node.subscribe("queue", Speed, queue=50)
        node.subscribe("lossy", Speed, lossy=True)
        node.subscribe("image", Speed)
        node.subscribe("map", Speed)
        await asyncio.sleep(0.5)
        found = {each.endpoint.topic[1:]: each.endpoint.qos for each in network.ports if each.owner is not user}
    assert found["periodic"] == Qos(deadline=100_000_000)
    assert found["sporadic"] == Qos(lifespan=20_000_000)
    assert found["latched"] == Qos(transient_local=True, depth=1)
    assert found["changed"] == Qos(reliable=False, depth=3)
    assert found["queue"].depth == 50
    assert not found["lossy"].reliable
    assert not found["image"].reliable  # so that messages arrive at all
    assert found["map"].transient_local


@both
@pytest.mark.virtual_time
async def test_the_graph_is_shown(version: int) -> None:
    network = FakeRosNetwork(version)
    talker = network.node("/arm/talker")
    talker.advertise("/arm/state", String)
    async with r2p.Module("PC1", via=network.transport()) as module:
        await asyncio.sleep(1)
        view = module.network
        topic = view.topics()["arm/state"]
        modules = {each.name: each.state for each in view.modules()}
        nodes = {node: topics for node, topics in view.nodes().items() if node[0] != "PC1"}
        learnt = await view.message_type(topic.fingerprint or b"")
        talker.close()
        await asyncio.sleep(1)
        assert "arm/state" not in view.topics()
    assert learnt is String
    assert "arm/talker" in modules
    assert nodes == {("arm/talker", "talker"): (["arm/state"], [])}


class Wheel(r2p.Message, name="robot_msgs/Wheel"):
    speed: r2p.f32 = 0.0


class Base(r2p.Message, name="robot_msgs/Base"):
    """A type of the user, which does not come with ROS, with another one in it."""

    stamp: Timestamp = Timestamp()
    wheels: Annotated[tuple[Wheel, ...], r2p.Max(8)] = ()
    name: Annotated[str, r2p.Max(20)] = ""


@both
@pytest.mark.virtual_time
async def test_a_type_of_the_user_is_learnt_from_the_node_that_has_it(version: int) -> None:
    network = FakeRosNetwork(version)
    talker = network.node("/talker")
    talker.advertise("/base", Base)
    async with r2p.Module("PC1", via=network.transport(), observer=True) as module, node_in(module) as node:
        await asyncio.sleep(1)
        cls = await module.network.message_type(module.network.topics()["base"].fingerprint or b"")
        assert cls is not None
        assert cls is not Base
        subscriber = node.subscribe("base", cls)
        await subscriber.wait_publisher()
        talker.publish("/base", Base(Timestamp(1, 2), (Wheel(3.0), Wheel(4.0)), "left"))
        message: Any = await subscriber.fetch()
    assert [each.speed for each in message.wheels] == [3.0, 4.0]
    assert (message.stamp, message.name) == (Timestamp(1, 2), "left")


@given(st.text(max_size=300), st.sampled_from(["", "/robot1", "/a/b"]))
def test_any_name_of_the_graph_has_a_valid_name_here_or_none(name: str, ns: str) -> None:
    names = GraphNames(RosOptions(ns=ns))
    topic = names.from_ros(name)
    if topic is not None:
        assert topic_name(topic) == topic or topic[:1].isdecimal() or "/" in topic
        assert names.to_ros(topic) in (name, None)
    module, node = names.module(name)
    assert module_path(module) == module
    assert node_name(node) == node


@given(st.from_regex(TOPIC, fullmatch=True), st.sampled_from(["", "/robot1"]))
def test_the_name_of_a_topic_comes_back(topic: str, ns: str) -> None:
    names = GraphNames(RosOptions(ns=ns))
    there = names.to_ros(topic)
    assert there is None or names.from_ros(there) == topic


@pytest.mark.virtual_time
async def test_a_flood_of_notices_of_other_programs_is_short(caplog: pytest.LogCaptureFixture) -> None:
    async with r2p.Module("PC1", via=FakeRosNetwork(1).transport()) as module:
        link: Any = module.links[0]
        await asyncio.sleep(0.1)
        caplog.clear()
        for number in range(10_000):
            link.notice(f"connection refused: {number % 2}", f"\x1b[2J {number}" + "x" * 5000, trouble=True)
        for _ in range(3):  # as of a connection that is tried again
            link.notice("other", "still heard", trouble=True)
        await asyncio.sleep(1)
        link.notice("connection refused: 0", "refused", trouble=True)
    texts = [record.getMessage() for record in caplog.records if "link ros1:" in record.getMessage()]
    assert len(texts) == 22
    assert max(map(len, texts)) < 3000
    assert texts[-2:] == ["link ros1: still heard", "link ros1: refused (4990 more since the last such line)"]


HOSTILE = ["", "/", "//", "/a b", "/\x00", "/é", "/a/" + "b" * 300, "no_slash", "/~private", "/R2P", "/x" * 200, "/1"]


@both
@pytest.mark.virtual_time
async def test_hostile_names_are_counted_and_raise_nothing(version: int) -> None:
    network = FakeRosNetwork(version)
    kind = RosType("std_msgs/String\n", "\xff" * 1000)
    async with r2p.Module("PC1", via=network.transport()) as module:
        for number, name in enumerate(HOSTILE):
            node = network.node(name + "x" * number)
            node.advertise(name, String, type=kind)
            node.subscribe(name, String, type=kind)
        await asyncio.sleep(1)
        link = module.links[0]
        assert link.losses["name not carried"] >= 5
        assert set(link.discovery.topics) <= {"R2P", "1", "/".join("x" * 200)}
        assert not link.losses["internal error"]


@both
@pytest.mark.virtual_time
async def test_hostile_messages_are_counted_and_raise_nothing(version: int) -> None:
    network = FakeRosNetwork(version)
    user = network.node("/user")
    async with r2p.Module("PC1", via=network.transport()) as module, node_in(module) as node:
        velocities, imus = node.subscribe("cmd_vel", Velocity3), node.subscribe("speed", Speed)
        user.advertise("/cmd_vel", ros_class("geometry_msgs/Twist", version))
        user.advertise("/speed", Speed)
        await asyncio.sleep(0.1)
        for data in (b"", b"\0", b"\xff" * 8, b"\xff" * 100, b"\0\1\0\0", b"\0\1\0\0" + b"\xff" * 4):
            user.publish("/cmd_vel", data)
            user.publish("/speed", data)
        user.publish("/speed", Speed(1.0))
        assert await imus.fetch() == Speed(1.0)
        await asyncio.sleep(0.1)
        lost = module.links[0].losses
        assert not velocities.queue
        assert lost["undecodable"] >= 11
        assert not lost["internal error"]


@both
@pytest.mark.virtual_time
async def test_the_network_goes_and_comes_back(version: int) -> None:
    network = FakeRosNetwork(version)
    network.is_up = False
    user = network.node("/user")
    received = user.subscribe("/speed", Speed)
    async with r2p.Module("PC1", via=network.transport()) as module, node_in(module) as node:
        publisher, subscriber = node.advertise("speed", Speed), node.subscribe("goal", Speed)
        link = module.links[0]
        assert not link.up
        assert link.unreachable_reason == "the master does not answer"
        for number in range(2):
            network.set_up(True)
            await publisher.wait_subscriber()
            await publisher.publish(Speed(float(number)))
            user.publish("/goal", Speed(float(number)))
            assert await subscriber.fetch() == Speed(float(number))
            network.set_up(False)
            await asyncio.sleep(1)
            assert not link.up
            assert not module.network.topics().get("goal", r2p.TopicView("")).publishers
            await publisher.publish(Speed(9.0))
        assert link.stats.lost["link down"] == 2
    assert received == [Speed(0.0), Speed(1.0)]


@both
@pytest.mark.virtual_time
async def test_a_node_whose_name_is_taken_ends_and_the_others_go_on(
    version: int, caplog: pytest.LogCaptureFixture
) -> None:
    network = FakeRosNetwork(version)
    async with (
        r2p.Module("PC1", via=network.transport()) as module,
        node_in(module, name="one") as one,
        node_in(module, name="two") as two,
    ):
        one.advertise("a", Speed)
        two.advertise("b", Speed)
        await asyncio.sleep(0.1)
        module.links[0].shut_down("/one", "another node has its name")  # type: ignore[attr-defined]
        one.advertise("c", Speed)
        await asyncio.sleep(0.1)
        topics = {each.endpoint.topic for each in network.ports}
    assert topics == {"/b", "/rosout"}
    assert "/one is no longer a ROS node here: another node has its name" in caplog.text


@both
@pytest.mark.virtual_time
async def test_logs_are_rosout(version: int) -> None:
    network = FakeRosNetwork(version)
    name = "rosgraph_msgs/Log" if version == 1 else "rcl_interfaces/Log"
    received = network.node("/rqt").subscribe("/rosout", ros_class(name, version))
    async with r2p.Module("PC1", via=network.transport()) as module, node_in(module, name="drive") as node:
        node.advertise("speed", Speed)
        other = node.subscribe("log", Log)
        await asyncio.sleep(0.1)
        node.log.warning("too fast")
        await asyncio.sleep(0.1)
        assert (await other.fetch()).text == "too fast"
    assert [each.msg for each in received if "fast" in each.msg] == ["too fast"]


@both
@pytest.mark.virtual_time
async def test_a_topic_named_like_a_part_of_a_service_is_one_as_any_other(version: int) -> None:
    network = FakeRosNetwork(version)
    user = network.node("/user")
    wheels = user.subscribe("/wheel_r", Speed)
    async with r2p.Module("PC1", via=network.transport()) as module, node_in(module) as node:
        publisher, subscriber = node.advertise("wheel_r", Speed), node.subscribe("motor_q", Speed)
        await publisher.wait_subscriber()
        await publisher.publish(Speed(1.0))
        user.publish("/motor_q", Speed(2.0))
        assert await subscriber.fetch() == Speed(2.0)
    assert wheels == [Speed(1.0)]


# Options


def test_options() -> None:
    assert namespace("robot1/") == "/robot1"
    assert namespace("/a/b") == "/a/b"
    for text in ("/1", "/a b", "/a//b"):
        with pytest.raises(ValueError, match="/robot1"):
            namespace(text)
    assert qos_change("best_effort+depth:5+lifespan:1s") == QosChange(reliable=False, depth=5, lifespan=1_000_000_000)
    for text in ("fast", "depth:x", "depth:1000000", "deadline", "deadline:soon", ""):
        with pytest.raises(ValueError, match="is not a"):
            qos_change(text)
    with pytest.raises(TransportError, match="memory:lab is not a link to ROS"):
        ros_transport("memory:lab", RosOptions())
    transport = ros_transport(FakeRosNetwork().transport(ns="/a"), RosOptions(types={"x": Speed}))
    assert transport.options == RosOptions(ns="/a", types={"x": Speed})


@both
@pytest.mark.virtual_time
async def test_a_gateway_is_a_module_for_those_that_are_none(version: int) -> None:
    """A program and a tool hear nothing of what gateways say to each other."""
    network, bus = FakeRosNetwork(version), Network()
    gateway = r2p.Module("GW", via=[bus.transport(), network.transport(types={"speed": Speed})], bridge=True)
    async with gateway, bus.node("MOTOR") as motor, r2p.Module("PC1", via=network.transport()) as pc:
        motor.advertise("speed", Speed)
        await asyncio.sleep(3.0)
        assert "GW" in {each.name for each in pc.network.modules()}
