"""Management messages of one node, out and in (PROTOCOL.md 9).

`ManagementSender` queues them; among firmware of 2014, where all modules share one message id, they wait in a
`RateLimiter` until the bus is quiet. `ManagementHandlers` acts on those of the RTCAN bus itself, and answers requests
for slots while this node is the master. All others are for discovery, and leave the engine as `Received`.
"""

from collections import Counter, deque
from collections.abc import Callable, Hashable
from typing import Any

from r2p.codecs import management, rtcan
from r2p.protocols.rtcan.context import EngineContext
from r2p.protocols.rtcan.events import Fate, Profile
from r2p.protocols.rtcan.leases import SlotGrants, SlotRequests
from r2p.protocols.rtcan.master import Role
from r2p.protocols.rtcan.network import Detector, NetworkMembership
from r2p.protocols.rtcan.node_id import NodeId
from r2p.protocols.rtcan.plan import PeriodicMessage
from r2p.protocols.rtcan.queue import QueuedMessage
from r2p.protocols.rtcan.transmitter import SlotTransmitter
from r2p.units import LONG_AGO, MILLISECOND, NEVER

# Deadlines, in ns.
_DEADLINE = 50_000_000
_CONTROL = 10_000_000  # of what keeps the network: slots must not wait for all that discovery has to say
_URGENT = MILLISECOND

QUIET = 33_000_000
"""Among firmware: ns without management on the bus before any is sent."""
_SPREAD = 20_000_000  # ns; on one message id two nodes must not start at the same time
_MAX = 64  # messages that wait for silence


class RateLimiter:
    """Management messages that wait for silence. `draw(n)` gives a random number below n."""

    def __init__(self, draw: Callable[[int], int], counts: Counter[str]) -> None:
        self.waiting: deque[tuple[bytes, Hashable]] = deque()
        """Messages and their handles, the next one first."""
        self._draw = draw
        self._counts = counts
        self._urgent = 0  # so many of them are urgent: the first ones
        self._quiet_from = LONG_AGO
        self._delay: int | None = None  # drawn when it is needed: most networks are not of firmware

    def put(self, data: bytes, *, urgent: bool = False, handle: Hashable = None) -> Hashable:
        """Send it when it is quiet, `urgent` ones first, in order.

        The oldest that is not urgent is dropped when there are too many: its handle comes back.
        """
        dropped: Hashable = None
        if len(self.waiting) >= _MAX:
            self._counts["management dropped"] += 1
            if self._urgent == len(self.waiting):
                return handle
            _, dropped = self.waiting[self._urgent]
            del self.waiting[self._urgent]
        if urgent:
            self.waiting.insert(self._urgent, (data, handle))
            self._urgent += 1
        else:
            self.waiting.append((data, handle))
        return dropped

    def on_traffic(self, now: int) -> None:
        """A management frame was sent, by any node."""
        self._quiet_from = now
        self._delay = None

    @property
    def due(self) -> int:
        """When the next one may go."""
        if not self.waiting:
            return NEVER
        if self._delay is None:
            self._delay = self._draw(_SPREAD)
        return self._quiet_from + QUIET + self._delay

    def pop(self, now: int) -> tuple[bytes, Hashable] | None:
        """The message that may go now, and its handle."""
        if self.due > now:
            return None
        self.on_traffic(now)
        self._urgent = max(0, self._urgent - 1)
        return self.waiting.popleft()

    def clear(self) -> list[Hashable]:
        """Drop all; their handles come back."""
        handles = [handle for _, handle in self.waiting]
        self.waiting.clear()
        self._urgent = 0
        return handles


class ManagementSender:
    """Sends the management messages of this node."""

    def __init__(
        self, context: EngineContext, node_id: NodeId, detector: Detector, transmitter: SlotTransmitter
    ) -> None:
        self.limiter = RateLimiter(context.draw, context.counts)
        self._context = context
        self._node_id = node_id
        self._detector = detector
        self._transmitter = transmitter

    def send(self, now: int, message: management.Management) -> None:
        """Send a message of the engine itself."""
        data = management.encode(message)
        if self._detector.profile is Profile.FIRMWARE:
            self.send_bytes(now, data)
        else:
            self._enqueue(now, self._message_id(), data, None, _CONTROL)

    def send_bytes(self, now: int, data: bytes, *, urgent: bool = False, handle: Hashable = None) -> None:
        """Send a message; before the others, if it is urgent."""
        if self._detector.profile is not Profile.FIRMWARE:
            self._enqueue(now, self._message_id(), data, handle, _URGENT if urgent else _DEADLINE)
            return
        dropped = self.limiter.put(data, urgent=urgent, handle=handle)
        self._context.report(dropped, Fate.FULL, missed=False, at=now)

    def poll(self, now: int) -> None:
        """Among firmware: send the next message if the bus is quiet."""
        due = self.limiter.pop(now)
        if due is not None:
            self._enqueue(now, rtcan.FIRMWARE_MANAGEMENT, *due, _DEADLINE)

    def _message_id(self) -> int:
        return rtcan.message_id(rtcan.MANAGEMENT, self._node_id.id8)

    def _enqueue(self, now: int, message: int, data: bytes, handle: Hashable, within: int) -> None:
        outgoing = QueuedMessage(message, data, now + within, drop=False, handle=handle)
        if self._transmitter.queue.put(outgoing, urgent=within < _DEADLINE, management=True):
            self._transmitter.reschedule(now)
        else:
            self._context.counts["management dropped"] += 1
            self._context.report(handle, Fate.FULL, missed=False, at=now)


