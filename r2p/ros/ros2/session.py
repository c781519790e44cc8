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

_QUEUE_MAX = 65_536
"""Events that wait for the loop."""


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
        self.zid = str(session.zenoh.zid())
        self.graph = TokenGraph(self.zid, lost)
        self.paused = False
        """Whether messages of topics are left in zenoh's queues for now."""
        self.waiting_bytes = 0
        """Bytes of large messages that wait for the thread that sends them."""
        self._ids = itertools.count(1)
        self._nodes: dict[str, int] = {}
        self._declared: set[str] = set()

    def queue(self, handle: Callable[[Any], None]) -> LoopQueue:
        """Make a queue from zenoh's threads into the loop."""
        return LoopQueue(self.loop, handle, self.lost, most=_QUEUE_MAX)

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

    def declare(self, kind: EntityKind, node: str, name: str, type: str, checksum: str, qos: Qos) -> RmwToken:
        """Declare an endpoint of a node; return its token."""
        self.add_node(node)
        number = next(self._ids)
        token = RmwToken(self.domain, self.zid, self._nodes[node], number, kind, node, name, type, checksum, qos)
        self._declare(token)
        return token

    def undeclare(self, token: RmwToken) -> None:
        """Undeclare an endpoint."""
        key = encode_token(token)
        self._declared.discard(key)
        self.zenoh.undeclare_token(key)

    async def close(self) -> None:
        """Undeclare all tokens, so that no other node sees them any longer, and close the session."""
        for key in self._declared:
            self.zenoh.undeclare_token(key)
        self._declared.clear()
        await self.zenoh.close()

    def _declare(self, token: RmwToken) -> None:
        key = encode_token(token)
        self._declared.add(key)
        self.zenoh.declare_token(key)
