"""Calls within a module: what callers get, what handlers notice, and that nothing waits for itself."""

from __future__ import annotations

import asyncio
import functools
import inspect
import logging
from typing import TYPE_CHECKING, Any

import pytest

import r2p
from r2p.msg import Led
from r2p.services.server import WAITING_MAX
from r2p.services.topics import Outlet
from r2p.units import MILLISECOND, SECOND
from tests.runtime.test_topic import Line
from tests.services.common import Add, Desk, add, nodes, outcome, until

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine

pytestmark = pytest.mark.virtual_time


def with_pair(test: Callable[..., Coroutine[Any, Any, None]]) -> Callable[..., Coroutine[Any, Any, None]]:
    """Give a test a node that serves, and one that calls, as its first arguments."""

    @functools.wraps(test)
    async def run(**given: Any) -> None:
        async with nodes("server", "client") as (server, client):
            await test(server, client, **given)

    parameters = list(inspect.signature(test).parameters.values())[2:]
    run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    return run


@with_pair
async def test_a_call_returns_the_response(server: r2p.Node, client: r2p.Node) -> None:
    served = server.serve("add", Add, add)
    calls = client.client("add", Add)
    assert await calls.call(Add.Request(a=1, b=2)) == Add.Response(total=3)
    assert await calls.call(Add.Request(a=1), server="PC1") == Add.Response(total=1)
    assert (served.handled, served.failed, calls.servers) == (2, 0, ["PC1"])


@with_pair
async def test_a_decorated_function_serves_and_two_classes_do_as_one(server: r2p.Node, client: r2p.Node) -> None:

    @server.service("add", Add.Request, Add.Response)
    async def answer(request: Add.Request) -> Add.Response:
        return Add.Response(total=request.a)

    assert (
        await client.client("add", Add).call(Add.Request(a=5))
        == Add.Response(total=5)
        == await answer(Add.Request(a=5))
    )


