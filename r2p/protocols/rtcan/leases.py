"""Periodic messages and their slots, on lease from the master: requested, granted, and planned slot by slot.

The node renews the slots that it still needs every second. A lease lasts 3 s: for its owner from the request, for the
master from the grant, so an owner without answers stops first. Where renewals would take too much of the slots that are
free, the master grants longer leases, and each is renewed after a third of it. A new master of the same epoch renews
the grants of the last one; for three cycles it grants nothing else. `SlotGrants` is the master's side.

At the owner, `SlotRequests` keeps the leases, and `SlotPlan` has the actions of each slot. Slots are the clock of a
`PeriodicMessage`: `lead` before the first one of each occurrence its data are asked for, then each fragment has its
slot. Everything lies on slot boundaries, so to wake up in time is to know the next slot.
"""

import math
from collections.abc import Callable, Hashable, Iterable

import msgspec

from r2p.codecs import management, rtcan
from r2p.codecs.management import NO_PHASE, Grant, Refuse, RefuseReason, Renew, Renewed, Reserve
from r2p.protocols.rtcan.calendar import Calendar, Refusal, Reservation, asked_exactly, occupied
from r2p.protocols.rtcan.cycle import Timing, following
from r2p.protocols.rtcan.events import Due, EngineContext, SlotsGranted, SlotsLost, SlotsRefused
from r2p.units import LONG_AGO, MILLISECOND, SECOND

LEASE = 3_000_000_000  # ns, as the next four: two renewals may be lost
_LEASE_MAX = 15_000_000_000  # for so long nobody else gets the slots of a module that lost its power
_RENEWALS = 3  # in a lease
_RENEWAL = LEASE // _RENEWALS
_RETRY = 250_000_000
_PLANS_MAX = 256  # plans of cycles that are kept
_RENEWAL_FRAMES = 8  # of a renewal and its answer, at most: most have few frames, without their zeros
_RENEWAL_SHARE = 8  # part of the free slots, at most, for all renewals
_OWNER_FRAMES = 7  # a second, of each owner: a claim each 3 s, a renewal each 5 s, and a message of discovery
_MASTER_FRAMES = 4  # a second: NETWORK
_AHEAD = 1  # cycles from a grant to its first slot: by then all nodes have the new mask


class PeriodicMessage(msgspec.Struct, eq=False):
    """A message that goes every `interval` ns. `lead`: how long before its slot its data are needed (ns). It has `size`
    bytes; at most so many if its length `varies`: then it leaves some of its slots empty.

    `exact`: the interval is a whole number of slots, so it is asked for as it is before a shorter one will do.
    `active`: its slots may be used, from `from_cycle` on. Of an occurrence: `payload` to send in so many `frames`,
    those `sent`, and `waiting`, the number of the slot for which data were asked but not given yet. Without slots:
    `tick`, when it is due next, and `ticked`, whether data were asked. Of its requests: `asked`, when each was sent, by
    serial; `confirmed`, when the one was sent that was granted last, and `lease`, for how long (ns); `refused`, the
    reason of the last `SlotsRefused`.
    """

    high: int
    message: int
    size: int
    fragments: int
    interval: int
    lead: int
    handle: Hashable
    varies: bool = False
    exact: bool = False
    reservation: Reservation | None = None
    active: bool = False
    from_cycle: int = 0
    payload: bytes | None = None
    frames: int = 0
    sent: int = 0
    waiting: int | None = None
    unknown: bool = False
    tick: int | None = None
    ticked: bool = False
    asked: dict[int, int] = msgspec.field(default_factory=dict)
    confirmed: int = LONG_AGO
    lease: int = LEASE
    refused: str = ""

    def takes(self, size: int) -> bool:
        """Return whether the message may have so many bytes."""
        return size == self.size or (self.varies and size < self.size)

    def restart(self, payload: bytes | None = None) -> bool:
        """Begin the next occurrence, with fresh data; return whether data of the previous one were left."""
        unfinished = self.payload is not None
        self.payload = payload
        self.frames = 0 if payload is None else rtcan.fragment_count(len(payload))
        self.sent = 0
        self.waiting = None
        self.unknown = False
        return unfinished


