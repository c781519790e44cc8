"""Robots in tests: modules on an in-memory network, and nodes that a test itself speaks through."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from r2p import Module, Node
from r2p.transports.memory import MemoryLink, MemoryNetwork


class Network(MemoryNetwork):
    """An in-memory network and the modules on it; what the fixture `r2p_network` gives.

    Its faults (`loss`, `duplicate`, `reorder`: probabilities; `delay`, `jitter`: seconds) can be set while it runs,
    and `counts` tells what happened.
    """

    def module(self, name: str, *, remap: dict[str, str] | None = None, observer: bool = False) -> Module:
        """A module on this network, as `r2p.Module`; open it with `async with`."""
        return Module(name, via=self.transport(), remap=remap, observer=observer, watchdog=False)

    @asynccontextmanager
    async def node(self, module: str, *, name: str = "test", priority: int = 0) -> AsyncIterator[Node]:
        """A node for the test to speak through, in a module of its own."""
        async with self.module(module) as host, node_in(host, name=name, priority=priority) as node:
            yield node

    def disconnect(self, module: Module) -> None:
        """Pull a module's plug: it hears nobody, nobody hears it, and its link says so."""
        for link in self._links(module):
            link.disconnect()

    def connect(self, module: Module) -> None:
        """Plug it in again."""
        for link in self._links(module):
            link.connect()

    def _links(self, module: Module) -> list[MemoryLink]:
        return [link for link in module.links if isinstance(link, MemoryLink) and link.network is self]


@asynccontextmanager
async def node_in(module: Module, *, name: str = "test", priority: int = 0) -> AsyncIterator[Node]:
    """A node of an open module that does nothing by itself: the test advertises and subscribes with it.

    What it opened is closed with it.
    """
    node = module.start(_idle, name=name, priority=priority)
    await asyncio.sleep(0)  # it runs
    try:
        yield node
    finally:
        await module.nodes[name].stop()


async def _idle(_node: Node) -> None:
    """Live until cancelled."""
    await asyncio.get_running_loop().create_future()
