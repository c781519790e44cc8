"""The slave API: what the master and other nodes ask of one ROS node, and the one thing that it asks of others.

Each node has a server of its own, because roscpp calls every node at the root of its URI. Answers are `[code, text,
value]` with rospy's texts: code 1 for success, 0 for a failure, -1 for an error of the caller. What the caller has
wrong is never a fault.
"""

import os
from collections.abc import Callable, Iterable
from typing import Final, Literal, NamedTuple, Protocol

import msgspec

from r2p.ros.middleware import RosGraph
from r2p.ros.ros1.master import MasterError, value_of
from r2p.ros.ros1.names import join
from r2p.ros.ros1.xmlrpc import XmlRpcClient, XmlRpcError, is_host
from r2p.ros.ros1.xmlrpc_codec import Value

TCPROS: Final = "TCPROS"
"""The only transport of ROS 1 that everything has."""

_MULTICALL: Final = "system.multicall"
_CALLS_MAX: Final = 100  # calls in one
_TEXT_MAX: Final = 1000  # characters of what another node says, in what users see
_OK, _FAILURE, _ERROR = 1, 0, -1


class BusConnection(msgspec.Struct, frozen=True):
    """A TCPROS connection of a topic, as `rosnode info` shows it; services have none.

    `number` is unique within the node. `peer` is a node's name for a subscriber of ours ("o"), and the URI of the slave
    API of a publisher that is received ("i"). `payload` are bytes, and `text` says where the connection is.
    """

    number: int
    topic: str
    peer: str
    direction: Literal["i", "o"]
    connected: bool
    payload: int
    messages: int
    text: str = ""


class SlaveUser(Protocol):
    """What moves the messages of the nodes: TCPROS."""

    def publishers_changed(self, node: str, topic: str, publishers: list[str]) -> None:
        """Note the slave URIs of all publishers of a topic that the node subscribes: new ones are to be connected to,
        connections to those not in it are to be closed. Nodes of this process are not in it.
        """

    def tcpros_port(self, node: str, topic: str) -> int | None:
        """Return the port where the node's publisher of a topic accepts connections; None: it has none."""

    def connections(self, node: str) -> Iterable[BusConnection]:
        """Return all connections of topics that a node has."""

    def complete_graph(self, graph: RosGraph) -> RosGraph:
        """Return the graph with the types of services, which the master does not know."""


class SlaveOwner(Protocol):
    """The session, as one of its nodes sees it."""

    @property
    def master_uri(self) -> str:
        """Return the master's URI."""

    @property
    def host(self) -> str:
        """Return the host by which others reach this computer."""

    @property
    def slaves(self) -> SlaveUser:
        """Return what moves messages."""

    def publishers_updated(self, node: str, topic: str, publishers: list[str]) -> None:
        """Note all publishers of a topic."""

    def parameter_updated(self, node: str, key: str, value: Value) -> bool:
        """Note the value of a parameter; return whether it was subscribed."""

    def shutdown_asked(self, node: str, caller: str, reason: str) -> None:
        """Note that another node, or the master, wants the end of a node."""

    def slave_uri(self, node: str) -> str:
        """Return the URI of a node's slave API."""


