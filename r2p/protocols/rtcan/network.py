"""Finding, following and being the master: the node's knowledge of its network, and so its use of the bus.

    no master --sync received--> slave --four cycles without sync--> electing --elected, first sync sent--> master
                                   ^----------------------------------------------------a better one appears--'

A slave sends nothing before it knows, from the master's NETWORK, that its parameters are the network's; but when a
cycle that was lost goes on where it should be by now, it is the same network, with any master. A sync off the grid is
not followed while there is one on it. A master that receives a foreign sync sends NETWORK at once; of two masters the
one of lower (priority, id8) steps down when it receives that.

`Detector` finds out the kind of network, `MasterTracker` the sender of the syncs; `NetworkMembership` acts on it,
with `Election` and `MasterRole` (master.py).
"""

from collections.abc import Callable

import msgspec

from r2p.codecs import management
from r2p.codecs.rtcan import CYCLE_MASK, Frame
from r2p.protocols.rtcan.cycle import Alignment, Cycle, CycleState
from r2p.protocols.rtcan.events import EngineContext, LostSync, NewMaster, ParameterMismatch, ParametersMatch, Profile
from r2p.protocols.rtcan.leases import SlotGrants, SlotRequests
from r2p.protocols.rtcan.master import Election, MasterRole, Role
from r2p.protocols.rtcan.node_id import NodeId, Stage
from r2p.protocols.rtcan.transmitter import SlotTransmitter
from r2p.units import LONG_AGO, SECOND

REPEAT = SECOND
"""Ns between two NETWORK."""
FORGOTTEN = 3_000_000_000
"""A master without NETWORK for this long is gone (ns): two may be lost."""
_ANSWER_APART = 3  # cycles between two NETWORK that answer others
_TIME_MAX = (1 << 63) - 1  # ns, 292 years: no network lasts longer, and no field could say so
_UNKNOWN_MASTER = 1_200_000_000  # ns; a master that sends no NETWORK for so long is firmware
_NEAR = 4  # cycles that a NETWORK may be late, or extrapolating from the last one be wrong
_YIELDED = 3  # cycles after which a lesser master's syncs are over

_NOT_OF_THIS_CYCLE = (Alignment.FOREIGN, Alignment.REPEATED)

_TOO_LATE = (
    "this node was the master, and its computer was busy or stopped: "
    "give r2p a real-time priority (r2p doctor tells how), or let another node be the master (priority=)"
)


class Detector:
    """Finds out by listening whether the modules expect RTCAN with sync and claims, or are firmware of 2014."""

    def __init__(self, wanted: Profile) -> None:
        self.profile = wanted
        self._wanted = wanted
        self._firmware = False

    def start(self) -> None:
        """Listen anew."""
        self.profile = self._wanted
        self._firmware = False

    def firmware_seen(self) -> None:
        """Note a frame with high byte 0 that is not a sync: only firmware sends such frames."""
        self._firmware = True

    def decide(self, *, synced: bool) -> None:
        """Decide on the kind of network, after listening; `synced`: there are sync frames."""
        if self.profile is Profile.AUTO:
            self.profile = Profile.FIRMWARE if self._firmware and not synced else Profile.RTCAN


