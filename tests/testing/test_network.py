"""What `r2p.testing` gives to users for tests of their robots."""

import asyncio

import pytest

import r2p
from r2p.msg import Led
from r2p.testing.network import Network, node_in

pytestmark = pytest.mark.virtual_time


async def blink(node: r2p.Node) -> None:
    leds = node.advertise("leds", Led)
    value = 0
    async for _ in node.every(0.5):
        value ^= 1
        await leds.publish(Led(led=3, value=value))


async def test_a_robot_is_watched_by_the_test(r2p_network: Network) -> None:
    async with r2p_network.module("IMU1") as imu, r2p_network.node("PC1") as node:
        leds = node.subscribe("leds", Led)
        imu.start(blink)
        assert [(await leds.fetch(timeout=5)).value for _ in range(4)] == [1, 0, 1, 0]
        assert asyncio.get_running_loop().time() == 2.0


async def test_a_node_is_driven_by_the_test(r2p_network: Network) -> None:
    obeyed: list[int] = []

    async def obey(node: r2p.Node) -> None:
        leds = node.subscribe("leds", Led)
        while True:
            obeyed.append((await leds.fetch()).value)

    async with r2p_network.module("IMU1") as imu:
        imu.start(obey)
        async with node_in(imu, name="tester") as node:
            await node.advertise("leds", Led).publish(Led(value=5))
            await asyncio.sleep(0.1)
        assert obeyed == [5]
        assert not imu.nodes["tester"].running
        assert imu.nodes["obey"].running


async def test_faults_and_plugs(r2p_network: Network) -> None:
    async with r2p_network.module("IMU1") as imu, r2p_network.node("PC1") as node:
        leds = node.subscribe("leds", Led)
        imu.start(blink)
        await leds.fetch(timeout=5)
        r2p_network.loss = 1.0
        with pytest.raises(TimeoutError):
            await leds.fetch(timeout=2)
        assert r2p_network.counts["lost"]
        r2p_network.loss = 0.0
        await leds.fetch(timeout=2)
        r2p_network.disconnect(imu)
        assert not imu.links[0].up
        with pytest.raises(TimeoutError):
            await leds.fetch(timeout=2)
        r2p_network.connect(imu)
        await leds.fetch(timeout=2)


async def test_a_gateway_joins_two_networks(r2p_network: Network) -> None:
    other = Network()
    async with (
        r2p_network.module("GW", other, bridge=True),
        other.module("IMU1") as imu,
        r2p_network.node("PC1") as node,
    ):
        imu.start(blink)
        assert (await node.subscribe("leds", Led).fetch(timeout=30)).led == 3


async def test_each_test_has_a_network_of_its_own(r2p_network: Network) -> None:
    assert not r2p_network.counts


async def test_first_values_of_parameters(r2p_network: Network) -> None:
    async with r2p_network.module("A", params={"kp": 2}) as module, node_in(module) as node:
        assert node.parameter("kp", 0.5).value == 2.0