_Sends = dict[int, tuple[PeriodicMessage, int, bool]]
_Fills = dict[int, list[tuple[PeriodicMessage, int]]]


class SlotPlan:
    """The plan for the slots of the current cycle. Slot 0 of the next cycle counts as the last one of this.

    The plan repeats after the least common multiple of all periods: each cycle up to there is worked out once, unless
    there are too many of them to be kept.
    """

    def __init__(self, timing: Timing) -> None:
        self.periodics: dict[int, PeriodicMessage] = {}
        """The periodic messages of this node by high byte."""
        self.sends: _Sends = {}
        """By slot: a message, its fragment, and whether its data are only requested now."""
        self.fills: _Fills = {}
        """By slot: messages whose data are requested now, and how many slots ahead of theirs."""
        self.next = following((), timing.slots)
        """By slot: the first one after it with something to do."""
        self.own = 0
        """A bit for each slot that this node owns."""
        self._timing = timing
        self._stale = True
        self._cycles: dict[int, tuple[_Sends, _Fills, list[int], int]] = {}
        self._span = 1  # cycles after which all comes again

    def invalidate(self) -> None:
        """Plan anew from the next cycle on: a message got or lost its slots."""
        self._stale = True

    def begin_cycle(self, cycle: int) -> None:
        """Take up the plan of the cycle with this number."""
        if self._stale:
            self._restart(cycle)
        known = self._cycles.get(cycle % self._span)
        if known is None:
            if len(self._cycles) >= _PLANS_MAX:
                self._cycles.clear()
            known = self._cycles[cycle % self._span] = self._work_out(cycle)
        self.sends, self.fills, self.next, self.own = known

    def _restart(self, cycle: int) -> None:
        """Plan anew after a change of slots; the plan stays stale while some begin only in a later cycle."""
        messages = self.periodics.values()
        owners = [(each.from_cycle, each.reservation.period) for each in messages if each.active and each.reservation]
        self._stale = any(begins > cycle for begins, _ in owners)
        self._span = math.lcm(self._timing.slots, *[period for _, period in owners]) // self._timing.slots
        self._cycles.clear()

    def _work_out(self, cycle: int) -> tuple[_Sends, _Fills, list[int], int]:
        sends: _Sends = {}
        fills: _Fills = {}
        for each in self.periodics.values():
            if each.active and each.reservation is not None:
                self._enter(sends, fills, cycle, each, each.reservation)
        own = sum(1 << slot for slot in sends)
        return sends, fills, following(sends.keys() | fills.keys(), self._timing.slots), own

    def _enter(self, sends: _Sends, fills: _Fills, cycle: int, each: PeriodicMessage, reservation: Reservation) -> None:
        slots = self._timing.slots
        # Whole slots, rounded up; but not before the occurrence before this one is through.
        lead = min(-(-each.lead // self._timing.slot), reservation.period - each.fragments)
        start = cycle * slots
        if cycle >= each.from_cycle:
            for slot in _set_bits(occupied(reservation, start, slots)):
                fragment = (start + slot - reservation.phase) % reservation.period
                sends[slot] = each, fragment, not lead and not fragment
        if lead:
            # Data may be asked for in this cycle for a slot of a later one.
            first = reservation.first_from(max(start + 1 + lead, each.from_cycle * slots))
            for number in range(first, start + slots + lead + 1, reservation.period):
                fills.setdefault(number - lead - start, []).append((each, lead))


class SlotGrants:
    """The master's side: the granted slots, and until when."""

    def __init__(self, context: EngineContext) -> None:
        self.calendar = Calendar(context.timing.slots, context.settings.periods)
        self.collecting = False
        """True while only grants of another master are renewed."""
        self._cycle = context.cycle
        self._timers = context.timers

    @property
    def lease(self) -> int:
        """Return how long a lease is now (ns): the fewer slots are free, the more seldom it is renewed."""
        free, owners = self._free_rate, len(self._owners)
        renewal = _RENEWAL_SHARE * _RENEWAL_FRAMES * owners * SECOND / max(free, 1.0)
        return min(max(LEASE, round(_RENEWALS * renewal)), _LEASE_MAX) // MILLISECOND * MILLISECOND

    @property
    def _owners(self) -> set[int]:
        return {rtcan.id8_of(each.message) for each in self.calendar}

    @property
    def _free_rate(self) -> float:
        """Slots a second that are not reserved."""
        timing = self._cycle.timing
        taken = 1 / timing.slots + sum(each.fragments / each.period for each in self.calendar)
        return (1 - taken) * SECOND / timing.slot

    @property
    def _is_too_full(self) -> bool:
        """Return whether the slots that are left are too few for what keeps all others: then all would be lost."""
        return self._free_rate < frames_needed(len(self._owners))

    def clear(self) -> None:
        """Forget all grants."""
        for each in list(self.calendar):
            self.remove(each.message)

    def answer(self, now: int, wanted: Reserve, epoch: int) -> Grant | Refuse | None:
        """Grant or refuse; None: not now."""
        held = self.calendar.get(wanted.message)
        # With a phase: slots granted before, perhaps by the last master. The owner gets the same ones or none.
        outcome: Reservation | Refusal
        if wanted.phase != NO_PHASE:
            reservation = Reservation(wanted.message, wanted.period, wanted.phase, wanted.fragments)
            outcome = self.calendar.readmit(reservation)
        elif self.collecting and held is None:
            return None
        else:
            round_down = bool(wanted.flags & management.RESERVE_ROUND_DOWN)
            outcome = self.calendar.admit(wanted.message, wanted.period, wanted.fragments, round_down=round_down)
            if held is None and isinstance(outcome, Reservation) and self._is_too_full:
                self.calendar.remove(wanted.message)
                outcome = Refusal(wanted.message, RefuseReason.MANAGEMENT, outcome.period, outcome.fragments)
        if isinstance(outcome, Refusal):
            self._timers.clear(("granted", wanted.message))
            _, reason, period, fragments, other, rival = msgspec.structs.astuple(outcome)
            return Refuse(wanted.message, wanted.serial, int(reason), fragments, period, other, rival)
        lease = self.lease
        self._timers.set(("granted", wanted.message), now + lease)
        start = self._cycle.counter + (0 if outcome == held else _AHEAD)  # what it had is in all masks already
        _, period, phase, fragments = msgspec.structs.astuple(outcome)
        return Grant(wanted.message, wanted.serial, fragments, period, phase, start, epoch, lease // MILLISECOND)

    def renew(self, now: int, wanted: Renew, id8: int) -> Renewed:
        """Extend the leases that a module still needs. Those without a grant are missing in the answer."""
        held = [high for high in wanted.highs if high and self.calendar.get(rtcan.message_id(high, id8)) is not None]
        lease = self.lease
        for high in held:
            self._timers.set(("granted", rtcan.message_id(high, id8)), now + lease)
        return Renewed(id8, wanted.serial, lease // MILLISECOND, bytes(held).ljust(management.RENEW_MAX, b"\0"))

    def remove(self, message: int) -> None:
        """Free the slots of a message: its owner gave them back, or did not renew the lease."""
        self.calendar.remove(message)
        self._timers.clear(("granted", message))


class SlotRequests:
    """The owner's side: slots for the periodic messages of this node, which go by its own clock without slots.

    `ask` sends a request to the master, which may be this node; `abandon` gives up a message that waits for its slot.
    """

    def __init__(
        self,
        context: EngineContext,
        plan: SlotPlan,
        ask: Callable[[int, Reserve | Renew], None],
        abandon: Callable[[int, PeriodicMessage, str], None],
    ) -> None:
        self.has_master = False
        """True if there is a master to ask."""
        self._cycle = context.cycle
        self._plan = plan
        self._timers = context.timers
        self._periodics = plan.periodics
        self._actions = context.actions
        self._ask = ask
        self._abandon = abandon
        self._enabled = context.settings.reserves
        self._serial = 0

    def start(self, now: int, periodic: PeriodicMessage) -> None:
        """Request slots, and let the message go without until they are granted."""
        periodic.exact = asked_exactly(periodic.interval, self._cycle.timing.slot, self._cycle.timing.slots)
        self.schedule(now, periodic)
        self._start_ticking(now, periodic)

    def on_timer(self, now: int, kind: str, periodic: PeriodicMessage) -> None:
        """Request slots once more, give up slots whose lease has ended, or ask for data by the node's own clock."""
        if kind == "ask":
            self.request(now, periodic)
        elif kind == "lease":
            self.suspend(now, periodic, "the master does not answer")
            self.start(now, periodic)
        elif not periodic.active or self._cycle.counter < periodic.from_cycle:
            # In phase with the ticks before, however late this one is.
            at = now if periodic.tick is None else now - (now - periodic.tick) % periodic.interval
            periodic.tick = at + periodic.interval
            periodic.ticked = True
            self._timers.set(("tick", periodic.high), periodic.tick)
            self._actions.append(Due(periodic.high, at, False))

    def resume(self, now: int) -> None:
        """Request slots, now that there is a master."""
        self.has_master = True
        for each in self._periodics.values():
            each.exact = asked_exactly(each.interval, self._cycle.timing.slot, self._cycle.timing.slots)
            self.schedule(now, each)

    def pause(self, now: int, reason: str) -> None:
        """Suspend all slots while the bus has no master."""
        self.has_master = False
        for each in self._periodics.values():
            self.suspend(now, each, reason)

    def revoke_all(self, now: int, reason: str) -> None:
        """Give up all slots: they were granted in another network."""
        for each in self._periodics.values():
            self.revoke(now, each, reason)

    def schedule(self, now: int, periodic: PeriodicMessage) -> None:
        """Request slots for this message from now on, if there is a master."""
        if self.has_master and self._enabled:
            self._timers.set(("ask", periodic.high), now)

    def periodic_with(self, message: int) -> PeriodicMessage | None:
        """The periodic message of this node with this message id."""
        periodic = self._periodics.get(rtcan.high_byte(message))
        return periodic if periodic is not None and periodic.message == message else None

    def forget(self, periodic: PeriodicMessage) -> bool:
        """Drop a message that has ended; return whether it had slots."""
        had = periodic.reservation is not None
        periodic.reservation = None
        periodic.active = False
        for kind in "ask", "lease", "tick":
            self._timers.clear((kind, periodic.high))
        self._plan.invalidate()
        return had

    def request(self, now: int, periodic: PeriodicMessage) -> None:
        """Request slots from the master, and again after a while: its former ones, or any."""
        if not self.has_master or periodic.active:
            return
        self._timers.set(("ask", periodic.high), now + _RETRY)
        serial = self._next_serial(now, periodic)
        held = periodic.reservation
        if held is not None:
            self._ask(now, Reserve(periodic.message, serial, held.fragments, held.period, held.phase))
            return
        period = min(periodic.interval // self._cycle.timing.slot, NO_PHASE - 1)
        flags = 0 if periodic.exact else management.RESERVE_ROUND_DOWN
        self._ask(now, Reserve(periodic.message, serial, periodic.fragments, period, flags=flags))

    def renew(self, now: int) -> None:
        """Renew the slots that are still needed."""
        active = [each for each in self._periodics.values() if each.active]
        if not self.has_master or not active:
            return
        self._timers.set("renew", now + max(_RENEWAL, min(each.lease for each in active) // _RENEWALS))
        for first in range(0, len(active), management.RENEW_MAX):
            part = active[first : first + management.RENEW_MAX]
            highs = bytes(each.high for each in part).ljust(management.RENEW_MAX, b"\0")
            self._ask(now, Renew(self._next_serial(now, *part), highs))

    def on_grant(self, now: int, periodic: PeriodicMessage, grant: Grant) -> None:
        """Use granted slots. The lease runs from the request, as a grant takes time on a full bus."""
        asked = periodic.asked.get(grant.serial)
        if asked is None or grant.fragments != periodic.fragments or grant.period <= grant.fragments:
            return
        self._confirm(periodic, asked, grant.lease_ms)
        if periodic.active:
            return
        periodic.reservation = Reservation(periodic.message, grant.period, grant.phase, grant.fragments)
        periodic.refused = ""
        self._timers.clear(("ask", periodic.high))
        if "renew" not in self._timers:
            self._timers.set("renew", now + _RENEWAL)
        periodic.active = True
        periodic.restart()
        periodic.from_cycle = max(grant.from_cycle, self._cycle.counter + 1)
        self._plan.invalidate()
        interval = grant.period * self._cycle.timing.slot
        self._actions.append(SlotsGranted(periodic.high, grant.period, grant.phase, interval))

    def on_renewed(self, now: int, answer: Renewed) -> None:
        """Extend the leases that the master renews, perhaps late. Slots unknown to it are requested again."""
        for periodic in self._periodics.values():
            asked = periodic.asked.get(answer.serial)
            if asked is None or not periodic.active:
                continue
            if periodic.high in answer.highs:
                self._confirm(periodic, asked, answer.lease_ms)
            elif asked > periodic.confirmed:  # else the answer is older than the grant
                self.suspend(now, periodic, "the master does not know of it")
                self.schedule(now, periodic)

    def on_refuse(self, now: int, periodic: PeriodicMessage, refuse: Refuse) -> None:
        """Give up slots that the master refuses, and ask again later, when they may be free."""
        if periodic.active or refuse.serial not in periodic.asked:
            return
        self._start_ticking(now, periodic)
        try:
            reason = RefuseReason(refuse.reason)
        except ValueError:  # of a newer version
            return
        if periodic.exact and periodic.reservation is None:
            periodic.exact = False  # ask again, for a shorter one
            self._timers.set(("ask", periodic.high), now)
            return
        period, fragments, other, rival = refuse.period, refuse.fragments, refuse.other, refuse.rival
        text = Refusal(periodic.message, reason, period, fragments, other, rival).text
        self.revoke(now, periodic, text)
        # Other slots than the taken ones may well be free, so ask soon.
        self._timers.set(("ask", periodic.high), now + (_RETRY if reason is RefuseReason.TAKEN else _RENEWAL))
        if periodic.refused != text:
            periodic.refused = text
            self._actions.append(SlotsRefused(periodic.high, text))

    def revoke(self, now: int, periodic: PeriodicMessage, reason: str) -> None:
        """Give up the slots of a message. Answers to earlier requests no longer count."""
        periodic.reservation = None
        periodic.asked.clear()
        self.suspend(now, periodic, reason)

    def suspend(self, now: int, periodic: PeriodicMessage, reason: str) -> None:
        """Stop using the slots of a message until a master has confirmed them."""
        self._timers.clear(("lease", periodic.high))
        if periodic.active:
            periodic.active = False
            if periodic.payload is not None:
                self._abandon(now, periodic, "slots lost")
            periodic.restart()
            self._plan.invalidate()
            self._actions.append(SlotsLost(periodic.high, reason))

    def _start_ticking(self, now: int, periodic: PeriodicMessage) -> None:
        if ("tick", periodic.high) not in self._timers:
            self._timers.set(("tick", periodic.high), now)

    def _next_serial(self, now: int, *periodics: PeriodicMessage) -> int:
        self._serial = (self._serial + 1) % management.REQUEST_SERIALS
        for each in periodics:
            # Late answers to requests within a lease count; older ones would grant an expired lease.
            each.asked = {serial: at for serial, at in each.asked.items() if now < at + each.lease}
            each.asked[self._serial] = now
        return self._serial

    def _confirm(self, periodic: PeriodicMessage, asked: int, lease_ms: int) -> None:
        if asked >= periodic.confirmed:  # answers may come out of order
            periodic.confirmed, periodic.lease = asked, lease_ms * MILLISECOND
            self._timers.set(("lease", periodic.high), asked + periodic.lease)


def frames_needed(owners: int) -> int:
    """Return how many free slots a second it takes at least to keep the slots of so many modules."""
    return _MASTER_FRAMES + _OWNER_FRAMES * owners


def owners_kept(free: float) -> int:
    """Return of how many modules so many free slots a second keep the slots; a master refuses those of others."""
    return max(0, int(free - _MASTER_FRAMES) // _OWNER_FRAMES)


def _set_bits(bits: int) -> Iterable[int]:
    while bits:
        yield (bits & -bits).bit_length() - 1
        bits &= bits - 1
