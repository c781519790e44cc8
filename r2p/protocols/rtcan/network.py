"""Finding, following and being the master: what the node knows of its network, and how it may use the bus by that.

    no master --sync heard--> slave --four cycles without sync--> electing --nobody better--> master
                                ^------------------------------------------a better one meets it--'

A slave sends nothing before it knows, from the master's NETWORK, that its parameters are the network's; but when a
cycle that was lost goes on where it should be by now, it is the same network, whoever is the master. A sync off the
grid is not followed while there is one on it. A master that hears a foreign sync says at once who it is; of the two the
lesser one yields when it hears that.
"""

from collections import Counter
from collections.abc import Callable, Iterable

import msgspec

from r2p.codecs import management
from r2p.codecs.rtcan import Frame
from r2p.protocols.rtcan.cycle import HOLDOVER, Alignment, Cycle, State
from r2p.protocols.rtcan.election import Election, Role
from r2p.protocols.rtcan.events import LONG_AGO, Action, LostSync, NewMaster, Silenced, Unsilenced
from r2p.protocols.rtcan.identity import Identity, Stage
from r2p.protocols.rtcan.leases import Grants, Wishes
from r2p.protocols.rtcan.periodic import Periodic
from r2p.protocols.rtcan.sending import Sender
from r2p.protocols.schedule import Timers

REPEAT = 1_000_000_000
"""NETWORK is sent this often (ns)."""
_UNKNOWN_MASTER = 1_200_000_000  # a master that sends no NETWORK for so long is firmware
_FORGOTTEN = 3_000_000_000
_COLLECTING = 3  # cycles
_NEAR = 4  # cycles that a NETWORK may be late, or the last one be a guess