class ManagementHandlers:
    """A handler for each management message of the RTCAN bus itself.

    `send(now, message)` sends management; `start_ticking(now, periodic)` lets a message go on without slots.
    """

    def __init__(
        self,
        network: NetworkMembership,
        grants: SlotGrants,
        requests: SlotRequests,
        send: Callable[[int, management.Management], None],
        start_ticking: Callable[[int, PeriodicMessage], None],
    ) -> None:
        self._network = network
        self._grants = grants
        self._requests = requests
        self._send = send
        self._start_ticking = start_ticking
        self._handlers: dict[type, Callable[[int, Any, int], None]] = {
            management.Network: self._on_network,
            management.Claim: self._on_claim,
            management.Reserve: self._on_reserve,
            management.Grant: self._on_grant,
            management.Refuse: self._on_refuse,
            management.Release: self._on_release,
            management.Renew: self._on_renew,
            management.Renewed: self._on_renewed,
        }

    def handle(self, now: int, message: management.Management, source: int) -> bool:
        """Act on a message of the node with the id8 `source`. Says whether there is a handler for it."""
        handler = self._handlers.get(type(message))
        if handler is not None:
            handler(now, message, source)
        return handler is not None

    def ask(self, now: int, wanted: management.Reserve | management.Renew) -> None:
        """Ask the master for slots, which may be this node."""
        if not self._is_master:
            self._send(now, wanted)
            return
        id8 = self._network.node_id.id8
        # Its own answer never goes over the bus: handle it as if it had.
        answer = self._answer(now, wanted, id8)
        if answer is not None:
            self._handlers[type(answer)](now, answer, id8)

    @property
    def _is_master(self) -> bool:
        return self._network.election.role is Role.MASTER

    def _answer(
        self, now: int, wanted: management.Reserve | management.Renew, id8: int
    ) -> management.Grant | management.Refuse | management.Renewed | None:
        if isinstance(wanted, management.Renew):
            return self._grants.renew(now, wanted, id8)
        return self._grants.answer(now, wanted, self._network.epoch or 0)

    # Only the owner of a message id may speak of it, and only the master that this node follows may answer.

    def _on_network(self, now: int, message: management.Network, source: int) -> None:
        if message.id8 == source:
            self._network.on_network(now, message)

    def _on_claim(self, now: int, message: management.Claim, source: int) -> None:
        self._network.node_id.on_claim(now, message)
        self._network.on_claim(now, message)

    def _on_reserve(self, now: int, message: management.Reserve, source: int) -> None:
        if self._is_master and rtcan.id8_of(message.message) == source:
            answer = self._answer(now, message, source)
            if answer is not None:
                self._send(now, answer)

    def _on_renew(self, now: int, message: management.Renew, source: int) -> None:
        if self._is_master:
            self._send(now, self._grants.renew(now, message, source))

    def _on_renewed(self, now: int, message: management.Renewed, source: int) -> None:
        if message.id8 == self._network.node_id.id8 and source == self._network.master:
            self._requests.on_renewed(now, message)

    def _on_grant(self, now: int, message: management.Grant, source: int) -> None:
        periodic = self._requests.periodic_with(message.message)
        if periodic is not None and source == self._network.master and message.epoch == self._network.epoch:
            self._requests.on_grant(now, periodic, message)

    def _on_refuse(self, now: int, message: management.Refuse, source: int) -> None:
        periodic = self._requests.periodic_with(message.message)
        if periodic is not None and source == self._network.master:
            self._requests.on_refuse(now, periodic, message)
            self._start_ticking(now, periodic)

    def _on_release(self, now: int, message: management.Release, source: int) -> None:
        if self._is_master and rtcan.id8_of(message.message) == source:
            self._grants.remove(message.message)
