"""ROS 2 over zenoh: the middleware of a ROS link that speaks as rmw_zenoh does.

What the link declares before there is a session is declared when it opens. zenoh itself reconnects, and then repeats
all declarations.
"""

import asyncio
import functools
import random
from typing import TYPE_CHECKING

from r2p.clock import Backoff, Clock
from r2p.errors import NoServer, TransportError
from r2p.ros.middleware import Middleware, MiddlewareUser, RosEndpoint, RosServer, RosService
from r2p.ros.ros2.keys import TOKENS, RmwToken, is_full_name
from r2p.ros.ros2.matches import RmwMatches
from r2p.ros.ros2.options import Ros2Options, zenoh_config
from r2p.ros.ros2.services import RmwClient, RmwServer
from r2p.ros.ros2.session import RmwSession
from r2p.ros.ros2.topics import RmwPublisher, RmwSubscription
from r2p.runtime.backpressure import LINK_DOWN
from r2p.transports.stats import LoggedCounter
from r2p.transports.zenoh.config import connection_settings
from r2p.transports.zenoh.diagnose import NOT_ADMITTED, NOTHING_LISTENS, diagnose_connection, find_wrong_server
from r2p.transports.zenoh.session import Unreachable, ZenohSession, open_session

if TYPE_CHECKING:
    from collections.abc import Callable

    import zenoh

_BACKOFF_MAX_S = 0.5  # seconds between two attempts to open a session
_ALONE_S = 3.0  # seconds without any ROS node until other domains are looked at
_ALONE_TOOL_S = 0.3  # the same for a tool
_CLIENTS_MAX = 256  # of services; more only while all of them have calls
_DIAGNOSE_EVERY_S = 1.0  # seconds between two checks whether a session that is down should be explained

_START_ROUTER = "start it with `ros2 run rmw_zenoh_cpp rmw_zenohd`; any zenoh 1 router will do"