class Network:
    """The network as this node sees it. `say(now, message)` sends management; `priority` is that to be the master."""

    def __init__(
        self,
        cycle: Cycle,
        sender: Sender,
        identity: Identity,
        election: Election,
        grants: Grants,
        wishes: Wishes,
        timers: Timers,
        periodics: dict[int, Periodic],
        out: list[Action],
        counts: Counter[str],
        say: Callable[[int, management.Management], None],
        priority: int,
    ) -> None:
        self.master: int | None = None
        self.epoch: int | None = None
        self.utc_offset = 0
        """UTC less network time (ns), as the master says."""
        self.utc_error = management.NO_UTC
        """How far off that may be (us)."""
        self.verified = False
        """Whether the network's parameters are known to be ours."""
        self.silenced: str | None = None
        self._cycle = cycle
        self._sender = sender
        self._identity = identity
        self._election = election
        self._grants = grants
        self._wishes = wishes
        self._timers = timers
        self._out = out
        self._counts = counts
        self._say = say
        self._priority = priority
        self._periodics = periodics
        self._heard = LONG_AGO
        self._rank = (0, 0)
        self._latest: tuple[int, management.Network] | None = None
        self._first_sync = 0
        self._told = LONG_AGO
        self._collecting = 0

    # What is heard

    def sync(self, now: int, frame: Frame, stamp: int) -> None:
        """A sync frame of another node."""
        if self._election.role is Role.MASTER:
            self._counts["foreign syncs"] += 1
            self._introduce(now)
            return
        self._sender.poll(now)
        match self._cycle.heard(frame, stamp):
            case Alignment.FOREIGN:
                self._counts["foreign syncs"] += 1
            case Alignment.STARTED | Alignment.RESUMED as alignment:
                self._first_sync = now
                self.verified = alignment is Alignment.RESUMED
                self._election.end(Role.SLAVE)
                self._sender.turned(now)
                if self.verified:
                    self._identity.announce(now, again=True)  # its master is asked who it is
                self._recall(now)
            case Alignment.ALIGNED:
                self._sender.turned(now)
            case _:
                self._sender.kick(now)
        if not self.verified:
            self._verify_by_length(now)

    def network(self, now: int, told: management.Network) -> None:
        """A master says who it is and what its network is like."""
        if self._election.role is Role.MASTER:
            if self._election.beats(self._identity.id8, told.priority, told.id8):
                self._introduce(now)
                return
            self._yield(now, told)
        self._latest = now, told
        if self._is_another(now, told):
            self._counts["other masters"] += 1
            return
        self._heard = now
        self._rank = told.priority, told.id8
        timing = self._cycle.timing
        if (told.slots, told.slot) != (timing.slots, timing.slot):
            ours = f"{timing.slots} of {timing.slot // 1000} us"
            self._silence(now, f"the network has {told.slots} slots of {told.slot / 1000:g} us, this node {ours}")
        elif self._cycle.running:
            self._follow(now, told)

    def claim(self, now: int, claim: management.Claim) -> None:
        """A node announced itself."""
        self._election.heard(now, claim.id8, claim.priority)
        if claim.flags & management.CLAIM_ELECTING:
            if self._election.role is Role.MASTER:
                self._introduce(now)
            elif self._election.role is Role.ELECTING:
                self._identity.announce(now)

    # What the time brings

    def owned(self, now: int) -> None:
        """The node may send: look for a master."""
        if not self._cycle.running:
            self._elect(now, forget=False)

    def decide(self, now: int) -> None:
        """The time of the election is over."""
        free = self._identity.stage is Stage.OWNING and not self._cycle.running
        if free and self._election.decide(now, self._identity.id8):
            self._take_over(now)

    def turn(self, now: int) -> None:
        """A cycle is over."""
        if self._cycle.state is State.LEADING:
            if now > self._cycle.reference + (HOLDOVER + 2) * self._cycle.timing.cycle:
                self._abdicate(now, "this node was the master, and slept")
                self._elect(now, forget=True)
                return
            if self._collecting:
                self._collecting -= 1
                self._grants.collecting = self._collecting > 0
            frame = self._cycle.advance(self._grants.calendar.mask(self._cycle.counter + 1))
            self._sender.turned(now)
            self._sender.sync(now, frame)
        elif self._cycle.roll():
            self._counts["missed syncs"] += 1
            self._sender.turned(now)
        else:
            self._lose(now, "no sync for too long")

    def tell(self, now: int) -> None:
        """It is time for NETWORK."""
        if self._election.role is not Role.MASTER or self.epoch is None:
            return
        self._told = now
        self._timers.set("network", now + REPEAT)
        timing, counter = self._cycle.timing, self._cycle.counter & (1 << 64) - 1
        offset, error = self.utc_offset, self.utc_error
        self._say(
            now,
            management.Network(
                self._identity.id8, self._priority, self.epoch, counter, timing.slots, timing.slot, offset, error
            ),
        )

    def unsilence(self, now: int) -> None:
        """Nobody says any more that our parameters are wrong."""
        if self.silenced is None:
            return
        self.silenced = None
        self._out.append(Unsilenced())
        if self._identity.stage is Stage.OWNING and not self._cycle.running:
            self._elect(now, forget=True)

    def resign(self, now: int) -> None:
        """The node may not send for a while: it can't be the master, nor have slots."""
        if self._election.role is Role.MASTER:
            self._abdicate(now, "this node was the master, and may not send")
        self._election.end(Role.SLAVE if self._cycle.running else Role.NONE)
        self._suspend("the node may not send")

    def stop(self) -> None:
        """The bus is gone."""
        self._cycle.stop()
        self._election.end(Role.NONE)
        self._forget_master("the bus is gone")
        self._timers.clear("silence")
        self.silenced = None

    # Inside

    def _is_another(self, now: int, told: management.Network) -> bool:
        """Whether the syncs that we follow are those of another master; one of the two will yield."""
        if not self._cycle.running or self.master is None or now > self._heard + _FORGOTTEN:
            return False
        if (told.id8, told.epoch) == (self.master, self.epoch):
            return False
        same_grid = told.epoch == self.epoch and -_NEAR <= told.cycle - self._cycle.counter <= _NEAR
        return not (same_grid and (told.priority, told.id8) > self._rank)

    def _recall(self, now: int) -> None:
        """A cycle has started: if its count is that of the last NETWORK, it came from its master."""
        if self._latest is None or now > self._latest[0] + _FORGOTTEN:
            return
        at, told = self._latest
        timing = self._cycle.timing
        counter = told.cycle + (now - at) // timing.cycle
        near = (self._cycle.counter - counter + _NEAR) & 0xFF <= 2 * _NEAR
        if near and (told.slots, told.slot) == (timing.slots, timing.slot):
            self._heard = at
            self._follow(now, msgspec.structs.replace(told, cycle=counter))

    def _follow(self, now: int, told: management.Network) -> None:
        """The master of the syncs that we hear: its parameters are ours."""
        renumbered = self._cycle.anchor(told.cycle)
        if told.epoch != self.epoch or renumbered:
            for each in self._periodics.values():
                self._wishes.lapse(each, "another network")
        self.utc_offset, self.utc_error = told.utc_offset, told.utc_error
        self._timers.clear("silence")
        self.unsilence(now)
        news = (told.id8, told.epoch) != (self.master, self.epoch)
        self.master, self.epoch = told.id8, told.epoch
        self.verified = True
        if news or not self._wishes.open:
            self._suspend("another master")
            self._wishes.open = True
            self._out.append(NewMaster(told.id8, told.epoch, own=False))
            self._renew(now, self._periodics.values())

    def _verify_by_length(self, now: int) -> None:
        """A master that sends no NETWORK: believe it when its cycle is as long as ours."""
        measured = self._cycle.measured()
        if now < self._first_sync + _UNKNOWN_MASTER or measured is None:
            return
        timing = self._cycle.timing
        if abs(measured - timing.cycle) <= timing.cycle // 1000:
            self.verified = True
            self._out.append(NewMaster(None, 0, own=False))
        else:
            self._silence(now, f"a cycle takes {measured // 1000} us, this node's {timing.cycle // 1000} us")

    def _silence(self, now: int, reason: str) -> None:
        self._timers.set("silence", now + _FORGOTTEN)
        if self.silenced is None:
            self.silenced = reason
            self.verified = False
            self._suspend("the network has other parameters")
            self._out.append(Silenced(reason))

    def _elect(self, now: int, *, forget: bool) -> None:
        self._election.begin(now, forget=forget)
        self._identity.announce(now, again=True)

    def _lose(self, now: int, reason: str) -> None:
        """There is no cycle any more."""
        if self._latest is not None and self._latest[1].id8 == self.master:
            self._latest = None
        self._forget_master(reason)
        self._out.append(LostSync(reason))
        if self._identity.stage is Stage.OWNING:
            self._elect(now, forget=True)
        else:
            self._election.end(Role.NONE)

    def _take_over(self, now: int) -> None:
        """Be the master. Of a network that was there before, keep the epoch, and give its owners their slots again."""
        inherited = self.epoch is not None and self._cycle.anchored
        if not inherited:
            self._cycle.anchored = False
            self.epoch = self._identity.draw(0xFFFFFFFF) + 1
        assert self.epoch is not None
        self._election.end(Role.MASTER)
        self._cycle.lead(now)
        self.master = self._identity.id8
        self.verified = True
        self._grants.clear()
        self._collecting = _COLLECTING if inherited else 0
        self._grants.collecting = inherited
        self._wishes.open = True
        self._out.append(NewMaster(self.master, self.epoch, own=True))
        self._sender.turned(now)
        self._timers.set("network", now)
        self._renew(now, self._periodics.values())

    def _yield(self, now: int, told: management.Network) -> None:
        """A better master is there: its next sync will be followed."""
        self._election.heard(now, told.id8, told.priority)
        self._abdicate(now, "a better master is there")
        self._election.begin(now, forget=False)

    def _abdicate(self, now: int, reason: str) -> None:
        self._cycle.stop()
        self._grants.clear()
        self._timers.clear("network")
        self._forget_master(reason)
        self._out.append(LostSync(reason))

    def _introduce(self, now: int) -> None:
        """Say who is the master here, at most once in three cycles."""
        if now >= self._told + 3 * self._cycle.timing.cycle:
            self.tell(now)

    def _forget_master(self, reason: str) -> None:
        self.master = None
        self.verified = False
        self._suspend(reason)

    def _suspend(self, reason: str) -> None:
        self._wishes.open = False
        for each in self._periodics.values():
            self._wishes.suspend(each, reason)

    def _renew(self, now: int, periodics: Iterable[Periodic]) -> None:
        for each in periodics:
            self._wishes.want(now, each)
