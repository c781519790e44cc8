"""A MasterSession with nodes that only say what they have: what it reports is kept."""

from __future__ import annotations

import asyncio
import contextlib
from collections import Counter
from typing import TYPE_CHECKING, Any

from r2p.ros.ros1.environment import RosAddress
from r2p.ros.ros1.registration import MasterSession

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Iterable

    from r2p.ros.middleware import RosGraph
    from r2p.ros.ros1.slave import BusConnection


class Recorder:
    """Stands for the link and for TCPROS."""

    def __init__(self) -> None:
        self.events: list[tuple[Any, ...]] = []
        self.graph: RosGraph | None = None
        self.ports: dict[tuple[str, str], int] = {}
        self.bus: list[BusConnection] = []
        self._changed = asyncio.Event()

    async def until(self, condition: Callable[[], object]) -> None:
        """Wait until a condition is true; it is asked after each event."""
        async with asyncio.timeout(30.0):
            while not condition():
                self._changed.clear()
                await self._changed.wait()

    async def event(self, *beginning: Any) -> tuple[Any, ...]:
        """Wait for an event that begins with this, and return it; all before it are forgotten."""

        def found() -> int | None:
            matching = (i for i, each in enumerate(self.events) if each[: len(beginning)] == beginning)
            return next(matching, None)

        await self.until(lambda: found() is not None)
        index = found() or 0
        event = self.events[index]
        del self.events[: index + 1]
        return event

    def _add(self, *event: Any) -> None:
        self.events.append(event)
        self._changed.set()

    # MiddlewareUser

    def middleware_up(self) -> None:
        self._add("up")

    def middleware_down(self, reason: str) -> None:
        self._add("down", reason)

    def middleware_waits(self, reason: str) -> None:
        self._add("waits", reason)

    def graph_changed(self, graph: RosGraph) -> None:
        self.graph = graph
        self._add("graph", graph)

    def parameter_changed(self, key: str, value: object) -> None:
        self._add("parameter", key, value)

    def notice(self, kind: str, text: str, *, trouble: bool) -> None:
        self._add("notice", text, trouble)

    def shut_down(self, node: str, reason: str) -> None:
        self._add("shut_down", node, reason)

    def __getattr__(self, name: str) -> Any:
        raise AssertionError(f"the session has no business with {name}")

    # SlaveUser

    def publishers_changed(self, node: str, topic: str, publishers: list[str]) -> None:
        self._add("publishers", node, topic, publishers)

    def tcpros_port(self, node: str, topic: str) -> int | None:
        return self.ports.get((node, topic))

    def connections(self, node: str) -> Iterable[BusConnection]:
        return self.bus

    def complete_graph(self, graph: RosGraph) -> RosGraph:
        return graph


@contextlib.asynccontextmanager
async def running(uri: str, *nodes: str) -> AsyncIterator[tuple[MasterSession, Recorder]]:
    """A session on loopback with these nodes, that ends with the block."""
    recorder = Recorder()
    session = MasterSession(RosAddress(uri, "127.0.0.1", "127.0.0.1"), recorder, Counter())
    for node in nodes:
        session.add_node(node)
    task = asyncio.create_task(session.run(recorder, lambda: None))
    try:
        yield session, recorder
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task
