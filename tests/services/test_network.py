"""Calls between modules on networks that lose, double and reorder messages: each is handled once, and answered."""

from __future__ import annotations

import asyncio
import itertools
import logging
import random
from contextlib import AsyncExitStack
from typing import TYPE_CHECKING, Annotated

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import r2p
from r2p.codecs import services
from r2p.codecs.services import Kind, ServiceHeader
from r2p.sim import run
from r2p.testing.network import Network, node_in
from r2p.transports.memory import Datagram, MemoryPort
from tests.services.common import Add, Desk, Names, add, outcome, until

if TYPE_CHECKING:
    from r2p.services.server import Handler

pytestmark = pytest.mark.virtual_time


async def test_a_lossy_network_only_costs_time() -> None:
    """A fifth of all messages is lost, some come twice or late; no handler runs twice, and no call fails."""
    network = Network(loss=0.2, duplicate=0.1, reorder=0.1, delay=0.002, jitter=0.002)
    handled: list[int] = []

    async def handle(request: Add.Request) -> Add.Response:
        handled.append(request.a)
        await asyncio.sleep(0.01)
        return await add(request)

    async with network.node("S") as server, network.node("C") as client:
        served = server.serve("add", Add, handle)
        calls = client.client("add", Add)
        await calls.ready(10)
        for group in range(10):
            numbers = range(20 * group, 20 * group + 20)
            answers = await asyncio.gather(*(calls.call(Add.Request(a=n), timeout=4.0) for n in numbers))
            assert [each.total for each in answers] == list(numbers)
        assert sorted(handled) == list(range(200))
        assert served.repeated > 20


async def test_each_end_of_a_call_is_repeated_until_the_handler_has_it() -> None:
    network = Network()
    desk = Desk()
    async with network.node("S") as server, network.node("C") as client:
        server.serve("add", Add, desk.handle)
        calls = client.client("add", Add)
        await calls.ready(5)
        call = asyncio.create_task(calls.call(Add.Request(a=1), timeout=60.0))
        await until(lambda: desk.begun)
        network.loss = 1.0
        call.cancel()
        await asyncio.sleep(0.1)
        assert not desk.cancelled
        network.loss = 0.0
        await asyncio.sleep(0.3)
        assert desk.cancelled == [1]


async def test_the_time_out_reaches_a_handler_that_hears_nothing_more() -> None:
    """A memory network carries the deadline, so the server ends the handler itself."""
    network = Network()
    desk = Desk()
    async with network.node("S") as server, network.node("C") as client:
        server.serve("add", Add, desk.handle)
        calls = client.client("add", Add)
        await calls.ready(5)
        call = asyncio.create_task(outcome(calls.call(Add.Request(a=1), timeout=0.5)))
        await until(lambda: desk.begun)
        network.loss = 1.0
        assert str(await call) == "service add of S did not answer within 0.5 s"
        await asyncio.sleep(0.01)
        assert desk.cancelled == [1]


async def test_errors_and_busy_come_by_the_link_as_well(caplog: pytest.LogCaptureFixture) -> None:
    class Short(r2p.Message):
        a: r2p.u8 = 0

    async def fail(_request: r2p.Message) -> Add.Response:
        raise ValueError("no sensor at all, neither here nor there")

    async def short(_request: r2p.Message) -> Short:
        raise ValueError("no sensor")

    network = Network()
    desk = Desk()
    async with network.node("S") as server, network.node("C") as client:
        server.serve("fail", Add.Request, Add.Response, fail)
        server.serve("short", Add.Request, Short, short)
        server.serve("busy", Add, desk.handle, limit=1)
        failing = client.client("fail", Add)
        await failing.ready(5)
        error = await outcome(failing.call(Add.Request()))
        assert str(error) == "service fail of S: ValueError: no sensor at all,..."  # 32 bytes
        error = await outcome(client.client("short", Add.Request, Short).call(Add.Request()))
        assert str(error) == "service short of S: it failed; its log says why"
        assert "ValueError: no sensor at all, neither here nor there" in caplog.text
        busy = client.client("busy", Add)
        tasks = [asyncio.create_task(outcome(busy.call(Add.Request(a=n)))) for n in range(66)]
        await asyncio.sleep(0.3)
        desk.gate.set()
        answers = await asyncio.gather(*tasks)
        assert [str(each) for each in answers if isinstance(each, Exception)] == [
            "service busy of S is busy: call again later, or raise its limit="
        ]
        assert desk.begun == list(range(65))


