"""Finding, following and being the master: what the node knows of its network, and how it may use the bus by that.

    no master --sync heard--> slave --four cycles without sync--> electing --nobody better, first sync sent--> master
                                ^----------------------------------------------------------a better one meets it--'

A slave sends nothing before it knows, from the master's NETWORK, that its parameters are the network's; but when a
cycle that was lost goes on where it should be by now, it is the same network, whoever is the master. A sync off the
grid is not followed while there is one on it. A master that hears a foreign sync says at once who it is; of the two the
lesser one yields when it hears that.

`allegiance` tells whose syncs are heard, `reign` is the master's part, `election` says who takes over.
"""

from collections import Counter
from collections.abc import Callable

from r2p.codecs import management
from r2p.codecs.rtcan import Frame
from r2p.protocols.rtcan.allegiance import FORGOTTEN, Allegiance
from r2p.protocols.rtcan.cycle import Alignment, Cycle, State
from r2p.protocols.rtcan.election import Election, Role
from r2p.protocols.rtcan.events import LONG_AGO, Action, LostSync, NewMaster, Silenced, Unsilenced
from r2p.protocols.rtcan.identity import Identity, Stage
from r2p.protocols.rtcan.leases import Grants, Wishes
from r2p.protocols.rtcan.reign import Reign
from r2p.protocols.rtcan.sending import Sender
from r2p.protocols.schedule import Timers

REPEAT = 1_000_000_000
"""NETWORK is sent this often (ns)."""
_LONGEST = (1 << 63) - 1  # ns, 292 years: what no network has lasted, and no field of ours could tell
_PAUSE = 20_000_000  # ns before the first sync is tried again, at most

