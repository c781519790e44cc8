"""A served bus for tests: it runs in a thread of its own, and programs find it in a folder of the test's."""

from __future__ import annotations

import asyncio
import contextlib
import threading
from typing import TYPE_CHECKING, Any

from r2p.sim.buses.server import BusServer, serve_bus
from r2p.sim.transport import SimCan

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

PATIENCE = 30.0  # seconds


class ServedInThread:
    """A bus with its server, and its loop, which `call` runs functions in."""

    def __init__(self, name: str, **options: Any) -> None:
        self.can: SimCan
        self.server: BusServer
        self._name, self._options = name, options
        self._ready = threading.Event()
        self._end = asyncio.Event()
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_until_complete, args=(self._serve(),))

    def start(self) -> None:
        self._thread.start()
        assert self._ready.wait(PATIENCE)

    def call(self, function: Callable[..., object], *args: Any) -> None:
        self._loop.call_soon_threadsafe(function, *args)

    def end(self) -> None:
        """End the server, and wait for it."""
        if self._thread.is_alive():
            self.call(self._end.set)
            self._thread.join(PATIENCE)
            self._loop.close()

    async def _serve(self) -> None:
        self.can = SimCan(**self._options)
        async with serve_bus(self.can, self._name) as self.server:
            self._ready.set()
            await self._end.wait()


@contextlib.contextmanager
def served(name: str = "lab", **options: Any) -> Iterator[ServedInThread]:
    """Serve a bus while the block takes."""
    bus = ServedInThread(name, **options)
    bus.start()
    try:
        yield bus
    finally:
        bus.end()
