"""Management messages of one node, out and in (PROTOCOL.md 9).

`ManagementSender` queues them; among firmware of 2014, where all modules share one message id, they wait in a
`RateLimiter` until the bus is quiet. `ManagementHandlers` acts on those of the RTCAN bus itself, and answers requests
for slots while this node is the master. All others are for discovery, and leave the engine as `Received`.
"""

from collections import Counter, deque
from collections.abc import Callable, Hashable

from r2p.codecs import management, rtcan
from r2p.codecs.management import ManagementType, type_of
from r2p.codecs.rtcan import SRT_MIN
from r2p.protocols.rtcan.events import EngineContext, Fate, Profile
from r2p.protocols.rtcan.leases import SlotGrants, SlotRequests
from r2p.protocols.rtcan.master import Role
from r2p.protocols.rtcan.network import Detector, NetworkMembership
from r2p.protocols.rtcan.node_id import NodeId
from r2p.protocols.rtcan.queue import DISCOVERY, PRESENCE, REQUEST, QueuedMessage
from r2p.protocols.rtcan.transmitter import SlotTransmitter
from r2p.units import LONG_AGO, MILLISECOND, NEVER

# Deadlines, in ns.
DEADLINE = 50_000_000
CONTROL_DEADLINE = 10_000_000  # of what keeps the network: slots must not wait for all that discovery has to say
_URGENT = MILLISECOND

