"""The registrations of this process's ROS nodes with a master that may come and go.

`MasterSession` knows what its nodes have, and what the master knows of that: it registers the difference. It asks the
master once a second for its process and for what is registered. A master that has restarted knows nothing, so that all
is registered again; and connections of topics go on without it.
"""

import asyncio
import contextlib
from collections import Counter
from collections.abc import Callable
from typing import Final, Literal, NamedTuple

from r2p.clock import real_clock
from r2p.errors import Broken, NoServer, TransportError
from r2p.ros.middleware import MiddlewareUser, RosGraph, RosPeerEndpoint, RosPeerServer
from r2p.ros.ros1.environment import RosAddress, reachable_host, uri_of
from r2p.ros.ros1.master import MasterClient, MasterError, SystemState, value_of
from r2p.ros.ros1.slave import SlaveNode, SlaveUser
from r2p.ros.ros1.xmlrpc import XmlRpcClient, XmlRpcError, XmlRpcServer, split_uri
from r2p.ros.ros1.xmlrpc_codec import Value
from r2p.units import SECOND

POLL_S: Final = 1.0
"""Seconds between two polls of what is registered."""

RETRY_S: Final = 0.25
"""Seconds between two attempts to reach a master."""

PUBLISHERS_MAX: Final = 1000
"""Publishers of a topic that are connected to; further ones are counted."""

_SOON_S: Final = 0.05  # seconds from a hint of the master that something has changed to the next poll
_CLOSE_S: Final = 2.0  # seconds for a master to take what is unregistered at the end
_ASK_S: Final = 1.0  # seconds for another node to say who it is

_GONE = (OSError, XmlRpcError)  # what calls of a master raise that can't be reached; a TimeoutError is an OSError

_TAKEN: Final = "new node registered with same name"  # the master's words


OnParameter = Callable[[str, Value], object]
"""Called with a key and its value, None: it is not set. For a namespace the value is a dict, of other keys below it."""


class _MasterEntry(NamedTuple):
    """A registration: `detail` is the type of a topic, or the URI of a service."""

    kind: Literal["publisher", "subscriber", "service", "parameter", "value"]
    node: str
    name: str
    detail: str
    api: str


