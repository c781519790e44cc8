"""r2p parameters on a real parameter server, read and set with rosparam and rospy."""

from __future__ import annotations

import asyncio
import contextlib
import enum
from typing import TYPE_CHECKING, Any

import pytest

import r2p
from r2p.ros import exposed_parameters
from r2p.ros.ros1 import parameters, registration
from r2p.ros.ros1.master import MasterClient, MasterError
from r2p.ros.ros1.transport import from_url
from r2p.ros.ros1.xmlrpc import XmlRpcClient
from r2p.testing.network import Network, node_in
from r2p.transports.url import parse

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

    from tests.ros.ros1.programs import Ros1, RospyPeer

pytestmark = [
    pytest.mark.xdist_group("ros1"),
    pytest.mark.processes,
    pytest.mark.anyio,
    pytest.mark.parametrize("anyio_backend", [("asyncio", {"use_uvloop": True})], ids=["uvloop"]),
]


class Mode(enum.Enum):
    OFF = 0
    ON = 1


@pytest.fixture(autouse=True)
def looks_often(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("MODULES_PERIOD_S", "_OWN_PERIOD_S", "_REMOTE_PERIOD_S"):
        monkeypatch.setattr(exposed_parameters, name, 0.05)
    monkeypatch.setattr(registration, "POLL_S", 0.1)
    monkeypatch.setattr(parameters, "_CLOSE_S", 30.0)  # a busy master may take long


@pytest.fixture
async def master(ros1: Ros1) -> AsyncIterator[MasterClient]:
    client = XmlRpcClient()
    yield MasterClient(client, ros1.uri)
    client.close()


def transport(ros1: Ros1, monkeypatch: pytest.MonkeyPatch, options: str = "") -> Any:
    monkeypatch.setenv("ROS_IP", "127.0.0.1")
    return from_url(parse(f"ros1:{ros1.uri}{options}"))


@contextlib.asynccontextmanager
async def ros_node(module: r2p.Module, name: str) -> AsyncIterator[r2p.Node]:
    """A node that is a ROS node at once, as it has a topic."""
    async with node_in(module, name=name) as node:
        node.advertise("spin", r2p.msg.Led)
        yield node


async def until(condition: Callable[[], Any]) -> None:
    async with asyncio.timeout(30.0):
        while not condition():  # noqa: ASYNC110 - r2p changes a parameter without a word to this test
            await asyncio.sleep(0.01)


async def value(master: MasterClient, key: str, wanted: object) -> None:
    """Wait until the server has this value."""
    async with asyncio.timeout(30.0):
        while True:
            with contextlib.suppress(MasterError):
                if await master.get_param("/test", key) == wanted:
                    return
            await asyncio.sleep(0.01)


async def test_rosparam_reads_and_sets(
    ros1: Ros1, master: MasterClient, rospy_peer: RospyPeer, monkeypatch: pytest.MonkeyPatch
) -> None:
    via = transport(ros1, monkeypatch, ",ns=/robot1")
    async with r2p.Module("PC1", via=via, allow_control=True) as module, ros_node(module, "blink") as node:
        kp = node.parameter("kp", 0.5, max=2.0)
        mode = node.parameter("mode", Mode.OFF)
        gains = node.parameter("gains", (1, 2))
        await value(master, "/robot1/blink", {"kp": 0.5, "mode": "OFF", "gains": [1, 2]})
        assert (await ros1.run("rosparam", "set", "/robot1/blink/kp", "0.7")).code == 0
        await until(lambda: kp.value == 0.7)
        assert (await ros1.run("rosparam", "get", "/robot1/blink/kp")).output.strip() == "0.7"
        await rospy_peer.do("set_param", name="/robot1/blink", value={"mode": "ON", "gains": [3, 4]})
        await until(lambda: (mode.value, gains.value) == (Mode.ON, (3, 4)))
        await value(master, "/robot1/blink/kp", 0.7)  # a dict replaces all: what it leaves out is put back
        kp.set(1.5)
        await value(master, "/robot1/blink/kp", 1.5)
        assert await rospy_peer.do("get_param", name="/robot1/blink/kp") == 1.5
        late = node.parameter("late", 1)
        await value(master, "/robot1/blink/late", 1)
        await master.set_param("/test", "/robot1/blink/late", 2)
        await until(lambda: late.value == 2)
    await value(master, "/robot1/blink", {})


async def test_what_does_not_fit_is_put_back(
    ros1: Ros1, master: MasterClient, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    via = transport(ros1, monkeypatch)
    async with r2p.Module("PC1", via=via, allow_control=True) as module, ros_node(module, "blink") as node:
        kp = node.parameter("kp", 0.5, max=2.0)
        await value(master, "/blink/kp", 0.5)
        for wrong in (3.0, "fast", {"p": 1}):
            await master.set_param("/test", "/blink/kp", wrong)
            await value(master, "/blink/kp", 0.5)
        await master.delete_param("/test", "/blink/kp")
        await value(master, "/blink/kp", 0.5)
        assert kp.value == 0.5
        await until(lambda: "rosparam can't change /blink/kp: PC1/blink.kp = 3.0: it takes 2.0 or less" in caplog.text)


async def test_names_with_parts_are_namespaces(
    ros1: Ros1, master: MasterClient, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    via = transport(ros1, monkeypatch)
    async with r2p.Module("PC1", via=via, allow_control=True) as module, ros_node(module, "blink") as node:
        kp = node.parameter("pid.kp", 0.5)
        node.parameter("pid", 1)
        await value(master, "/blink/pid", {"kp": 0.5})
        await until(lambda: "PC1/blink.pid is not on the parameter server: /blink/pid/kp is there" in caplog.text)
        assert (await ros1.run("rosparam", "set", "/blink/pid/kp", "0.7")).code == 0
        await until(lambda: kp.value == 0.7)


async def test_a_node_that_starts_again(ros1: Ros1, master: MasterClient, monkeypatch: pytest.MonkeyPatch) -> None:
    via = transport(ros1, monkeypatch)
    async with r2p.Module("PC1", via=via, allow_control=True) as module:
        for default in (0.5, 0.6):
            async with ros_node(module, "again") as node:
                node.parameter("kp", default)
                await value(master, "/again/kp", default)
        await value(master, "/again", {})


async def test_without_permission(
    ros1: Ros1, master: MasterClient, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    via = transport(ros1, monkeypatch)
    async with r2p.Module("PC1", via=via) as module, ros_node(module, "blink") as node:
        kp = node.parameter("kp", 0.5)
        await value(master, "/blink/kp", 0.5)
        await master.set_param("/test", "/blink/kp", 0.7)
        await until(lambda: "/blink/kp: PC1 refuses changes from ros1: start it with --allow-control" in caplog.text)
        await value(master, "/blink/kp", 0.5)
        assert kp.value == 0.5
        assert module.links[0].stats.lost["change refused"] == 1


async def test_what_is_set_before_counts_and_stays(
    ros1: Ros1, master: MasterClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As a launch file sets it."""
    await master.set_param("/test", "/early/kp", 1)
    via = transport(ros1, monkeypatch)
    async with r2p.Module("PC1", via=via, allow_control=True) as module, ros_node(module, "early") as node:
        kp, ki = node.parameter("kp", 0.5), node.parameter("ki", 0.1)
        await until(lambda: kp.value == 1.0)
        await value(master, "/early", {"kp": 1.0, "ki": 0.1})
        ki.set(0.2)
        await value(master, "/early/ki", 0.2)
    await value(master, "/early", {"kp": 1})
    await master.delete_param("/test", "/early/kp")


@pytest.mark.parametrize(("options", "key"), [("", "/GW/MOTOR/pid"), (",ros_nodes=yes", "/MOTOR/pid")])
async def test_through_a_gateway(
    ros1: Ros1, master: MasterClient, monkeypatch: pytest.MonkeyPatch, options: str, key: str
) -> None:
    bus = Network()
    via = [bus.transport(), transport(ros1, monkeypatch, options)]
    async with r2p.Module("GW", via=via, bridge=r2p.BridgeOptions(allow_control=True)):
        async with bus.module("MOTOR") as motor, node_in(motor, name="pid") as node:
            kp = node.parameter("kp", 0.5)
            await value(master, f"{key}/kp", 0.5)
            await master.set_param("/test", f"{key}/kp", 0.7)
            await until(lambda: kp.value == 0.7)
            kp.set(0.9)
            await value(master, f"{key}/kp", 0.9)
        await value(master, key, {})


async def test_a_master_that_returns_gets_all_again(own_ros1: Ros1, monkeypatch: pytest.MonkeyPatch) -> None:
    client = XmlRpcClient()
    master = MasterClient(client, own_ros1.uri)
    via = transport(own_ros1, monkeypatch)
    async with r2p.Module("PC1", via=via, allow_control=True) as module, ros_node(module, "blink") as node:
        kp = node.parameter("kp", 0.5)
        await value(master, "/blink/kp", 0.5)
        own_ros1.close()
        kp.set(0.8)
        own_ros1.restart()
        client.close()
        await value(master, "/blink/kp", 0.8)
        await master.set_param("/test", "/blink/kp", 0.9)
        await until(lambda: kp.value == 0.9)
    client.close()
