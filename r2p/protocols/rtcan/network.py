"""Finding, following and being the master: what the node knows of its network, and how it may use the bus by that.

    no master --sync heard--> slave --four cycles without sync--> electing --nobody better, first sync sent--> master
                                ^----------------------------------------------------------a better one meets it--'

A slave sends nothing before it knows, from the master's NETWORK, that its parameters are the network's; but when a
cycle that was lost goes on where it should be by now, it is the same network, whoever is the master. A sync off the
grid is not followed while there is one on it. A master that hears a foreign sync says at once who it is; of the two the
lesser one yields when it hears that.

`allegiance` tells whose syncs are heard, `reign` is the master's part, `election` says who takes over.
"""

from collections import Counter, deque
from collections.abc import Callable, Hashable

import msgspec

from r2p.codecs import management
from r2p.codecs.rtcan import Frame
from r2p.protocols.rtcan.cycle import Alignment, Cycle, CycleState
from r2p.protocols.rtcan.events import (
    LONG_AGO,
    NEVER,
    Action,
    LostSync,
    NewMaster,
    ParameterMismatch,
    ParametersMatch,
    Profile,
)
from r2p.protocols.rtcan.leases import SlotGrants, SlotRequests
from r2p.protocols.rtcan.master import Election, MasterRole, Role
from r2p.protocols.rtcan.node_id import Identity, Stage
from r2p.protocols.rtcan.transmitter import SlotTransmitter
from r2p.protocols.timers import KeyedTimers

REPEAT = 1_000_000_000
"""NETWORK is sent this often (ns)."""
_LONGEST = (1 << 63) - 1  # ns, 292 years: what no network has lasted, and no field of ours could tell
_PAUSE = 20_000_000  # ns before the first sync is tried again, at most

_SLEPT = (
    "this node was the master, and its computer was busy or stopped: "
    "give r2p a real-time priority (r2p doctor tells how), or let another node be the master (priority=)"
)


