"""A link to a ROS network, against plain ROS nodes of an in-memory one."""

import asyncio

import pytest

import r2p
from r2p.testing.network import Network, node_in
from tests.ros.fake import FakeRosNetwork


class Speed(r2p.Message, name="robot_msgs/Speed"):
    left: r2p.f32 = 0.0
    right: r2p.f32 = 0.0
    mode: r2p.u8 = 0


both = pytest.mark.parametrize("version", [1, 2])


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
async def test_a_gateway_joins_a_bus_and_ros(version: int) -> None:
    network, bus = FakeRosNetwork(version), Network()
    listener = network.node("/listener")
    speeds = listener.subscribe("/speed", Speed)
    gateway = r2p.Module(
        "GW", via=[bus.transport(), network.transport(types={"speed": Speed, "goal": Speed})], bridge=True
    )
    async with gateway, bus.node("MOTOR") as node:
        publisher, subscriber = node.advertise("speed", Speed), node.subscribe("goal", Speed)
        listener.advertise("/goal", Speed)
        await publisher.wait_subscriber()
        await publisher.publish(Speed(1.0, 2.0, 3))
        await asyncio.sleep(1)
        listener.publish("/goal", Speed(4.0, 5.0, 6))
        goal = await subscriber.fetch()
        await asyncio.sleep(0.1)
        graph = network.graph(listener)
    assert (speeds, goal) == ([Speed(1.0, 2.0, 3)], Speed(4.0, 5.0, 6))
    assert graph.nodes == {"/GW"}
