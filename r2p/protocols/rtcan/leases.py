"""Slots on lease: the node asks the master for slots, and says every second which ones it still needs.

Both sides are here: `SlotRequests` at the owner of periodic messages, `SlotGrants` at the master. A lease lasts 3 s,
for its owner from the request on, for the master from the grant on: so an owner without answers stops first. A new
master of the same epoch renews the grants of the last one; for three cycles it grants nothing else.
"""

from collections.abc import Callable

from r2p.codecs import management, rtcan
from r2p.codecs.management import NO_PHASE, Grant, Refuse, Renew, Renewed, Reserve
from r2p.protocols.rtcan.calendar import Calendar, Reason, Refusal, Reservation
from r2p.protocols.rtcan.context import EngineContext
from r2p.protocols.rtcan.events import SlotsGranted, SlotsLost, SlotsRefused
from r2p.protocols.rtcan.plan import PeriodicMessage, SlotPlan
from r2p.units import LONG_AGO, MILLISECOND, SECOND

LEASE = 3_000_000_000  # ns, as the next two: two renewals may be lost
_RENEWAL = SECOND
_RETRY = 250_000_000
_SERIALS = 256  # the serial of a request is a byte
_AHEAD = 1  # cycles from a grant to its first slot: by then all nodes have the new mask