class Ros2Middleware(Middleware):
    """A connection to ROS 2 by zenoh's router, or directly to other peers."""

    version = 2
    lost: LoggedCounter

    def __init__(self, options: Ros2Options, clock: Clock, random: random.Random, *, observer: bool = False) -> None:
        """`observer`: for a tool, whose user waits."""
        self.lost = LoggedCounter(options.name, clock)
        self._options = options
        self._clock = clock
        self._random = random
        self._alone_after = _ALONE_TOOL_S if observer else _ALONE_S
        self._user: MiddlewareUser | None = None
        self._session: RmwSession | None = None
        self._matches: RmwMatches | None = None
        self._up = False
        self._transports: set[str] = set()
        self._nodes: dict[str, None] = {}
        self._advertised: dict[RosEndpoint, RmwPublisher | None] = {}
        self._publishers: dict[tuple[str, str], RmwPublisher] = {}
        self._subscribed: dict[RosEndpoint, None] = {}
        self._subscriptions: dict[tuple[str, str, str], RmwSubscription] = {}
        self._served: dict[RosServer, RmwServer | None] = {}
        self._clients: dict[tuple[str, str, RosService], RmwClient] = {}

    # Connection

    async def run(self, user: MiddlewareUser, opened: "Callable[[], object]") -> None:
        self._user = user
        config = zenoh_config(self._options)
        session = await self._open(config, user, opened)
        try:
            self._start(session, user)
            opened()
            await self._explain(config, user)
        finally:
            await asyncio.shield(self._close(session))

    async def _open(self, config: "zenoh.Config", user: MiddlewareUser, opened: "Callable[[], object]") -> ZenohSession:
        backoff = Backoff(self._random, longest=_BACKOFF_MAX_S)
        settings = connection_settings(config)
        while True:
            reason = await find_wrong_server(settings)
            try:
                if not reason:
                    return await open_session(config, self.lost.internal_error)
            except TransportError as error:
                raise self._options.error(str(error)) from error
            except Unreachable:
                reason = await self._diagnose(config)
            opened()
            user.middleware_waits(reason)
            await asyncio.sleep(backoff.delay())

    async def _diagnose(self, config: "zenoh.Config") -> str:
        reason = await diagnose_connection(connection_settings(config))
        return f"{reason} ({_START_ROUTER})" if NOTHING_LISTENS in reason else reason

    async def _explain(self, config: "zenoh.Config", user: MiddlewareUser) -> None:
        """Report the reason whenever the session is down, and once where ROS nodes are if there are none here."""
        assert self._matches is not None
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(self._matches.look_for_other_domains(self._alone_after))
            reason = ""
            while True:
                await asyncio.sleep(_DIAGNOSE_EVERY_S)
                if self._is_up():
                    continue
                before, reason = reason, await self._diagnose(config)
                if NOT_ADMITTED in reason and reason != before:
                    continue  # zenoh may be about to try again
                if not self._is_up():
                    user.middleware_waits(reason)

    def _start(self, zenoh_session: ZenohSession, user: MiddlewareUser) -> None:
        session = self._session = RmwSession(zenoh_session, self._options.domain, user, self.lost, self._clock)
        matches = self._matches = RmwMatches(session, self._reaches, self._client_gone)
        for node in self._nodes:
            session.add_node(node)
        for endpoint in self._advertised:
            self._open_publisher(session, endpoint)
        for endpoint in self._subscribed:
            self._open_subscription(session, endpoint)
        for server in self._served:
            self._served[server] = RmwServer(session, server)
        if self._options.zenoh.mode == "peer":  # other peers may connect to it: it is up even alone
            self._on_up()
        zenoh_session.watch_transports(session.queue(self._on_transport))
        zenoh_session.watch_tokens(f"{TOKENS}/{session.domain}", session.queue(matches.on_token))

    async def _close(self, zenoh_session: ZenohSession) -> None:
        """Undeclare everything, so that no other node sees it any longer, and close the session."""
        session, self._session = self._session, None
        if self._matches is not None:
            self._matches.on_down()
        if session is None:
            await zenoh_session.close()
            return
        opened = self._advertised, self._subscriptions, self._served, self._clients
        for each in [each for table in opened for each in table.values() if each is not None]:
            self.lost.guard(each.close)
        self._advertised = dict.fromkeys(self._advertised)
        self._served = dict.fromkeys(self._served)
        for table in (self._publishers, self._subscriptions, self._clients):
            table.clear()
        for node in self._nodes:
            session.remove_node(node)
        await session.close()

    def _on_transport(self, change: tuple[str, bool, bool]) -> None:
        other, opened, _ = change
        if opened:
            self._transports.add(other)
            self._on_up()
            return
        self._transports.discard(other)
        if not self._transports and self._options.zenoh.mode != "peer":
            self._on_down("the connection is lost")

    def _is_up(self) -> bool:
        return self._up

    def _on_up(self) -> None:
        if not self._up and self._user is not None and self._matches is not None:
            self._up = True
            self._user.middleware_up()
            self._matches.on_up()

    def _on_down(self, reason: str) -> None:
        if self._up and self._user is not None and self._matches is not None:
            self._up = False
            self._matches.on_down()
            self._user.middleware_down(reason)

    # Nodes

    def add_node(self, node: str) -> None:
        self._nodes[node] = None
        if self._session is not None:
            self._session.add_node(node)

    def remove_node(self, node: str) -> None:
        self._nodes.pop(node, None)
        for endpoint in [each for each in self._advertised if each.node == node]:
            self.withdraw(endpoint)
        for endpoint in [each for each in self._subscribed if each.node == node]:
            self.unsubscribe(endpoint)
        for server in [each for each in self._served if each.node == node]:
            self.unserve(server)
        for key in [key for key in self._clients if key[0] == node]:
            self._clients.pop(key).close()
        if self._session is not None:
            self._session.remove_node(node)

    def _is_valid(self, name: str) -> bool:
        """Return whether ROS has such names; one that it has not is reported."""
        if is_full_name(name):
            return True
        self.lost["not a name in ROS"] += 1
        if self._user is not None:
            text = f"{name} is not on ROS 2: each part of a name there begins with a letter or an underscore"
            self._user.notice(f"name {name}", text, trouble=True)
        return False

    # Topics

    def advertise(self, endpoint: RosEndpoint) -> None:
        if not self._is_valid(endpoint.topic):
            return
        self._advertised[endpoint] = None
        if self._session is not None:
            self._open_publisher(self._session, endpoint)

    def _open_publisher(self, session: RmwSession, endpoint: RosEndpoint) -> None:
        publisher = RmwPublisher(session, endpoint)
        self._advertised[endpoint] = self._publishers[endpoint.node, endpoint.topic] = publisher
        self._added(publisher.token)

    def withdraw(self, endpoint: RosEndpoint) -> None:
        publisher = self._advertised.pop(endpoint, None)
        if publisher is None:
            return
        publisher.close()
        index = endpoint.node, endpoint.topic
        if self._publishers.get(index) is publisher:
            del self._publishers[index]
        self._removed(publisher.token)

    def publish(self, node: str, topic: str, data: bytes, stamp: int) -> None:
        publisher = self._publishers.get((node, topic))
        if publisher is None:
            self.lost[LINK_DOWN if self._session is None else "not advertised"] += 1
        else:
            publisher.publish(data, stamp)

    @property
    def full(self) -> bool:
        return self._session is not None and self._session.full

    def subscribe(self, endpoint: RosEndpoint) -> None:
        if not self._is_valid(endpoint.topic):
            return
        self._subscribed[endpoint] = None
        if self._session is not None:
            self._open_subscription(self._session, endpoint)

    def _open_subscription(self, session: RmwSession, endpoint: RosEndpoint) -> None:
        index = _index(endpoint)
        if index not in self._subscriptions:
            self._subscriptions[index] = RmwSubscription(session, endpoint)
        self._added(self._subscriptions[index].add(endpoint))

    def unsubscribe(self, endpoint: RosEndpoint) -> None:
        self._subscribed.pop(endpoint, None)
        subscription = self._subscriptions.get(_index(endpoint))
        if subscription is not None and self._session is not None:
            subscription.remove(endpoint)
            self._session.later(functools.partial(self._close_unused, subscription, _index(endpoint)))

    def _close_unused(self, subscription: RmwSubscription, index: tuple[str, str, str]) -> None:
        """Close a subscription unless another subscriber has joined it meanwhile, as at a change of QoS."""
        if not subscription.tokens and self._subscriptions.get(index) is subscription:
            del self._subscriptions[index]
            subscription.close()

    def pause(self) -> None:
        if self._session is not None:
            self._session.paused = True

    def resume(self) -> None:
        if self._session is not None:
            self._session.paused = False
            for subscription in list(self._subscriptions.values()):
                subscription.resume()

    def _added(self, token: RmwToken) -> None:
        if self._matches is not None:
            self._matches.own_added(token)

    def _removed(self, token: RmwToken) -> None:
        if self._matches is not None:
            self._matches.own_removed(token)

    def _reaches(self, topic: str) -> bool:
        publishers = [each for (_, name), each in self._publishers.items() if name == topic]
        return all(each.reaches_subscriber for each in publishers)

    # Services

    def serve(self, server: RosServer) -> None:
        if not self._is_valid(server.service):
            return
        self._served[server] = None if self._session is None else RmwServer(self._session, server)
        if (opened := self._served[server]) is not None:
            self._added(opened.token)

    def unserve(self, server: RosServer) -> None:
        opened = self._served.pop(server, None)
        if opened is not None:
            opened.close()

    async def call(self, node: str, service: str, type: RosService, request: bytes, timeout: float) -> bytes:
        session = self._session
        if session is None or not self._up:
            raise NoServer(f"{service}: {self._options.name} is not connected to zenoh's router")
        client = self._clients.pop((node, service, type), None)
        if client is None:
            self._close_idle_clients()
            client = RmwClient(session, node, service, type)
            self._added(client.token)
        self._clients[node, service, type] = client  # the last to be closed for want of room
        return await client.call(request, timeout)

    def _close_idle_clients(self) -> None:
        """Make room for one more client: each service of each node that ever came may have been called once."""
        idle = [key for key, client in self._clients.items() if client.is_idle]
        for key in idle[: max(0, len(self._clients) - _CLIENTS_MAX + 1)]:
            self._clients.pop(key).close()

    def _client_gone(self, gid: bytes) -> None:
        for server in self._served.values():
            if server is not None:
                server.cancel(gid)


def _index(endpoint: RosEndpoint) -> tuple[str, str, str]:
    return endpoint.topic, endpoint.type.name, endpoint.type.checksum
