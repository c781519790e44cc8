"""The service that these tests call, and nodes to do so."""

from __future__ import annotations

import asyncio
from contextlib import AsyncExitStack, asynccontextmanager
from typing import TYPE_CHECKING, Annotated

import r2p
from r2p.testing.network import node_in

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable


class Add(r2p.Service):
    """Adds two numbers; the response has room for the text of an error."""

    class Request(r2p.Message):
        a: r2p.u32 = 0
        b: r2p.u32 = 0

    class Response(r2p.Message):
        total: r2p.u64 = 0
        spare: tuple[r2p.u64, r2p.u64, r2p.u64] = (0, 0, 0)


class Names(r2p.Service):
    """What a request without fields asks for: a list, as long as it is."""

    class Request(r2p.Message):
        pass

    class Response(r2p.Message):
        names: Annotated[tuple[Annotated[str, r2p.Max(30)], ...], r2p.Max(5)] = ()


async def add(request: Add.Request) -> Add.Response:
    return Add.Response(total=request.a + request.b)


class Desk:
    """A handler that takes as long as it is told: a request waits until `release`, and what became of it is noted."""

    def __init__(self) -> None:
        self.begun: list[int] = []
        self.cancelled: list[int] = []
        self.gate = asyncio.Event()

    async def handle(self, request: Add.Request) -> Add.Response:
        self.begun.append(request.a)
        try:
            await self.gate.wait()
        except asyncio.CancelledError:
            self.cancelled.append(request.a)
            raise
        return await add(request)


@asynccontextmanager
async def nodes(*names: str) -> AsyncIterator[list[r2p.Node]]:
    """Nodes of one module without links."""
    async with r2p.Module("PC1", via=[], watchdog=False) as module, AsyncExitStack() as stack:
        yield [await stack.enter_async_context(node_in(module, name=name)) for name in names]


async def until(condition: Callable[[], object]) -> None:
    """Wait until the condition holds."""
    async with asyncio.timeout(30):
        while not condition():  # noqa: ASYNC110 - there is no event
            await asyncio.sleep(0.001)


async def outcome(call: Awaitable[object]) -> object:
    """What a call returns, or the exception that it raises."""
    try:
        return await call
    except (r2p.Error, TimeoutError) as error:
        return error
