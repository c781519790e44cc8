"""The clock of the physics: steps everything that has a `step(dt)` with the time of the event loop."""

import asyncio
from collections.abc import Iterable
from types import TracebackType
from typing import Protocol, Self

from r2p.clock import Ticker
from r2p.units import SECOND

_CATCH_UP = 1.0
"""Seconds of physics to make up for after the loop was blocked; after a long sleep of the computer, more would hang."""


class Part(Protocol):
    """Something that changes with time."""

    def step(self, dt: float) -> object:
        """Advance by `dt` seconds."""


class Plant:
    """Steps its parts in order, every `dt` seconds of the running loop's clock, inside `async with`."""

    def __init__(self, parts: Iterable[Part] = (), *, dt: float = 0.001) -> None:
        self.parts = list(parts)
        self.dt = dt
        self.steps = 0
        """The number of steps so far."""
        self._ticker: Ticker | None = None

    async def __aenter__(self) -> Self:
        self._ticker = Ticker(asyncio.get_running_loop(), round(self.dt * SECOND), self._tick, background=True)
        self._ticker.start()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._ticker is not None:
            self._ticker.close()

    def step(self, count: int = 1) -> None:
        """Do `count` steps at once."""
        dt, parts = self.dt, self.parts
        for _ in range(count):
            for part in parts:
                part.step(dt)
        self.steps += count

    def _tick(self, _scheduled: int, _late: int, skipped: int) -> None:
        self.step(1 + min(skipped, round(_CATCH_UP / self.dt)))
