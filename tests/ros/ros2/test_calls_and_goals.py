"""Calls and goals over zenoh: between r2p and zenoh-ros2-sdk, a ROS 2 of other authors, and by r2p's own commands."""

import asyncio
import json
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

import pytest
import zenoh_ros2_sdk
from zenoh_ros2_sdk.session import ZenohSession

import r2p
from r2p.ros import ActionClient, ActionServer, GoalCanceled
from r2p.ros.std_srvs import SetBool
from r2p.testing.network import node_in
from tests.ros.ros2.network import RouterOfTests, router
from tests.ros.test_actions import Count, count
from tests.ros.test_type_descriptions import Cart

pytestmark = pytest.mark.anyio
LIMIT = 20.0


class AddTwoInts(r2p.Service, name="example_interfaces/AddTwoInts"):
    class Request(r2p.Message):
        a: r2p.i64 = 0
        b: r2p.i64 = 0

    class Response(r2p.Message):
        sum: r2p.i64 = 0


class Sdk:
    """Services of zenoh-ros2-sdk, which has threads of its own."""

    def __init__(self, port: int) -> None:
        self._options: dict[str, Any] = {
            "srv_type": "example_interfaces/srv/AddTwoInts",
            "request_definition": "int64 a\nint64 b",
            "response_definition": "int64 sum",
            "router_port": port,
        }
        self._opened: list[Any] = []

    async def client(self, name: str) -> Any:
        client = await asyncio.to_thread(zenoh_ros2_sdk.ROS2ServiceClient, name, timeout=LIMIT, **self._options)
        self._opened.append(client)
        return client

    async def serve(self, name: str) -> None:
        def add(request: Any) -> Any:
            return server.response_msg_class(sum=request.a + request.b)

        server = await asyncio.to_thread(zenoh_ros2_sdk.ROS2ServiceServer, name, callback=add, **self._options)
        self._opened.append(server)

    def close(self) -> None:
        for each in self._opened:
            each.close()
        ZenohSession.get_instance("127.0.0.1", self._options["router_port"]).close()


@asynccontextmanager
async def node_on(network: RouterOfTests, name: str) -> AsyncIterator[r2p.Node]:
    async with r2p.Module(name.upper(), via=f"ros2:{network.endpoint}") as module, node_in(module, name=name) as node:
        yield node


async def test_services_go_both_ways_with_another_implementation() -> None:
    async def add(request: AddTwoInts.Request) -> AddTwoInts.Response:
        return AddTwoInts.Response(request.a + request.b)

    async with asyncio.timeout(LIMIT), router() as network, node_on(network, "adder") as node:
        sdk = Sdk(network.port)
        try:
            await sdk.serve("/theirs/add")
            client = node.client("theirs/add", AddTwoInts)
            await client.ready()
            results = await asyncio.gather(*(client.call(AddTwoInts.Request(n, 40), timeout=LIMIT) for n in range(20)))
            assert [each.sum for each in results] == list(range(40, 60))
            node.serve("ours/add", AddTwoInts, add)
            theirs = await sdk.client("/ours/add")
            for n in range(3):
                answer = await asyncio.to_thread(theirs.call, a=n, b=2)
                assert answer.sum == n + 2
        finally:
            await asyncio.to_thread(sdk.close)


async def test_goals_and_commands() -> None:
    """An action between two programs, and `r2p service` for a service whose type every ROS has."""

    async def enable(request: SetBool.Request) -> SetBool.Response:
        return SetBool.Response(success=request.data, message="as you wish")

    async with (
        asyncio.timeout(2 * LIMIT),
        router() as network,
        node_on(network, "robot") as robot,
        node_on(network, "pilot") as pilot,
    ):
        robot.serve("motors/enable", SetBool, enable)
        ActionServer(robot, "arm/count", Count, count)
        client = ActionClient(pilot, "arm/count", Count)
        await client.ready()
        goal = await client.send(Count.Goal(3, 0.01), timeout=LIMIT)
        assert [each.number async for each in goal] == [0, 1, 2]
        assert (await goal.wait()).numbers == (0, 1, 2)
        goal = await client.send(Count.Goal(3, LIMIT), timeout=LIMIT)
        async for _ in goal:
            assert await goal.cancel(LIMIT)
            break
        with pytest.raises(GoalCanceled):
            await goal.wait()
        command = [sys.executable, "-m", "r2p", "service"]
        call = await asyncio.create_subprocess_exec(
            *command,
            "call",
            "motors/enable",
            "data=true",
            f"--via=ros2:{network.endpoint}",
            stdout=asyncio.subprocess.PIPE,
        )
        output, _ = await call.communicate()
        assert (call.returncode, json.loads(output)) == (0, {"success": True, "message": "as you wish"})


async def test_a_tool_learns_a_type_from_its_node() -> None:
    """By the service `get_type_description` of the node, as tools of ROS do it."""
    async with (
        asyncio.timeout(LIMIT),
        router() as network,
        node_on(network, "robot") as node,
        r2p.Module("TOOL", via=f"ros2:{network.endpoint}", observer=True) as tool,
    ):
        node.advertise("cart", Cart)
        wanted = r2p.layout(Cart)
        while (found := await tool.links[0].message_type(wanted.fingerprint)) is None:  # noqa: ASYNC110 - no event
            await asyncio.sleep(0.01)
        assert (r2p.layout(found).name, r2p.layout(found).schema) == (wanted.name, wanted.schema)