QUIET = 33_000_000
"""Among firmware: ns without management on the bus before any is sent."""
_SPREAD = 20_000_000  # ns; on one message id two nodes must not start at the same time
_MAX = 64  # messages that wait for silence
_PRESENCES = (ManagementType.ALIVE, ManagementType.HELLO, ManagementType.NAME)


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
        """Queue a message to be sent when it is quiet, `urgent` ones first, in order.

        If there are too many, drop the oldest one that is not urgent, and return its handle.
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
        """Wait for silence again: a node has sent a management frame."""
        self._quiet_from = now
        self._delay = None

    @property
    def due(self) -> int:
        """Return when the next message may go."""
        if not self.waiting:
            return NEVER
        if self._delay is None:
            self._delay = self._draw(_SPREAD)
        return self._quiet_from + QUIET + self._delay

    def pop(self, now: int) -> tuple[bytes, Hashable] | None:
        """Pop the message that may go now, with its handle."""
        if self.due > now:
            return None
        self.on_traffic(now)
        self._urgent = max(0, self._urgent - 1)
        return self.waiting.popleft()

    def clear(self) -> list[Hashable]:
        """Drop all; return their handles."""
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
        """Send a message of the engine itself, in the place of one about the same that waits and is out of date."""
        data = management.encode(message)
        if self._detector.profile is Profile.FIRMWARE:
            self.send_bytes(now, data)
            return
        subject, queue = _subject(message), self._transmitter.queue
        queue.withdraw(self._message_id(), lambda each: each.subject == subject)
        floor = REQUEST if isinstance(message, management.Reserve) else SRT_MIN
        self._enqueue(now, self._message_id(), rtcan.pack_management(data), None, CONTROL_DEADLINE, floor, subject)

    def send_bytes(self, now: int, data: bytes, *, urgent: bool = False, handle: Hashable = None) -> None:
        """Send a message; before the others, if it is urgent. One that waits already is not sent twice."""
        if self._detector.profile is not Profile.FIRMWARE:
            message, packed = self._message_id(), rtcan.pack_management(data)
            if urgent or handle is not None or not self._transmitter.queue.repeats(message, packed):
                within, floor = (_URGENT, SRT_MIN) if urgent else (DEADLINE, _floor(data))
                self._enqueue(now, message, packed, handle, within, floor)
            return
        dropped = self.limiter.put(data, urgent=urgent, handle=handle)
        self._context.report(dropped, Fate.FULL, missed=False, at=now)

    def poll(self, now: int) -> None:
        """Among firmware: send the next message if the bus is quiet."""
        due = self.limiter.pop(now)
        if due is not None:
            self._enqueue(now, rtcan.FIRMWARE_MANAGEMENT, *due, DEADLINE)  # no floor: there are no leases of slots

    def _message_id(self) -> int:
        return rtcan.message_id(rtcan.MANAGEMENT, self._node_id.id8)

    def _enqueue(
        self,
        now: int,
        message: int,
        payload: bytes,
        handle: Hashable,
        within: int,
        floor: int = SRT_MIN,
        subject: Hashable = None,
    ) -> None:
        marked, deadline = len(payload) < management.SIZE, now + within
        outgoing = QueuedMessage(
            message, payload, deadline, drop=False, handle=handle, floor=floor, subject=subject, marked=marked
        )
        if self._transmitter.queue.put(outgoing, urgent=floor < DISCOVERY, management=True):
            self._transmitter.reschedule(now)
        else:
            self._context.counts["management dropped"] += 1
            self._context.report(handle, Fate.FULL, missed=False, at=now)


def _floor(data: bytes) -> int:
    """Return the least laxity of a message of discovery. A good-bye stays behind what was said before it."""
    if type_of(data) not in _PRESENCES:
        return DISCOVERY
    message = management.decode(data)
    leaves = isinstance(message, management.Hello) and message.flags & management.HELLO_LEAVING
    return DISCOVERY if leaves else PRESENCE


def _subject(message: management.Management) -> Hashable:
    """Return what a message of the engine is about: a later one about the same makes it needless."""
    match message:
        case management.Reserve(of) | management.Release(of):
            return "wanted", of
        case management.Grant(of) | management.Refuse(of):
            return "answer", of
        case management.Renew(highs=highs):
            return "needed", highs
        case management.Renewed(id8=id8, highs=highs):
            return "renewed", id8, highs
        case _:
            return type(message)


class ManagementHandlers:
    """Acts on the management messages of the RTCAN bus itself. `send(now, message)` sends management."""

    def __init__(
        self,
        network: NetworkMembership,
        grants: SlotGrants,
        requests: SlotRequests,
        send: Callable[[int, management.Management], None],
    ) -> None:
        self._network = network
        self._grants = grants
        self._requests = requests
        self._send = send

    def handle(self, now: int, message: management.Management, source: int) -> None:
        """Act on a message of the node with the id8 `source`.

        Only the owner of a message id may manage it, and only the master that this node follows may answer.
        """
        network = self._network
        match message:
            case management.Network(id8=id8) if id8 == source:
                network.on_network(now, message)
            case management.Claim():
                network.node_id.on_claim(now, message)
                network.on_claim(now, message)
            case management.Reserve() | management.Renew() if self._is_master:
                if (answer := self._answer(now, message, source)) is not None:
                    self._send(now, answer)
            case management.Release(of) if self._is_master and rtcan.id8_of(of) == source:
                self._grants.remove(of)
            case management.Renewed(id8=id8) if id8 == network.node_id.id8 and source == network.master:
                self._requests.on_renewed(now, message)
            case management.Grant() | management.Refuse() if source == network.master:
                self._on_answer(now, message)

    def ask(self, now: int, wanted: management.Reserve | management.Renew) -> None:
        """Request slots from the master, which may be this node."""
        id8 = self._network.node_id.id8
        if not self._is_master:
            self._send(now, wanted)
        elif (answer := self._answer(now, wanted, id8)) is not None:
            self.handle(now, answer, id8)  # its own answer never goes over the bus

    @property
    def _is_master(self) -> bool:
        return self._network.election.role is Role.MASTER

    def _answer(
        self, now: int, wanted: management.Reserve | management.Renew, source: int
    ) -> management.Grant | management.Refuse | management.Renewed | None:
        if isinstance(wanted, management.Renew):
            return self._grants.renew(now, wanted, source)
        if rtcan.id8_of(wanted.message) != source:
            return None
        return self._grants.answer(now, wanted, self._network.epoch or 0)

    def _on_answer(self, now: int, answer: management.Grant | management.Refuse) -> None:
        periodic = self._requests.periodic_with(answer.message)
        if periodic is None:
            return
        if isinstance(answer, management.Refuse):
            self._requests.on_refuse(now, periodic, answer)
        elif answer.epoch == self._network.epoch:
            self._requests.on_grant(now, periodic, answer)
