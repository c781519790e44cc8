"""How tools wait for messages: they say what they wait for, and may give up."""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable
from typing import Any

import r2p
from r2p.tools.session import Session, TimedOut


async def watched(session: Session, subscriber: r2p.Subscriber[Any]) -> AsyncIterator[r2p.Sample]:
    """The samples of a subscription; says what it waits for until there is a first one."""

    def missing() -> str:
        return ("the first message" if subscriber.publishers else "a publisher") + f" of {subscriber.topic}"

    samples = subscriber.samples()
    with session.waiting(missing):
        first = await anext(samples, None)
    if first is not None:
        yield first
    async for sample in samples:
        yield sample


@contextlib.asynccontextmanager
async def patience(what: str, timeout: float | None) -> AsyncIterator[Callable[[], None]]:
    """Raise TimedOut in the block when the function that it gets has not been called for `timeout` seconds."""
    loop = asyncio.get_running_loop()
    try:
        async with asyncio.timeout(timeout) as limit:

            def heard() -> None:
                if timeout is not None and not limit.expired():
                    limit.reschedule(loop.time() + timeout)

            yield heard
    except TimeoutError:
        raise TimedOut(f"nothing on {what} for {timeout:g} s") from None
