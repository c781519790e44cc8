"""Actions between nodes of r2p, within a module, over links that lose messages, and over ROS 2; and with a ROS node."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Annotated

import pytest

import r2p
from r2p.ros import (
    Action,
    ActionClient,
    ActionServer,
    GoalAborted,
    GoalCanceled,
    GoalRejected,
    GoalState,
    ServerGoal,
)
from r2p.ros.action_types import UUID, CancelCode, CancelGoal, GoalInfo, GoalStatusArray, action_types
from r2p.ros.middleware import Qos
from r2p.testing.network import Network, node_in
from tests.ros.fake import FakeRosNetwork
from tests.ros.test_services import Peer


class Count(Action, name="test_msgs/Count"):
    class Goal(r2p.Message):
        to: r2p.i32 = 0
        pause: r2p.f32 = 0.25

    class Result(r2p.Message):
        numbers: Annotated[tuple[r2p.i32, ...], r2p.Max(100)] = ()

    class Feedback(r2p.Message):
        number: r2p.i32 = 0


async def count(goal: ServerGoal[Count.Goal, Count.Result, Count.Feedback]) -> Count.Result:
    if goal.request.to < 0:
        raise GoalAborted("numbers below zero", Count.Result((-1,)))
    numbers: list[int] = []
    try:
        for number in range(goal.request.to):
            if number == 13:
                raise RuntimeError("thirteen")
            numbers.append(number)
            await goal.feedback(Count.Feedback(number))
            await asyncio.sleep(goal.request.pause)
    except asyncio.CancelledError:
        await asyncio.sleep(0.1)  # clean-up
    return Count.Result(tuple(numbers))


@asynccontextmanager
async def module_and_client(kind: str) -> AsyncIterator[tuple[r2p.Module, r2p.Node]]:
    """Yield a module for a server, and a node for its client: in it, or in another on a network of some kind."""
    network, bus = FakeRosNetwork(2), Network(loss=0.1 if kind == "lossy" else 0.0)

    def module(name: str) -> r2p.Module:
        if kind == "can":
            return r2p.Module(name, via="sim:actions")
        return r2p.Module(name, via=network.transport()) if kind == "ros2" else bus.module(name)

    async with module("A") as server:
        if kind == "module":
            async with node_in(server, name="client") as node:
                yield server, node
        else:
            async with module("B") as other, node_in(other, name="client") as node:
                yield server, node


@asynccontextmanager
async def two_nodes(kind: str) -> AsyncIterator[tuple[r2p.Node, r2p.Node]]:
    """The same, with a node for the server."""
    async with module_and_client(kind) as (module, client), node_in(module, name="server") as server:
        yield server, client


every_way = pytest.mark.parametrize("kind", ["module", "lossy", "ros2"])


@pytest.mark.parametrize("kind", ["module", "lossy", "can", "ros2"])
@pytest.mark.virtual_time
async def test_goals(kind: str, caplog: pytest.LogCaptureFixture) -> None:
    async with two_nodes(kind) as (server_node, node):
        client = ActionClient(node, "count", Count)
        if kind == "module":
            with pytest.raises(r2p.NoServer, match="action count has no server: service count/_action/send_goal has"):
                await client.send(Count.Goal(3))
        ActionServer(server_node, "count", Count, count, check=lambda goal: "too far" if goal.to > 50 else None)
        await client.ready(5)
        seen: list[int] = []
        async with await client.send(Count.Goal(4), timeout=10) as goal:
            assert goal.state in (GoalState.ACCEPTED, GoalState.EXECUTING)
            async for feedback in goal:
                seen += [feedback.number]
            result = await goal.wait()
        assert result.numbers == (0, 1, 2, 3)
        if kind == "lossy":
            assert set(seen) <= {0, 1, 2, 3}
        else:
            assert seen == [0, 1, 2, 3]
        assert goal.has_ended
        assert goal.accepted_at > 0
        with pytest.raises(GoalRejected, match="action count: the server has rejected the goal"):
            await client.send(Count.Goal(51), timeout=10)
        assert "action count: goal rejected: too far" in caplog.text
        with pytest.raises(GoalAborted, match="the server has aborted the goal") as aborted:
            await (await client.send(Count.Goal(-1), timeout=10)).wait(10)
        assert aborted.value.result == Count.Result((-1,))
        assert "action count: goal aborted: numbers below zero" in caplog.text
        failing = await client.send(Count.Goal(20), timeout=10)
        with pytest.raises(TimeoutError, match="the goal has not ended within 1 s"):
            await failing.wait(1)
        with pytest.raises(GoalAborted):
            await failing.wait(60)
        assert "action count: goal aborted: RuntimeError: thirteen" in caplog.text
        assert not client.goals


@every_way
@pytest.mark.virtual_time
async def test_cancellation(kind: str) -> None:
    async with two_nodes(kind) as (server_node, node):
        client = ActionClient(node, "count", Count)
        server = ActionServer(server_node, "count", Count, count)
        await client.ready(5)
        goal = await client.send(Count.Goal(100, 10.0), timeout=10)
        await asyncio.sleep(15)
        assert await goal.cancel(10)
        with pytest.raises(GoalCanceled, match="action count: the goal was cancelled") as canceled:
            await goal.wait(10)
        assert canceled.value.result == Count.Result((0, 1))
        assert not await goal.cancel(10)
        with pytest.raises(TimeoutError, match="the goal has not ended within 5 s: cancelled"):
            await client.call(Count.Goal(100, 10.0), timeout=5)
        await asyncio.sleep(10)
        assert not server.running
        goals = [await client.send(Count.Goal(100, 10.0), timeout=10) for _ in range(3)]
        next(iter(server.running)).can_cancel = False
        assert not await goals[0].cancel(10)
        assert await client.cancel_all(10) == 2
        await asyncio.sleep(10)
        assert [each.has_ended for each in goals] == [False, True, True]
        task = asyncio.create_task(client.call(Count.Goal(100, 10.0)))
        await asyncio.sleep(15)
        task.cancel()
        await asyncio.sleep(10)
        assert len(server.running) == 1
        states = [each.state for each in server.goals.values()]
        assert states.count(GoalState.CANCELED) == 5


@pytest.mark.virtual_time
async def test_limits_and_preemption() -> None:
    async with two_nodes("module") as (server_node, node):
        full = ActionServer(server_node, "full", Count, count, limit=1)
        ActionServer(server_node, "last", Count, count, limit=1, preempt=True)
        client, last = ActionClient(node, "full", Count), ActionClient(node, "last", Count)
        goal = await client.send(Count.Goal(4, 1.0))
        with pytest.raises(GoalRejected):
            await client.send(Count.Goal(4, 1.0))
        assert (await goal.wait()).numbers == (0, 1, 2, 3)
        first = await last.send(Count.Goal(4, 1.0))
        await asyncio.sleep(1.5)
        second = await last.send(Count.Goal(1, 1.0))
        third = await last.send(Count.Goal(2, 1.0))
        with pytest.raises(GoalAborted) as aborted:
            await first.wait()
        assert aborted.value.result.numbers == (0, 1)
        with pytest.raises(GoalAborted):
            await second.wait()
        assert (await third.wait()).numbers == (0, 1)
        assert len(full.goals) == 1


@pytest.mark.parametrize("kind", ["module", "network", "ros2"])
@pytest.mark.virtual_time
async def test_the_end_of_a_node_aborts_its_goals(kind: str) -> None:
    end = asyncio.Event()

    async def serve(node: r2p.Node) -> None:
        ActionServer(node, "count", Count, count)
        await end.wait()

    async with module_and_client(kind) as (module, node):
        module.start(serve)
        client = ActionClient(node, "count", Count)
        await client.ready(5)
        goal = await client.send(Count.Goal(100, 10.0), timeout=10)
        await asyncio.sleep(5)
        end.set()
        with pytest.raises(GoalAborted) as aborted:
            await goal.wait(10)
        assert aborted.value.result.numbers == (0,)


@pytest.mark.virtual_time
async def test_a_server_that_is_gone() -> None:
    bus = Network()
    async with bus.node("B", name="client") as node, bus.module("A") as module, node_in(module) as server_node:
        client = ActionClient(node, "count", Count)
        ActionServer(server_node, "count", Count, count)
        await client.ready(5)
        goal = await client.send(Count.Goal(100, 10.0))
        bus.disconnect(module)
        with pytest.raises(r2p.NoServer, match="action count: its server is gone for 10 s"):
            await goal.wait(60)
        assert goal.has_ended
        assert [each async for each in goal] == [Count.Feedback(0)]


@pytest.mark.virtual_time
async def test_the_end_of_a_client_cancels_what_it_waits_for() -> None:
    async def call(node: r2p.Node) -> None:
        await ActionClient(node, "count", Count).call(Count.Goal(100, 10.0))

    async with two_nodes("ros2") as (server_node, node):
        server = ActionServer(server_node, "count", Count, count)
        caller = asyncio.create_task(call(node))
        await asyncio.sleep(5)
        assert len(server.running) == 1
        caller.cancel()
        await asyncio.sleep(5)
        assert [each.state for each in server.goals.values()] == [GoalState.CANCELED]


@pytest.mark.virtual_time
async def test_a_client_that_is_a_ros_node() -> None:
    """It makes the services and topics of the action by their types, as rclpy does."""
    network, types = FakeRosNetwork(2), action_types(Count)
    ros = network.node("/pilot")
    send, get_result, cancel = Peer(ros, types.send_goal), Peer(ros, types.get_result), Peer(ros, CancelGoal)
    feedback = ros.subscribe("/count/_action/feedback", types.feedback_message)
    statuses = ros.subscribe("/count/_action/status", GoalStatusArray, Qos(transient_local=True, depth=1))
    goal_id = UUID(b"0123456789abcdef")
    async with r2p.Module("A", via=network.transport()) as module, node_in(module, name="counter") as node:
        ActionServer(node, "count", Count, count)
        await asyncio.sleep(1)
        servers = {name: entry[1] for name, entry in network.servers.items()}
        assert {name: each.type.name for name, each in servers.items()} == {
            "/count/_action/send_goal": "test_msgs/action/Count_SendGoal",
            "/count/_action/get_result": "test_msgs/action/Count_GetResult",
            "/count/_action/cancel_goal": "action_msgs/CancelGoal",
        }
        assert {each.node for each in servers.values()} == {"/counter"}
        request = types.send_goal.Request(goal_id=goal_id, goal=Count.Goal(3, 1.0))
        answer = await send.call("/count/_action/send_goal", request)
        assert answer.accepted
        assert not (await send.call("/count/_action/send_goal", request)).accepted  # its identifier is taken
        result = await get_result.call("/count/_action/get_result", types.get_result.Request(goal_id=goal_id))
        assert (result.status, result.result) == (GoalState.SUCCEEDED, Count.Result((0, 1, 2)))
        assert [each.feedback.number for each in feedback] == [0, 1, 2]
        states = [[status.status for status in each.status_list] for each in statuses]
        assert states == [[GoalState.ACCEPTED], [GoalState.EXECUTING], [GoalState.SUCCEEDED]]
        assert statuses[-1].status_list[0].goal_info == GoalInfo(goal_id, answer.stamp)
        for request, code in (
            (CancelGoal.Request(GoalInfo(goal_id)), CancelCode.TERMINATED),
            (CancelGoal.Request(GoalInfo(UUID(bytes(15) + b"1"))), CancelCode.UNKNOWN_GOAL),
            (CancelGoal.Request(), CancelCode.NONE),
        ):
            assert (await cancel.call("/count/_action/cancel_goal", request)).return_code == code
        unknown = types.get_result.Request(goal_id=UUID(bytes(16)))
        assert (await get_result.call("/count/_action/get_result", unknown)).status == GoalState.UNKNOWN


@pytest.mark.virtual_time
async def test_through_a_gateway() -> None:
    """A robot on a bus serves an action, which ROS 2 nodes call through a gateway that learns its types."""
    network, bus = FakeRosNetwork(2), Network()
    gateway = r2p.Module("GW", via=[bus.transport(), network.transport()], bridge=True)
    async with (
        gateway,
        bus.node("ROBOT") as server_node,
        r2p.Module("PC", via=network.transport()) as module,
        node_in(module) as node,
    ):
        ActionServer(server_node, "count", Count, count)
        client = ActionClient(node, "count", Count)
        await client.ready(20)
        await asyncio.sleep(5)
        goal = await client.send(Count.Goal(3, 1.0), timeout=5)
        assert [each.number async for each in goal] == [0, 1, 2]
        assert (await goal.wait()).numbers == (0, 1, 2)


def test_mistakes() -> None:
    async def main() -> None:
        async with r2p.Module("A") as module, node_in(module) as node:
            with pytest.raises(r2p.Error, match="action count: the handler <lambda> is not a coroutine function"):
                ActionServer(node, "count", Count, lambda goal: None)  # type: ignore[arg-type, return-value]
            with pytest.raises(r2p.MessageError, match="limit is a number of goals, 1 or more, not 0"):
                ActionServer(node, "count", Count, count, limit=0)
            with pytest.raises(r2p.InvalidName):
                ActionClient(node, "a b", Count)
            ActionServer(node, "count", Count, count)
            ends = len(node.services), len(node.publishers)
            with pytest.raises(r2p.Error, match="is already served by node"):
                ActionServer(node, "count", Count, count)
            assert (len(node.services), len(node.publishers)) == ends
            client = ActionClient(node, "count", Count)
            with pytest.raises(r2p.MessageError, match="action count takes Goal, not Result"):
                await client.send(Count.Result())  # type: ignore[arg-type]
            client.close()
            with pytest.raises(r2p.Closed, match="the client of action count is closed"):
                await client.send(Count.Goal())

    asyncio.run(main())


@pytest.mark.virtual_time
async def test_an_action_is_not_on_ros_1(caplog: pytest.LogCaptureFixture) -> None:
    """ROS 1 has no such types: its master would refuse some of the topics, and clients would find a part of them."""
    caplog.set_level("INFO")
    network = FakeRosNetwork(1)
    async with r2p.Module("BOT", via=network.transport()) as module, node_in(module, name="counter") as node:
        ActionServer(node, "count", Count, count)
        await asyncio.sleep(5)
        graph = network.graph(network.node("/other"))
    assert {each.topic for each in graph.publishers | graph.subscribers if "action" in each.topic} == set()
    assert graph.servers == frozenset()
    assert caplog.text.count("actions are those of ROS 2, ROS 1 has none") == 1
