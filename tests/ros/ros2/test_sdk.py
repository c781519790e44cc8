"""r2p programs with zenoh-ros2-sdk, another implementation of rmw_zenoh's formats: both ways, and its sudden end."""

import asyncio

import pytest

import r2p
from r2p.msg import String
from r2p.ros.std_srvs import SetBool
from r2p.testing.network import node_in
from tests.ros.ros2.network import GUARD, RouterOfTests, router
from tests.ros.ros2.sdk_peer import sdk_peer
from tests.services.common import until

pytestmark = [pytest.mark.anyio, pytest.mark.processes]


def module(network: RouterOfTests, name: str = "PC1") -> r2p.Module:
    return r2p.Module(name, via=f"ros2:{network.endpoint}", watchdog=False)


async def test_topics_and_graph() -> None:
    async with router() as network, sdk_peer(network.port) as peer, asyncio.timeout(GUARD):
        async with module(network) as pc, node_in(pc, name="blink") as node:
            chatter, answers = node.advertise("robot1/chatter", String), node.subscribe("answers", String)
            await peer.ask("advertise", "/answers", "sdk_talker", None)
            await peer.ask("subscribe", "/robot1/chatter", "sdk_listener", "2::,5:,:,:,,")
            await chatter.wait_subscriber()
            await answers.wait_publisher()
            for number in range(3):
                await chatter.publish(String(data=f"ü{number}"))
                await peer.ask("publish", "/answers", f"à {number}")
            assert [(await answers.fetch()).data for _ in range(3)] == ["à 0", "à 1", "à 2"]
            await peer.until(lambda: len(peer.received) == 3)
            assert peer.received == [["/robot1/chatter", f"ü{number}"] for number in range(3)]
            topics = await peer.ask("topics")
            assert topics["/robot1/chatter"] == topics["/answers"] == ["std_msgs/msg/String"]
            info = await peer.ask("topic_info", "/robot1/chatter")
            assert [each["node_name"] for each in info["publishers"]] == ["blink"]
            assert pc.network.nodes()["sdk_talker", "sdk_talker"] == (["answers"], [])
            # It is killed and comes back: seen as gone, then served anew.
            await peer.kill()
            await until(lambda: not chatter.subscribers)
            async with sdk_peer(network.port) as again:
                await again.ask("subscribe", "/robot1/chatter", "sdk_listener", None)
                await chatter.wait_subscriber()
                await chatter.publish(String(data="again"))
                await again.until(lambda: again.received)
                assert again.received == [["/robot1/chatter", "again"]]
        # This side ends: no trace of it is left.
        async with sdk_peer(network.port) as last:
            assert await last.ask("topics") == {}


async def test_services() -> None:
    async with (
        asyncio.timeout(GUARD),
        router() as network,
        sdk_peer(network.port) as peer,
        module(network) as pc,
        node_in(pc, name="motor") as node,
    ):
        asked: list[bool] = []

        @node.service("enable", SetBool)
        async def enable(request: SetBool.Request) -> SetBool.Response:
            asked.append(request.data)
            return SetBool.Response(success=request.data, message=f"now {request.data}")

        await peer.ask("serve", "/sdk/enable", "sdk_server")
        client = node.client("sdk/enable", SetBool)
        await client.ready()
        response = await client.call(SetBool.Request(data=True))
        assert (response.success, response.message, peer.asked) == (True, "it is True", [])
        while "/enable" not in await peer.ask("services"):
            pass
        assert await peer.ask("call", "/enable", "sdk_caller", False) == [False, "now False"]
        assert await peer.ask("call", "/enable", "sdk_caller", True) == [True, "now True"]
        assert asked == [False, True]
        assert peer.asked == [["/sdk/enable", True]]
        # It is killed: its service is gone at once, and r2p's own goes on.
        await peer.kill()
        await until(lambda: not client.servers)
        with pytest.raises(r2p.NoServer):
            await client.call(SetBool.Request(data=True))
        async with sdk_peer(network.port) as again:
            assert await again.ask("call", "/enable", "sdk_caller", True) == [True, "now True"]
