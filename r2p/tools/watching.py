"""How tools wait for messages: they say what they wait for, and may give up."""

import asyncio
import contextlib
import difflib
from collections.abc import AsyncIterator, Callable, Iterator
from typing import Any

import r2p
from r2p.tools.session import Session, TimedOut

HINT_AFTER = 2.0
"""Seconds without a publisher after which a tool names topics that the user may have meant."""


async def watched(session: Session, subscriber: r2p.Subscriber[Any]) -> AsyncIterator[r2p.Sample]:
    """The samples of a subscription; says what it waits for until there is a first one."""

    def missing() -> str:
        return ("the first message" if subscriber.publishers else "a publisher") + f" of {subscriber.topic}"

    samples = subscriber.samples()
    with session.waiting(missing), _hint(session, subscriber):
        first = await anext(samples, None)
    if first is not None:
        yield first
    async for sample in samples:
        yield sample


@contextlib.contextmanager
def _hint(session: Session, subscriber: r2p.Subscriber[Any]) -> Iterator[None]:
    """While the block waits: once, the published topics with names much like this one, if this one has no publisher."""

    def tell() -> None:
        topics = session.module.network.topics().items()
        published = [name for name, view in topics if view.publishers or view.published_on]
        close = difflib.get_close_matches(subscriber.topic, published)
        if close and not subscriber.publishers:
            session.say(f"nobody publishes {subscriber.topic}: is it one of {', '.join(close)}?")

    timer = asyncio.get_running_loop().call_later(HINT_AFTER, tell)
    try:
        yield
    finally:
        timer.cancel()


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
