"""Processes that die, hang and come back, on a network of processes."""

import asyncio
import resource
import signal
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest

import r2p
from r2p.msg import Float32
from r2p.protocols.discovery.events import ModuleChanged, ModuleGone
from r2p.testing.network import node_in
from r2p.transports.zenoh.sender import ZenohSubscriber
from tests.transports.test_conformance import first, other, until
from tests.transports.zenoh.cable import Net, guarded, module
from tests.transports.zenoh.peer import MODULES, TOPICS, Page

pytestmark = [pytest.mark.anyio, pytest.mark.one_loop, pytest.mark.processes]

Process = asyncio.subprocess.Process

FLOOD = 40  # messages each ms: 40 MB/s, until it is gone
BOUND = 8_000_000  # bytes


async def start(role: str, name: str, url: str) -> Process:
    process = await asyncio.create_subprocess_exec(
        sys.executable,
        "-m",
        "tests.transports.zenoh.peer",
        role,
        name,
        url,
        stdin=asyncio.subprocess.PIPE,
        stdout=asyncio.subprocess.PIPE,
    )
    assert process.stdout is not None
    assert await process.stdout.readline() == b"ready\n"
    return process


@asynccontextmanager
async def running(role: str, name: str, url: str) -> AsyncIterator[Process]:
    process = await start(role, name, url)
    try:
        yield process
    finally:
        if process.returncode is None:
            process.send_signal(signal.SIGCONT)
            process.kill()
        await process.wait()


async def gone(events: AsyncIterator[object], name: str) -> None:
    async for event in events:
        if isinstance(event, ModuleGone) and event.info.name == name:
            return


async def come(events: AsyncIterator[object], name: str) -> None:
    async for event in events:
        if isinstance(event, ModuleChanged) and event.info.name == name:
            return


@guarded
async def test_a_router_that_dies_and_comes_back_while_messages_flow() -> None:
    """Each message is received, or counted where it was lost: at the sender while that knows, else on the way."""
    net = Net()
    async with module("A", net.join) as a, module("B", net.join) as b, node_in(a) as alice, node_in(b) as bob:
        events = b.events()
        publisher = alice.advertise("count", Float32)
        subscriber = bob.subscribe("count", Float32, queue=1_000_000)
        slow, watching = alice.advertise("slow", Float32), bob.subscribe("slow", Float32, lossy=True)
        enough = asyncio.Event()
        async with running("router", "ROUTER", net.listen) as router:
            await publisher.wait_subscriber()
            await _confirmed(slow, watching)
            flowing = asyncio.create_task(_flow(a, alice, publisher, enough))
            await until(lambda: subscriber.queue)
            router.kill()
            await first(events, r2p.LinkDown)
            assert not other(b, "A")
            assert "no program listens" in (await first(events, r2p.LinkWaits)).reason
        received = len(subscriber.queue)
        async with running("router", "ROUTER", net.listen):
            assert (await first(events, r2p.LinkUp)).outage > 0
            await until(lambda: len(subscriber.queue) > received)
            enough.set()
            unwanted = await flowing
            await until(lambda: subscriber.queue[-1].sequence == publisher.sent)
            lost = a.links[0].losses["link down"] + b.links[0].losses["on the way"]
            assert lost > 0
            assert publisher.sent == len(subscriber.queue) + lost + unwanted
            assert other(b, "A")
            await _confirmed(slow, watching)


async def _confirmed(publisher: r2p.Publisher[Float32], subscriber: r2p.Subscriber[Float32]) -> None:
    """A message comes, and who sent it knows that: else it would suspect a router's access control."""
    await publisher.wait_subscriber()
    (remote,) = publisher._topic.remote_subscribers
    assert isinstance(remote, ZenohSubscriber)
    await publisher.publish(Float32(1.0))
    await subscriber.fetch()
    await until(lambda: not remote.unacknowledged())


async def _flow(module: r2p.Module, node: r2p.Node, publisher: r2p.Publisher[Float32], enough: asyncio.Event) -> int:
    """Publish until it is enough. How many messages had no subscriber: back on the network, none is known yet."""
    unwanted = 0
    async for _ in node.every(0.001):
        unwanted += module.links[0].up and not publisher.subscribers
        await publisher.publish(Float32(1.0))
        if enough.is_set():
            break
    return unwanted


@guarded
async def test_what_a_dead_process_had_is_gone_at_once() -> None:
    net = Net()
    async with module("A", net.listen) as a:
        events = a.events()
        async with running("count", "COUNT", net.join) as process:
            await come(events, "COUNT")
            await until(lambda: "count" in a.network.topics())
            process.kill()
            await gone(events, "COUNT")
            await until(lambda: "count" not in a.network.topics())  # a token of its own: it may end just after


@guarded
async def test_a_process_that_hangs_is_gone_without_effect_on_the_others() -> None:
    """Stopped with everything open; the others go on, and it is back when it goes on itself."""
    net = Net()
    async with (
        module("A", net.listen) as a,
        node_in(a) as alice,
        running("watch", "HUNG", net.join) as hung,
        running("watch", "WELL", net.join) as well,
    ):
        events = a.events()
        publisher = alice.advertise("count", Float32)
        flood = alice.advertise("flood", Page, r2p.Sporadic(deadline=1.0))
        await until(lambda: other(a, "HUNG") and other(a, "WELL"))
        await publisher.wait_subscriber()
        await flood.wait_subscriber()
        before = _resident()
        hung.send_signal(signal.SIGSTOP)
        leaving = asyncio.create_task(gone(events, "HUNG"))
        async for _ in alice.every(0.001):
            await publisher.publish(Float32(1.0))
            for _ in range(FLOOD):
                await flood.publish(Page())
            if leaving.done():
                break
        assert _resident() - before < BOUND
        assert publisher.missed <= 1
        assert other(a, "WELL")
        received = await _received(well, at_least=publisher.sent // 2)
        assert received <= publisher.sent
        returning = asyncio.create_task(come(a.events(), "HUNG"))
        hung.send_signal(signal.SIGCONT)
        await returning
        seen = await _received(hung)
        while await _received(hung) <= seen:  # it is served again
            await publisher.publish(Float32(1.0))


def _resident() -> int:
    """Bytes of memory that this process has."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()


async def _received(process: Process, at_least: int = 0) -> int:
    assert process.stdin is not None
    assert process.stdout is not None
    while True:
        process.stdin.write(b"\n")
        number = int(await process.stdout.readline())
        if number >= at_least:
            return number


@guarded
async def test_fifty_modules_join_at_once() -> None:
    net = Net()
    async with module("A", net.listen) as a:
        async with running("many", "", net.join):
            await until(lambda: len(a.network.modules()) == MODULES + 1)
            topics = a.network.topics
            await until(lambda: sum(name.startswith("m") for name in topics()) == MODULES * TOPICS)
            assert {view.publishers[0].node for view in topics().values() if view.name.startswith("m")} == {"many"}
        await until(lambda: len(a.network.modules()) == 1)
        assert not a.links[0].losses


@guarded
async def test_a_module_that_waits_for_its_router() -> None:
    net = Net()
    waiting = module("B", net.join)
    events = waiting.events()
    async with waiting as b:
        assert "no program listens" in (await first(events, r2p.LinkWaits)).reason
        async with running("router", "ROUTER", net.listen):
            await first(events, r2p.LinkUp)
            await until(lambda: other(b, "ROUTER"))