async def test_several_servers_are_reported_and_one_can_be_chosen(caplog: pytest.LogCaptureFixture) -> None:
    network = Network()
    handled: list[str] = []

    def handler(name: str) -> Handler[Add.Request, Add.Response]:
        async def handle(request: Add.Request) -> Add.Response:
            handled.append(name)
            return await add(request)

        return handle

    async with AsyncExitStack() as stack:
        for name in ("B", "A"):
            node = await stack.enter_async_context(network.node(name))
            node.serve("add", Add, handler(name))
        client = await stack.enter_async_context(network.node("C"))
        calls = client.client("add", Add)
        await until(lambda: len(calls.servers) == 2)
        for server in (None, "B", "A"):
            await calls.call(Add.Request(), server=server)
        assert handled == ["A", "B", "A"]
        with pytest.raises(r2p.NoServer, match="service add is not served by module X: it is by A, B"):
            await calls.call(Add.Request(), server="X")
    lines = [each.getMessage() for each in caplog.records if each.levelno == logging.WARNING]
    assert lines == ["service add has 2 servers, A, B: calls go to A; choose one with server="]


async def test_no_server_on_a_link_is_known_after_two_seconds_at_most() -> None:
    network = Network()
    loop = asyncio.get_running_loop()
    async with network.node("S") as server, network.node("C") as client:
        server.serve("add", Add, add)
        missing = client.client("ad", Add)
        with pytest.raises(r2p.NoServer, match=r"^service ad has no server; did you mean add\?$"):
            await missing.call(Add.Request(), timeout=60.0)
        assert loop.time() < 0.7  # all modules on the link are r2p's, and nothing new was announced
    async with network.node("alone") as client:
        began = loop.time()
        with pytest.raises(r2p.NoServer, match=r"^service add has no server$"):
            await client.client("add", Add).call(Add.Request(), timeout=60.0)
        assert loop.time() - began == pytest.approx(2.0, abs=0.06)


async def test_a_link_that_is_down_is_named_and_a_call_goes_on_when_it_is_up() -> None:
    network = Network()
    async with network.module("S") as one, network.module("C") as two, node_in(one) as server, node_in(two) as client:
        server.serve("add", Add, add)
        calls = client.client("add", Add)
        await calls.ready(5)
        network.disconnect(one)
        call = asyncio.create_task(calls.call(Add.Request(a=3), timeout=20.0))
        await asyncio.sleep(0.5)
        network.connect(one)
        assert await call == Add.Response(total=3)
        await asyncio.sleep(2)
        network.disconnect(two)
        with pytest.raises(r2p.NoServer, match=r"^service add has no server; link memory is down$"):
            await calls.call(Add.Request())


async def test_a_restarted_server_gets_a_call_that_is_not_answered_yet() -> None:
    network = Network()
    desk = Desk()
    async with network.node("C") as client:
        calls = client.client("add", Add)
        async with network.node("S") as server:
            server.serve("add", Add, desk.handle)
            call = asyncio.create_task(calls.call(Add.Request(a=3), timeout=30.0))
            await until(lambda: desk.begun)
            network.loss = 1.0
        network.loss = 0.0
        async with network.node("S") as server:
            server.serve("add", Add, add)
            assert await call == Add.Response(total=3)


async def test_a_restart_of_the_callers_node_gets_no_answers_of_before() -> None:
    network = Network()
    async with network.node("S") as server, network.module("C") as module:
        server.serve("add", Add, add)
        for number in range(3):
            async with node_in(module) as client:
                calls = client.client("add", Add)
                await calls.ready(5)
                assert await calls.call(Add.Request(a=number)) == Add.Response(total=number)


async def test_answers_go_only_to_the_link_of_the_caller() -> None:
    """Of two networks, with a client each, only the caller's gets the response."""
    left, right = Network(), Network()
    async with left.module("S", right) as module, node_in(module) as server:
        server.serve("add", Add, add)
        async with left.node("C") as client, right.module("D") as other, node_in(other) as bystander:
            calls, idle = client.client("add", Add), bystander.client("add", Add)
            await calls.ready(5)
            await idle.ready(5)
            assert await calls.call(Add.Request(a=1)) == Add.Response(total=1)
            await asyncio.sleep(0.1)
            assert (other.links[0].stats.received, idle.late) == (0, 0)


async def test_a_call_through_gateways() -> None:
    networks = [Network(loss=0.05) for _ in range(4)]
    async with AsyncExitStack() as stack:
        for number, (one, two) in enumerate(itertools.pairwise(networks)):
            await stack.enter_async_context(one.module(f"GW{number}", two, bridge=True))
        server = await stack.enter_async_context(networks[0].node("S"))
        client = await stack.enter_async_context(networks[-1].node("C"))
        desk = Desk()
        desk.gate.set()
        server.serve("add", Add, desk.handle)
        calls = client.client("add", Add)
        await calls.ready(20)
        for number in range(50):
            answer = await calls.call(Add.Request(a=number), timeout=5.0, server="S")
            assert answer == Add.Response(total=number)
        assert desk.begun == list(range(50))


