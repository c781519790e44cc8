"""What a server of an action answers to each request: as rclpy's, whose dialogue is recorded, and which repeats it."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Awaitable, Callable
from typing import TYPE_CHECKING, Any

import pytest

import r2p
from r2p.messages import Array
from r2p.ros import ActionServer, ServerGoal
from r2p.ros.action_types import UUID, CancelGoal, GoalInfo, GoalStatusArray, action_types
from r2p.ros.middleware import Qos
from r2p.testing.network import node_in
from tests.ros.fake import FakeRosNetwork
from tests.ros.test_service_types import Fibonacci
from tests.ros.test_services import Peer

if TYPE_CHECKING:
    from tests.ros.rclpy.peer import RclpyPeer

TYPES = action_types(Fibonacci)
RESULT = [0, 1, 1]


@pytest.fixture(scope="module")
def anyio_backend() -> tuple[str, dict[str, Any]]:
    return "asyncio", {}


Call = Callable[..., Awaitable[Any]]
"""Calls a service of the action, `send_goal`, `cancel_goal` or `get_result`, for a goal; returns what is compared."""

RECORDED = {
    "no goal to cancel": (0, []),
    "a goal to cancel that is unknown": (2, []),
    "a result that is unknown": (0, []),
    "a goal": True,
    "the same goal again": False,
    "its end": (0, ["01"]),
    "its result": (5, RESULT),
    "its end again": (3, []),
    "its result again": (5, RESULT),
    "another goal": True,
    "the end of all": (0, ["02"]),
    "the result of another goal": (5, RESULT),
    "a quick goal": True,
    "the result of a quick goal": (4, RESULT),
    "the end of a quick goal": (3, []),
    "the end of all goals that have ended": (0, []),
}
STATES = [[1], [2], [3], [5], [5, 1], [5, 2], [5, 3], [5, 5]]
"""What the status topic of the patient server has, message by message."""


async def dialogue(patient: Call, quick: Call) -> dict[str, Any]:
    """Ask two servers: `patient` works until it is cancelled, `quick` has the result at once."""
    return {
        "no goal to cancel": await patient("cancel_goal", 0),
        "a goal to cancel that is unknown": await patient("cancel_goal", 9),
        "a result that is unknown": await patient("get_result", 9),
        "a goal": await patient("send_goal", 1),
        "the same goal again": await patient("send_goal", 1),
        "its end": await patient("cancel_goal", 1),
        "its result": await patient("get_result", 1),
        "its end again": await patient("cancel_goal", 1),
        "its result again": await patient("get_result", 1),
        "another goal": await patient("send_goal", 2),
        "the end of all": await patient("cancel_goal", 0),
        "the result of another goal": await patient("get_result", 2),
        "a quick goal": await quick("send_goal", 3),
        "the result of a quick goal": await quick("get_result", 3),
        "the end of a quick goal": await quick("cancel_goal", 3),
        "the end of all goals that have ended": await quick("cancel_goal", 0),
    }


def of_rclpy(peer: RclpyPeer, action: str) -> Call:
    types = {"send_goal": "test_msgs/action/Fibonacci_SendGoal", "get_result": "test_msgs/action/Fibonacci_GetResult"}

    async def call(service: str, number: int) -> Any:
        goal_id = {"uuid": {"hex": bytes([number] * 16).hex()}}
        request: dict[str, Any] = {"goal_id": goal_id}
        if service == "cancel_goal":
            request = {"goal_info": request}
        kind, name = types.get(service, "action_msgs/srv/CancelGoal"), f"{action}/_action/{service}"
        answer = await peer.ask_async("call", node="asker", service=name, type=kind, request=request)
        value = answer["value"]
        if service == "send_goal":
            return value["accepted"]
        if service == "get_result":
            return value["status"], value["result"]["sequence"]
        return value["return_code"], [each["goal_id"]["uuid"]["hex"][:2] for each in value["goals_canceling"]]

    return call


@pytest.mark.xdist_group("rclpy")
@pytest.mark.processes
@pytest.mark.anyio
async def test_rclpy(rclpy_peer: RclpyPeer) -> None:
    for node in ("server", "asker"):
        rclpy_peer.ask("node", name=node)
    for action, patience in (("/patient", 30.0), ("/quick", 0.0)):
        rclpy_peer.ask(
            "act",
            node="server",
            action=action,
            type="test_msgs/action/Fibonacci",
            feedback=[],
            result={"sequence": RESULT},
            patience=patience,
        )
    rclpy_peer.ask(
        "subscribe",
        node="asker",
        topic="/patient/_action/status",
        type="action_msgs/msg/GoalStatusArray",
        qos={"transient_local": True},
        decode=True,
    )
    assert await dialogue(of_rclpy(rclpy_peer, "/patient"), of_rclpy(rclpy_peer, "/quick")) == RECORDED
    events = [await rclpy_peer.event(topic="/patient/_action/status") for _ in STATES]
    assert [[each["status"] for each in event["value"]["status_list"]] for event in events] == STATES


def of_r2p(network: FakeRosNetwork, action: str) -> Call:
    node = network.node(f"/asker_of{action.replace('/', '_')}")
    peers = {"send_goal": Peer(node, TYPES.send_goal), "get_result": Peer(node, TYPES.get_result)}

    async def call(service: str, number: int) -> Any:
        goal_id, name = UUID(bytes([number] * 16)), f"{action}/_action/{service}"
        if service == "cancel_goal":
            answer = await Peer(node, CancelGoal).call(name, CancelGoal.Request(GoalInfo(goal_id)))
            return answer.return_code, [each.goal_id.uuid.hex()[:2] for each in answer.goals_canceling]
        goal = {"goal": Fibonacci.Goal()} if service == "send_goal" else {}
        kind = TYPES.send_goal if service == "send_goal" else TYPES.get_result
        answer = await peers[service].call(name, kind.Request(goal_id=goal_id, **goal))
        return answer.accepted if service == "send_goal" else (answer.status, list(answer.result.sequence))

    return call


@pytest.mark.virtual_time
async def test_r2p() -> None:
    async def quick(goal: ServerGoal[Fibonacci.Goal, Fibonacci.Result, Fibonacci.Feedback]) -> Fibonacci.Result:
        return Fibonacci.Result(Array(RESULT))

    async def patient(goal: ServerGoal[Fibonacci.Goal, Fibonacci.Result, Fibonacci.Feedback]) -> Fibonacci.Result:
        with contextlib.suppress(asyncio.CancelledError):
            await asyncio.sleep(30)
        return Fibonacci.Result(Array(RESULT))

    network = FakeRosNetwork(2)
    statuses = network.node("/watcher").subscribe(
        "/patient/_action/status", GoalStatusArray, Qos(transient_local=True, depth=1)
    )
    async with r2p.Module("ARM", via=network.transport()) as module, node_in(module, name="server") as node:
        ActionServer(node, "patient", Fibonacci, patient)
        ActionServer(node, "quick", Fibonacci, quick)
        await asyncio.sleep(1)
        assert await dialogue(of_r2p(network, "/patient"), of_r2p(network, "/quick")) == RECORDED
    assert [[each.status for each in status.status_list] for status in statuses] == STATES
