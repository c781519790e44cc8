"""What a link has registered at its middleware: ROS nodes, publishers and subscribers, by the topics of this side, and
servers, by the services; and what is not registered, and why.
"""

import asyncio
from collections import Counter
from collections.abc import Callable, Collection
from typing import Any, TypeAlias

import msgspec

from r2p.clock import Alarm, clock_of, in_background
from r2p.codecs.management import ROLE_PUBLISHES, ROLE_SUBSCRIBES
from r2p.protocols.discovery.directory import decrement
from r2p.ros.middleware import Middleware, RosEndpoint, RosServer
from r2p.units import SECOND

SERVES, CALLS = "serves", "calls"
"""The roles of a node in a service, beside ROLE_PUBLISHES and ROLE_SUBSCRIBES in a topic."""


class RosClient(msgspec.Struct, frozen=True):
    """A client of a service in one of the link's ROS nodes: the node is shown, each call names it."""

    node: str
    service: str


Registered: TypeAlias = RosEndpoint | RosServer | RosClient


class Registrations:
    """Registers the difference between what a topic has and should have.

    A ROS node is shown from its first endpoint to its last one. While there is none, the module itself is a ROS node,
    `module_node`: `at_once`, or after a second, as programs start and end without endpoints. After `keep_module_node`
    it always is.
    """

    def __init__(
        self,
        middleware: Middleware,
        module_node: str,
        loop: asyncio.AbstractEventLoop,
        on_alone: Callable[[], object],
        *,
        at_once: bool,
    ) -> None:
        """`on_alone` is called when the module becomes a ROS node, as it has no others."""
        self.module_node = module_node
        self._on_alone = on_alone
        self.nodes: set[str] = set()
        """The ROS nodes of this link."""
        self._middleware = middleware
        self._keep_module_node = False
        self._methods: dict[int | str, tuple[Callable[[Any], object], Callable[[Any], object]]] = {
            ROLE_PUBLISHES: (middleware.advertise, middleware.withdraw),
            ROLE_SUBSCRIBES: (middleware.subscribe, middleware.unsubscribe),
            SERVES: (middleware.serve, middleware.unserve),
            CALLS: (_do_nothing, _do_nothing),
        }
        self._endpoints: dict[tuple[str, int | str], set[Registered]] = {}
        self._counts: Counter[str] = Counter()
        self.refused: set[str] = set()
        """Nodes that are not shown, as others have their names."""
        self._shown: Callable[[str], object] = _do_nothing
        self._gone: Callable[[str], object] = _do_nothing
        self._at_once = self._alone = at_once
        self._clock = clock_of(loop)
        self._alarm = Alarm(loop, self._show_module_node, background=True)
        self._note_alone()
        self._add_nodes()

    def close(self) -> None:
        """Remove all nodes from the ROS network."""
        self._alarm.close()

    def declare(self, name: str, role: int | str, endpoints: Collection[Registered]) -> None:
        """Have these endpoints of a topic or service in a role, and no others. No node ends in between."""
        wanted = {each for each in endpoints if each.node not in self.refused}
        before = self._endpoints.get((name, role), set())
        new, gone = _sorted(wanted - before), _sorted(before - wanted)
        self._counts.update(each.node for each in new)
        self._note_alone()
        self._add_nodes()
        register, unregister = self._methods[role]
        for endpoint in gone:  # first: a new one may only differ in its type or quality of service
            unregister(endpoint)
            decrement(self._counts, endpoint.node)
        for endpoint in new:
            register(endpoint)
        self._note_alone()
        self._remove_nodes()
        if wanted:
            self._endpoints[name, role] = wanted
        else:
            self._endpoints.pop((name, role), None)

    def watch(self, shown: Callable[[str], object], gone: Callable[[str], object]) -> None:
        """Call `shown` with each node, now and when a new one is shown, and `gone` before a node is removed."""
        self._shown, self._gone = shown, gone
        for node in sorted(self.nodes):
            shown(node)

    def unwatch(self) -> None:
        """Call these functions no more."""
        self._shown = self._gone = _do_nothing

    @property
    def shows_module_node(self) -> bool:
        """Return whether the module itself is a ROS node."""
        return self.module_node in self.nodes

    def keep_module_node(self) -> None:
        """Show the module as a ROS node from now on, whatever other nodes it has."""
        self._keep_module_node = True
        self._add_nodes()

    def endpoints(self, name: str, role: int) -> list[RosEndpoint]:
        """Return the endpoints of a topic in a role."""
        return [each for each in self._endpoints.get((name, role), ()) if isinstance(each, RosEndpoint)]

    def node_of(self, name: str) -> str:
        """Return a node that publishes a topic; empty without one."""
        return next((each.node for each in self._endpoints.get((name, ROLE_PUBLISHES), ())), "")

    def nodes_besides(self, name: str) -> list[str]:
        """Return the nodes that have anything but this topic, in order."""
        shares = Counter(each.node for role in self._methods for each in self._endpoints.get((name, role), ()))
        return sorted(node for node, count in self._counts.items() if count > shares[node])

    def forget_node(self, node: str) -> None:
        """Remove a node for good: another one has its name."""
        self.refused.add(node)
        for (name, role), endpoints in list(self._endpoints.items()):
            self.declare(name, role, endpoints)

    def _note_alone(self) -> None:
        """Note whether the link has endpoints: after a second without any, the module itself becomes a ROS node."""
        if self._at_once:
            self._alone = not self._counts
        elif self._counts:
            self._alone = False
            self._alarm.set(None)
        elif not self._alone:
            self._alarm.set(self._clock.monotonic() + SECOND)

    def _show_module_node(self) -> None:
        self._alone = True
        self._add_nodes()
        self._on_alone()

    def _wanted(self) -> set[str]:
        module = {self.module_node} - self.refused if self._keep_module_node or self._alone else set()
        return self._counts.keys() | module

    def _add_nodes(self) -> None:
        for node in sorted(self._wanted() - self.nodes):
            self._middleware.add_node(node)
            self.nodes.add(node)
            self._shown(node)

    def _remove_nodes(self) -> None:
        self._add_nodes()  # the module's own one, before the last other one goes
        for node in sorted(self.nodes - self._wanted()):
            self._gone(node)
            self._middleware.remove_node(node)
            self.nodes.remove(node)