async def test_requests_and_responses_may_vary_in_length() -> None:
    async def names(_request: Names.Request) -> Names.Response:
        if len(known) > 3:
            raise ValueError("too many " + "names " * 40)
        return Names.Response(names=tuple(known))

    known: list[str] = []
    network = Network()
    async with network.node("S") as server, network.node("C") as client:
        server.serve("names", Names, names)
        for node in (server, client):
            calls = node.client("names", Names)
            await calls.ready(5)
            known[:] = []
            while len(known) <= 3:
                assert await calls.call(Names.Request()) == Names.Response(names=tuple(known))
                known.append("x" * 7 * len(known) if len(known) < 3 else "y")
            error = await outcome(calls.call(Names.Request()))
            assert str(error).startswith("service names of S: ValueError: too many names names names")
        assert str(error).endswith("...")  # after 200 bytes, by the link


async def test_what_others_could_write_into_is_not_handed_over() -> None:
    class Blob(r2p.Message):
        data: Annotated[bytes, r2p.Max(10)] = b""

    async with Network().node("S") as node:
        got: list[object] = []

        async def echo(request: Blob) -> Blob:
            got.append(request.data)
            return Blob(bytearray(b"out"))  # type: ignore[arg-type]

        node.serve("echo", Blob, Blob, echo)
        response = await node.client("echo", Blob, Blob).call(Blob(bytearray(b"in")))  # type: ignore[arg-type]
        assert [type(each) for each in (*got, response.data)] == [bytes, bytes]


# Hostile messages

BYTES = st.binary(max_size=60)
MESSAGES = st.builds(
    services.encode,
    st.builds(
        ServiceHeader, st.sampled_from([0, 1, 2]), st.integers(0, 3), st.sampled_from(Kind), st.sampled_from([0, 1, 2])
    ),
    BYTES,
    st.sampled_from([0, 20, 44]),
)


@given(st.lists(BYTES | MESSAGES, max_size=30))
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.too_slow])
def test_hostile_requests_and_answers_are_counted_and_never_raise(hostile: list[bytes]) -> None:
    """They come in the place of a peer's messages, with instances that are right now and then."""

    async def scenario() -> None:
        async with r2p.Module("PC1", via=[], watchdog=False) as module, node_in(module) as node:
            node._space.instance = 1
            served, calls = node.serve("add", Add, add), node.client("sub", Add)
            source = r2p.Source("X", "", "line")
            for data in hostile:
                sample = r2p.Sample(data, source, 0)
                served.receive(sample)
                calls.receive(sample)
            await asyncio.sleep(0.1)
            assert (served.running, served.waiting, len(served._open)) == (0, 0, 0)
            assert await node.client("add", Add).call(Add.Request(a=1)) == Add.Response(total=1)

    run(scenario)


def test_what_a_flood_of_requests_makes_a_server_remember_is_bounded() -> None:
    async def scenario() -> None:
        chance = random.Random(1)
        async with r2p.Module("PC1", via=[], watchdog=False) as module, node_in(module) as node:
            served = node.serve("add", Add, add)
            for _ in range(8000):
                kind = chance.choice([Kind.REQUEST, Kind.CANCEL])
                header = ServiceHeader(chance.getrandbits(32), chance.getrandbits(16), kind)
                served.receive(r2p.Sample(services.encode(header, bytes(8)), r2p.Source("X", "", "line"), 0))
            await asyncio.sleep(0.1)
            assert served._answers.size <= 1 << 20
            for number in range(1000):
                data = services.encode(ServiceHeader(7, number, Kind.CANCEL), bytes(8))
                served.receive(r2p.Sample(data, r2p.Source("X", "", "line"), 0))
            assert len([key for key in served._answers if key[0] == 7]) == 64

    run(scenario)


async def test_an_answer_goes_to_its_caller_alone() -> None:
    """A memory network can do that; behind a gateway, and from callers that no module is known for, it goes to all."""
    network, far = Network(), Network()
    heard: list[int] = []

    def hear(datagram: Datagram) -> None:
        if datagram.topic == b"add_r":
            heard.append(services.decode(datagram.data).number)

    network.plug_in(network.new_address(), MemoryPort(network, hear, lambda: None))
    async with (
        network.node("S") as server,
        network.node("C") as client,
        network.node("OTHER") as other,
        network.module("GW", far, bridge=True),
        far.node("FAR") as behind,
    ):
        server.serve("add", Add, add)
        calls, distant = client.client("add", Add), behind.client("add", Add)
        others = other.subscribe("add_r", None)
        await calls.ready(5)
        await distant.ready(5)
        await asyncio.sleep(1)
        for number in range(5):
            assert await calls.call(Add.Request(a=number)) == Add.Response(total=number)
        assert (heard, len(others.queue)) == ([], 0)
        assert await distant.call(Add.Request(a=7)) == Add.Response(total=7)
        assert len(heard) == len(others.queue) > 0
        network.duplicate = 1.0  # the request comes twice, so the answer goes out again, and arrives four times
        assert await calls.call(Add.Request(a=8)) == Add.Response(total=8)
        await asyncio.sleep(1)
        assert len(heard) == len(others.queue)