@with_pair
async def test_an_exception_is_a_service_error_there_and_a_line_of_the_log_here(
    server: r2p.Node, client: r2p.Node, caplog: pytest.LogCaptureFixture
) -> None:

    async def fail(request: Add.Request) -> Add.Response:
        if request.a:
            raise r2p.ServiceError("the arm is not homed")
        return Add.Response(total=1 // request.b)

    served = server.serve("add", Add, fail)
    calls = client.client("add", Add)
    with pytest.raises(r2p.ServiceError, match=r"^service add of PC1: ZeroDivisionError: "):
        await calls.call(Add.Request())
    with pytest.raises(r2p.ServiceError, match=r"^service add of PC1: the arm is not homed$"):
        await calls.call(Add.Request(a=1))
    await asyncio.sleep(2)
    await outcome(calls.call(Add.Request(a=1)))
    assert served.failed == 3
    lines = [(each.levelno, bool(each.exc_info)) for each in caplog.records if each.name == "r2p.PC1.server"]
    assert lines == [(logging.ERROR, True), (logging.WARNING, False)]


@pytest.mark.parametrize("answer", [None, Add.Request()])
@with_pair
async def test_a_wrong_response_is_an_error_of_the_handler(
    server: r2p.Node, client: r2p.Node, answer: r2p.Message | None
) -> None:
    async def wrong(_request: Add.Request) -> Add.Response:
        return answer  # type: ignore[return-value]

    server.serve("add", Add, wrong)
    error = await outcome(client.client("add", Add).call(Add.Request()))
    assert str(error).endswith(f"the handler returned {type(answer).__name__}, not Response")


@with_pair
async def test_what_does_not_fit_is_refused_before_it_is_sent(server: r2p.Node, client: r2p.Node) -> None:
    server.serve("add", Add, add)
    calls = client.client("add", Add)
    with pytest.raises(r2p.MessageError, match=r"Request\.a"):
        await calls.call(Add.Request(a=-1))
    with pytest.raises(r2p.MessageError, match="service add takes Request, not Response"):
        await calls.call(Add.Response())  # type: ignore[arg-type]
    with pytest.raises(r2p.MessageError, match="time-out"):
        await calls.call(Add.Request(), timeout=0)


@pytest.mark.parametrize("end", ["time-out", "cancellation", "asyncio.timeout"])
@with_pair
async def test_the_end_of_a_caller_reaches_its_handler(server: r2p.Node, client: r2p.Node, end: str) -> None:
    desk = Desk()
    server.serve("add", Add, desk.handle)
    calls = client.client("add", Add)
    call = asyncio.create_task(calls.call(Add.Request(a=7), timeout=1.0 if end == "time-out" else 100.0))
    await until(lambda: desk.begun)
    if end == "time-out":
        with pytest.raises(TimeoutError, match=r"^service add of PC1 did not answer within 1 s$"):
            await call
        assert asyncio.get_running_loop().time() == pytest.approx(1.0, abs=0.01)
    elif end == "cancellation":
        call.cancel()
        with pytest.raises(asyncio.CancelledError):
            await call
    else:
        with pytest.raises(TimeoutError):
            async with asyncio.timeout(0.1):
                await call
    await asyncio.sleep(0)
    await asyncio.sleep(0)
    assert desk.cancelled == [7]


@with_pair
async def test_eight_run_64_wait_and_one_more_is_refused(server: r2p.Node, client: r2p.Node) -> None:
    desk = Desk()
    served = server.serve("add", Add, desk.handle)
    calls = client.client("add", Add)
    tasks = [asyncio.create_task(calls.call(Add.Request(a=n))) for n in range(8 + WAITING_MAX)]
    await asyncio.sleep(0.1)
    assert (len(desk.begun), served.running, served.waiting) == (8, 8, WAITING_MAX)
    with pytest.raises(r2p.ServiceBusy, match="service add of PC1 is busy"):
        await calls.call(Add.Request())
    tasks[-1].cancel()  # one that waits
    desk.gate.set()
    answers = await asyncio.gather(*tasks[:-1])
    assert [each.total for each in answers] == list(range(8 + WAITING_MAX - 1))
    assert desk.begun == list(range(8 + WAITING_MAX - 1))
    assert served.refused == 1


async def test_services_that_call_each_other_never_wait_for_each_others_place() -> None:
    """Eight callers take all places of `ping`; each handler calls `pong`, which calls `ping`, six levels deep."""
    async with nodes("one", "two", "caller") as (one, two, caller):
        pings, pongs = two.client("ping", Add), one.client("pong", Add)

        async def ping(request: Add.Request) -> Add.Response:
            return await add(request) if not request.b else await pongs.call(Add.Request(request.a + 1, request.b - 1))

        async def pong(request: Add.Request) -> Add.Response:
            return await add(request) if not request.b else await pings.call(Add.Request(request.a + 1, request.b - 1))

        first = one.serve("ping", Add, ping)
        two.serve("pong", Add, pong, limit=1)
        calls = caller.client("ping", Add)
        answers = await asyncio.gather(*(calls.call(Add.Request(b=6)) for _ in range(8)))
        assert {each.total for each in answers} == {6}
        assert (first.running, first.waiting) == (0, 0)


@with_pair
async def test_a_service_that_calls_itself_for_ever_is_busy_in_the_end(server: r2p.Node, client: r2p.Node) -> None:
    calls = client.client("add", Add)

    async def again(request: Add.Request) -> Add.Response:
        return await calls.call(request)

    served = server.serve("add", Add, again)
    error = await outcome(calls.call(Add.Request()))
    assert "ServiceBusy" in str(error)
    assert served.running == 0


async def test_a_call_from_a_subscribers_callback() -> None:
    """Its node also serves what it calls: callback and handler are in the same node."""
    async with r2p.Module("PC1", via=[], watchdog=False) as module:
        got: list[int] = []

        async def asking(node: r2p.Node) -> None:
            node.serve("add", Add, add)
            calls = node.client("add", Add)

            async def ask(request: Add.Request) -> None:
                got.append((await calls.call(request)).total)

            node.subscribe("numbers", Add.Request, ask)
            numbers = node.advertise("numbers", Add.Request)
            await numbers.publish(Add.Request(a=1, b=1))
            while not got:
                await node.spin()

        module.start(asking)
        await module.wait()
        assert got == [2]


@with_pair
async def test_without_a_server_there_is_none_as_soon_as_that_is_sure(server: r2p.Node, client: r2p.Node) -> None:
    server.serve("add", Add, add)
    loop = asyncio.get_running_loop()
    calls = client.client("ad", Add)
    with pytest.raises(r2p.NoServer, match=r"^service ad has no server; did you mean add\?$"):
        await calls.call(Add.Request(), timeout=60.0)
    assert loop.time() == pytest.approx(0.5, abs=0.06)  # a node of this module may have started meanwhile
    with pytest.raises(r2p.NoServer):
        await calls.call(Add.Request(), timeout=60.0)
    assert loop.time() < 0.7
    with pytest.raises(r2p.NoServer, match="not served by module IMU1: it is by PC1"):
        await client.client("add", Add).call(Add.Request(), timeout=60.0, server="IMU1")


@with_pair
async def test_a_server_that_starts_a_little_later_is_waited_for(server: r2p.Node, client: r2p.Node) -> None:
    calls = client.client("add", Add)
    call = asyncio.create_task(calls.call(Add.Request(a=1)))
    ready = asyncio.create_task(calls.ready(timeout=1.0))
    with pytest.raises(TimeoutError, match=r"^service add has no server within 0\.1 s$"):
        await calls.ready(timeout=0.1)
    await asyncio.sleep(0.2)
    served = server.serve("add", Add, add)
    await ready
    assert await call == Add.Response(total=1)
    served.close()
    assert not calls.servers
    with pytest.raises(r2p.NoServer):
        await calls.call(Add.Request())


async def test_the_end_of_the_servers_node_ends_its_handlers_and_their_clean_up_is_waited_for() -> None:
    async with r2p.Module("PC1", via=[], watchdog=False) as module:
        log: list[str] = []

        async def handle(_request: Add.Request) -> Add.Response:
            try:
                await asyncio.sleep(100)
            finally:
                await asyncio.sleep(0.5)
                log.append("motor off")
            return Add.Response()

        async def serving(node: r2p.Node) -> None:
            node.serve("add", Add, handle)
            await node.spin()

        async def calling(node: r2p.Node) -> None:
            error = await outcome(node.client("add", Add).call(Add.Request(), timeout=50.0))
            log.append(str(error))

        module.start(serving)
        module.start(calling)
        await asyncio.sleep(1)
        await module.nodes["serving"].stop()
        log.append("stopped")
        await module.wait()
        assert log[0] == "motor off"
        assert set(log[1:]) == {"stopped", "service add of PC1: its node ends"}


async def test_the_end_of_the_callers_node_cancels_its_handler() -> None:
    async with r2p.Module("PC1", via=[], watchdog=False) as module:
        desk = Desk()

        async def serving(node: r2p.Node) -> None:
            node.serve("add", Add, desk.handle)
            await node.spin()

        async def calling(node: r2p.Node) -> None:
            calls = node.client("add", Add)
            await asyncio.gather(calls.call(Add.Request(a=1)), _raise_soon())

        module.start(serving)
        module.start(calling)
        await until(lambda: desk.begun)
        await module.nodes["calling"].stop()
        await asyncio.sleep(0.01)
        assert desk.cancelled == [1]


async def _raise_soon() -> None:
    await asyncio.sleep(100)


@with_pair
async def test_mistakes_are_errors_that_say_what_to_do(server: r2p.Node, client: r2p.Node) -> None:

    def plain(request: Add.Request) -> Add.Response:
        return Add.Response(total=request.a)

    class Half(r2p.Service):
        class Request(r2p.Message):
            a: r2p.u8 = 0

    with pytest.raises(r2p.Error, match=r"the handler plain is not a coroutine function: write `async def`"):
        server.serve("add", Add, plain)  # type: ignore[arg-type]
    with pytest.raises(r2p.MessageError, match=r"Half lacks a message class Response: nest `class Response"):
        client.client("add", Half)  # type: ignore[arg-type]
    with pytest.raises(r2p.MessageError, match="Request is the type of one message"):
        client.client("add", Add.Request)  # type: ignore[arg-type]
    with pytest.raises(r2p.MessageError, match="limit is a number of handlers"):
        server.serve("add", Add, add, limit=0)
    server.serve("add", Add, add)
    with pytest.raises(r2p.Error, match="already served by node server of module PC1"):
        client.serve("add", Add, add)
    with pytest.raises(r2p.TypeMismatch, match="topic add_r is Add_Response_r"):
        client.client("add", Add.Response, Add.Request)
    calls = client.client("add", Add)
    calls.close()
    with pytest.raises(r2p.Closed, match="the client of service add is closed"):
        await calls.call(Add.Request())


async def test_a_node_that_returns_says_that_its_services_end(caplog: pytest.LogCaptureFixture) -> None:
    async def serving(node: r2p.Node) -> None:
        node.serve("add", Add, add)

    async with r2p.Module("PC1", via=[], watchdog=False) as module:
        module.start(serving)
        await module.wait()
    assert "nothing serves add any more; end its function with `while True: await node.spin()`" in caplog.text


async def test_remapping_renames_a_service() -> None:
    async with r2p.Module("PC1", via=[], remap={"add": "sum"}, watchdog=False) as module:

        async def serving(node: r2p.Node) -> None:
            assert node.serve("add", Add, add).name == "sum"
            assert await node.client("add", Add).call(Add.Request(a=4)) == Add.Response(total=4)

        module.start(serving)
        await module.wait()
        assert not module.space.topics.keys() & {"add_q", "add_r"}


@with_pair
async def test_an_answer_waits_until_its_link_knows_of_its_caller(server: r2p.Node, client: r2p.Node) -> None:
    outlet = Outlet(server._space, server, "answers", r2p.layout(Led))
    outlet.answer(b"stale", MILLISECOND, "a", 1)
    await asyncio.sleep(0.1)
    outlet.answer(b"fresh", SECOND, "a", 1)
    one, other = Line("b"), Line("a")
    outlet.where.join(other)
    outlet.where.join(one)
    assert (one.got, other.got) == ([], [b"fresh"])
    outlet.answer(b"later", SECOND, "b", 2)
    assert one.got == [b"later"]
    outlet.answer(b"beside others", SECOND, "c", 3)
    third = Line("c")
    outlet.where.join(third)
    assert third.got == [b"beside others"]