TYPE_UNKNOWN = "type unknown"
"""The reason of a topic or service whose class no program here knows."""

_REPORTED_AFTER_S = 3.0
"""Seconds until it is reported that a topic or service is not on ROS: its type may be on its way."""


class NotOnRos:
    """The topics, or the services, of this side that are not on the ROS network, and why.

    Each one is reported and counted once, if it stays so. `what` comes before its name: "service ", or nothing.
    """

    def __init__(
        self, what: str, loop: asyncio.AbstractEventLoop, lost: Counter[str], notice: Callable[..., object]
    ) -> None:
        self.reasons: dict[str, str] = {}
        self._what = what
        self._loop = loop
        self._lost = lost
        self._notice = notice
        self._reported: set[str] = set()
        self._closed = False

    def note(self, name: str, reason: str) -> None:
        """Note why a topic or service is not on the ROS network; empty if it is."""
        if not reason:
            self.reasons.pop(name, None)
            return
        is_new = name not in self.reasons
        self.reasons[name] = reason
        if is_new:
            in_background(self._loop.call_later(_REPORTED_AFTER_S, self._report, name))

    def close(self) -> None:
        """Stop reporting."""
        self._closed = True

    def _report(self, name: str) -> None:
        reason = self.reasons.get(name)
        if reason is None or self._closed or name in self._reported:
            return
        self._reported.add(name)
        self._lost[f"{self._what}not on ROS"] += 1
        advice = f": give --type {name}=TYPE" if reason == TYPE_UNKNOWN else ""
        self._notice("not on ROS", f"{self._what}{name} is not on ROS: {reason}{advice}", trouble=False)


def _sorted(endpoints: Collection[Registered]) -> list[Registered]:
    return sorted(
        endpoints, key=lambda each: (each.node, each.topic if isinstance(each, RosEndpoint) else each.service)
    )


def _do_nothing(endpoint: object) -> None: ...