class SlotGrants:
    """The master's side: the slots that are granted, and until when."""

    def __init__(self, context: EngineContext) -> None:
        self.calendar = Calendar(context.timing.slots)
        self.collecting = False
        """Whether only grants of another master are renewed for now."""
        self._cycle = context.cycle
        self._timers = context.timers

    def clear(self) -> None:
        """Forget all grants."""
        for each in list(self.calendar):
            self.remove(each.message)

    def answer(self, now: int, wanted: Reserve, epoch: int) -> Grant | Refuse | None:
        """Grant or refuse; None: not now."""
        held = self.calendar.get(wanted.message)
        # With a phase: slots that it had, perhaps by the last master. It gets the same ones or none.
        outcome: Reservation | Refusal
        if wanted.phase != NO_PHASE:
            reservation = Reservation(wanted.message, wanted.period, wanted.phase, wanted.fragments)
            outcome = self.calendar.readmit(reservation)
        elif self.collecting and held is None:
            return None
        else:
            round_down = bool(wanted.flags & management.RESERVE_ROUND_DOWN)
            outcome = self.calendar.admit(wanted.message, wanted.period, wanted.fragments, round_down=round_down)
        if isinstance(outcome, Refusal):
            self._timers.clear(("granted", wanted.message))
            reason = int(outcome.reason)
            period, fragments, other, rival = outcome.period, outcome.fragments, outcome.other, outcome.rival
            return Refuse(wanted.message, wanted.serial, reason, fragments, period, other, rival)
        self._timers.set(("granted", wanted.message), now + LEASE)
        period, phase, fragments = outcome.period, outcome.phase, outcome.fragments
        start = self._cycle.counter + (0 if outcome == held else _AHEAD)  # what it had is in all masks already
        return Grant(wanted.message, wanted.serial, fragments, period, phase, start, epoch, LEASE // MILLISECOND)

    def renew(self, now: int, wanted: Renew, id8: int) -> Renewed:
        """A module still needs its slots: prolong their leases. Those without a grant are missing in the answer."""
        held = [high for high in wanted.highs if high and self.calendar.get(rtcan.message_id(high, id8)) is not None]
        for high in held:
            self._timers.set(("granted", rtcan.message_id(high, id8)), now + LEASE)
        return Renewed(id8, wanted.serial, LEASE // MILLISECOND, bytes(held).ljust(management.RENEW_MAX, b"\0"))

    def remove(self, message: int) -> None:
        """The slots of a message come free: its owner gave them back, or did not renew the lease."""
        self.calendar.remove(message)
        self._timers.clear(("granted", message))


class SlotRequests:
    """The owner's side: slots for the periodic messages of this node.

    `ask` sends a request to the master, which may be this node; `abandon` gives up a message that waits for its slot.
    """

    def __init__(
        self,
        context: EngineContext,
        plan: SlotPlan,
        ask: Callable[[int, Reserve | Renew], None],
        abandon: Callable[[int, PeriodicMessage], None],
    ) -> None:
        self.has_master = False
        """Whether there is a master to ask."""
        self._cycle = context.cycle
        self._plan = plan
        self._timers = context.timers
        self._periodics = plan.periodics
        self._actions = context.actions
        self._ask = ask
        self._abandon = abandon
        self._enabled = context.settings.reserves
        self._serial = 0
        self._asked: dict[int, dict[int, int]] = {}  # by high byte: when slots were asked for, by serial
        self._confirmed: dict[int, int] = {}  # by high byte: when the request was sent that was granted last
        self._refused: dict[int, str] = {}  # by high byte: the reason of the last `SlotsRefused`

    def resume(self, now: int) -> None:
        """There is a master: ask it for slots."""
        self.has_master = True
        for each in self._periodics.values():
            self.schedule(now, each)

    def pause(self, now: int, reason: str) -> None:
        """Note that there is no master, so that no slots may be used."""
        self.has_master = False
        for each in self._periodics.values():
            self.suspend(now, each, reason)

    def revoke_all(self, now: int, reason: str) -> None:
        """All slots are gone: they were granted in another network."""
        for each in self._periodics.values():
            self.revoke(now, each, reason)

    def schedule(self, now: int, periodic: PeriodicMessage) -> None:
        """Ask for slots for this message from now on, if there is a master."""
        if self.has_master and self._enabled:
            self._timers.set(("ask", periodic.high), now)

    def periodic_with(self, message: int) -> PeriodicMessage | None:
        """The periodic message of this node with this message id."""
        periodic = self._periodics.get(rtcan.high_byte(message))
        return periodic if periodic is not None and periodic.message == message else None

    def forget(self, periodic: PeriodicMessage) -> bool:
        """The message ends. Says whether it had slots."""
        had = periodic.reservation is not None
        periodic.reservation = None
        periodic.active = False
        for kind in "ask", "lease":
            self._timers.clear((kind, periodic.high))
        self._asked.pop(periodic.high, None)
        self._confirmed.pop(periodic.high, None)
        self._refused.pop(periodic.high, None)
        self._plan.invalidate()
        return had

    def request(self, now: int, periodic: PeriodicMessage) -> None:
        """Ask the master for slots, and again after a while: for those that it had, or for any."""
        if not self.has_master or periodic.active:
            return
        self._timers.set(("ask", periodic.high), now + _RETRY)
        serial = self._next_serial(now, periodic.high)
        held = periodic.reservation
        if held is not None:
            self._ask(now, Reserve(periodic.message, serial, held.fragments, held.period, held.phase))
            return
        period = min(periodic.interval // self._cycle.timing.slot, NO_PHASE - 1)
        flags = management.RESERVE_ROUND_DOWN
        self._ask(now, Reserve(periodic.message, serial, periodic.fragments, period, flags=flags))

    def renew(self, now: int) -> None:
        """Tell the master which slots are still needed."""
        highs = [each.high for each in self._periodics.values() if each.active]
        if not self.has_master or not highs:
            return
        self._timers.set("renew", now + _RENEWAL)
        for first in range(0, len(highs), management.RENEW_MAX):
            part = bytes(highs[first : first + management.RENEW_MAX])
            serial = self._next_serial(now, *part)
            self._ask(now, Renew(serial, part.ljust(management.RENEW_MAX, b"\0")))

    def on_grant(self, now: int, periodic: PeriodicMessage, grant: Grant) -> None:
        """The master grants slots. On a full bus that takes time: the lease runs from the request on."""
        asked = self._asked.get(periodic.high, {}).get(grant.serial)
        if asked is None or grant.fragments != periodic.fragments or grant.period <= grant.fragments:
            return
        if periodic.active:
            self._confirm(periodic, asked, grant.lease_ms)
            return
        periodic.reservation = Reservation(periodic.message, grant.period, grant.phase, grant.fragments)
        self._refused.pop(periodic.high, None)
        self._timers.clear(("ask", periodic.high))
        self._confirm(periodic, asked, grant.lease_ms)
        if "renew" not in self._timers:
            self._timers.set("renew", now + _RENEWAL)
        periodic.active = True
        periodic.restart()
        periodic.from_cycle = max(grant.from_cycle, self._cycle.counter + 1)
        self._plan.invalidate()
        interval = grant.period * self._cycle.timing.slot
        self._actions.append(SlotsGranted(periodic.high, grant.period, grant.phase, interval))

    def on_renewed(self, now: int, answer: Renewed) -> None:
        """The master prolongs leases, perhaps late. Slots that it no longer knows are requested again."""
        for high, asked_at in list(self._asked.items()):
            periodic, asked = self._periodics.get(high), asked_at.get(answer.serial)
            if asked is None or periodic is None or not periodic.active:
                continue
            if high in answer.highs:
                self._confirm(periodic, asked, answer.lease_ms)
            elif asked > self._confirmed.get(high, LONG_AGO):  # else the answer is older than the grant
                self.suspend(now, periodic, "the master does not know of it")
                self.schedule(now, periodic)

    def on_refuse(self, now: int, periodic: PeriodicMessage, refuse: Refuse) -> None:
        """The master refuses slots."""
        if periodic.active or refuse.serial not in self._asked.get(periodic.high, {}):
            return
        try:
            reason = Reason(refuse.reason)
        except ValueError:  # of a newer version
            return
        period, fragments, other, rival = refuse.period, refuse.fragments, refuse.other, refuse.rival
        text = Refusal(periodic.message, reason, period, fragments, other, rival).text
        self.revoke(now, periodic, text)
        self._timers.set(("ask", periodic.high), now + (_RETRY if reason == Reason.TAKEN else _RENEWAL))
        if self._refused.get(periodic.high) != text:
            self._refused[periodic.high] = text
            self._actions.append(SlotsRefused(periodic.high, text))

    def revoke(self, now: int, periodic: PeriodicMessage, reason: str) -> None:
        """Its slots are gone. Answers to earlier requests no longer count."""
        periodic.reservation = None
        self._asked.pop(periodic.high, None)
        self.suspend(now, periodic, reason)

    def suspend(self, now: int, periodic: PeriodicMessage, reason: str) -> None:
        """Its slots may not be used until a master has confirmed them."""
        self._timers.clear(("lease", periodic.high))
        if periodic.active:
            periodic.active = False
            if periodic.payload is not None:
                self._abandon(now, periodic)
            periodic.restart()
            self._plan.invalidate()
            self._actions.append(SlotsLost(periodic.high, reason))

    def _next_serial(self, now: int, *highs: int) -> int:
        self._serial = (self._serial + 1) % _SERIALS
        for high in highs:
            # Late answers to all requests of the last 3 s count; older ones would grant a lease that is over.
            asked = {serial: at for serial, at in self._asked.get(high, {}).items() if now < at + LEASE}
            self._asked[high] = asked | {self._serial: now}
        return self._serial

    def _confirm(self, periodic: PeriodicMessage, asked: int, lease_ms: int) -> None:
        """The lease runs on; answers may come out of order."""
        if asked >= self._confirmed.get(periodic.high, LONG_AGO):
            self._confirmed[periodic.high] = asked
            self._timers.set(("lease", periodic.high), asked + lease_ms * MILLISECOND)