class MasterSession:
    """Keeps nodes, their topics and services registered, and reports the graph; each node has a slave server.

    Everything can be declared before `run` and while the master is gone. It calls `middleware_up`, `middleware_waits`,
    `graph_changed`, `notice` and `shut_down` of the MiddlewareUser itself.
    """

    def __init__(self, address: RosAddress, slaves: SlaveUser, lost: Counter[str]) -> None:
        self.address = address
        self.slaves = slaves
        self.lost = lost
        self.client = XmlRpcClient()
        """For calls of other nodes: `slave.request_topic`."""
        self.master = MasterClient(self.client, address.master)
        self.host = address.host or "127.0.0.1"
        """The host by which others reach this computer, as far as that is known."""
        self.ends_without_nodes: Callable[[], bool] = lambda: False
        """Returns whether to end, with Broken, when the only node was ended by another one, or by `rosnode kill`."""
        self._broken = ""
        self._user: MiddlewareUser | None = None
        self._nodes: dict[str, SlaveNode] = {}
        self._parameters: dict[str, OnParameter] = {}
        """What is subscribed on the parameter server, by key: a parameter or a namespace."""
        self._held: dict[str, Value] = {}
        """Parameters that are set for as long as the session lasts."""
        self._servers: dict[str, XmlRpcServer] = {}
        self._started: set[XmlRpcServer] = set()
        self._ended: list[XmlRpcServer] = []
        self._registered: dict[_MasterEntry, None] = {}
        self._refused: set[_MasterEntry] = set()
        """Registrations that the master does not want, or has given to another node."""
        self._pid: int | None = None
        self._graph: RosGraph | None = None
        self._trouble = ""
        self._outages = 0
        self._poll_at = 0.0
        self._changed = asyncio.Event()
        self._updated: set[tuple[str, str]] = set()
        """Subscriptions whose publishers the master has reported since they were registered."""
        self._tasks: set[asyncio.Task[None]] = set()
        self._being_checked: set[str] = set()
        """The nodes of which the master is being asked whether another one has taken the name."""

    # What nodes have

    def add_node(self, node: str) -> None:
        """Start the slave server of a node, unless it exists. Raises TransportError without a free port."""
        if node in self._nodes:
            return
        self._nodes[node] = slave = SlaveNode(node, self)
        try:
            self._servers[node] = XmlRpcServer(self.address.bind, slave.handle, self.lost)
        except OSError as error:
            raise TransportError(f"the ROS node {node} can't listen at {self.address.bind}: {error}") from error
        self._touch()

    def remove_node(self, node: str) -> None:
        """Unregister everything that a node still has, and end its slave server."""
        if self._nodes.pop(node, None) is not None:
            self._ended.append(self._servers.pop(node))
            self._touch()

    def advertise(self, node: str, topic: str, type_name: str) -> None:
        """Register a publisher."""
        self._nodes[node].publications[topic] = type_name
        self._touch()

    def withdraw(self, node: str, topic: str) -> None:
        """Unregister a publisher."""
        if node in self._nodes:
            self._nodes[node].publications.pop(topic, None)
            self._touch()

    def subscribe(self, node: str, topic: str, type_name: str) -> None:
        """Register a subscriber (type `*`: any); `SlaveUser.publishers_changed` follows, at once or later."""
        self._nodes[node].subscriptions[topic] = type_name
        self._touch()

    def unsubscribe(self, node: str, topic: str) -> None:
        """Unregister a subscriber."""
        if node in self._nodes:
            self._nodes[node].subscriptions.pop(topic, None)
            self._touch()

    def serve(self, node: str, service: str, port: int) -> None:
        """Register a service that listens at a port of this computer."""
        self._nodes[node].services[service] = port
        self._touch()

    def unserve(self, node: str, service: str) -> None:
        """Unregister a service."""
        if node in self._nodes:
            self._nodes[node].services.pop(service, None)
            self._touch()

    def watch_parameters(self, key: str, on_parameter: OnParameter) -> None:
        """Subscribe to a parameter, or to those in a namespace, as one of the nodes; if that is done already, again.

        It begins with what is set, also after a restart of the master.
        """
        for entry in [each for each in self._registered if each.kind == "parameter" and each.name == key]:
            del self._registered[entry]
        self._parameters[key] = on_parameter
        self._touch()

    def unwatch_parameters(self, key: str) -> None:
        """Unsubscribe from parameters."""
        self._parameters.pop(key, None)
        self._touch()

    def hold_parameter(self, key: str, value: Value) -> None:
        """Set a parameter on the server, also on one that has restarted, and delete it at the end."""
        self._held[key] = value
        self._touch()

    def slave_uri(self, node: str) -> str:
        """Return the URI of a node's slave API."""
        return uri_of("http", self.host, self._servers[node].port)

    @property
    def master_uri(self) -> str:
        """Return the master's URI."""
        return self.address.master

    async def find_service(self, node: str, service: str, timeout: float) -> tuple[str, int]:
        """Return the host and port of a service. Raises NoServer, and TimeoutError if the master does not answer."""
        try:
            async with asyncio.timeout(timeout):
                uri = await self.master.lookup_service(node, service)
            host, port = split_uri(uri, "rosrpc")[1:]
        except MasterError:
            raise NoServer(f"no ROS node serves {service}") from None
        except TimeoutError:
            raise
        except _GONE as error:
            raise NoServer(f"{service} can't be found: {_reason(self.address.master, error)}") from None
        return host, port

    # What runs

    async def run(self, user: MiddlewareUser, opened: Callable[[], object]) -> None:
        """Stay registered until cancelled; then unregister everything, and close the slave servers.

        Raises Broken if the only node was ended, and the session is to end then.
        """
        self._user = user
        opened()
        try:
            while True:
                if self._broken:
                    raise Broken(self._broken)
                try:
                    await self._step()
                    pause = max(0.0, self._poll_at - _now())
                except (MasterError, *_GONE) as error:
                    self._note_gone(error)
                    pause = RETRY_S
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout(pause):
                        await self._changed.wait()
        finally:
            await self._close()

    async def _step(self) -> None:
        self._changed.clear()
        polls = _now() >= self._poll_at
        if polls:
            await self._check_master()
        await self._synchronise()
        self._note_up()
        if polls:
            await self._poll()
            self._poll_at = _now() + POLL_S

    async def _check_master(self) -> None:
        """Find out whether this is the master that was registered with, and the host by which it is reached."""
        pid = await self.master.get_pid(self._name())
        if pid != self._pid:
            self._pid = pid
            self._registered.clear()
            self._refused.clear()
        if not self.address.host:
            self.host = reachable_host(self.client.local_host(self.master.uri))

    async def _synchronise(self) -> None:
        """Register what is missing, after what is too much was unregistered: a node has one URI at a time."""
        for server in {*self._servers.values()} - self._started:
            self._started.add(server)
            await server.start()
        wanted = self._wanted()
        for entry in [each for each in self._registered if each not in wanted]:
            self._registered.pop(entry, None)
            with contextlib.suppress(MasterError):
                await self._unregister(entry)
        self._refused.intersection_update(wanted)
        for entry in wanted:
            if entry not in self._registered and entry not in self._refused:
                await self._register(entry)
        while self._ended:
            server = self._ended.pop()
            self._started.discard(server)
            await server.close()

    def _wanted(self) -> dict[_MasterEntry, None]:
        found = {_MasterEntry("value", "/r2p", key, "", ""): None for key in self._held}
        for name, node in self._nodes.items():
            api = self.slave_uri(name)
            found.update((_MasterEntry("publisher", name, *each, api), None) for each in node.publications.items())
            found.update((_MasterEntry("subscriber", name, *each, api), None) for each in node.subscriptions.items())
            for service, port in node.services.items():
                found[_MasterEntry("service", name, service, uri_of("rosrpc", self.host, port), api)] = None
        for name in [*self._nodes][:1]:
            api = self.slave_uri(name)
            found.update((_MasterEntry("parameter", name, key, "", api), None) for key in self._parameters)
        return found

    async def _register(self, entry: _MasterEntry) -> None:
        kind, node, name, detail, api = entry
        try:
            match kind:
                case "publisher":
                    await self.master.register_publisher(node, name, detail, api)
                case "subscriber":
                    await self._register_subscriber(entry)
                case "service":
                    await self.master.register_service(node, name, detail, api)
                case "parameter":
                    self.parameter_updated(node, name, await self.master.subscribe_param(node, api, name))
                case "value":
                    await self.master.set_param(node, name, self._held[name])
        except MasterError as error:
            self._refused.add(entry)
            self._notice(f"refused {kind} {name}", f"the ROS master refuses the {kind} {name} of {node}: {error}")
        else:
            self._registered[entry] = None

    async def _register_subscriber(self, entry: _MasterEntry) -> None:
        subscription = entry.node, entry.name
        self._updated.discard(subscription)
        uris = await self.master.register_subscriber(entry.node, entry.name, entry.detail, entry.api)
        if subscription not in self._updated:  # else the list is older than what the master has reported meanwhile
            self.publishers_updated(*subscription, uris)

    async def _unregister(self, entry: _MasterEntry) -> None:
        kind, node, name, detail, api = entry
        match kind:
            case "publisher":
                await self.master.unregister_publisher(node, name, api)
            case "subscriber":
                await self.master.unregister_subscriber(node, name, api)
            case "service":
                await self.master.unregister_service(node, name, detail)
            case "parameter":
                await self.master.unsubscribe_param(node, api, name)
            case "value":
                await self.master.delete_param(node, name)

    # What the master knows

    async def _poll(self) -> None:
        before = frozenset(self._nodes)  # one may end meanwhile, and is still in the answer
        state = await self.master.get_system_state(self._name())
        types = await self.master.get_topic_types(self._name())
        for entry in [each for each in self._registered if not _is_known(each, state)]:
            await self._find_lost(entry, state)
        graph = self.slaves.complete_graph(_graph_of(state, types, before | self._nodes.keys()))
        if graph != self._graph and self._user is not None:
            self._graph = graph
            self._user.graph_changed(graph)

    async def _find_lost(self, entry: _MasterEntry, state: SystemState) -> None:
        """Find out why the master has lost a registration; register it again unless another node has taken it."""
        if entry not in self._registered:
            return
        if entry.kind == "service" and (others := state.services.get(entry.name)):
            del self._registered[entry]
            self._refused.add(entry)
            text = (
                f"the service {entry.name} of {entry.node} is now that of {', '.join(others)}, which was started later"
            )
            self._notice(f"taken service {entry.name}", text)
            return
        try:
            uri = await self.master.lookup_node(entry.node, entry.node)
        except MasterError:
            uri = entry.api
        if uri != entry.api:
            await self._end_taken(entry.node, uri)
            return
        lost = [each for each in self._registered if each.node == entry.node]
        self.lost["registrations that the ROS master had lost"] += len(lost)
        for each in lost:
            del self._registered[each]
        self._touch()

    # What others ask of the slaves

    def publishers_updated(self, node: str, topic: str, publishers: list[str]) -> None:
        """Note all publishers of a topic."""
        self._updated.add((node, topic))
        self.poll_soon()
        own = {self.slave_uri(each) for each in self._nodes}
        if node in self._nodes and topic in self._nodes[node].subscriptions:
            others = [uri for uri in dict.fromkeys(publishers) if uri not in own]
            if len(others) > PUBLISHERS_MAX:
                self.lost["publishers over the limit"] += len(others) - PUBLISHERS_MAX
            self.slaves.publishers_changed(node, topic, others[:PUBLISHERS_MAX])

    def parameter_updated(self, node: str, key: str, value: Value) -> bool:
        """Note the value of a parameter; return whether it was subscribed."""
        watching = [call for subscribed, call in self._parameters.items() if _contains(subscribed, key)]
        for on_parameter in watching:
            on_parameter(key, None if value == {} else value)
        return bool(watching)

    def shutdown_asked(self, node: str, caller: str, reason: str) -> None:
        """End a node: its name was taken, or a user wants it."""
        taken = caller == "/master" and _TAKEN in reason
        if taken and (f"[{node}]" not in reason or node in self._being_checked):
            return  # for an earlier process, whose port this node has now; or it is being found out
        if taken:
            self._being_checked.add(node)
        end = self._find_taken(node) if taken else self._end_asked(node, f"{caller} asked for it: {reason}")
        task = asyncio.get_running_loop().create_task(end)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _find_taken(self, node: str) -> None:
        uri = "an unknown place"
        try:
            with contextlib.suppress(MasterError, *_GONE):
                uri = await self.master.lookup_node(node, node)
        finally:
            self._being_checked.discard(node)
        if node in self._nodes and uri != self.slave_uri(node):  # else the master has not said that
            await self._end_taken(node, uri)

    async def _end_taken(self, node: str, uri: str) -> None:
        """End a node without unregistering it: its registrations are those of the other one, or gone."""
        for entry in [each for each in self._registered if each.node == node]:
            del self._registered[entry]
        process = ""
        with contextlib.suppress(MasterError, *_GONE):
            answer = await self.client.call(uri, "getPid", node, timeout=_ASK_S)
            process = f" (process {value_of('getPid', answer)!r:.20})"
        reason = f"another node has taken its name, at {uri}{process}: give one of them another name"
        await self._end_asked(node, reason)

    async def _end_asked(self, node: str, reason: str) -> None:
        if self._nodes.keys() == {node} and self.ends_without_nodes():
            self._broken = f"{node} is no longer a ROS node: {reason}"
            self._touch()
        if node in self._nodes and self._user is not None:
            self.remove_node(node)
            self._user.shut_down(node, reason)

    # Notices for users

    def _note_up(self) -> None:
        if self._user is None:
            return
        if self._trouble and self._outages:
            text = f"the ROS master at {self.address.master} is back: everything is registered again"
            self._user.notice(f"master back {self._outages}", text, trouble=False)
        self._trouble = ""
        self._user.middleware_up()

    def _note_gone(self, error: Exception) -> None:
        """Report once that the master does not answer. Open connections go on without it, so the link stays up."""
        self.client.close()
        self._poll_at = 0.0
        reason = _reason(self.address.master, error)
        if self._user is None or reason == self._trouble:
            return
        if self._pid is None:
            self._user.middleware_waits(reason)
        elif not self._trouble:
            self._outages += 1
            self.lost["ROS master gone"] += 1
            text = f"{reason}; topics that are connected go on, and everything is registered again when it is back"
            self._notice(f"master gone {self._outages}", text)
        self._trouble = reason

    def _notice(self, kind: str, text: str) -> None:
        if self._user is not None:
            self._user.notice(kind, text, trouble=True)

    # The end

    async def _close(self) -> None:
        """Unregister everything, so that peers learn of the end from the master, and close the servers after that."""
        for task in self._tasks:
            task.cancel()
        try:
            with contextlib.suppress(*_GONE):
                async with asyncio.timeout(_CLOSE_S):
                    await self._unregister_all()
        finally:
            self._registered.clear()
            for server in (*self._servers.values(), *self._ended):
                await server.close()
            self.client.close()

    async def _unregister_all(self) -> None:
        if self._trouble:
            return
        for entry in [*self._registered]:
            with contextlib.suppress(MasterError):
                await self._unregister(entry)

    def _name(self) -> str:
        """Return a node as which the master is asked."""
        return next(iter(self._nodes), "/r2p")

    def _touch(self) -> None:
        self._changed.set()

    def poll_soon(self) -> None:
        """Poll what is registered in a moment: something has changed."""
        self._poll_at = min(self._poll_at, _now() + _SOON_S)
        self._touch()


