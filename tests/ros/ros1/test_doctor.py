"""`r2p doctor` on a ROS 1 network with a real master."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from r2p.ros.ros1.master import MasterClient
from r2p.ros.ros1.xmlrpc import XmlRpcClient
from r2p.tools import ros_checks
from tests.ports import free_port

if TYPE_CHECKING:
    from r2p.tools.checks import Check
    from tests.ros.ros1.programs import Ros1

pytestmark = [
    pytest.mark.xdist_group("ros1"),
    pytest.mark.anyio,
    pytest.mark.parametrize("anyio_backend", [("asyncio", {"use_uvloop": True})], ids=["uvloop"]),
]


async def _checks(url: str) -> list[Check]:
    return [check async for check in ros_checks.before(url)]


async def test_nodes_that_nobody_reaches_are_named(ros1: Ros1, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_MASTER_URI", ros1.uri)
    monkeypatch.setenv("ROS_IP", "127.0.0.1")
    client = XmlRpcClient()
    master = MasterClient(client, ros1.uri)
    away = {"/elsewhere": "http://no-such-robot.invalid:4000/", "/ended": f"http://127.0.0.1:{free_port()}/"}
    for name, uri in away.items():
        await master.register_publisher(name, f"{name}/chat", "std_msgs/String", uri)
    try:
        checks = await _checks("ros1:")
    finally:
        for name, uri in away.items():
            await master.unregister_publisher(name, f"{name}/chat", uri)
        client.close()
    assert [(each.what, each.ok) for each in checks[:2]] == [("master", True), ("address", True)]
    assert f"{ros1.uri} answers" in checks[0].found
    nodes = {each.found.split()[0]: each for each in checks[2:]}
    assert "but no-such-robot.invalid is not known here" in nodes["/elsewhere"].found
    assert "ROS_IP" in nodes["/elsewhere"].do
    assert nodes["/ended"].found.endswith("nothing listens there")
    assert "rosnode cleanup" in nodes["/ended"].do


async def test_no_master(monkeypatch: pytest.MonkeyPatch) -> None:
    port = free_port()
    (check,) = await _checks(f"ros1:http://127.0.0.1:{port}")
    assert (check.ok, check.found) == (False, f"http://127.0.0.1:{port}: nothing listens there")
    assert check.do.startswith("start one there: roscore")
    monkeypatch.setenv("ROS_MASTER_URI", "https://robot")
    (check,) = await _checks("ros1:")
    assert not check.ok
    assert "ROS_MASTER_URI" in check.found


async def test_an_address_that_leads_nowhere() -> None:
    own = ros_checks.own_address
    assert own("127.0.0.1", "http://localhost:11311").ok
    loopback = own("127.0.0.1", "http://192.0.2.1:11311")
    assert (loopback.ok, loopback.do[:14]) == (False, "export ROS_IP=")
    unknown = own("no-such-robot.invalid", "http://localhost:11311")
    assert "a name that is not even known here" in unknown.found
