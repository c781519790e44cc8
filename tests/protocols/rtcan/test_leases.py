"""Hard real-time messages: slots of their own, on lease, and what becomes of them."""

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from r2p.codecs import management, rtcan
from r2p.codecs.management import Grant, RefuseReason, Renew, Renewed, Reserve
from r2p.protocols.rtcan.calendar import PeriodRule, Reservation, occupied
from r2p.protocols.rtcan.cycle import timing
from r2p.protocols.rtcan.events import (
    Done,
    Due,
    EngineContext,
    EngineSettings,
    Fate,
    ForeignSyncs,
    SlotsGranted,
    SlotsLost,
    SlotsRefused,
)
from r2p.protocols.rtcan.leases import LEASE, PeriodicMessage, SlotPlan, SlotRequests
from tests.protocols.rtcan.bus import MS, SECOND, Bus
from tests.protocols.rtcan.networks import CYCLE, SLOT, TOPIC, counted, is_sync, network, starts, syncs

MESSAGE = 0x050A


@pytest.mark.parametrize("lead", [0, 1, 500_000, 3 * MS, SECOND])
@pytest.mark.parametrize("size", [3, 8, 16, 20])
def test_a_periodic_message_owns_its_slots(size: int, lead: int) -> None:
    bus = Bus()
    _master, owner, listener = network(bus, 1, 0, 0)
    filled = counted(owner, size)
    listener.engine.subscribe(rtcan.message_id(TOPIC, 11), size)
    owner.act(owner.engine.reserve(owner.now, TOPIC, size, 5 * MS, lead=lead, handle="hrt"))
    bus.run(20 * MS)
    (granted,) = owner.of(SlotsGranted)
    phase = granted.phase
    assert granted == SlotsGranted(TOPIC, 30, phase, 30 * SLOT)
    begin = bus.now
    bus.run(SECOND)
    fragments = rtcan.fragment_count(size)
    at = [start for start in starts(bus, TOPIC, 0) if start > begin]
    reference = syncs(bus, begin)[0][0]
    assert {(start - reference) % (30 * SLOT) for start in at} == {SLOT * (phase + n) for n in range(fragments)}
    assert abs(len(at) - fragments * SECOND // (30 * SLOT)) <= fragments
    got = listener.received(TOPIC)
    assert got == sorted(got, key=filled.index)  # never an old one after a newer one
    assert len(filled) - len(got) <= 2
    assert owner.engine.counts["missed"] <= 1  # what still waited without slots when it got them
    asked = {due.at for due in owner.of(Due) if due.slotted}
    assert set(at[::fragments]) <= asked


def test_the_master_has_slots_too_and_none_is_given_twice() -> None:
    bus = Bus()
    nodes = network(bus, 1, 0, 0, periods=PeriodRule.HARMONIC)
    for high, period in ((2, MS), (3, 5 * MS), (4, 10 * MS)):
        for node in nodes:
            counted(node)
            node.act(node.engine.reserve(node.now, high, 8, period))
        bus.run(100 * MS)
    phases = sorted((g.period, g.phase) for node in nodes for g in node.of(SlotsGranted))
    assert phases == [(6, 1), (6, 2), (6, 3), (30, 4), (30, 5), (30, 6), (60, 10), (60, 11), (60, 12)]  # thesis 4.4.1
    begin = bus.now
    bus.run(20 * CYCLE)
    hrt = [at for at, frame, _ in bus.sent if frame.id >> 23 == 0 and at > begin and not is_sync(frame)]
    assert len(hrt) == pytest.approx(20 * 39, abs=39)
    assert all(node.engine.counts["missed"] == 0 for node in nodes)
    mask = nodes[2].engine.cycle.mask
    assert mask is not None
    assert (mask >> 1).bit_count() == 39


def test_a_refusal_says_why_and_the_message_goes_as_a_soft_one() -> None:
    bus = Bus()
    master, owner = network(bus, 1, 0)
    counted(owner, 400)
    owner.engine.reserve(owner.now, TOPIC, 400, 5 * MS)
    bus.run(100 * MS)
    (refused,) = owner.of(SlotsRefused)
    assert "a period of 30 slots" in refused.reason
    assert {frame.id >> 23 for _, frame, _ in bus.sent if frame.id >> 15 & 0xFF == TOPIC} <= set(range(1, 6))
    assert master.engine.cycle.mask == 1


def test_without_a_master_periodic_messages_go_as_soft_ones_with_their_period_as_deadline() -> None:
    bus = Bus()
    a, b = network(bus, 0, 0)
    filled = counted(a)
    b.engine.subscribe(rtcan.message_id(TOPIC, 10), 8)
    a.act(a.engine.reserve(a.now, TOPIC, 8, 10 * MS, handle="periodic"))
    bus.run(SECOND)
    assert b.received(TOPIC) == filled[:-1]
    assert len(filled) == 101
    assert {frame.id >> 23 for _, frame, _ in bus.sent if frame.id >> 15 & 0xFF == TOPIC} == {10}
    assert [due.at for due in a.of(Due)] == [a.of(Due)[0].at + n * 10 * MS for n in range(101)]
    assert {(done.handle, done.fate) for done in a.of(Done)} == {("periodic", Fate.SENT)}


def test_a_period_without_data_is_skipped() -> None:
    bus = Bus()
    _, owner = network(bus, 1, 0)
    owner.fill = lambda due: None
    owner.act(owner.engine.reserve(owner.now, TOPIC, 8, MS, lead=MS))
    bus.run(100 * MS)
    assert starts(bus, TOPIC) == []
    assert owner.engine.counts["slots without data"] > 50
    with pytest.raises(ValueError, match="7 bytes for a periodic message of 8"):
        owner.engine.fill(owner.now, TOPIC, bytes(7))


def test_a_missed_slot_abandons_the_message_and_the_next_one_has_fresh_data() -> None:
    bus = Bus()
    _, owner, listener = network(bus, 1, 0, 0)
    filled = counted(owner, 24)
    listener.engine.subscribe(rtcan.message_id(TOPIC, 11), 24)
    owner.act(owner.engine.reserve(owner.now, TOPIC, 24, 10 * MS, handle="hrt"))
    bus.run(100 * MS)
    bus.run_until(lambda: bus.sent[-1][1].id >> 15 & 0xFF == TOPIC and bus.sent[-1][1].id & 0x7F == 2)
    bus.run(150_000)
    before = len(listener.received(TOPIC))
    at = owner.engine.next_deadline()
    assert at is not None
    bus.now = owner.true(at) + 100_000  # the next fragment's interrupt comes 100 us late
    owner.act(owner.engine.poll(owner.now))
    assert owner.of(Done)[-1].fate is Fate.ABANDONED
    assert owner.engine.counts["late_to_slot"] == 1
    abandoned = len(filled)
    bus.run(3 * CYCLE)
    assert listener.received(TOPIC)[before:] == filled[abandoned:][:2]
    assert len(filled) >= abandoned + 2
    assert listener.engine.reassembly.losses[11]["gap"] == 1


def test_slots_are_given_back() -> None:
    bus = Bus()
    master, owner = network(bus, 1, 0)
    counted(owner)
    owner.act(owner.engine.reserve(owner.now, TOPIC, 8, 10 * MS))
    bus.run(100 * MS)
    (granted,) = owner.of(SlotsGranted)
    assert master.engine.cycle.mask == 1 | 1 << granted.phase
    owner.act(owner.engine.release(owner.now, TOPIC))
    bus.run(30 * MS)
    assert master.engine.cycle.mask == 0b1
    assert starts(bus, TOPIC)[-1] < bus.now - 25 * MS


def test_the_slots_of_a_dead_node_come_free_after_3_s() -> None:
    bus = Bus()
    master, owner = network(bus, 1, 0)
    counted(owner)
    owner.act(owner.engine.reserve(owner.now, TOPIC, 8, 10 * MS))
    bus.run(10 * SECOND)
    (granted,) = owner.of(SlotsGranted)
    assert master.engine.cycle.mask == 1 | 1 << granted.phase  # renewed and renewed
    assert owner.of(SlotsLost) == []
    bus.kill(owner)
    other = bus.add(id8=12)  # another node must acknowledge
    bus.start(other)
    bus.run(SECOND)
    assert master.engine.cycle.mask == 1 | 1 << granted.phase
    bus.run(2100 * MS)
    assert master.engine.cycle.mask == 0b1


def test_the_owner_stops_when_the_master_does_not_answer() -> None:
    bus = Bus()
    master, owner = network(bus, 1, 0)
    counted(owner)
    owner.act(owner.engine.reserve(owner.now, TOPIC, 8, 10 * MS))
    bus.run(100 * MS)
    master.deaf = lambda frame: frame.id >> 15 & 0xFF == rtcan.MANAGEMENT
    bus.run(4 * SECOND)
    assert owner.of(SlotsLost) == [SlotsLost(TOPIC, "the master does not answer")]
    assert master.engine.cycle.mask == 0b1
    assert {frame.id >> 23 for at, frame, _ in bus.sent[-50:] if frame.id >> 15 & 0xFF == TOPIC} != {0}
    master.deaf = lambda frame: False
    bus.run(SECOND)
    assert len(owner.of(SlotsGranted)) == 2  # it has asked all the time
    assert starts(bus, TOPIC, 0)[-1] > bus.now - 2 * CYCLE


periodics = st.lists(
    st.builds(
        lambda period, phase, fragments, lead, begins: PeriodicMessage(
            TOPIC,
            0x2105,
            8 * fragments,
            fragments,
            period * SLOT,
            lead * SLOT,
            None,
            reservation=Reservation(0x2105, period, 1 + phase, fragments),
            active=True,
            from_cycle=begins,
        ),
        st.sampled_from([60, 120, 240, 720, 90, 36, 48, 3570]),  # with all of them, the plan repeats after 4 284 cycles
        st.integers(0, 50),
        st.integers(1, 3),
        st.integers(0, 100),
        st.integers(0, 5),
    ),
    max_size=4,
)


@given(periodics, st.integers(0, 3))
def test_a_plan_that_knows_its_cycles_says_what_a_new_one_says(messages: list[PeriodicMessage], gone: int) -> None:
    plan = SlotPlan(timing())
    plan.periodics = dict(enumerate(messages))
    for cycle in range(40):
        if cycle == 30:  # a message loses its slots
            plan.periodics.pop(gone, None)
            plan.invalidate()
        fresh = SlotPlan(timing())
        fresh.periodics = plan.periodics
        plan.begin_cycle(cycle)
        fresh.begin_cycle(cycle)
        assert (plan.sends, plan.fills, plan.next) == (fresh.sends, fresh.fills, fresh.next)


def test_what_waits_for_its_slot_when_the_slots_are_given_back_is_counted() -> None:
    bus = Bus()
    _master, owner, _ = network(bus, 1, 0, 0)
    filled = counted(owner, 20)
    owner.act(owner.engine.reserve(owner.now, TOPIC, 20, 5 * MS, lead=2 * MS, handle="hrt"))
    bus.run(SECOND)
    asked = len(filled)
    bus.run_until(lambda: len(filled) > asked)
    owner.act(owner.engine.release(owner.now, TOPIC))
    bus.run(20 * MS)
    fates = [done.fate for done in owner.of(Done) if done.fate is not Fate.REPLACED]
    assert fates[-1] is Fate.ABANDONED
    assert fates.count(Fate.SENT) == len(filled) - 1
    assert owner.engine.counts["hrt slots given back"] == 1


@pytest.mark.parametrize("mask", [0, 1])
def test_a_forged_sync_without_our_slots_does_not_end_them(mask: int) -> None:
    """A broken node is a bit earlier than the master. What the last ten syncs said is believed for three cycles."""
    bus = Bus()
    _master, owner, listener = network(bus, 1, 0, 0)
    filled = counted(owner)
    listener.engine.subscribe(rtcan.message_id(TOPIC, 11), 8)
    owner.act(owner.engine.reserve(owner.now, TOPIC, 8, 5 * MS, handle="hrt"))
    bus.run(SECOND)
    missed, got = owner.engine.counts["missed"], len(filled)
    for _ in range(10):
        reference, counter = owner.engine.cycle.reference, owner.engine.cycle.counter
        assert owner.engine.cycle.running
        forged = rtcan.encode_sync(counter + 1, mask)
        bus.run(reference + CYCLE + 120_000 - bus.now)  # the master's has not ended yet
        owner.act(owner.engine.receive(owner.now, forged, owner.now))
        bus.run(200 * MS)
    assert owner.engine.counts["masks doubted"] == 10
    assert owner.of(ForeignSyncs) == []
    assert owner.engine.counts["missed"] == missed
    assert len(listener.received(TOPIC)) >= len(filled) - 1
    assert len(filled) > got


def test_a_mask_that_stays_without_our_slots_is_believed() -> None:
    bus = Bus()
    master, owner, _ = network(bus, 1, 0, 0)
    counted(owner)
    owner.act(owner.engine.reserve(owner.now, TOPIC, 8, 5 * MS, handle="hrt"))
    bus.run(SECOND)
    master.engine.grants.calendar.mask = lambda cycle: 1  # type: ignore[method-assign]
    bus.run(20 * CYCLE)
    assert owner.engine.counts["masks doubted"] == 3
    assert owner.engine.counts["hrt not in the mask"] > 0
    (found,) = owner.of(ForeignSyncs)
    assert found.reason == "4 in a row lack slots of this module, which now counts them as lost"


def test_plans_that_never_repeat_are_not_all_kept() -> None:
    plan = SlotPlan(timing())
    owned = Reservation(MESSAGE, 59 * 64 * 6, 1)  # it repeats after 3 776 cycles
    plan.periodics[TOPIC] = PeriodicMessage(TOPIC, MESSAGE, 8, 1, MS, 0, None, reservation=owned, active=True)
    used = 0
    for cycle in range(3776):
        plan.begin_cycle(cycle)
        used += plan.own.bit_count()
        assert plan.own == occupied(owned, cycle * 60, 60)
        assert len(plan._cycles) <= 256
    assert used == 3776 * 60 // owned.period


def test_a_period_that_does_not_divide_the_cycle_is_kept_with_the_whole_counter() -> None:
    """90 slots: two messages in three cycles, also for a node that joins when the sync's counter has wrapped."""
    bus = Bus()
    _master, owner, listener = network(bus, 1, 0, 0)
    late = bus.add(id8=20)
    counted(owner)
    counted(late)
    listener.engine.subscribe(rtcan.message_id(TOPIC, 11), 8)
    owner.act(owner.engine.reserve(owner.now, TOPIC, 8, 90 * SLOT, handle="hrt"))
    bus.run(4 * SECOND)  # over 256 cycles
    bus.start(late)
    bus.run(2 * SECOND)
    late.act(late.engine.reserve(late.now, 6, 8, 48 * SLOT, handle="hrt"))
    bus.run(SECOND)
    begin = bus.now
    bus.run(6 * SECOND)
    assert [(granted.period, granted.interval) for granted in owner.of(SlotsGranted)] == [(90, 90 * SLOT)]
    assert [granted.period for granted in late.of(SlotsGranted)] == [48]
    for node, high, period in ((owner, TOPIC, 90), (late, 6, 48)):
        at = [start for start in starts(bus, high, 0) if start > begin]
        assert len(at) == pytest.approx(6 * SECOND / (period * SLOT), abs=1)
        assert {b - a for a, b in pairwise(at)} == {period * SLOT}
        assert node.engine.counts["missed"] <= 1  # what waited when it got the slots


def test_a_period_that_is_impossible_as_it_is_is_rounded_down_at_once() -> None:
    bus = Bus()
    _master, owner = network(bus, 1, 0)
    counted(owner)
    owner.act(owner.engine.reserve(owner.now, TOPIC, 8, 61 * SLOT))  # it has no factor in common with 60
    bus.run(100 * MS)
    assert [granted.period for granted in owner.of(SlotsGranted)] == [60]
    assert owner.of(SlotsRefused) == []


def test_a_master_that_keeps_the_harmonic_rule_rounds_down() -> None:
    bus = Bus()
    _master, owner = network(bus, 1, 0, periods=PeriodRule.HARMONIC)
    counted(owner)
    owner.act(owner.engine.reserve(owner.now, TOPIC, 8, 90 * SLOT))
    bus.run(100 * MS)
    assert [(granted.period, granted.phase) for granted in owner.of(SlotsGranted)] == [(60, 1)]


# Answers of the master that come late, or out of order


class Owner:
    """One periodic message, and what it has asked for; nothing of that goes anywhere."""

    def __init__(self) -> None:
        self.asked: list[Reserve | Renew] = []
        self.abandoned: list[int] = []
        self.periodic = PeriodicMessage(TOPIC, MESSAGE, 8, 1, 10_000_000, 0, None)
        context = EngineContext(EngineSettings(number=1))
        plan = SlotPlan(context.timing)
        plan.periodics[TOPIC] = self.periodic
        self.out, self.timers = context.actions, context.timers
        self.requests = SlotRequests(
            context,
            plan,
            lambda now, wanted: self.asked.append(wanted),
            lambda now, periodic, reason: self.abandoned.append(now),
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
            if ("lease", TOPIC) in list(self.timers.pop(at)):
                return at
        return None


def test_a_grant_counts_though_it_was_asked_again_meanwhile() -> None:
    """On a full bus answers take longer than the next request; if only the last one counted, there were never slots."""
    owner = Owner()
    first = owner.ask(0)
    owner.ask(SECOND // 4)
    owner.grant(SECOND // 3, first)
    assert owner.out == [SlotsGranted(TOPIC, 60, 1, 9_960_000)]
    assert owner.lease() == LEASE  # from the request on that was answered


def test_a_renewal_counts_though_it_was_asked_again_meanwhile() -> None:
    owner = Owner()
    owner.grant(0, owner.ask(0))
    late = owner.renew(SECOND)
    owner.renew(2 * SECOND)
    owner.renewed(5 * SECOND // 2, late, TOPIC)
    assert owner.lease() == SECOND + LEASE


def test_an_older_answer_does_not_shorten_a_lease() -> None:
    owner = Owner()
    owner.grant(0, owner.ask(0))
    serials = [owner.renew(n * SECOND) for n in (1, 2)]
    for serial in reversed(serials):
        owner.renewed(2 * SECOND, serial, TOPIC)
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
    assert owner.out[-1] == SlotsLost(TOPIC, "the master does not know of it")


def test_answers_without_a_request_change_nothing() -> None:
    owner = Owner()
    serial = owner.ask(0)
    owner.grant(0, serial + 1)
    owner.renewed(0, serial, TOPIC)
    refusal = management.Refuse(MESSAGE, serial, int(RefuseReason.FULL), 1, 60)
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


def test_leases_outlast_discovery_that_fills_all_free_slots() -> None:
    """The nodes with low ids win each arbitration of equal laxity, and say more than the bus can carry."""
    bus = Bus()
    *talkers, owner, master = network(bus, 0, 0, 0, 0, 1)
    counted(owner)
    for high in range(20, 20 + 53):  # of 59 slots, one in each cycle; 6 are free
        master.act(master.engine.reserve(master.now, high, 8, CYCLE))
    owner.act(owner.engine.reserve(owner.now, TOPIC, 8, CYCLE))
    bus.run(SECOND)
    assert len(owner.of(SlotsGranted)) == 1
    since = bus.now
    alive = management.encode(management.Alive("TALKER"))
    while bus.now < since + 2 * LEASE:
        for node in talkers:
            if node.engine.waiting < 20:
                node.act(node.engine.manage(node.now, alive))
        bus.run(CYCLE)
    assert not owner.of(SlotsLost)
    said = [node for at, frame, node in bus.sent if at > since and not is_sync(frame) and node in talkers]
    assert len(said) > 1000, "discovery fills what is left"


def test_leases_are_longer_where_few_slots_are_left_for_renewals() -> None:
    bus = Bus()
    owner, master = network(bus, 0, 1)
    counted(owner)
    owner.act(owner.engine.reserve(owner.now, TOPIC, 8, CYCLE))
    bus.run(SECOND)
    assert owner.engine.periodics[TOPIC].lease == LEASE
    for high in range(20, 20 + 57):  # one slot of each cycle is left
        master.act(master.engine.reserve(master.now, high, 8, CYCLE))
    bus.run(3 * SECOND)
    lease = owner.engine.periodics[TOPIC].lease
    assert LEASE < lease <= 4 * LEASE
    since, asked = bus.now, []
    bus.run(3 * lease)
    assert not owner.of(SlotsLost)
    for at, frame, node in bus.sent:  # the last frame of a message has its type
        message = rtcan.message_of(frame.id)
        left = frame.id & rtcan.LEFT_MASK & ~rtcan.FIRST_MARK
        if at > since and node is owner and not left and rtcan.high_byte(message) == 1:
            asked += [at] if frame.data[-1] == management.ManagementType.RENEW else []
    assert len(asked) == pytest.approx(9, abs=1)


def test_slots_that_management_needs_are_refused() -> None:
    """Else no lease could be renewed, and all slots would be lost."""
    bus = Bus()
    owner, master = network(bus, 0, 1)
    for high in range(20, 20 + 57):
        master.act(master.engine.reserve(master.now, high, 8, CYCLE))
    counted(owner)
    owner.act(owner.engine.reserve(owner.now, TOPIC, 8, CYCLE))
    bus.run(SECOND)
    assert len(owner.of(SlotsGranted)) == 1
    owner.act(owner.engine.reserve(owner.now, TOPIC + 1, 8, CYCLE))
    bus.run(10 * SECOND)
    (refused,) = owner.of(SlotsRefused)
    assert refused.high == TOPIC + 1
    assert "carry what keeps the others" in refused.reason
    assert not owner.of(SlotsLost)
    owner.act(owner.engine.release(owner.now, TOPIC))
    bus.run(2 * SECOND)
    assert [each.high for each in owner.of(SlotsGranted)] == [TOPIC, TOPIC + 1]
