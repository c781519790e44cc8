"""Slots on lease: the node asks the master for slots, and says every second which ones it still wants.

Both sides are here: `SlotRequests` at the owner of periodic messages, `SlotGrants` at the master. A lease lasts 3 s
from the request on, for its owner, and from the grant on for the master, so an owner that hears nothing stops first.
A new master of the same epoch grants to those who had slots what they had; for three cycles it grants nothing else.
"""

from collections.abc import Callable

from r2p.codecs import management, rtcan
from r2p.codecs.management import NO_PHASE, Grant, Refuse, Renew, Renewed, Reserve
from r2p.protocols.rtcan.calendar import Calendar, Reason, Refusal, Reservation
from r2p.protocols.rtcan.cycle import Cycle
from r2p.protocols.rtcan.events import LONG_AGO, Action, Degraded, Granted, Refused
from r2p.protocols.rtcan.plan import PeriodicMessage, SlotPlan
from r2p.protocols.timers import KeyedTimers

LEASE = 3_000_000_000
_RENEWAL = 1_000_000_000
_RETRY = 250_000_000
_AHEAD = 1
"""Cycles from a grant to its first slot."""


class SlotGrants:
    """The master's side: who has which slots, and until when."""

    def __init__(self, cycle: Cycle, timers: KeyedTimers) -> None:
        self.calendar = Calendar(cycle.timing.slots)
        self.collecting = False
        """Only what another master granted is granted now."""
        self._cycle = cycle
        self._timers = timers

    def clear(self) -> None:
        for each in list(self.calendar):
            self.remove(each.message)

    def answer(self, now: int, wanted: Reserve, epoch: int) -> Grant | Refuse | None:
        """Grant or refuse; None: not now."""
        held = self.calendar.get(wanted.message)
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
        start = self._cycle.counter + (0 if outcome == held else _AHEAD)
        return Grant(wanted.message, wanted.serial, fragments, period, phase, start, epoch, LEASE // 1_000_000)

    def renew(self, now: int, wanted: Renew, id8: int) -> Renewed:
        """A module still wants what it was granted."""
        held = [high for high in wanted.highs if high and self.calendar.get(rtcan.message_id(high, id8)) is not None]
        for high in held:
            self._timers.set(("granted", rtcan.message_id(high, id8)), now + LEASE)
        return Renewed(id8, wanted.serial, LEASE // 1_000_000, bytes(held).ljust(management.RENEW_MAX, b"\0"))

    def remove(self, message: int) -> None:
        """Its owner gave them back, or was silent for too long."""
        self.calendar.remove(message)
        self._timers.clear(("granted", message))


class SlotRequests:
    """The owner's side: what this node wants slots for. `ask` sends a request to the master, which may be this node.

    `abandon` gives up a message that waits for its slot. Not `enabled`: it wants nothing.
    """

    def __init__(
        self,
        cycle: Cycle,
        agenda: SlotPlan,
        timers: KeyedTimers,
        periodics: dict[int, PeriodicMessage],
        out: list[Action],
        ask: Callable[[int, Reserve | Renew], None],
        abandon: Callable[[int, PeriodicMessage], None],
        *,
        enabled: bool = True,
    ) -> None:
        self.open = False
        """Whether there is a master to ask."""
        self._cycle = cycle
        self._agenda = agenda
        self._timers = timers
        self._periodics = periodics
        self._out = out
        self._ask = ask
        self._abandon = abandon
        self._enabled = enabled
        self._serial = 0
        self._asked: dict[int, dict[int, int]] = {}  # by high byte: when it was asked, by serial
        self._confirmed: dict[int, int] = {}  # by high byte: when what the master granted was asked
        self._refused: dict[int, str] = {}

    def resume(self, now: int) -> None:
        """There is a master to ask."""
        self.open = True
        for each in self._periodics.values():
            self.want(now, each)

    def pause(self, now: int, reason: str) -> None:
        """There is none: nobody has slots."""
        self.open = False
        for each in self._periodics.values():
            self.suspend(now, each, reason)

    def void(self, now: int, reason: str) -> None:
        """What was granted is worth nothing any more."""
        for each in self._periodics.values():
            self.lapse(now, each, reason)

    def want(self, now: int, periodic: PeriodicMessage) -> None:
        """Ask for slots for this message, now and again, if there is a master."""
        if self.open and self._enabled:
            self._timers.set(("ask", periodic.high), now)

    def forget(self, periodic: PeriodicMessage) -> bool:
        """It does not need any slots any more. Says whether it had some."""
        had = periodic.reservation is not None
        periodic.reservation = None
        periodic.active = False
        for kind in "ask", "lease":
            self._timers.clear((kind, periodic.high))
        self._asked.pop(periodic.high, None)
        self._confirmed.pop(periodic.high, None)
        self._refused.pop(periodic.high, None)
        self._agenda.changed()
        return had

    def request(self, now: int, periodic: PeriodicMessage) -> None:
        """It is time to ask."""
        if not self.open or periodic.active:
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
        """It is time to say what is still wanted."""
        highs = [each.high for each in self._periodics.values() if each.active]
        if not self.open or not highs:
            return
        self._timers.set("renew", now + _RENEWAL)
        for first in range(0, len(highs), management.RENEW_MAX):
            part = bytes(highs[first : first + management.RENEW_MAX])
            serial = self._next_serial(now, *part)
            self._ask(now, Renew(serial, part.ljust(management.RENEW_MAX, b"\0")))

    def granted(self, now: int, periodic: PeriodicMessage, grant: Grant) -> None:
        """The master answered, be it late: the lease runs from the request on that it answers."""
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
        self._agenda.changed()
        interval = grant.period * self._cycle.timing.slot
        self._out.append(Granted(periodic.high, grant.period, grant.phase, interval))

    def renewed(self, now: int, answer: Renewed) -> None:
        """The master answered, be it late. What it does not know any more has to be asked for anew."""
        for high, asked_at in list(self._asked.items()):
            periodic, asked = self._periodics.get(high), asked_at.get(answer.serial)
            if asked is None or periodic is None or not periodic.active:
                continue
            if high in answer.highs:
                self._confirm(periodic, asked, answer.lease_ms)
            elif asked > self._confirmed.get(high, LONG_AGO):
                self.suspend(now, periodic, "the master does not know of it")
                self.want(now, periodic)

    def refused(self, now: int, periodic: PeriodicMessage, refuse: Refuse) -> None:
        """The master answered: no."""
        if periodic.active or refuse.serial not in self._asked.get(periodic.high, {}):
            return
        try:
            reason = Reason(refuse.reason)
        except ValueError:
            return
        period, fragments, other, rival = refuse.period, refuse.fragments, refuse.other, refuse.rival
        text = Refusal(periodic.message, reason, period, fragments, other, rival).text
        self.lapse(now, periodic, text)
        self._timers.set(("ask", periodic.high), now + (_RETRY if reason == Reason.TAKEN else _RENEWAL))
        if self._refused.get(periodic.high) != text:
            self._refused[periodic.high] = text
            self._out.append(Refused(periodic.high, text))

    def lapse(self, now: int, periodic: PeriodicMessage, reason: str) -> None:
        """Its slots are gone. What was answered to earlier requests does not count any more."""
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
            self._agenda.changed()
            self._out.append(Degraded(periodic.high, reason))

    def _next_serial(self, now: int, *highs: int) -> int:
        self._serial = self._serial + 1 & 0xFF
        for high in highs:
            asked = {serial: at for serial, at in self._asked.get(high, {}).items() if now < at + LEASE}
            self._asked[high] = asked | {self._serial: now}
        return self._serial

    def _confirm(self, periodic: PeriodicMessage, asked: int, lease_ms: int) -> None:
        """The lease runs on; answers may come out of order."""
        if asked >= self._confirmed.get(periodic.high, LONG_AGO):
            self._confirmed[periodic.high] = asked
            self._timers.set(("lease", periodic.high), asked + lease_ms * 1_000_000)