class NetworkMembership:
    """The network as this node sees it. `say(now, message)` sends management; `priority` is that to be the master."""

    def __init__(
        self,
        cycle: Cycle,
        sender: SlotTransmitter,
        identity: Identity,
        election: Election,
        grants: SlotGrants,
        wishes: SlotRequests,
        timers: KeyedTimers,
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
        self._allegiance = MasterTracker(cycle)
        self._reign = MasterRole(cycle, sender, grants, self._crowned, self._later)
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
        held = self._cycle.state is CycleState.HOLDING
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
        if self._cycle.state is CycleState.LEADING:
            if not self._reign.turn(now):
                self._abdicate(now, _SLEPT)
                self._elect(now, forget=True)
            return
        if self._cycle.state is CycleState.HOLDING:  # only now it is sure: a sync may be read late
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
        # One that still waits has an old counter.
        self._sender.withdraw_management(self._identity.id8, management.ManagementType.NETWORK)
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
        self._out.append(ParametersMatch())
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
            self._out.append(ParameterMismatch(reason))

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
        self._sender.withdraw_management(self._identity.id8, management.ManagementType.NETWORK)
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


# Whose syncs are those that a slave follows? A sync frame does not say; NETWORK, which comes once a second, does.


FORGOTTEN = 3_000_000_000
"""A master that is not heard for so long is none (ns)."""
_UNKNOWN_MASTER = 1_200_000_000  # a master that sends no NETWORK for so long is firmware
_NEAR = 4  # cycles that a NETWORK may be late, or the last one be a guess
_YIELDED = 3  # cycles after which a lesser master's syncs are over


class MasterTracker:
    """What is known about the master of the cycle that a node follows."""

    def __init__(self, cycle: Cycle) -> None:
        self._cycle = cycle
        self._heard = LONG_AGO
        self._rank = (0, 0)
        self._latest: tuple[int, management.Network] | None = None
        self._rival: tuple[int, management.Network] | None = None
        self._since = 0

    def told(self, now: int, told: management.Network, master: int | None, epoch: int | None) -> bool:
        """A master says who it is; ours so far is this one. Says whether it is ours."""
        self._latest = now, told
        rank = told.priority, told.id8
        if self._is_another(now, told, master, epoch):
            if rank > self._rank:
                self._rival = self._latest
            return False
        self._heard, self._rank = now, rank
        return True

    def matches(self, told: management.Network) -> bool:
        """Whether a network has our slots."""
        timing = self._cycle.timing
        return (told.slots, told.slot) == (timing.slots, timing.slot)

    def started(self, now: int) -> management.Network | None:
        """A cycle has started: what its master last said, if it is the one that spoke last, by its count."""
        self._since = now
        self._rival = None
        return self._recall(now, self._latest)

    def goes_on(self, now: int) -> management.Network | None:
        """One more sync: what its master said, if it is another one than ours."""
        rival = self._rival
        if rival is None or now < rival[0] + _YIELDED * self._cycle.timing.cycle:
            return None
        self._rival = None
        return self._recall(now, rival)

    def foreign(self) -> None:
        """A sync is off our grid: there is another master, but ours has not become it."""
        self._rival = None

    def believed(self, now: int) -> bool | None:
        """Whether a master that sends no NETWORK has our cycle, by its length; None: not known yet."""
        measured = self._cycle.measured()
        if now < self._since + _UNKNOWN_MASTER or measured is None:
            return None
        ours = self._cycle.timing.cycle
        length, error = measured
        return abs(length - ours) <= ours // 1000 + error

    def forget(self, master: int | None) -> None:
        """This master's syncs are over."""
        self._rival = None
        if self._latest is not None and self._latest[1].id8 == master:
            self._latest = None

    def _is_another(self, now: int, told: management.Network, master: int | None, epoch: int | None) -> bool:
        """Whether the syncs that we follow are those of another master; one of the two will yield."""
        if not self._cycle.running or master is None or now > self._heard + FORGOTTEN:
            return False
        if (told.id8, told.epoch) == (master, epoch):
            return False
        same_grid = told.epoch == epoch and -_NEAR <= told.cycle - self._cycle.counter <= _NEAR
        return not (same_grid and (told.priority, told.id8) > self._rank)

    def _recall(self, now: int, heard: tuple[int, management.Network] | None) -> management.Network | None:
        """What a master said, as it would say it now, if it can be the master of this cycle."""
        if heard is None or now > heard[0] + FORGOTTEN:
            return None
        at, told = heard
        counter = told.cycle + (now - at) // self._cycle.timing.cycle
        near = (self._cycle.counter - counter + _NEAR) & 0xFF <= 2 * _NEAR
        if not near or not self.matches(told):
            return None
        self._heard, self._rank = at, (told.priority, told.id8)
        return msgspec.structs.replace(told, cycle=counter)


# What the modules on the bus expect: RTCAN with sync and claims, or firmware of 2014 (PROTOCOL.md 6, 7 and 9).


QUIET = 33_000_000
"""ns without management traffic before any is sent."""
_SPREAD = 20_000_000
_MOST = 64


class Detector:
    """Finds out by listening whose network this is."""

    def __init__(self, wanted: Profile) -> None:
        self.profile = wanted
        self._wanted = wanted
        self._firmware = False

    def start(self) -> None:
        """Listen anew."""
        self.profile = self._wanted
        self._firmware = False

    def firmware_heard(self) -> None:
        """A frame with high byte 0 that is no sync was heard."""
        self._firmware = True

    def decide(self, *, synced: bool) -> None:
        """The time to listen is over; `synced` says whether there are sync frames."""
        if self.profile is Profile.AUTO:
            self.profile = Profile.FIRMWARE if self._firmware and not synced else Profile.RTCAN


class RateLimiter:
    """Management messages that wait for silence. `draw(n)` gives a random number below n."""

    def __init__(self, draw: Callable[[int], int], counts: Counter[str]) -> None:
        self._draw = draw
        self._counts = counts
        self.waiting: deque[tuple[bytes, Hashable]] = deque()
        """Messages and their handles, the next one first."""
        self._urgent = 0  # so many of them are urgent: the first ones
        self._quiet_from = LONG_AGO
        self._delay: int | None = None  # drawn when it is needed: most networks are not of firmware

    def put(self, data: bytes, *, urgent: bool = False, handle: Hashable = None) -> Hashable:
        """Send it when it is quiet, `urgent` ones first, in order.

        The oldest that is not urgent is dropped when there are too many: its handle comes back.
        """
        dropped: Hashable = None
        if len(self.waiting) >= _MOST:
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

    def traffic(self, now: int) -> None:
        """Somebody, or this node, sent a management frame."""
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
        """What may go now, and its handle."""
        if self.due > now:
            return None
        self.traffic(now)
        self._urgent = max(0, self._urgent - 1)
        return self.waiting.popleft()

    def __len__(self) -> int:
        return len(self.waiting)

    def clear(self) -> list[Hashable]:
        """Forget all; their handles come back."""
        handles = [handle for _, handle in self.waiting]
        self.waiting.clear()
        self._urgent = 0
        return handles
