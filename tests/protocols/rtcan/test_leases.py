"""Answers of the master that come late, or out of order."""

from r2p.codecs import management
from r2p.codecs.management import Grant, Renew, Renewed, Reserve
from r2p.protocols.rtcan.calendar import Reason
from r2p.protocols.rtcan.context import EngineContext
from r2p.protocols.rtcan.events import EngineSettings, SlotsGranted, SlotsLost, SlotsRefused
from r2p.protocols.rtcan.leases import LEASE, SlotRequests
from r2p.protocols.rtcan.plan import PeriodicMessage, SlotPlan

SECOND = 1_000_000_000
HIGH, MESSAGE = 5, 0x050A


class Owner:
    """One periodic message, and what it has asked for; nothing of that goes anywhere."""

    def __init__(self) -> None:
        self.asked: list[Reserve | Renew] = []
        self.abandoned: list[int] = []
        self.periodic = PeriodicMessage(HIGH, MESSAGE, 8, 1, 10_000_000, 0, None)
        context = EngineContext(EngineSettings(number=1))
        plan = SlotPlan(context.timing)
        plan.periodics[HIGH] = self.periodic
        self.out, self.timers = context.actions, context.timers
        self.requests = SlotRequests(
            context,
            plan,
            lambda now, wanted: self.asked.append(wanted),
            lambda now, periodic: self.abandoned.append(now),
        )
        self.requests.has_master = True

    def ask(self, now: int) -> int:
        """A request; comes back: its serial."""
        self.requests.request(now, self.periodic)
        return self.asked[-1].serial

    def renew(self, now: int) -> int:
        self.requests.renew(now)
        return self.asked[-1].serial

    def grant(self, now: int, serial: int) -> None:
        self.requests.on_grant(now, self.periodic, Grant(MESSAGE, serial, 1, 60, 1, 3, 77, LEASE // 1_000_000))

    def renewed(self, now: int, serial: int, *highs: int) -> None:
        data = bytes(highs).ljust(management.RENEW_MAX, b"\0")
        self.requests.on_renewed(now, Renewed(10, serial, LEASE // 1_000_000, data))

    def lease(self) -> int | None:
        """When it ends."""
        while (at := self.timers.next()) is not None:
            if ("lease", HIGH) in list(self.timers.pop(at)):
                return at
        return None


def test_a_grant_counts_though_it_was_asked_again_meanwhile() -> None:
    """On a full bus answers take longer than the next request; if only the last one counted, there were never slots."""
    owner = Owner()
    first = owner.ask(0)
    owner.ask(SECOND // 4)
    owner.grant(SECOND // 3, first)
    assert owner.out == [SlotsGranted(HIGH, 60, 1, 9_960_000)]
    assert owner.lease() == LEASE  # from the request on that was answered


def test_a_renewal_counts_though_it_was_asked_again_meanwhile() -> None:
    owner = Owner()
    owner.grant(0, owner.ask(0))
    late = owner.renew(SECOND)
    owner.renew(2 * SECOND)
    owner.renewed(5 * SECOND // 2, late, HIGH)
    assert owner.lease() == SECOND + LEASE


def test_an_older_answer_does_not_shorten_a_lease() -> None:
    owner = Owner()
    owner.grant(0, owner.ask(0))
    serials = [owner.renew(n * SECOND) for n in (1, 2)]
    for serial in reversed(serials):
        owner.renewed(2 * SECOND, serial, HIGH)
    assert owner.lease() == 2 * SECOND + LEASE


def test_an_older_answer_does_not_end_a_lease() -> None:
    """The master did not know of it yet when it wrote that."""
    owner = Owner()
    owner.grant(0, owner.ask(0))
    before = owner.renew(SECOND)
    owner.requests.suspend(SECOND, owner.periodic, "another master")
    owner.grant(2 * SECOND, owner.ask(2 * SECOND))
    owner.renewed(2 * SECOND, before)
    assert owner.periodic.active
    owner.renewed(3 * SECOND, owner.renew(3 * SECOND))
    assert not owner.periodic.active
    assert owner.out[-1] == SlotsLost(HIGH, "the master does not know of it")


def test_answers_without_a_request_change_nothing() -> None:
    owner = Owner()
    serial = owner.ask(0)
    owner.grant(0, serial + 1)
    owner.renewed(0, serial, HIGH)
    refusal = management.Refuse(MESSAGE, serial, int(Reason.FULL), 1, 60)
    owner.requests.on_refuse(0, owner.periodic, refusal)
    owner.requests.on_refuse(0, owner.periodic, refusal)
    owner.grant(0, serial)  # to what was refused
    assert [type(each) for each in owner.out] == [SlotsRefused]
    forgotten = owner.ask(4 * SECOND)
    owner.ask(4 * SECOND + LEASE)
    owner.grant(4 * SECOND + LEASE, forgotten)
    assert not owner.periodic.active


def test_what_waits_for_a_slot_that_is_lost_is_given_up() -> None:
    owner = Owner()
    owner.grant(0, owner.ask(0))
    owner.periodic.restart(b"12345678")
    owner.requests.suspend(SECOND, owner.periodic, "another master")
    owner.requests.suspend(SECOND, owner.periodic, "another master")
    assert owner.abandoned == [SECOND]
    assert owner.periodic.payload is None