class MasterTracker:
    """The master of the cycle that a node follows. A sync frame does not name it; NETWORK, once a second, does."""

    def __init__(self, cycle: Cycle) -> None:
        self._cycle = cycle
        self._heard_at = LONG_AGO
        self._rank = (0, 0)
        self._latest: tuple[int, management.Network] | None = None  # when a NETWORK came, and what it said
        self._rival: tuple[int, management.Network] | None = None
        self._since = 0

    def on_network(self, now: int, network: management.Network, master: int | None, epoch: int | None) -> bool:
        """Note a NETWORK, and return whether it is from the node's master, so far `master`."""
        self._latest = now, network
        rank = network.priority, network.id8
        if self._is_another(now, network, master, epoch):
            if rank > self._rank:
                self._rival = self._latest
            return False
        self._heard_at, self._rank = now, rank
        return True

    def matches(self, network: management.Network) -> bool:
        """Return whether a network has as many slots, of the same length, as this node."""
        timing = self._cycle.timing
        return (network.slots, network.slot) == (timing.slots, timing.slot)

    def on_started(self, now: int) -> management.Network | None:
        """Note that a cycle has started; return the last NETWORK, brought up to date, if its counter fits."""
        self._since = now
        self._rival = None
        return self._recall(now, self._latest)

    def on_aligned(self, now: int) -> management.Network | None:
        """Note one more sync on the grid; return the NETWORK of another master if the sync must be that master's."""
        rival = self._rival
        if rival is None or now < rival[0] + _YIELDED * self._cycle.timing.cycle:
            return None
        self._rival = None
        return self._recall(now, rival)

    def on_foreign(self) -> None:
        """Note a sync off the grid: it is the rival's, and those on the grid are still the master's."""
        self._rival = None

    def has_our_length(self, now: int) -> bool | None:
        """Return whether the cycle of a master that sends no NETWORK is as long as this node's; None if unknown."""
        measured = self._cycle.measured()
        if now < self._since + _UNKNOWN_MASTER or measured is None:
            return None
        ours = self._cycle.timing.cycle
        length, error = measured
        return abs(length - ours) <= ours // 1000 + error  # clocks differ less, other numbers of slots more

    def forget(self, master: int | None) -> None:
        """Forget a master whose syncs are over."""
        self._rival = None
        if self._latest is not None and self._latest[1].id8 == master:
            self._latest = None

    def _is_another(self, now: int, network: management.Network, master: int | None, epoch: int | None) -> bool:
        """Return whether a NETWORK is from another master than the one that is followed; one of the two will yield."""
        if not self._cycle.running or master is None or now > self._heard_at + FORGOTTEN:
            return False
        if (network.id8, network.epoch) == (master, epoch):
            return False
        # A better master that goes on with this epoch, grid and count has taken over: it is followed from now on.
        same_grid = network.epoch == epoch and -_NEAR <= network.cycle - self._cycle.counter <= _NEAR
        return not (same_grid and (network.priority, network.id8) > self._rank)

    def _recall(self, now: int, received: tuple[int, management.Network] | None) -> management.Network | None:
        """Return a NETWORK as its master would send it now, if it can be the master of this cycle."""
        if received is None or now > received[0] + FORGOTTEN:
            return None
        at, network = received
        counter = network.cycle + (now - at) // self._cycle.timing.cycle
        # Before it is anchored, the cycle's own counter has only the 8 bits of a sync.
        near = (self._cycle.counter - counter + _NEAR) & CYCLE_MASK <= 2 * _NEAR
        if not near or not self.matches(network):
            return None
        self._heard_at, self._rank = at, (network.priority, network.id8)
        return msgspec.structs.replace(network, cycle=counter)


