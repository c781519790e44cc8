"""Processes that die, hang and come back, on a network of processes."""

import asyncio
import signal
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import pytest

import r2p
from r2p.msg import Float32
from r2p.protocols.events import ModuleChanged, ModuleGone
from r2p.testing.network import node_in
from tests.transports.test_conformance import first, other, until
from tests.transports.zenoh.cable import Net, guarded, module
from tests.transports.zenoh.peer import MODULES, TOPICS

pytestmark = [pytest.mark.anyio, pytest.mark.processes]

Process = asyncio.subprocess.Process


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
    net = Net()
    router = await start("router", "ROUTER", net.listen)
    async with running("count", "COUNT", net.join), module("B", net.join) as b, node_in(b) as bob:
        events = b.events()
        subscriber = bob.subscribe("count", Float32, queue=100)
        samples = subscriber.samples()
        before = await anext(samples)
        router.kill()
        await router.wait()
        await first(events, r2p.LinkDown)
        assert not other(b, "COUNT")
        assert "nobody listens" in (await first(events, r2p.LinkWaits)).reason
        router = await start("router", "ROUTER", net.listen)
        up = await first(events, r2p.LinkUp)
        assert up.outage > 0
        after = before
        while after.stamp < before.stamp + 1_000_000_000 * up.outage:
            after = await anext(samples)
        assert other(b, "COUNT")
        assert after.sequence > before.sequence + subscriber.lost
        router.kill()
        await router.wait()


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
            assert "count" not in a.network.topics()


@guarded
async def test_a_process_that_hangs_is_gone_and_nobody_else_notices() -> None:
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
        await until(lambda: other(a, "HUNG") and other(a, "WELL"))
        await publisher.wait_subscriber()
        hung.send_signal(signal.SIGSTOP)
        leaving = asyncio.create_task(gone(events, "HUNG"))
        async for _ in alice.every(0.001):
            await publisher.publish(Float32(1.0))
            if leaving.done():
                break
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
        assert "nobody listens" in (await first(events, r2p.LinkWaits)).reason
        async with running("router", "ROUTER", net.listen):
            await first(events, r2p.LinkUp)
            await until(lambda: other(b, "ROUTER"))
