"""What a link has registered at its middleware: ROS nodes, publishers and subscribers, by the topics of this side."""

from collections import Counter

from r2p.codecs.management import ROLE_PUBLISHES
from r2p.protocols.discovery.directory import decrement
from r2p.ros.middleware import Middleware, RosEndpoint


class Registrations:
    """Registers the difference between what a topic has and should have.

    A ROS node is shown from its first endpoint to its last one. While there is none, the module itself is a ROS node,
    `module_node`; with `keep_module_node` it always is.
    """

    def __init__(self, middleware: Middleware, module_node: str, *, keep_module_node: bool = False) -> None:
        self.module_node = module_node
        self.nodes: set[str] = set()
        """The ROS nodes of this link."""
        self._middleware = middleware
        self._keep_module_node = keep_module_node
        self._endpoints: dict[tuple[str, int], set[RosEndpoint]] = {}
        self._counts: Counter[str] = Counter()
        self._refused: set[str] = set()
        self._add_nodes()

    def declare(self, topic: str, role: int, endpoints: set[RosEndpoint]) -> None:
        """Have these endpoints of a topic in a role, and no others. New ones come first: no node ends in between."""
        endpoints = {each for each in endpoints if each.node not in self._refused}
        before = self._endpoints.get((topic, role), set())
        new, gone = _sorted(endpoints - before), _sorted(before - endpoints)
        self._counts.update(each.node for each in new)
        self._add_nodes()
        for endpoint in new:
            (self._middleware.advertise if role == ROLE_PUBLISHES else self._middleware.subscribe)(endpoint)
        for endpoint in gone:
            (self._middleware.withdraw if role == ROLE_PUBLISHES else self._middleware.unsubscribe)(endpoint)
            decrement(self._counts, endpoint.node)
        self._remove_nodes()
        if endpoints:
            self._endpoints[topic, role] = endpoints
        else:
            self._endpoints.pop((topic, role), None)

    def forget_node(self, node: str) -> None:
        """Remove a node for good: another one has its name."""
        self._refused.add(node)
        for (topic, role), endpoints in list(self._endpoints.items()):
            self.declare(topic, role, endpoints)

    def _wanted(self) -> set[str]:
        module = {self.module_node} - self._refused if self._keep_module_node or not self._counts else set()
        return self._counts.keys() | module

    def _add_nodes(self) -> None:
        for node in sorted(self._wanted() - self.nodes):
            self._middleware.add_node(node)
            self.nodes.add(node)

    def _remove_nodes(self) -> None:
        wanted = self._wanted()
        for node in sorted(wanted - self.nodes):  # the module's own one, before the last other one goes
            self._middleware.add_node(node)
        for node in sorted(self.nodes - wanted):
            self._middleware.remove_node(node)
        self.nodes = wanted


def _sorted(endpoints: set[RosEndpoint]) -> list[RosEndpoint]:
    return sorted(endpoints, key=lambda each: (each.node, each.topic))