_SLEPT = (
    "this node was the master, and its computer was busy or stopped: "
    "give r2p a real-time priority (r2p doctor tells how), or let another node be the master (priority=)"
)


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
        self._allegiance = Allegiance(cycle)
        self._reign = Reign(cycle, sender, grants, self._crowned, self._later)
        self._told = LONG_AGO

    @property
    def settled(self) -> bool:
        """Whether it is decided how the bus may be used: in slots, or without."""
        decided = self.silenced is None and self._election.role is not Role.ELECTING
        return decided and (self.verified or not self._cycle.running)

    # What is heard

    def sync(self, now: int, frame: Frame, stamp: int) -> None:
        """A sync frame of another node."""
        if self._election.role is Role.MASTER:
            self._counts["foreign syncs"] += 1
            self._introduce(now)
            return
        self._sender.poll(now)
        held = self._cycle.state is State.HOLDING
        match self._cycle.heard(frame, stamp):
            case Alignment.ALIGNED:
                if held:
                    self._counts["missed syncs"] += 1
                self._sender.turned(now)
                self._follow(now, self._allegiance.goes_on(now))
            case Alignment.FOREIGN:
                self._counts["foreign syncs"] += 1
                self._allegiance.foreign()
            case Alignment.STARTED | Alignment.RESUMED as alignment:
                self._join(now, resumed=alignment is Alignment.RESUMED)
            case _:
                self._sender.aligned(now)
        if not self.verified:
            self._verify_by_length(now)

    def network(self, now: int, told: management.Network) -> None:
        """A master says who it is and what its network is like."""
        if told.cycle * self._cycle.timing.cycle > _LONGEST:
            self._counts["undecodable"] += 1
            return
        if self._election.role is Role.MASTER:
            if self._election.beats(self._identity.id8, told.priority, told.id8):
                self._introduce(now)
                return
            self._yield(now, told)
        if not self._allegiance.told(now, told, self.master, self.epoch):
            self._counts["other masters"] += 1
        elif not self._allegiance.matches(told):
            timing = self._cycle.timing
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
        free = self._identity.stage is Stage.OWNING and not self._cycle.running and self.silenced is None
        if free and self._election.decide(now, self._identity.id8):
            self._reign.found(now, inherits=self.epoch is not None and self._cycle.anchored)

    def turn(self, now: int) -> None:
        """A cycle is over."""
        if self._cycle.state is State.LEADING:
            if not self._reign.turn(now):
                self._abdicate(now, _SLEPT)
                self._elect(now, forget=True)
            return
        if self._cycle.state is State.HOLDING:  # only now it is sure: a sync may be read late
            self._counts["missed syncs"] += 1
        if self._cycle.roll():
            self._sender.turned(now)
        else:
            self._lose(now, "no sync for too long")

    def tell(self, now: int) -> None:
        """It is time for NETWORK."""
        if self._election.role is not Role.MASTER or self.epoch is None:
            return
        self._told = now
        self._sender.withdraw_management(self._identity.id8, management.NETWORK)  # it would tell an old counter
        self._timers.set("network", now + REPEAT)
        timing, counter = self._cycle.timing, self._cycle.counter
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
        self._reign.cancel()
        self._election.end(Role.SLAVE if self._cycle.running else Role.NONE)
        self._wishes.pause(now, "the node may not send")

    def stop(self, now: int) -> None:
        """The bus is gone."""
        self._cycle.stop()
        self._reign.cancel()
        self._election.end(Role.NONE)
        self._forget_master(now, "the bus is gone")
        self._timers.clear("silence")
        self.silenced = None

    # Inside

    def _join(self, now: int, *, resumed: bool) -> None:
        """There is a cycle: its master is somebody else."""
        self.verified = resumed
        self._reign.cancel()
        self._election.end(Role.SLAVE)
        self._sender.turned(now)
        if resumed:
            self._identity.announce(now, again=True)  # its master is asked who it is
        self._follow(now, self._allegiance.started(now))

    def _follow(self, now: int, told: management.Network | None) -> None:
        """The master of the syncs that we hear, if it is known: its parameters are ours."""
        if told is None:
            return
        renumbered = self._cycle.anchor(told.cycle)
        if told.epoch != self.epoch or renumbered:
            self._wishes.void(now, "another network")
        self.utc_offset, self.utc_error = told.utc_offset, told.utc_error
        self._timers.clear("silence")
        self.unsilence(now)
        news = (told.id8, told.epoch) != (self.master, self.epoch)
        self.master, self.epoch = told.id8, told.epoch
        self.verified = True
        if news or not self._wishes.open:
            self._wishes.pause(now, "another master")
            if news:
                self._out.append(NewMaster(told.id8, told.epoch, own=False))
            self._wishes.resume(now)

    def _verify_by_length(self, now: int) -> None:
        """A master that sends no NETWORK: believe it when its cycle is as long as ours."""
        believed = self._allegiance.believed(now)
        if believed and self.silenced is None:
            self.verified = True
            self._out.append(NewMaster(None, 0, own=False))
        elif believed is False:
            measured, _ = self._cycle.measured() or (0, 0)
            ours = self._cycle.timing.cycle
            self._silence(now, f"a cycle takes {measured // 1000} us, this node's {ours // 1000} us")

    def _silence(self, now: int, reason: str) -> None:
        self._timers.set("silence", now + FORGOTTEN)
        if self.silenced is None:
            self.silenced = reason
            self.verified = False
            self._reign.cancel()
            self._wishes.pause(now, "the network has other parameters")
            self._out.append(Silenced(reason))

    def _elect(self, now: int, *, forget: bool) -> None:
        self._election.begin(now, forget=forget)
        self._identity.announce(now, again=True)

    def _lose(self, now: int, reason: str) -> None:
        """There is no cycle any more."""
        self._allegiance.forget(self.master)
        self._forget_master(now, reason)
        self._out.append(LostSync(reason))
        if self._identity.stage is Stage.OWNING:
            self._elect(now, forget=True)
        else:
            self._election.end(Role.NONE)

    def _later(self, now: int) -> None:
        """The first sync did not get through."""
        self._election.again(now + self._identity.draw(_PAUSE))

    def _crowned(self, now: int, inherits: bool) -> None:
        """This node is the master. Of a network that was there before it keeps the epoch."""
        if not inherits:
            self.epoch = self._identity.draw(0xFFFFFFFF) + 1
        self._election.end(Role.MASTER)
        self.master = self._identity.id8
        self.verified = True
        self._out.append(NewMaster(self.master, self.epoch or 0, own=True))
        self._timers.set("network", now)  # goes off at once, and what depends on the role is settled
        self._wishes.resume(now)

    def _yield(self, now: int, told: management.Network) -> None:
        """A better master is there: its next sync will be followed."""
        self._election.heard(now, told.id8, told.priority)
        self._abdicate(now, "a better master is there")
        self._election.begin(now, forget=False)

    def _abdicate(self, now: int, reason: str) -> None:
        self._reign.end()
        self._sender.withdraw_management(self._identity.id8, management.NETWORK)
        self._timers.clear("network")
        self._forget_master(now, reason)
        self._out.append(LostSync(reason))

    def _introduce(self, now: int) -> None:
        """Say who is the master here, at most once in three cycles."""
        if now >= self._told + 3 * self._cycle.timing.cycle:
            self.tell(now)

    def _forget_master(self, now: int, reason: str) -> None:
        self.master = None
        self.verified = False
        self._wishes.pause(now, reason)
