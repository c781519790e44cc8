"""Collects the figures of a module's network once a second."""

import asyncio
from types import TracebackType
from typing import Self

from r2p.codecs.services import is_of_service
from r2p.errors import Closed
from r2p.modules.graph import Endpoint, ModuleView, TopicView
from r2p.modules.module import Module
from r2p.monitoring.snapshot import (
    ModuleFigures,
    NetworkSnapshot,
    NodeFigures,
    PublisherFigures,
    SubscriberFigures,
    TopicFigures,
)
from r2p.runtime.sample import PublisherClass

_CLASS_NAMES = {
    PublisherClass.PERIODIC: "periodic",
    PublisherClass.SPORADIC: "sporadic",
    PublisherClass.NON_REAL_TIME: "non real-time",
}


class NetworkMonitor:
    """Collects figures while its block is open: `snapshot` is the newest, and `changed()` waits for the next one.

    It takes its turn in the event loop once each `period` (s), whatever the number of topics.
    """

    def __init__(self, module: Module, *, period: float = 1.0) -> None:
        self.snapshot = NetworkSnapshot(time=0)
        """The newest figures."""
        self._module = module
        self._period = period
        self._changed = asyncio.Event()

    async def __aenter__(self) -> Self:
        """Begin to collect. Raises Closed if the module is not open."""
        self._collect()
        self._task = asyncio.create_task(self._run(), name=f"{self._module.name} monitor")
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._task.cancel()
        await asyncio.wait([self._task])

    async def changed(self) -> NetworkSnapshot:
        """Wait for the next figures, and return them."""
        await self._changed.wait()
        return self.snapshot

    def measure(self, topic: str) -> None:
        """Subscribe to a topic, to know its rate, latency and losses. Raises InvalidName and NameTooLong."""
        raise NotImplementedError(topic)

    def stop_measuring(self, topic: str) -> None:
        """End the subscription to a topic that is measured."""
        raise NotImplementedError(topic)

    async def _run(self) -> None:
        while True:
            await asyncio.sleep(self._period)
            try:
                self._collect()
            except Closed:
                return

    def _collect(self) -> None:
        network = self._module.network
        views = network.topics()
        nodes = network.nodes()
        self.snapshot = NetworkSnapshot(
            time=self._module.space.clock.now(),
            network=", ".join(link.name for link in self._module.links),
            modules=[_module(view, nodes) for view in network.modules()],
            topics=[_topic(view, is_of_service=is_of_service(name, views)) for name, view in views.items()],
        )
        changed, self._changed = self._changed, asyncio.Event()
        changed.set()


def _module(view: ModuleView, nodes: dict[tuple[str, str], tuple[list[str], list[str]]]) -> ModuleFigures:
    own = [NodeFigures(node, None, None, *topics) for (module, node), topics in nodes.items() if module == view.name]
    return ModuleFigures(
        view.name, view.state, view.kind, view.age, view.link, view.release, rebooted=view.rebooted, nodes=own
    )


def _topic(view: TopicView, *, is_of_service: bool) -> TopicFigures:
    return TopicFigures(
        view.name,
        type=view.layout.name if view.layout else view.ros_type or None,
        size=view.size or None,
        varies=view.varies,
        mismatch=view.mismatch,
        age=view.age,
        publishers=[_publisher(each) for each in view.publishers],
        subscribers=[SubscriberFigures(each.module, each.node, each.link) for each in view.subscribers],
        is_of_service=is_of_service,
    )


def _publisher(endpoint: Endpoint) -> PublisherFigures:
    klass = endpoint.publisher_class
    return PublisherFigures(
        endpoint.module, endpoint.node, endpoint.link, None if klass is None else _CLASS_NAMES[klass]
    )