def _now() -> float:
    return real_clock().monotonic() / SECOND


def _contains(subscribed: str, key: str) -> bool:
    return key == subscribed or key.startswith(subscribed.rstrip("/") + "/")


def _reason(uri: str, error: Exception) -> str:
    if isinstance(error, TimeoutError):
        return f"the ROS master at {uri} does not answer"
    if isinstance(error, OSError):
        return (
            f"no ROS master at {uri} ({error.strerror or error}): start roscore, or set ROS_MASTER_URI to another one"
        )
    return f"what answers at {uri} is not a ROS master: {error}"


def _is_known(entry: _MasterEntry, state: SystemState) -> bool:
    """Return whether the master has a registration. It can't be asked for subscriptions of parameters."""
    tables = {"publisher": state.publishers, "subscriber": state.subscribers, "service": state.services}
    table = tables.get(entry.kind)
    return table is None or entry.node in table.get(entry.name, ())


def _graph_of(state: SystemState, types: dict[str, str], own: frozenset[str]) -> RosGraph:
    """Return what the nodes of others have."""

    def pairs(table: dict[str, list[str]]) -> list[tuple[str, str]]:
        return [(node, name) for name, nodes in table.items() for node in nodes if node not in own]

    publishers, subscribers, servers = map(pairs, (state.publishers, state.subscribers, state.services))
    return RosGraph(
        frozenset(node for node, _ in (*publishers, *subscribers, *servers)),
        frozenset(RosPeerEndpoint(node, topic, types.get(topic, "")) for node, topic in publishers),
        frozenset(RosPeerEndpoint(node, topic, types.get(topic, "")) for node, topic in subscribers),
        frozenset(RosPeerServer(node, service) for node, service in servers),
    )
