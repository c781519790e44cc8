"""The in-memory network: its faults, and what its modules say without any."""

import asyncio
from collections import Counter
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager

import pytest

import r2p
from r2p.codecs import management
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


class Listener:
    """A port that hears what is said to all, message by message; it counts the topics of `publisher_of`."""

    def __init__(self, net: MemoryNetwork) -> None:
        self.advertised: Counter[str] = Counter()
        net.plug_in(net.new_address(), MemoryPort(net, self._hear, lambda: None))

    def _hear(self, datagram: Datagram) -> None:
        message = management.decode(datagram.data)
        if isinstance(message, management.Advertise) and "/" in message.topic:
            self.advertised[message.topic] += 1


@asynccontextmanager
async def publisher_of(net: MemoryNetwork, name: str, topics: int = 3) -> AsyncIterator[None]:
    async with r2p.Module(name, via=net.transport()) as module, node_in(module) as node:
        for number in range(topics):
            node.advertise(f"{name}/t{number}", Float32)
        yield


@pytest.mark.virtual_time
async def test_one_who_is_new_is_told_everything_alone() -> None:
    net = MemoryNetwork()
    async with publisher_of(net, "A"), publisher_of(net, "B"):
        await asyncio.sleep(5)
        listener = Listener(net)
        async with r2p.Module("C", via=net.transport()) as newcomer:
            await asyncio.sleep(0.1)
            assert {"A/t0", "A/t2", "B/t0", "B/t2"} <= newcomer.links[0].discovery.topics.keys()
            assert len([each for each in newcomer.links[0].discovery.endpoints.values() if "/t" in each.topic]) == 6
    assert not listener.advertised


@pytest.mark.virtual_time
async def test_topics_are_said_once_and_with_their_types() -> None:
    """Also those of modules that start together, when none knows the others yet; what a module had in its fast ring
    before it knew them is said once more.
    """
    net = MemoryNetwork()
    listener = Listener(net)
    names = [f"M{number}" for number in range(8)]
    async with AsyncExitStack() as stack:
        modules = [await stack.enter_async_context(r2p.Module(name, via=net.transport())) for name in names]
        for name, module in zip(names, modules, strict=True):
            node = await stack.enter_async_context(node_in(module))
            for number in range(10):
                node.advertise(f"{name}/t{number}", Float32)
        await asyncio.sleep(0.1)
        for module in modules:
            known = module.links[0].discovery.topics
            types = [known[f"{name}/t{n}"].fingerprint for name in names if name != module.name for n in range(10)]
            assert set(types) == {r2p.layout(Float32).fingerprint}
        await asyncio.sleep(20)
    assert sum(listener.advertised.values()) <= 80 + len(names)


@pytest.mark.virtual_time
async def test_what_is_said_is_repeated_again_when_something_may_be_lost() -> None:
    net = MemoryNetwork()
    async with publisher_of(net, "A"), publisher_of(net, "B"):
        await asyncio.sleep(1)
        listener = Listener(net)
        await asyncio.sleep(10)
        assert not listener.advertised
        net.loss = 1e-9
        await asyncio.sleep(10)
        assert min(listener.advertised[f"{module}/t{n}"] for module in "AB" for n in range(3)) >= 4
        net.loss = 0.0
        await asyncio.sleep(5)
        listener.advertised.clear()
        await asyncio.sleep(10)
        assert not listener.advertised


@pytest.mark.virtual_time
async def test_what_a_start_and_a_second_of_rest_cost_each_pair_of_modules() -> None:
    start, rest = dict[int, float](), dict[int, float]()
    for count in (5, 20):
        net = MemoryNetwork()
        async with AsyncExitStack() as stack:
            for number in range(count):
                await stack.enter_async_context(publisher_of(net, f"M{number}"))
            await asyncio.sleep(20)
            delivered, pairs = net.counts["delivered"], count * (count - 1)
            start[count] = delivered / pairs
            await asyncio.sleep(100)
            rest[count] = (net.counts["delivered"] - delivered) / pairs / 100
    assert start[20] < 1.5 * start[5]
    assert rest[20] < 1.1 * rest[5] < 1.1


@pytest.mark.virtual_time
async def test_modules_that_were_there_before_a_crowd_are_not_taken_for_gone() -> None:
    """With 80 modules, the rounds of ALIVE take longer than the leases of before."""
    net = MemoryNetwork()
    async with AsyncExitStack() as stack:
        first = [await stack.enter_async_context(r2p.Module(f"A{n}", via=net.transport())) for n in range(3)]
        await asyncio.sleep(10)
        for number in range(80):
            await stack.enter_async_context(r2p.Module(f"B{number}", via=net.transport()))
        for _ in range(40):
            await asyncio.sleep(1)
            assert [len(module.links[0].discovery.modules) for module in first] == [82] * 3
