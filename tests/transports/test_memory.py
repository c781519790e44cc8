"""The faults of the in-memory network."""

import asyncio
from contextlib import AsyncExitStack

import pytest

import r2p
from r2p.errors import TransportError
from r2p.msg import Float32
from r2p.sim import run
from r2p.testing.network import node_in
from r2p.transports.memory import IN_FLIGHT, Datagram, MemoryNetwork, MemoryPort, network
from r2p.transports.url import open_transport

MESSAGES = 500


async def stream(network: MemoryNetwork, *, quiet: bool = True) -> list[float]:
    """What arrives of MESSAGES numbers, one a millisecond; the handshake is spared the faults."""
    faults = {name: getattr(network, name) for name in ("loss", "duplicate", "reorder", "delay", "jitter")}
    for name in faults:
        setattr(network, name, 0.0)
    async with (
        r2p.Module("A", via=network.transport()) as a,
        r2p.Module("B", via=network.transport()) as b,
        node_in(a) as alice,
        node_in(b) as bob,
    ):
        publisher, subscriber = alice.advertise("n", Float32), bob.subscribe("n", Float32, queue=2 * MESSAGES)
        await publisher.wait_subscriber()
        for name, value in faults.items():
            setattr(network, name, value)
        for number in range(MESSAGES):
            await publisher.publish(Float32(data=float(number)))
            await asyncio.sleep(0.001)
        await asyncio.sleep(1)
        return [(await subscriber.fetch()).data for _ in range(len(subscriber.queue))]


SENT = [float(number) for number in range(MESSAGES)]


@pytest.mark.virtual_time
async def test_without_faults_everything_arrives_in_order() -> None:
    assert await stream(MemoryNetwork()) == SENT


@pytest.mark.virtual_time
async def test_loss() -> None:
    network = MemoryNetwork(loss=0.2)
    received = await stream(network)
    assert 0.7 * MESSAGES < len(received) < 0.9 * MESSAGES
    assert received == sorted(received)
    assert network.counts["lost"] >= MESSAGES - len(received)


@pytest.mark.virtual_time
async def test_duplicates() -> None:
    received = await stream(MemoryNetwork(duplicate=0.2))
    assert sorted(set(received)) == SENT
    assert 1.1 * MESSAGES < len(received) < 1.3 * MESSAGES


@pytest.mark.virtual_time
async def test_reordering() -> None:
    received = await stream(MemoryNetwork(reorder=0.1, delay=0.002))
    assert received != SENT
    assert sorted(received) == SENT


@pytest.mark.virtual_time
async def test_delay_and_jitter() -> None:
    received = await stream(MemoryNetwork(delay=0.5, jitter=0.005))
    assert received != SENT
    assert sorted(received) == SENT


def test_the_same_seed_goes_the_same_way() -> None:
    def go(loop: int, network: int | None) -> list[float]:
        return run(lambda: stream(MemoryNetwork(loss=0.3, seed=network)), seed=loop)

    assert go(1, None) == go(1, None) != go(2, None)
    assert go(1, 7) == go(2, 7) != go(1, 8)


@pytest.mark.virtual_time
async def test_a_full_network_makes_publishers_wait() -> None:
    """A second on the way, and no more than IN_FLIGHT messages of all modules in it."""
    network = MemoryNetwork()
    async with (
        r2p.Module("A", via=network.transport()) as a,
        r2p.Module("B", via=network.transport()) as b,
        node_in(a) as alice,
        node_in(b) as bob,
    ):
        publisher = alice.advertise("n", Float32, r2p.NonRealTime(stall=5.0))
        subscriber = bob.subscribe("n", Float32, queue=4 * IN_FLIGHT)
        await publisher.wait_subscriber()
        network.delay = 1.0
        for number in range(2 * IN_FLIGHT):
            await publisher.publish(Float32(data=float(number)))
        assert 1.0 <= asyncio.get_running_loop().time() < 3.0
        assert publisher.missed == 0
        for number in range(2 * IN_FLIGHT):
            assert (await subscriber.fetch(timeout=2)).data == number


@pytest.mark.virtual_time
async def test_options_of_the_url_hold_for_the_whole_network() -> None:
    async with AsyncExitStack() as stack:
        await stack.enter_async_context(r2p.Module("A", via="memory:lab,loss=0.5"))
        assert network("lab").loss == 0.5
        await stack.enter_async_context(r2p.Module("B", via="memory:lab,delay=10ms"))
        assert (network("lab").loss, network("lab").delay) == (0.5, 0.01)
        assert network("other").loss == 0.0


def test_a_network_without_a_name() -> None:
    with pytest.raises(TransportError, match="give the network a name"):
        open_transport("memory:")


@pytest.mark.virtual_time
async def test_what_is_on_its_way_is_limited_in_bytes_too() -> None:
    """64 MiB; one message always has room."""
    net = MemoryNetwork(delay=1.0)
    received: list[Datagram] = []
    net.plug_in(2, MemoryPort(net, received.append, lambda: None))
    image = Datagram(1, b"image", bytes(32 << 20))
    for full in (False, True):
        assert not net.full
        net.send(image)
        assert net.full is full
    await asyncio.sleep(1.5)
    assert (received, net.full) == ([image] * 2, False)