class NetworkMembership:
    """The network as this node sees it. `send(now, message)` sends management."""

    def __init__(
        self,
        context: EngineContext,
        transmitter: SlotTransmitter,
        node_id: NodeId,
        grants: SlotGrants,
        requests: SlotRequests,
        send: Callable[[int, management.Management], None],
    ) -> None:
        self.election = Election(context)
        self.node_id = node_id
        self.master: int | None = None
        """The master's id8."""
        self.epoch: int | None = None
        """The current run of the network, through which cycles are counted."""
        self.utc_offset = 0
        """UTC less network time (ns), by the master."""
        self.utc_error = management.NO_UTC
        """Largest error of `utc_offset` (us)."""
        self.verified = False
        """True once the network's parameters are known to be those of this node."""
        self.mismatch: str | None = None
        """The reason why the node sends nothing: how the network's parameters differ."""
        self._context = context
        self._cycle = context.cycle
        self._timers = context.timers
        self._actions = context.actions
        self._counts = context.counts
        self._transmitter = transmitter
        self._requests = requests
        self._send = send
        self._tracker = MasterTracker(context.cycle)
        self._master_role = MasterRole(context, transmitter, grants, self._on_elected)
        self._sent_at = LONG_AGO

    @property
    def decided(self) -> bool:
        """Return whether it is known how to use the bus: in slots, or without."""
        decided = self.mismatch is None and self.election.role is not Role.ELECTING
        return decided and (self.verified or not self._cycle.running)

    # Frames and messages of others

    def on_sync(self, now: int, frame: Frame, stamp: int) -> None:
        """Follow the sync frame of another node; as the master, answer it."""
        if self.election.role is Role.MASTER:
            self._foreign_sync(now)
            self._answer(now)
            return
        self._transmitter.poll(now)  # first the rest of the cycle that ends now
        bridged = self._cycle.state is CycleState.HOLDING
        alignment = self._cycle.on_sync(frame, stamp)
        match alignment:
            case Alignment.ALIGNED:
                if bridged:
                    self._counts["missed syncs"] += 1
                self._transmitter.begin_cycle(now)
                self._follow(now, self._tracker.on_aligned(now))
            case Alignment.FOREIGN:
                self._foreign_sync(now)
                self._tracker.on_foreign()
            case Alignment.STARTED | Alignment.RESUMED:
                self._join(now, resumed=alignment is Alignment.RESUMED)
            case _:
                self._transmitter.realign(now)
        if not self.verified:
            self._verify_by_length(now)
        if self._context.report_syncs and alignment not in _NOT_OF_THIS_CYCLE:
            self._report_sync(frame, stamp)

    def on_network(self, now: int, network: management.Network) -> None:
        """Follow the NETWORK of a master, yield to it, or answer it."""
        if network.cycle * self._cycle.timing.cycle > _TIME_MAX:
            self._counts["undecodable"] += 1  # forged: a NETWORK of this node could not say this count as a time
            return
        if self.election.role is Role.MASTER:
            if self.election.beats(self.node_id.id8, network.priority, network.id8):
                self._answer(now)
                return
            self._yield_to(now, network)
        if not self._tracker.on_network(now, network, self.master, self.epoch):
            self._counts["other masters"] += 1
        elif not self._tracker.matches(network):
            timing = self._cycle.timing
            ours = f"{timing.slots} of {timing.slot // 1000} us"
            self._stop_sending(
                now, f"the network has {network.slots} slots of {network.slot / 1000:g} us, this node {ours}"
            )
        elif self._cycle.running:
            self._follow(now, network)

    def on_claim(self, now: int, claim: management.Claim) -> None:
        """Note the claim of a node; if it looks for a master, answer."""
        self.election.on_claim(now, claim.id8, claim.priority)
        if claim.flags & management.CLAIM_ELECTING:
            if self.election.role is Role.MASTER:
                self._answer(now)
            elif self.election.role is Role.ELECTING:
                self.node_id.claim(now)

    # Time

    def on_id_owned(self, now: int) -> None:
        """Look for a master, now that the node may send management."""
        if not self._cycle.running:
            self._elect(now, forget=False)

    def decide_election(self, now: int) -> None:
        """Send the first sync if this node is elected, now that the claims are collected."""
        may_lead = self.node_id.stage is Stage.OWNING and not self._cycle.running and self.mismatch is None
        if may_lead and self.election.decide(now, self.node_id.id8):
            self._master_role.start_network(now, inherits=self.epoch is not None and self._cycle.anchored)

    def next_cycle(self, now: int) -> None:
        """Begin the next cycle: lead it, bridge a missing sync, or give the cycle up."""
        if self._cycle.state is CycleState.LEADING:
            if not self._master_role.begin_cycle(now):
                self._step_down(now, _TOO_LATE)
                self._elect(now, forget=True)
            return
        if self._cycle.state is CycleState.HOLDING:  # only now it is sure: a sync may be read late
            self._counts["missed syncs"] += 1
        if self._cycle.bridge():
            self._transmitter.begin_cycle(now)
        else:
            self._lose_cycle(now, "no sync for too long")

    def send_network(self, now: int) -> None:
        """As the master: send NETWORK, and again in a second."""
        if self.election.role is not Role.MASTER or self.epoch is None:
            return
        self._sent_at = now
        self._timers.set("network", now + REPEAT)
        timing, counter = self._cycle.timing, self._cycle.counter
        id8, priority = self.node_id.id8, self._context.settings.priority
        offset, error = self.utc_offset, self.utc_error
        self._send(
            now, management.Network(id8, priority, self.epoch, counter, timing.slots, timing.slot, offset, error)
        )

    def forget_mismatch(self, now: int) -> None:
        """Forget that parameters differ: no NETWORK shows it any longer, or one shows the opposite."""
        if self.mismatch is None:
            return
        self.mismatch = None
        self._actions.append(ParametersMatch())
        if self.node_id.stage is Stage.OWNING and not self._cycle.running:
            self._elect(now, forget=True)

    def on_id_lost(self, now: int) -> None:
        """Give up the role of master and all slots, as the node may not send for a while."""
        if self.election.role is Role.MASTER:
            self._step_down(now, "this node was the master, and may not send")
        self._master_role.cancel()
        self.election.end(Role.SLAVE if self._cycle.running else Role.NONE)
        self._requests.pause(now, "the node may not send")

    def stop(self, now: int) -> None:
        """Forget the network, as the bus is gone."""
        self._cycle.stop()
        self._master_role.cancel()
        self.election.end(Role.NONE)
        self._forget_master(now, "the bus is gone")
        self._timers.clear("silence")
        self.mismatch = None

    # Slave

    def _join(self, now: int, *, resumed: bool) -> None:
        """Become a slave in a cycle that another master has started."""
        self.verified = resumed
        self._master_role.cancel()
        self.election.end(Role.SLAVE)
        self._transmitter.begin_cycle(now)
        if resumed:
            self.node_id.claim(now, at_once=True)  # with the flag that asks the master for NETWORK
        self._follow(now, self._tracker.on_started(now))

    def _follow(self, now: int, network: management.Network | None) -> None:
        """Follow the NETWORK of the syncs' master, whose parameters fit; None: not known yet."""
        if network is None:
            return
        renumbered = self._cycle.anchor(network.cycle)  # phases count from cycle 0: the node has other slots then
        if network.epoch != self.epoch or renumbered:
            self._requests.revoke_all(now, "another network")
        self.utc_offset, self.utc_error = network.utc_offset, network.utc_error
        self._timers.clear("silence")
        self.forget_mismatch(now)
        changed = (network.id8, network.epoch) != (self.master, self.epoch)
        self.master, self.epoch = network.id8, network.epoch
        self.verified = True
        # Another master may not know this node's leases: stop, and have it confirm them.
        if changed or not self._requests.has_master:
            self._requests.pause(now, "another master")
            if changed:
                self._actions.append(NewMaster(network.id8, network.epoch, own=False))
            self._requests.resume(now)

    def _foreign_sync(self, now: int) -> None:
        self._counts["foreign syncs"] += 1
        self._context.sync_check.on_foreign(now)

    def _report_sync(self, frame: Frame, stamp: int) -> None:
        """Report a sync that was received, once it is known whose it is."""
        if self.verified and self._cycle.anchored:
            self._context.report_sync(frame, stamp - self._context.settings.receive_latency)

    def _verify_by_length(self, now: int) -> None:
        """Accept a master without NETWORK if its cycle is as long as this node's."""
        ours = self._tracker.has_our_length(now)
        if ours and self.mismatch is None:
            self.verified = True
            self._actions.append(NewMaster(None, 0, own=False))
        elif ours is False:
            measured, _ = self._cycle.measured() or (0, 0)
            length = self._cycle.timing.cycle
            self._stop_sending(now, f"a cycle takes {measured // 1000} us, this node's {length // 1000} us")

    def _stop_sending(self, now: int, mismatch: str) -> None:
        self._timers.set("silence", now + FORGOTTEN)
        if self.mismatch is None:
            self.mismatch = mismatch
            self.verified = False
            self._master_role.cancel()
            self._requests.pause(now, "the network has other parameters")
            self._actions.append(ParameterMismatch(mismatch))

    def _lose_cycle(self, now: int, reason: str) -> None:
        self._tracker.forget(self.master)
        self._forget_master(now, reason)
        self._actions.append(LostSync(reason))
        if self.node_id.stage is Stage.OWNING:
            self._elect(now, forget=True)
        else:
            self.election.end(Role.NONE)

    def _forget_master(self, now: int, reason: str) -> None:
        self.master = None
        self.verified = False
        self._requests.pause(now, reason)

    def _elect(self, now: int, *, forget: bool) -> None:
        self.election.begin(now, forget=forget)
        self.node_id.claim(now, at_once=True)

    # Master

    def _on_elected(self, now: int, inherits: bool) -> None:
        """Be the master. A network that this node `inherits` keeps its epoch."""
        if not inherits:
            self.epoch = self._context.draw(management.EPOCH_MAX) + 1  # never 0
        self.election.end(Role.MASTER)
        self.master = self.node_id.id8
        self.verified = True
        self._actions.append(NewMaster(self.master, self.epoch or 0, own=True))
        self._timers.set("network", now)  # goes off at once: then the engine also updates its mode for the new role
        self._requests.resume(now)

    def _yield_to(self, now: int, network: management.Network) -> None:
        """Make room for a better master, whose next sync will be followed."""
        self.election.on_claim(now, network.id8, network.priority)  # a candidate, should its syncs not come
        self._step_down(now, "a better master is there")
        self.election.begin(now, forget=False)

    def _step_down(self, now: int, reason: str) -> None:
        self._master_role.step_down()
        self._transmitter.withdraw_network(self.node_id.id8)
        self._timers.clear("network")
        self._forget_master(now, reason)
        self._actions.append(LostSync(reason))

    def _answer(self, now: int) -> None:
        """As the master: send NETWORK out of turn, at most once in three cycles."""
        if now >= self._sent_at + _ANSWER_APART * self._cycle.timing.cycle:
            self.send_network(now)
