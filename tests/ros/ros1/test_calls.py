"""Services of r2p programs and of rospy call each other."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

import pytest

import r2p
from r2p.ros.std_srvs import SetBool
from r2p.testing.network import node_in

if TYPE_CHECKING:
    from tests.ros.ros1.programs import Ros1, RospyPeer

pytestmark = [pytest.mark.xdist_group("ros1"), pytest.mark.processes, pytest.mark.anyio]

LIMIT = 30.0


@pytest.fixture(scope="module")
def anyio_backend() -> tuple[str, dict[str, Any]]:
    return "asyncio", {"use_uvloop": True}


async def enable(request: SetBool.Request) -> SetBool.Response:
    if not request.data:
        raise r2p.ServiceError("the motors stay on")
    return SetBool.Response(success=True, message="on")


async def test_services_of_programs(ros1: Ros1, rospy_peer: RospyPeer) -> None:
    fields = {"success": True, "message": "done"}
    await rospy_peer.do("serve", service="/turn", type="std_srvs/SetBool", fields=fields)
    async with (
        asyncio.timeout(2 * LIMIT),
        r2p.Module("PC1", via=f"ros1:{ros1.uri}") as module,
        node_in(module, name="motors") as node,
    ):
        node.serve("motors/enable", SetBool, enable)
        client = node.client("turn", SetBool)
        await client.ready()
        calls = (client.call(SetBool.Request(data=True), timeout=LIMIT) for _ in range(10))
        assert await asyncio.gather(*calls) == [SetBool.Response(success=True, message="done")] * 10
        await rospy_peer.do("unserve", service="/turn")
        await rospy_peer.do("serve", service="/refuse", type="std_srvs/SetBool", error="I refuse")
        refused = node.client("refuse", SetBool)
        await refused.ready()
        with pytest.raises(r2p.ServiceError, match=r"service refuse of peer: .*I refuse"):
            await refused.call(SetBool.Request(data=True), timeout=LIMIT)
        await rospy_peer.do("unserve", service="/refuse")
        service = {"service": "/motors/enable", "type": "std_srvs/SetBool"}
        assert await rospy_peer.do("call", **service, fields={"data": True}) == {"success": True, "message": "on"}
        tool = await ros1.run("rosservice", "call", "/motors/enable", "false")
        assert "the motors stay on" in tool.output
