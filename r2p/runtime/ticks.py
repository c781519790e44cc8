"""The loop of a periodic node: ticks on absolute phase, which count the periods that the loop's body has missed."""

import asyncio
from collections.abc import AsyncIterator
from typing import NamedTuple, Protocol

from r2p.clock import Clock, Ticker
from r2p.units import SECOND


class Tick(NamedTuple):
    """One period of `Node.every`: when it was due (monotonic ns), how late it is (s), periods skipped before it."""

    due: int
    late: float
    skipped: int


class Closable(Protocol):
    """A ticker, of which a node only wants that it ends with it."""

    def close(self) -> None:
        """Stop the ticks."""


async def ticks(
    period: float, loop: asyncio.AbstractEventLoop, clock: Clock, tickers: set[Closable]
) -> AsyncIterator[Tick]:
    """Yield a tick each `period` seconds, the first after one period. The ticker is in `tickers` while it runs."""
    waiter: asyncio.Future[None] | None = None
    due = skipped = 0

    def on_tick(scheduled: int, _late: int, lost: int) -> None:
        nonlocal due, skipped
        skipped += lost + (due > 0)
        due = scheduled
        if waiter is not None and not waiter.done():
            waiter.set_result(None)

    ticker = Ticker(loop, round(period * SECOND), on_tick)
    tickers.add(ticker)
    ticker.start()
    try:
        while True:
            if not due:
                waiter = loop.create_future()
                await waiter
            tick = Tick(due, (clock.monotonic() - due) / SECOND, skipped)
            due = skipped = 0
            yield tick
    finally:
        ticker.close()
        tickers.discard(ticker)
