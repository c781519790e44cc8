"""Robots in tests: modules on an in-memory network, and nodes with which the test itself publishes and subscribes."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from r2p import BridgeOptions, Module, Node
from r2p.parameters.sources import GivenParameters
from r2p.transports.memory import MemoryLink, MemoryNetwork


class Network(MemoryNetwork):
    """An in-memory network for modules: the fixture `r2p_network`.

    Its faults (`loss`, `duplicate`, `reorder`: probabilities; `delay`, `jitter`: seconds) can be set while it runs,
    and `counts` has what happened.
    """

    def module(
        self,
        name: str,
        *others: "Network",
        remap: dict[str, str] | None = None,
        observer: bool = False,
        bridge: bool | BridgeOptions = False,
        params: GivenParameters = None,
    ) -> Module:
        """Return a module on this network, an `r2p.Module`; open it with `async with`. `params` are as for `Module`.

        It also has a link on each of the `others`; with `bridge` it is a gateway between all of them.
        """
        via = [each.transport() for each in (self, *others)]
        # No watchdog: it measures real time, and a slow computer is not what is tested.
        return Module(name, via=via, remap=remap, observer=observer, bridge=bridge, watchdog=False, params=params)

    @asynccontextmanager
    async def node(self, module: str, *, name: str = "test", priority: int = 0) -> AsyncIterator[Node]:
        """Open a node for the test, in a module of its own."""
        async with self.module(module) as host, node_in(host, name=name, priority=priority) as node:
            yield node

    def disconnect(self, module: Module) -> None:
        """Disconnect a module: it neither sends nor receives, and its link goes down."""
        for link in self._links(module):
            link.disconnect()

    def connect(self, module: Module) -> None:
        """Connect a module again."""
        for link in self._links(module):
            link.connect()

    def _links(self, module: Module) -> list[MemoryLink]:
        return [link for link in module.links if isinstance(link, MemoryLink) and link.network is self]


@asynccontextmanager
async def node_in(module: Module, *, name: str = "test", priority: int = 0) -> AsyncIterator[Node]:
    """Open a node of an open module for the test, which advertises and subscribes with it.

    Its publishers and subscribers are closed with it.
    """
    node = module.start(_idle, name=name, priority=priority)
    await asyncio.sleep(0)  # until its task has begun: from then on its priority counts
    try:
        yield node
    finally:
        await module.nodes[name].stop()


async def _idle(_node: Node) -> None:
    """Run until cancelled."""
    await asyncio.get_running_loop().create_future()