class SlaveNode:
    """One ROS node of this process: what it has, and its slave API."""

    def __init__(self, name: str, owner: SlaveOwner) -> None:
        self.name = name
        self.publications: dict[str, str] = {}
        """The types of topics that it publishes."""
        self.subscriptions: dict[str, str] = {}
        """The types of topics that it subscribes; `*`: any."""
        self.services: dict[str, int] = {}
        """The ports of its services."""
        self._owner = owner

    # What others call

    def handle(self, method: str, arguments: list[Value]) -> object:
        """Answer a call, or a list of calls."""
        if method == _MULTICALL and len(arguments) == 1 and isinstance(arguments[0], list):
            return [self._handle_one(each) for each in arguments[0][:_CALLS_MAX]]
        return self._answer(method, arguments)

    def _handle_one(self, call: Value) -> object:
        match call:
            case {"methodName": str(method), "params": list(arguments)} if method != _MULTICALL:
                return [self._answer(method, arguments)]
        return {"faultCode": 1, "faultString": "a call has a methodName and params"}

    def _answer(self, method: str, arguments: list[Value]) -> object:
        known = _METHODS.get(method)
        if known is None:
            return [_ERROR, f"unknown method {method:.100}", 0]
        problem = _problem(known, arguments)
        return [_ERROR, problem, known.failed] if problem else known.answer(self, *arguments)

    def get_pid(self, _caller: str) -> object:
        return [_OK, "", os.getpid()]

    def get_name(self, _caller: str) -> object:
        return [_OK, "", self.name]

    def get_uri(self, _caller: str) -> object:
        return [_OK, "", self._owner.slave_uri(self.name)]

    def get_master_uri(self, _caller: str) -> object:
        return [_OK, self._owner.master_uri, self._owner.master_uri]

    def get_publications(self, _caller: str) -> object:
        return [_OK, "publications", [*self.publications.items()]]

    def get_subscriptions(self, _caller: str) -> object:
        return [_OK, "subscriptions", [*self.subscriptions.items()]]

    def get_bus_info(self, _caller: str) -> object:
        rows = [
            [each.number, each.peer, each.direction, TCPROS, each.topic, each.connected, each.text]
            for each in self._owner.slaves.connections(self.name)
        ]
        return [_OK, "bus info", rows]

    def get_bus_stats(self, _caller: str) -> object:
        """Return the statistics of publishers and subscribers; those of services are empty, as in rospy."""
        connections = [*self._owner.slaves.connections(self.name)]
        return [_OK, "", [self._published(connections), self._subscribed(connections), []]]

    def _published(self, connections: list[BusConnection]) -> list[object]:
        rows: list[object] = []
        for topic in self.publications:
            found = [each for each in connections if each.topic == topic and each.direction == "o"]
            stats = [[each.number, each.payload, each.messages, each.connected] for each in found]
            rows.append([topic, sum(each.payload for each in found), stats])
        return rows

    def _subscribed(self, connections: list[BusConnection]) -> list[object]:
        rows: list[object] = []
        for topic in self.subscriptions:
            found = [each for each in connections if each.topic == topic and each.direction == "i"]
            rows.append([topic, [[each.number, each.payload, each.messages, -1, each.connected] for each in found]])
        return rows

    def request_topic(self, _caller: str, topic: str, protocols: list[Value]) -> object:
        """Return where a subscriber is to connect."""
        name = join("/", topic)
        if not protocols:
            return [_ERROR, "ERROR: parameter [protocols] must be specified and non-empty", []]
        port = self._owner.slaves.tcpros_port(self.name, name)
        if port is None:
            return [_ERROR, f"Not a publisher of [{name}]", []]
        if not any(isinstance(each, list) and each[:1] == [TCPROS] for each in protocols):
            return [_FAILURE, "no supported protocol implementations", []]
        host = self._owner.host
        return [_OK, f"ready on {host}:{port}", [TCPROS, host, port]]

    def publisher_update(self, _caller: str, topic: str, publishers: list[Value]) -> object:
        name = join("/", topic)
        if name in self.subscriptions:
            self._owner.publishers_updated(self.name, name, [each for each in publishers if isinstance(each, str)])
        return [_OK, "", 0]

    def param_update(self, _caller: str, key: str, value: Value) -> object:
        known = self._owner.parameter_updated(self.name, join("/", key), value)
        return [_OK, "", 0] if known else [_ERROR, "not subscribed", 0]

    def shutdown(self, caller: str, reason: str = "") -> object:
        self._owner.shutdown_asked(self.name, caller, reason[:_TEXT_MAX])
        return [_OK, "shutdown", 0]


class _Method(NamedTuple):
    """A call: what answers it, the types of its arguments after the caller's name, and its value if they are wrong."""

    answer: Callable[..., object]
    arguments: tuple[tuple[str, type], ...] = ()
    failed: object = -1
    optional: int = 0
    """How many of the last arguments may be left out."""


_METHODS: Final = {
    "getPid": _Method(SlaveNode.get_pid),
    "getName": _Method(SlaveNode.get_name),
    "getUri": _Method(SlaveNode.get_uri),
    "getMasterUri": _Method(SlaveNode.get_master_uri),
    "getPublications": _Method(SlaveNode.get_publications),
    "getSubscriptions": _Method(SlaveNode.get_subscriptions),
    "getBusInfo": _Method(SlaveNode.get_bus_info),
    "getBusStats": _Method(SlaveNode.get_bus_stats),
    "requestTopic": _Method(SlaveNode.request_topic, (("topic", str), ("protocols", list)), []),
    "publisherUpdate": _Method(SlaveNode.publisher_update, (("topic", str), ("publishers", list))),
    "paramUpdate": _Method(SlaveNode.param_update, (("parameter_key", str), ("parameter_value", object))),
    "shutdown": _Method(SlaveNode.shutdown, (("msg", str),), optional=1),
}


def _problem(method: _Method, arguments: list[Value]) -> str:
    """Return the fault in the arguments of a call, in rospy's words; empty for valid ones."""
    if not arguments:
        return "missing required caller_id parameter"
    caller, *others = arguments
    if not isinstance(caller, str):
        return "caller_id must be a string"
    if not len(method.arguments) - method.optional <= len(others) <= len(method.arguments):
        return "Error: bad call arity"
    for (name, kind), value in zip(method.arguments, others, strict=False):
        if kind is str and not (isinstance(value, str) and (value or method.optional)):
            return f"ERROR: parameter [{name}] must be a non-empty string"
        if not isinstance(value, kind):
            return f"ERROR: param [{name}] must be a list"
    return ""


# What a subscriber calls


async def request_topic(client: XmlRpcClient, uri: str, node: str, topic: str, timeout: float) -> tuple[str, int]:
    """Ask a publisher (its slave URI) for the TCPROS address of a topic, as `node`.

    Raises XmlRpcError with a text for users if it refuses, OSError, and TimeoutError after `timeout` seconds.
    """
    answer = await client.call(uri, "requestTopic", node, topic, [[TCPROS]], timeout=timeout)
    try:
        value = value_of("requestTopic", answer)
    except MasterError as error:
        raise XmlRpcError(f"the publisher of {topic} at {uri} refuses the connection: {error}") from None
    match value:
        case ["TCPROS", str(host), int(port), *_] if is_host(host) and 0 < port < 65536:
            return host, port
    raise XmlRpcError(f"the publisher of {topic} at {uri} does not say where to connect: {value!r:.200}")
