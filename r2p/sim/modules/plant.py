"""The clock of the physics: moves everything that has a `step(dt)` on, as the event loop's time goes on."""

import asyncio
from collections.abc import Iterable
from types import TracebackType
from typing import Protocol, Self

from r2p.clock import Ticker

_SECOND = 1_000_000_000
_CATCH_UP = 1.0
"""Seconds of physics that are made up for when the loop was blocked; a computer that slept is not to be punished."""


class Part(Protocol):
    """Something that changes with time."""

    def step(self, dt: float) -> object:
        """Move on by `dt` seconds."""


class Plant:
    """Steps its parts, in their order, every `dt` seconds of the running loop's clock, inside of `async with`."""

    def __init__(self, parts: Iterable[Part] = (), *, dt: float = 0.001) -> None:
        self.parts = list(parts)
        self.dt = dt
        self.steps = 0
        """Done so far."""
        self._ticker: Ticker | None = None

    async def __aenter__(self) -> Self:
        self._ticker = Ticker(asyncio.get_running_loop(), round(self.dt * _SECOND), self._tick, background=True)
        self._ticker.start()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._ticker is not None:
            self._ticker.close()

    def step(self, count: int = 1) -> None:
        """So many steps at once."""
        dt, parts = self.dt, self.parts
        for _ in range(count):
            for part in parts:
                part.step(dt)
        self.steps += count

    def _tick(self, _scheduled: int, _late: int, skipped: int) -> None:
        self.step(1 + min(skipped, round(_CATCH_UP / self.dt)))
