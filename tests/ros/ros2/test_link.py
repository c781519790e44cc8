"""Two r2p programs on one ROS 2 network, and a gateway to it: what links of r2p do by themselves works there, too."""

import asyncio
from pathlib import Path

import pytest

import r2p
from r2p.msg import String
from r2p.ros.link import RosLink
from r2p.ros.ros2.middleware import Ros2Middleware
from r2p.ros.std_srvs import SetBool
from r2p.testing.network import node_in
from r2p.transports.url import open_transport
from tests.ports import free_port
from tests.ros.ros2.network import GUARD, RouterOfTests, router
from tests.services.common import until

pytestmark = pytest.mark.anyio


def module(network: RouterOfTests, name: str, options: str = "") -> r2p.Module:
    return r2p.Module(name, via=f"ros2:{network.endpoint}{options}", watchdog=False)


def ros_publisher(module: r2p.Module, topic: str) -> object:
    link = module.links[0]
    assert isinstance(link, RosLink)
    assert isinstance(link.middleware, Ros2Middleware)
    return link.middleware._publishers.get(("/a", topic))


async def test_two_programs() -> None:
    """Messages, a latched value for a later subscriber, and calls; the router is lost in between."""
    async with asyncio.timeout(GUARD), router() as network, module(network, "ONE") as one, node_in(one, name="a") as a:
        numbers, state = a.advertise("numbers", String), a.advertise("state", String, latch=True)
        await state.publish(String(data="old"))
        await state.publish(String(data="new"))

        async def enable(request: SetBool.Request) -> SetBool.Response:
            return SetBool.Response(success=request.data)

        a.serve("enable", SetBool, enable)
        await until(lambda: ros_publisher(one, "/numbers"))
        registered = ros_publisher(one, "/numbers")
        async with module(network, "TWO") as two, node_in(two, name="b") as b:
            assert (await b.subscribe("state", String).fetch()).data == "new"
            received = b.subscribe("numbers", String, queue=100)
            client = b.client("enable", SetBool)
            await numbers.wait_subscriber()
            assert ros_publisher(one, "/numbers") is registered  # the type of the subscriber has changed nothing
            for _ in range(2):
                await numbers.wait_subscriber()
                await received.wait_publisher()
                for number in range(50):
                    await numbers.publish(String(data=str(number)))
                assert [(await received.fetch()).data for _ in range(50)] == [str(number) for number in range(50)]
                await client.ready()
                assert (await client.call(SetBool.Request(data=True))).success
                await network.stop()
                await until(lambda: not one.links[0].up and not two.links[0].up)
                await network.start()
            assert two.links[0].losses == {}


async def test_domains(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nodes on another domain are not there; where they are is said."""
    monkeypatch.setattr("r2p.ros.ros2.middleware._ALONE_S", 0.2)
    async with (
        asyncio.timeout(GUARD),
        router() as network,
        module(network, "ONE", "?domain=7") as one,
        module(network, "TWO") as two,
        node_in(one, name="a") as a,
        node_in(two, name="b") as b,
    ):
        publisher = a.advertise("numbers", String)
        b.subscribe("numbers", String)
        texts = (event.text async for event in two.events() if isinstance(event, r2p.LinkNotice))
        assert await anext(texts) == (
            "no other ROS node is on domain 0, but there are nodes on domain 7: is ?domain=7 (or ROS_DOMAIN_ID) meant?"
        )
        assert not publisher.subscribers


async def test_peers_without_a_router(tmp_path: Path) -> None:
    """One listens, as its file says, and is up alone; the other one connects."""
    port, path = free_port(), tmp_path / "peer.json5"
    path.write_text(f'{{listen: {{endpoints: ["tcp/127.0.0.1:{port}"]}}, scouting: {{multicast: {{enabled: false}}}}}}')
    async with (
        asyncio.timeout(GUARD),
        r2p.Module("ONE", via=f"ros2:?mode=peer&config={path}", watchdog=False) as one,
        r2p.Module("TWO", via=f"ros2:tcp/127.0.0.1:{port}?mode=peer", watchdog=False) as two,
        node_in(one, name="a") as a,
        node_in(two, name="b") as b,
    ):
        publisher, subscriber = a.advertise("numbers", String), b.subscribe("numbers", String)
        await publisher.wait_subscriber()
        await publisher.publish(String(data="direct"))
        assert (await subscriber.fetch()).data == "direct"


def test_urls() -> None:
    for url, reason in {
        "ros2:router": "'router' is not a zenoh endpoint: give it as tcp/ADDRESS:PORT",
        "ros2:tcp/router": "the port is missing: tcp/router:7447",
        "ros2:?domain=233": "a domain of ROS is a number from 0 to 232",
        "ros2:?mode=router": "use one of client, peer",
        "ros2:?qos=x": "has no option 'qos'; it knows: config, domain, mode, ns, ros_nodes, shm",
    }.items():
        with pytest.raises(r2p.TransportError, match=reason.replace("(", r"\(")):
            open_transport(url)
