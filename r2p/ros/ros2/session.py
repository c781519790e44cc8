"""The zenoh session of a ROS 2 link, as its publishers, subscribers and servers share it."""

import asyncio
import itertools
from collections.abc import Callable
from typing import Any

from r2p.clock import Clock
from r2p.ros.middleware import MiddlewareUser, Qos
from r2p.ros.ros2.graph import TokenGraph
from r2p.ros.ros2.keys import EntityKind, RmwToken, encode_token
from r2p.transports.stats import LoggedCounter
from r2p.transports.zenoh.session import LoopQueue, ZenohSession
from r2p.transports.zenoh.threads import OutboundThread

_QUEUE_MAX = 65_536
"""Events that wait for the loop."""

_WAITING_BYTES_MAX = 32 << 20  # bytes of messages that wait for the thread that sends them; more are lost
_WAITING_BYTES_FULL = 8 << 20  # ... from which on publishers wait that can
_WAITING_OVERHEAD = 16 << 10  # bytes that are counted for each of them besides its own: so short ones are limited, too


class RmwSession:
    """A session on one domain. Ids of nodes and endpoints are unique in it."""

    def __init__(
        self, session: ZenohSession, domain: int, user: MiddlewareUser, lost: LoggedCounter, clock: Clock
    ) -> None:
        self.zenoh = session
        self.domain = domain
        self.user = user
        self.lost = lost
        self.clock = clock
        self.loop = asyncio.get_running_loop()
        self.zid = str(session.raw.zid())
        self.graph = TokenGraph(self.zid, lost)
        self.paused = False
        """Whether messages of topics are left in zenoh's queues for now."""
        self.waiting_bytes = 0
        """Bytes of messages that wait for the thread of large messages."""
        self.requests = OutboundThread(self.loop, lost.internal_error)
        """The thread that sends requests and responses: they wait for room, as in rmw_zenoh, or routers drop them."""
        self._later: list[Callable[[], object]] = []
        self._ids = itertools.count(1)
        self._nodes: dict[str, int] = {}
        self._own: dict[tuple[EntityKind, str], dict[RmwToken, None]] = {}

    def queue(self, handle: Callable[[Any], None]) -> LoopQueue:
        """Make a queue from zenoh's threads into the loop."""

        def counted(item: Any) -> None:
            if queue.overflowed:
                self.lost["events overflown"] += queue.overflowed
                queue.overflowed = 0
            handle(item)

        queue = LoopQueue(self.loop, counted, self.lost, most=_QUEUE_MAX)
        return queue

    def add_node(self, node: str) -> None:
        """Declare a node."""
        if node not in self._nodes:
            number = self._nodes[node] = next(self._ids)
            self._declare(RmwToken(self.domain, self.zid, number, number, EntityKind.NODE, node))

    def remove_node(self, node: str) -> None:
        """Undeclare a node."""
        number = self._nodes.pop(node, None)
        if number is not None:
            self.undeclare(RmwToken(self.domain, self.zid, number, number, EntityKind.NODE, node))

    def later(self, function: Callable[[], object]) -> None:
        """Call a function at the end of this turn of the loop, at the latest before the session is closed."""
        self._later.append(function)
        if len(self._later) == 1:
            self.loop.call_soon(self._call_later)

    def _call_later(self) -> None:
        functions, self._later = self._later, []
        for each in functions:
            self.lost.guard(each)

    async def close(self) -> None:
        """Send what waits, and close the session."""
        self._call_later()
        await asyncio.to_thread(self.requests.finish)
        await self.zenoh.close()

    def has_node(self, node: str) -> bool:
        """Return whether a node is one of the link's."""
        return node in self._nodes

    def own_endpoints(self, kind: EntityKind, name: str) -> list[RmwToken]:
        """Return the link's endpoints of this kind on a topic, or for a service."""
        return list(self._own.get((kind, name), ()))

    def declare(self, kind: EntityKind, node: str, name: str, type: str, checksum: str, qos: Qos) -> RmwToken:
        """Declare an endpoint of a node; return its token."""
        self.add_node(node)
        number = next(self._ids)
        token = RmwToken(self.domain, self.zid, self._nodes[node], number, kind, node, name, type, checksum, qos)
        self._own.setdefault((kind, name), {})[token] = None
        self._declare(token)
        return token

    def undeclare(self, token: RmwToken) -> None:
        """Undeclare a node or an endpoint."""
        endpoints = self._own.get((token.kind, token.name), {})
        endpoints.pop(token, None)
        if not endpoints:
            self._own.pop((token.kind, token.name), None)
        self.zenoh.undeclare_token(encode_token(token))

    def _declare(self, token: RmwToken) -> None:
        self.zenoh.declare_token(encode_token(token))

    # Large messages

    @property
    def full(self) -> bool:
        """Return whether so much waits for the thread that publishers are to wait, too."""
        return self.waiting_bytes > _WAITING_BYTES_FULL

    def add_waiting(self, size: int) -> bool:
        """Count a message for the thread; return False if it has no room for it."""
        if self.waiting_bytes > _WAITING_BYTES_MAX:
            return False
        self.waiting_bytes += size + _WAITING_OVERHEAD
        return True

    def sent(self, size: int) -> None:
        """Count a message that the thread has sent."""
        was_full = self.full
        self.waiting_bytes -= size + _WAITING_OVERHEAD
        if was_full and not self.full:
            self.user.made_room()
