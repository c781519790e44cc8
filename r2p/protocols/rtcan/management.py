"""What the management messages of RTCAN mean for this node, and what it answers as the master (PROTOCOL.md 9)."""

from collections.abc import Callable
from typing import Any

from r2p.codecs import management, rtcan
from r2p.protocols.rtcan.leases import SlotGrants, SlotRequests
from r2p.protocols.rtcan.master import Election, Role
from r2p.protocols.rtcan.network import NetworkMembership
from r2p.protocols.rtcan.node_id import Identity
from r2p.protocols.rtcan.plan import PeriodicMessage


class ManagementHandlers:
    """The handlers of one node. `say(now, message)` sends; `tick(now, periodic)` goes on without slots."""

    def __init__(
        self,
        identity: Identity,
        election: Election,
        grants: SlotGrants,
        wishes: SlotRequests,
        network: NetworkMembership,
        periodics: dict[int, PeriodicMessage],
        say: Callable[[int, management.Management], None],
        tick: Callable[[int, PeriodicMessage], None],
    ) -> None:
        self._identity = identity
        self._election = election
        self._grants = grants
        self._wishes = wishes
        self._network = network
        self._periodics = periodics
        self._say = say
        self._tick = tick
        self._handlers: dict[type, Callable[[int, Any, int], None]] = {
            management.Network: self._told,
            management.Claim: self._claimed,
            management.Reserve: self._wanted,
            management.Grant: self._granted,
            management.Refuse: self._refused,
            management.Release: self._released,
            management.Renew: self._renew,
            management.Renewed: self._renewed,
        }

    def take(self, now: int, message: management.Management, source: int) -> bool:
        """A message of the node with the id8 `source`; False if it is none of the bus's own."""
        handler = self._handlers.get(type(message))
        if handler is not None:
            handler(now, message, source)
        return handler is not None

    def ask(self, now: int, wanted: management.Reserve | management.Renew) -> None:
        """Ask the master for slots, which may be this node."""
        if self._election.role is not Role.MASTER:
            self._say(now, wanted)
            return
        id8 = self._identity.id8
        answer = self._answer(now, wanted, id8)
        if answer is not None:
            self._handlers[type(answer)](now, answer, id8)

    def _answer(
        self, now: int, wanted: management.Reserve | management.Renew, id8: int
    ) -> management.Grant | management.Refuse | management.Renewed | None:
        if isinstance(wanted, management.Renew):
            return self._grants.renew(now, wanted, id8)
        return self._grants.answer(now, wanted, self._network.epoch or 0)

    def _own(self, message: int) -> PeriodicMessage | None:
        """Our periodic message with this id."""
        periodic = self._periodics.get(rtcan.high_byte(message))
        return periodic if periodic is not None and periodic.message == message else None

    def _told(self, now: int, message: management.Network, source: int) -> None:
        if message.id8 == source:
            self._network.network(now, message)

    def _claimed(self, now: int, message: management.Claim, source: int) -> None:
        self._identity.claimed(now, message)
        self._network.claim(now, message)

    def _wanted(self, now: int, message: management.Reserve, source: int) -> None:
        if self._election.role is Role.MASTER and rtcan.id8_of(message.message) == source:
            answer = self._answer(now, message, source)
            if answer is not None:
                self._say(now, answer)

    def _renew(self, now: int, message: management.Renew, source: int) -> None:
        if self._election.role is Role.MASTER:
            self._say(now, self._grants.renew(now, message, source))

    def _renewed(self, now: int, message: management.Renewed, source: int) -> None:
        if message.id8 == self._identity.id8 and source == self._network.master:
            self._wishes.renewed(now, message)

    def _granted(self, now: int, message: management.Grant, source: int) -> None:
        periodic = self._own(message.message)
        if periodic is not None and source == self._network.master and message.epoch == self._network.epoch:
            self._wishes.granted(now, periodic, message)

    def _refused(self, now: int, message: management.Refuse, source: int) -> None:
        periodic = self._own(message.message)
        if periodic is not None and source == self._network.master:
            self._wishes.refused(now, periodic, message)
            self._tick(now, periodic)

    def _released(self, now: int, message: management.Release, source: int) -> None:
        if self._election.role is Role.MASTER and rtcan.id8_of(message.message) == source:
            self._grants.remove(message.message)
