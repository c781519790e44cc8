"""Whole networks on a bus that is true to the bit: how they form, what they carry, how they survive."""

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import pytest

from r2p.codecs import management, rtcan
from r2p.codecs.rtcan import Frame
from r2p.errors import MessageError
from r2p.protocols.rtcan.election import Role
from r2p.protocols.rtcan.engine import Engine
from r2p.protocols.rtcan.events import (
    Action,
    Degraded,
    Done,
    Due,
    Fate,
    Granted,
    IdConflict,
    LostSync,
    Mailbox,
    NewMaster,
    Outcome,
    Profile,
    Ready,
    Received,
    Refused,
    Silenced,
    Transmit,
    Unsilenced,
    Withdraw,
)
from r2p.protocols.rtcan.settings import Settings
from tests.protocols.rtcan.bus import MS, SECOND, Bus, Node

CYCLE = 9_960_000
SLOT = 166_000
TOPIC = 5


def network(bus: Bus, *priorities: int, **settings: Any) -> list[Node]:
    """Nodes with id8 10, 11, ... that have found their master."""
    nodes = [bus.add(id8=10 + i, priority=priority, **settings) for i, priority in enumerate(priorities)]
    bus.start()
    bus.run(2 * SECOND)
    return nodes


def act(node: Node, actions: Sequence[Action]) -> None:
    node.act(actions)


def publish(node: Node, high: int, data: bytes, deadline: int | None = None, *, drop: bool = True) -> None:
    """Soft real-time within `deadline` ns; without, non real-time. The handle is the data."""
    if deadline is None:
        act(node, node.engine.publish(node.now, high, data, handle=data))
    else:
        act(node, node.engine.publish(node.now, high, data, deadline=node.now + deadline, drop=drop, handle=data))


def starts(bus: Bus, high: int, laxity: int | None = None) -> list[int]:
    """When the frames of a topic started."""
    return [
        at
        for at, frame, _ in bus.sent
        if frame.id >> 15 & 0xFF == high and (laxity is None or frame.id >> 23 == laxity) and not is_sync(frame)
    ]


def is_sync(frame: Frame) -> bool:
    return rtcan.is_sync(frame.id)


def syncs(bus: Bus, since: int = 0) -> list[tuple[int, Node]]:
    return [(at, node) for at, frame, node in bus.sent if is_sync(frame) and at >= since]


def counted(node: Node, size: int = 8) -> list[bytes]:
    """Its periodic message gets a running number."""
    told: list[bytes] = []

    def fill(due: Due) -> bytes:
        told.append(len(told).to_bytes(size, "little"))
        return told[-1]

    node.fill = fill
    return told


# Forming a network


def test_the_highest_priority_becomes_the_master_and_all_know_it() -> None:
    bus = Bus()
    nodes = network(bus, 3, 7, 7, 0)
    assert [node.engine.role for node in nodes] == [Role.SLAVE, Role.SLAVE, Role.MASTER, Role.SLAVE]
    assert {node.engine.master for node in nodes} == {12}
    assert len({node.engine.epoch for node in nodes}) == 1
    assert len({node.engine.cycle for node in nodes}) == 1
    assert {node for _, node in syncs(bus)} == {nodes[2]}
    times = [node.engine.network_time(node.now) for node in nodes]
    assert times == [times[0]] * 4
    assert bus.collisions == 0


def test_sync_frames_come_every_cycle_and_count() -> None:
    bus = Bus()
    network(bus, 1, 0)
    at = [start for start, _ in syncs(bus)]
    assert {b - a for a, b in pairwise(at)} == {CYCLE}
    counters = [rtcan.decode_sync(frame).cycle for _, frame, _ in bus.sent if is_sync(frame)]
    assert counters == [n & 0xFF for n in range(1, len(counters) + 1)]  # the original's first is 1, too


def test_nobody_sends_before_having_listened() -> None:
    bus = Bus()
    network(bus, 1, 2)
    assert bus.sent[0][0] >= 1_200 * MS


def test_a_late_node_joins_and_does_not_disturb() -> None:
    bus = Bus()
    master, _ = network(bus, 1, 0)
    late = bus.add(id8=20, priority=200, offset=-77 * SECOND, ppm=50)
    bus.start(late)
    joined = bus.now
    bus.run(3 * SECOND)
    assert (late.engine.role, master.engine.role) == (Role.SLAVE, Role.MASTER)
    assert late.engine.cycle == master.engine.cycle
    assert late.engine.cycle is not None
    assert late.engine.cycle > 256  # it has the whole counter
    at = [start for start, _ in syncs(bus, joined)]
    assert {b - a for a, b in pairwise(at)} == {CYCLE}
    mine = [start for start, _, node in bus.sent if node is late]
    assert mine[0] > joined + 1_200 * MS
    reference = at[0]
    assert {(start - reference) % CYCLE // SLOT for start in mine}.isdisjoint({0})


def test_without_anybody_to_be_the_master_there_are_no_slots() -> None:
    bus = Bus()
    a, b = network(bus, 0, 0)
    assert [node.engine.role for node in (a, b)] == [Role.NONE, Role.NONE]
    b.engine.subscribe(rtcan.message_id(TOPIC, 10), 4)
    publish(a, TOPIC, b"abcd", 20 * MS)
    sent = bus.now
    bus.run(MS)
    assert b.received(TOPIC) == [b"abcd"]
    assert starts(bus, TOPIC) == [sent]


def test_a_node_alone_on_the_bus_gives_up_message_by_message() -> None:
    """Nobody acknowledges."""
    bus = Bus()
    (node,) = network(bus, 0)
    publish(node, TOPIC, b"a", 5 * SECOND)
    bus.run(SECOND)
    assert node.of(Done)[-1].fate is Fate.FAILED
    assert bus.sent == []
    other = bus.add(id8=11)
    bus.start(other)
    publish(node, TOPIC, b"b", 5 * SECOND)
    bus.run(MS)
    assert node.of(Done)[-1].fate is Fate.SENT


# Soft and non real-time


@pytest.mark.parametrize("one_shot", [True, False])
@pytest.mark.parametrize("priority", [0, 1])
def test_the_least_laxity_wins_on_the_bus(priority: int, one_shot: bool) -> None:
    """In slots and without."""
    bus = Bus()
    a, b, c = nodes = network(bus, priority, 0, 0)
    for node in nodes:
        node.one_shot = one_shot
    for node, high, deadline in ((a, 2, 9), (a, 3, 4), (b, 4, 30), (b, 5, None), (c, 6, 20), (c, 7, 6)):
        publish(node, high, bytes([high]), deadline * MS + MS // 2 if deadline else None)
    bus.run(9 * MS)
    order = [frame.data[0] for _, frame, _ in bus.sent if frame.id >> 15 & 0xFF in range(2, 8)]
    if priority:
        assert order == [3, 7, 2, 6, 4, 5]
    else:  # each has handed over one frame of each class at once, and only then learns of the others
        assert sorted(order) == [2, 3, 4, 5, 6, 7]
        assert order.index(7) < order.index(4) < order.index(5)
    assert all(node.engine.counts["missed"] == 0 for node in nodes)


def test_free_slots_carry_one_frame_each_and_reserved_ones_none() -> None:
    bus = Bus()
    master, slave = network(bus, 1, 0)
    counted(slave)
    act(slave, slave.engine.reserve(slave.now, TOPIC, 8, MS))
    bus.run(100 * MS)
    begin = bus.now
    for _ in range(40):
        publish(master, 6, bytes(16), 40 * MS)
    bus.run(40 * MS)
    reference = syncs(bus, begin)[0][0]
    slots = {(start - reference) // SLOT for start in starts(bus, 6)}
    assert len(slots) == len(starts(bus, 6)) == 80
    assert all((start - reference) % SLOT == 0 for start in starts(bus, 6))
    assert all(slot % 60 and slot % 6 != 1 for slot in slots)
    periodic = [start for start in starts(bus, TOPIC) if start > begin]
    assert {b - a for a, b in pairwise(periodic)} == {6 * SLOT}


def test_a_message_of_many_fragments_and_an_urgent_one_in_between() -> None:
    bus = Bus()
    a, b = network(bus, 1, 0)
    for high, size in ((2, 100), (3, 8)):
        b.engine.subscribe(rtcan.message_id(high, 10), size)
    publish(a, 2, bytes(range(100)), 60 * MS)
    bus.run(MS)
    publish(a, 3, b"urgent!!", 5 * MS)
    bus.run(20 * MS)
    assert [received.high for received in b.of(Received)] == [3, 2]
    assert b.received(2) == [bytes(range(100))]
    assert {done.fate for done in a.of(Done)} == {Fate.SENT}


@pytest.mark.parametrize("priority", [0, 1])
def test_overdue_is_dropped_or_sent_and_counted_either_way(priority: int) -> None:
    bus = Bus()
    a, b = network(bus, priority, 0)
    for high in 2, 3, 4:
        b.engine.subscribe(rtcan.message_id(high, 10), 256)
    for _ in range(2):
        publish(a, 2, bytes(256), 2 * MS)
    publish(a, 3, bytes(256), 3 * MS)
    publish(a, 4, bytes(256), 3 * MS, drop=False)
    bus.run(200 * MS)
    fates = [(done.fate, done.missed) for done in a.of(Done)]
    assert sorted(fates, key=str) == sorted(
        [(Fate.SENT, True), (Fate.OVERDUE, True), (Fate.OVERDUE, True), (Fate.SENT, True)], key=str
    )
    assert a.engine.counts["missed"] == 4
    assert (len(b.received(2)), len(b.received(3)), len(b.received(4))) == (1, 0, 1)  # what had started is finished


def test_nothing_starts_that_does_not_end_in_its_slot() -> None:
    bus = Bus()
    master, slave = network(bus, 1, 0)
    bus.run(3 * MS)
    publish(slave, TOPIC, bytes(8), 50 * MS)
    at = slave.engine.next_deadline()
    assert at is not None
    late = at + 60_000
    actions = slave.engine.poll(late)  # its timer interrupt came 60 us late
    assert actions == ()
    assert slave.engine.counts["late_to_slot"] == 1
    following = slave.engine.next_deadline()
    assert following == at + SLOT
    (transmit,) = slave.engine.poll(following)
    assert isinstance(transmit, Transmit)
    assert transmit.not_before == following
    assert transmit.not_after == following + SLOT - 160_000  # as if it were as long as can be
    in_time = following + 20_000
    slave.engine.confirm(in_time, Mailbox.SRT, Outcome.LATE, in_time)
    (transmit,) = slave.engine.poll(following + SLOT + 15_000)  # ... which 15 us later is too long
    assert isinstance(transmit, Transmit)
    length = (rtcan.frame_bits(transmit.frame.id, transmit.frame.data) + 3) * 1_000
    assert transmit.not_after == following + 2 * SLOT - length
    assert master.engine.counts["late_to_slot"] == 0


def next_transmit(node: Node) -> Transmit:
    """Poll, without the bus, until there is a frame to transmit."""
    while True:
        at = node.engine.next_deadline()
        assert at is not None
        for action in node.engine.poll(at):
            if isinstance(action, Transmit):
                return action


def test_a_frame_that_did_not_start_goes_back_to_the_queue() -> None:
    bus = Bus()
    _, slave = network(bus, 1, 0)
    bus.run(3 * MS)
    publish(slave, TOPIC, bytes(8), 50 * MS)
    laxities = []
    for outcome in (Outcome.LATE, Outcome.LOST, Outcome.SENT):
        transmit = next_transmit(slave)
        laxities.append(transmit.frame.id >> 23)
        at = transmit.not_before + MS
        slave.engine.confirm(at, transmit.mailbox, outcome, at)
    assert laxities == [49, 48, 47]
    assert slave.engine.counts["late_to_slot"] == 1
    assert slave.engine.counts["arbitration lost"] == 1
    assert slave.engine.waiting == 0


def test_coarse_ports_may_start_anywhere_in_free_slots() -> None:
    bus = Bus()
    master, slave = network(bus, 1, 0, coarse=True)
    counted(master)
    act(master, master.engine.reserve(master.now, TOPIC, 8, 2 * MS))
    bus.run(100 * MS)
    publish(slave, 6, bytes(8), 50 * MS)
    at = slave.engine.next_deadline()
    assert at is not None
    (transmit,) = slave.engine.poll(at + 90_000)
    assert isinstance(transmit, Transmit)
    assert transmit.not_after - at > 3 * SLOT
    assert slave.engine.mask is not None
    reference = syncs(bus)[-1][0]
    assert not slave.engine.mask >> ((transmit.not_after - reference) // SLOT) & 1


def test_an_unknown_outcome_is_not_sent_again() -> None:
    engine, now = ready_engine()
    first = engine.publish(now, TOPIC, bytes(12), handle="x")
    second = engine.confirm(now + 1, Mailbox.NRT, Outcome.UNKNOWN, now + 1)
    third = engine.confirm(now + 2, Mailbox.NRT, Outcome.SENT, now + 2)
    frames = [action.frame for action in (*first, *second, *third) if isinstance(action, Transmit)]
    assert [frame.id & 0x7F for frame in frames] == [1, 0]
    assert third == [Done("x", Fate.UNKNOWN, False, now + 2)]


def ready_engine(**settings: Any) -> tuple[Engine, int]:
    """An engine that is ready, without a bus, and has nothing to say for the next second."""
    engine = Engine(Settings(number=1 << 40, id8=10, profile=Profile.RTCAN, **settings))
    actions = list(engine.start(0))
    while (at := engine.next_deadline()) is not None and at < 2 * SECOND:
        actions = list(engine.poll(at))
        for action in actions:
            if isinstance(action, Transmit):
                actions += engine.confirm(at, action.mailbox, Outcome.SENT, at)
    assert engine.ready
    return engine, 2 * SECOND


def test_without_slots_each_class_has_its_own_frame_with_the_port() -> None:
    engine, now = ready_engine()
    actions = [*engine.publish(now, 2, b"n"), *engine.publish(now, 3, b"s", deadline=now + 5 * MS)]
    assert [(a.mailbox, a.not_after - now) for a in actions if isinstance(a, Transmit)] == [
        (Mailbox.NRT, (1 << 62) - now),
        (Mailbox.SRT, 5 * MS),
    ]
    assert engine.publish(now, 4, b"m", deadline=now + 9 * MS) == ()
    (following,) = engine.confirm(now + MS, Mailbox.SRT, Outcome.SENT, now + MS)
    assert isinstance(following, Transmit)
    assert following.frame.id >> 23 == 8


def test_after_a_bus_error_a_topic_waits_a_little() -> None:
    engine, now = ready_engine()
    engine.publish(now, 2, b"n", deadline=now + 50 * MS)
    assert engine.confirm(now + 1, Mailbox.SRT, Outcome.ERROR, now + 1) == ()
    retry = engine.next_deadline()
    assert retry is not None
    assert now + MS // 2 < retry < now + 10 * MS
    (again,) = engine.poll(retry)
    assert isinstance(again, Transmit)


def test_what_is_not_ready_or_does_not_fit() -> None:
    engine = Engine(Settings(number=1))
    assert engine.publish(0, 2, b"x", handle="h") == [Done("h", Fate.DISCARDED, False, 0)]
    assert engine.manage(0, bytes(32)) == ()
    assert (engine.id8, engine.next_deadline(), engine.poll(5)) == (None, None, ())
    with pytest.raises(MessageError, match="1 to 1024"):
        engine.publish(0, 2, bytes(1025))
    with pytest.raises(ValueError, match="id8 0"):
        Engine(Settings(number=1, id8=0))
    ready, now = ready_engine(capacity=2)
    last = [ready.publish(now, high, b"x", handle=high) for high in (2, 3, 4)][-1]
    assert last == [Done(4, Fate.FULL, False, now)]
    assert ready.full


# Hard real-time


@pytest.mark.parametrize("lead", [0, 1, 500_000, 3 * MS, SECOND])
@pytest.mark.parametrize("size", [3, 8, 16, 20])
def test_a_periodic_message_owns_its_slots(size: int, lead: int) -> None:
    bus = Bus()
    _master, owner, listener = network(bus, 1, 0, 0)
    told = counted(owner, size)
    listener.engine.subscribe(rtcan.message_id(TOPIC, 11), size)
    act(owner, owner.engine.reserve(owner.now, TOPIC, size, 5 * MS, lead=lead, handle="hrt"))
    bus.run(20 * MS)
    granted = owner.of(Granted)
    assert granted == [Granted(TOPIC, 30, 1, 30 * SLOT)]
    begin = bus.now
    bus.run(SECOND)
    fragments = rtcan.fragment_count(size)
    at = [start for start in starts(bus, TOPIC, 0) if start > begin]
    reference = syncs(bus, begin)[0][0]
    assert {(start - reference) % (30 * SLOT) for start in at} == {SLOT * (1 + n) for n in range(fragments)}
    assert abs(len(at) - fragments * SECOND // (30 * SLOT)) <= fragments
    got = listener.received(TOPIC)
    assert got == sorted(got, key=told.index)  # never an old one after a newer one
    assert len(told) - len(got) <= 2
    assert owner.engine.counts["missed"] <= 1  # what still waited without slots when it got them
    asked = {due.at for due in owner.of(Due) if due.slotted}
    assert set(at[::fragments]) <= asked


def test_the_master_has_slots_too_and_none_is_given_twice() -> None:
    bus = Bus()
    nodes = network(bus, 1, 0, 0)
    for high, period in ((2, MS), (3, 5 * MS), (4, 10 * MS)):
        for node in nodes:
            counted(node)
            act(node, node.engine.reserve(node.now, high, 8, period))
        bus.run(100 * MS)
    phases = sorted((g.period, g.phase) for node in nodes for g in node.of(Granted))
    assert phases == [(6, 1), (6, 2), (6, 3), (30, 4), (30, 5), (30, 6), (60, 10), (60, 11), (60, 12)]
    begin = bus.now
    bus.run(20 * CYCLE)
    hrt = [at for at, frame, _ in bus.sent if frame.id >> 23 == 0 and at > begin and not is_sync(frame)]
    assert len(hrt) == pytest.approx(20 * 39, abs=39)
    assert all(node.engine.counts["missed"] == 0 for node in nodes)
    mask = nodes[2].engine.mask
    assert mask is not None
    assert (mask >> 1).bit_count() == 39


def test_a_refusal_says_why_and_the_message_goes_as_a_soft_one() -> None:
    bus = Bus()
    master, owner = network(bus, 1, 0)
    counted(owner, 400)
    owner.engine.reserve(owner.now, TOPIC, 400, 5 * MS)
    bus.run(100 * MS)
    (refused,) = owner.of(Refused)
    assert "a period of 30 slots" in refused.reason
    assert {frame.id >> 23 for _, frame, _ in bus.sent if frame.id >> 15 & 0xFF == TOPIC} <= set(range(1, 6))
    assert master.engine.mask == 1


def test_without_a_master_periodic_messages_go_as_soft_ones_with_their_period_as_deadline() -> None:
    bus = Bus()
    a, b = network(bus, 0, 0)
    told = counted(a)
    b.engine.subscribe(rtcan.message_id(TOPIC, 10), 8)
    act(a, a.engine.reserve(a.now, TOPIC, 8, 10 * MS, handle="periodic"))
    bus.run(SECOND)
    assert b.received(TOPIC) == told[:-1]
    assert len(told) == 101
    assert {frame.id >> 23 for _, frame, _ in bus.sent if frame.id >> 15 & 0xFF == TOPIC} == {10}
    assert [due.at for due in a.of(Due)] == [a.of(Due)[0].at + n * 10 * MS for n in range(101)]
    assert {(done.handle, done.fate) for done in a.of(Done)} == {("periodic", Fate.SENT)}


def test_a_period_without_data_is_skipped() -> None:
    bus = Bus()
    _, owner = network(bus, 1, 0)
    owner.fill = lambda due: None
    act(owner, owner.engine.reserve(owner.now, TOPIC, 8, MS, lead=MS))
    bus.run(100 * MS)
    assert starts(bus, TOPIC) == []
    assert owner.engine.counts["slots without data"] > 50
    with pytest.raises(ValueError, match="7 bytes for a periodic message of 8"):
        owner.engine.fill(owner.now, TOPIC, bytes(7))


def test_a_missed_slot_abandons_the_message_and_the_next_one_has_fresh_data() -> None:
    bus = Bus()
    _, owner, listener = network(bus, 1, 0, 0)
    told = counted(owner, 24)
    listener.engine.subscribe(rtcan.message_id(TOPIC, 11), 24)
    act(owner, owner.engine.reserve(owner.now, TOPIC, 24, 10 * MS, handle="hrt"))
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
    abandoned = len(told)
    bus.run(3 * CYCLE)
    assert listener.received(TOPIC)[before:] == told[abandoned:][:2]
    assert len(told) >= abandoned + 2
    assert listener.engine.losses[11]["gap"] == 1


def test_slots_are_given_back() -> None:
    bus = Bus()
    master, owner = network(bus, 1, 0)
    counted(owner)
    act(owner, owner.engine.reserve(owner.now, TOPIC, 8, 10 * MS))
    bus.run(100 * MS)
    assert master.engine.mask == 0b11
    act(owner, owner.engine.release(owner.now, TOPIC))
    bus.run(30 * MS)
    assert master.engine.mask == 0b1
    assert starts(bus, TOPIC)[-1] < bus.now - 25 * MS


def test_the_slots_of_a_dead_node_come_free_after_3_s() -> None:
    bus = Bus()
    master, owner = network(bus, 1, 0)
    counted(owner)
    act(owner, owner.engine.reserve(owner.now, TOPIC, 8, 10 * MS))
    bus.run(10 * SECOND)
    assert master.engine.mask == 0b11  # renewed and renewed
    assert owner.of(Degraded) == []
    bus.kill(owner)
    other = bus.add(id8=12)  # somebody must acknowledge
    bus.start(other)
    bus.run(SECOND)
    assert master.engine.mask == 0b11
    bus.run(2100 * MS)
    assert master.engine.mask == 0b1


def test_the_owner_stops_when_the_master_does_not_answer() -> None:
    bus = Bus()
    master, owner = network(bus, 1, 0)
    counted(owner)
    act(owner, owner.engine.reserve(owner.now, TOPIC, 8, 10 * MS))
    bus.run(100 * MS)
    master.deaf = lambda frame: frame.id >> 15 & 0xFF == rtcan.MANAGEMENT
    bus.run(4 * SECOND)
    assert owner.of(Degraded) == [Degraded(TOPIC, "the master does not answer")]
    assert master.engine.mask == 0b1
    assert {frame.id >> 23 for at, frame, _ in bus.sent[-50:] if frame.id >> 15 & 0xFF == TOPIC} != {0}


# Losing sync, losing the master


def test_one_missed_sync_silences_soft_messages_for_a_cycle_and_nothing_else() -> None:
    bus = Bus()
    _, owner, _ = network(bus, 1, 0, 0)
    counted(owner)
    act(owner, owner.engine.reserve(owner.now, TOPIC, 8, MS))
    bus.run(100 * MS)
    bus.run_until(lambda: is_sync(bus.sent[-1][1]))
    bus.run(300_000)
    owner.deaf = is_sync
    begin = bus.now
    bus.run(CYCLE)
    publish(owner, 6, b"soft", 60 * MS)
    bus.run(CYCLE)
    assert starts(bus, 6) == []
    owner.deaf = lambda frame: False
    bus.run(2 * CYCLE)
    assert owner.engine.counts["missed syncs"] == 2
    assert len(starts(bus, 6)) == 1
    periodic = [at for at in starts(bus, TOPIC) if at > begin]
    assert {b - a for a, b in pairwise(periodic)} == {6 * SLOT}
    assert owner.of(LostSync) == []


def test_after_four_cycles_without_sync_it_is_lost_and_found_again() -> None:
    bus = Bus()
    master, owner, _ = network(bus, 1, 0, 0)
    counted(owner)
    act(owner, owner.engine.reserve(owner.now, TOPIC, 8, MS))
    bus.run(100 * MS)
    owner.deaf = is_sync
    begin = bus.now
    bus.run(10 * CYCLE)
    assert len(owner.of(LostSync)) == 1
    assert owner.of(Degraded) == [Degraded(TOPIC, "no sync for too long")]
    hard = [at for at in starts(bus, TOPIC, 0) if at > begin]
    assert 3 * CYCLE < hard[-1] - begin < 5 * CYCLE
    owner.deaf = lambda frame: False
    bus.run(200 * MS)
    assert owner.engine.role is Role.SLAVE
    assert owner.engine.cycle == master.engine.cycle
    assert len(owner.of(Granted)) == 2
    assert starts(bus, TOPIC, 0)[-1] > bus.now - MS - SLOT


def test_the_next_best_takes_over_and_everything_goes_on() -> None:
    bus = Bus()
    first, second, third, owner = network(bus, 9, 5, 7, 0)
    told = counted(owner)
    for node in second, third:
        node.engine.subscribe(rtcan.message_id(TOPIC, 13), 8)
    act(owner, owner.engine.reserve(owner.now, TOPIC, 8, MS))
    counted(second)
    act(second, second.engine.reserve(second.now, 6, 8, 10 * MS))
    bus.run(100 * MS)
    epoch, cycle, grid = owner.engine.epoch, owner.engine.cycle, syncs(bus)[-1][0]
    phases = {node: node.of(Granted)[-1].phase for node in (owner, second)}
    bus.kill(first)
    died = bus.now
    bus.run(SECOND)
    assert [node.engine.role for node in (second, third, owner)] == [Role.SLAVE, Role.MASTER, Role.SLAVE]
    assert {node.engine.master for node in (second, third, owner)} == {12}
    assert {node.engine.epoch for node in (second, third, owner)} == {epoch}
    after = syncs(bus, died)
    assert {node for _, node in after} == {third}
    assert after[0][0] - died < 10 * CYCLE
    assert (after[0][0] - grid) % CYCLE < 2_000  # the same grid, but for the drift of no clock here
    assert owner.engine.cycle is not None
    assert cycle is not None
    assert owner.engine.cycle - cycle == pytest.approx(SECOND // CYCLE, abs=2)
    assert {node: node.of(Granted)[-1].phase for node in (owner, second)} == phases
    assert third.received(TOPIC)[-1] in told[-2:]
    assert starts(bus, TOPIC, 0)[-1] > bus.now - 2 * MS


def test_a_returning_better_master_does_not_take_over() -> None:
    bus = Bus()
    first, second = network(bus, 9, 5)
    bus.kill(first)
    bus.add(id8=20)
    bus.start(bus.nodes[-1])
    bus.run(SECOND)
    again = bus.add(id8=10, priority=9)
    bus.start(again)
    bus.run(3 * SECOND)
    assert (second.engine.role, again.engine.role) == (Role.MASTER, Role.SLAVE)
    assert again.engine.epoch == second.engine.epoch


def test_two_masters_that_meet_the_lesser_one_yields_at_once() -> None:
    """Two networks that did not hear each other are connected."""
    bus = Bus()
    groups = [[bus.add(id8=id8, priority=priority) for id8, priority in ((n, n), (n + 1, 0))] for n in (10, 20)]
    numbers = {node: frozenset((node.engine._core.settings.id8 or 0,)) for node in bus.nodes}
    apart = True

    def cut(node: Node, frame: Frame) -> bool:
        other = 2 if node in groups[0] else 1
        sender = bus.sent[-1][2]
        return apart and sender in groups[other - 1]

    for node in bus.nodes:
        node.deaf = lambda frame, node=node: cut(node, frame)  # type: ignore[misc]  # the default binds it
    assert numbers
    bus.start(*groups[0])
    bus.run(3 * MS)
    bus.start(*groups[1])
    bus.run(3 * SECOND)
    roles = [[node.engine.role for node in group] for group in groups]
    assert roles == [[Role.MASTER, Role.SLAVE]] * 2
    apart = False
    met = bus.now
    bus.run(500 * MS)
    assert [node.engine.role for group in groups for node in group] == [Role.SLAVE, Role.SLAVE, Role.MASTER, Role.SLAVE]
    assert {node.engine.master for node in bus.nodes} == {20}
    assert len({node.engine.epoch for node in bus.nodes}) == 1
    lesser = [at for at, node in syncs(bus, met) if node is groups[0][0]]
    assert len(lesser) <= 3
    assert len({node.engine.cycle for node in bus.nodes}) == 1


def test_new_slots_are_not_given_away_before_the_old_owners_have_asked() -> None:
    bus = Bus()
    first, second, owner, newcomer = network(bus, 9, 5, 0, 0)
    counted(owner)
    counted(newcomer)
    act(owner, owner.engine.reserve(owner.now, TOPIC, 8, 10 * MS))
    bus.run(100 * MS)
    bus.kill(first)
    act(newcomer, newcomer.engine.reserve(newcomer.now, 6, 8, 10 * MS))
    bus.run(SECOND)
    assert second.engine.role is Role.MASTER
    assert owner.of(Granted)[-1].phase == 1
    assert newcomer.of(Granted)[-1].phase == 2


# Parameters and ids


def test_a_node_with_other_parameters_does_not_transmit() -> None:
    bus = Bus()
    master, _ = network(bus, 1, 0)
    other = bus.add(id8=20, slots=50)
    bus.start(other)
    bus.run(3 * SECOND)
    (silenced,) = other.of(Silenced)
    assert silenced.reason == "the network has 60 slots of 166 us, this node 50 of 200 us"
    assert not any(node is other for _, _, node in bus.sent)
    bus.kill(master)
    bus.run(5 * SECOND)
    assert other.of(Unsilenced)
    assert any(node is other for _, _, node in bus.sent)


def test_a_master_that_sends_no_network_is_believed_by_its_cycle() -> None:
    """Firmware with slots: soft messages go, reservations don't."""
    bus = Bus()
    master, node = bus.add(id8=1, priority=1), bus.add(id8=11)
    other = bus.add(id8=12, slots=50)
    for each in node, other:
        each.deaf = lambda frame: frame.id >> 15 & 0xFF == rtcan.MANAGEMENT
    bus.start(master, other)
    bus.run(SECOND // 2)
    bus.start(node)
    bus.run(5 * SECOND)
    assert NewMaster(None, 0, False) in node.of(NewMaster)
    assert "this node's 10000 us" in other.of(Silenced)[0].reason
    begin = bus.now
    publish(node, TOPIC, b"x", 50 * MS)
    bus.run(50 * MS)
    assert (starts(bus, TOPIC)[0] - syncs(bus, begin)[0][0]) % SLOT == 0
    assert node.engine.network_time(node.now) is None


def test_two_nodes_that_want_the_same_id8() -> None:
    bus = Bus()
    a = bus.add(id8=10, number=0x500)
    bus.start(a)
    bus.run(2 * SECOND)
    b = bus.add(id8=10, number=0x400)
    b.deaf = lambda frame: bus.now < 3 * SECOND + 600 * MS  # it does not hear the other before it claims
    bus.start(b)
    bus.run(5 * SECOND)
    assert IdConflict(10, True) in a.of(IdConflict)
    assert a.engine.id8 is None
    assert b.engine.id8 == 10
    assert not any(node is a for at, _, node in bus.sent if at > bus.now - SECOND)
    bus.kill(b)
    bus.run(5 * SECOND)
    assert len(a.of(Ready)) == 2


def test_nodes_that_start_at_the_same_moment_get_different_ids() -> None:
    bus = Bus()
    nodes = [bus.add(number=n << 40 | n) for n in range(1, 9)]
    bus.start()
    bus.run(4 * SECOND)
    ids = [node.engine.id8 for node in nodes]
    assert None not in ids
    assert len(set(ids)) == 8


def test_what_waits_is_discarded_when_the_id8_is_lost() -> None:
    engine, now = ready_engine()
    engine.reserve(now, 6, 8, 10 * MS)
    engine.publish(now, TOPIC, b"1", handle=1)
    engine.publish(now, TOPIC, b"2", handle=2)
    claim = management.encode(management.Claim(10, 0))
    actions: list[Action] = []
    for left, data in rtcan.fragments(claim):
        actions += engine.receive(now, Frame(rtcan.encode_identifier(1, 0x010A, left), data), now)
    assert [(done.handle, done.fate) for done in actions if isinstance(done, Done)] == [
        (1, Fate.DISCARDED),
        (2, Fate.DISCARDED),
    ]
    assert Withdraw(Mailbox.NRT) in actions
    assert IdConflict(10, True) in actions
    assert engine.publish(now, TOPIC, b"3", handle=3) == [Done(3, Fate.DISCARDED, False, now)]
    assert engine.confirm(now, Mailbox.NRT, Outcome.LATE, now) == ()
    assert engine.filters() == [(0, 0)]


# Firmware of 2014


def firmware_management(bus: Bus, node: Node, text: bytes) -> None:
    """A firmware module says something."""
    for left, data in rtcan.fragments(text.ljust(31, b"\0") + b"\x11"):
        node.act(node.engine.receive(node.now, Frame(rtcan.encode_identifier(50, 0, left), data), node.now))


def test_a_network_of_firmware_is_recognised_and_management_waits_for_silence() -> None:
    bus = Bus()
    node, other = bus.add(id8=10, priority=9), bus.add(id8=11)
    bus.start()
    bus.run(SECOND)
    for each in bus.nodes:
        firmware_management(bus, each, b"IMU1")
    bus.run(SECOND)
    assert [each.engine.profile for each in bus.nodes] == [Profile.FIRMWARE] * 2
    assert node.of(Received) == []  # it does not speak yet
    firmware_management(bus, node, b"IMU2")
    assert [(each.payload[:4], each.source) for each in node.of(Received)] == [(b"IMU2", 0)]
    bus.run(5 * SECOND)
    assert syncs(bus) == []
    assert node.engine.role is Role.NONE
    assert {frame.id >> 7 & 0xFFFF for _, frame, _ in bus.sent} == {0}
    first = [at for at, frame, _ in bus.sent if frame.id & 0x7F == 3]
    firmware_management(bus, node, b"IMU1")
    heard = bus.now
    act(node, node.engine.manage(node.now, b"hello".ljust(32, b"\0")))
    bus.run(100 * MS)
    mine = [at for at, frame, _ in bus.sent if frame.data.startswith(b"hello")]
    assert heard + 33 * MS <= mine[0] <= heard + 60 * MS
    assert min(b - a for a, b in pairwise(first)) >= 33 * MS
    assert other.received(0)[-1].startswith(b"hello")


def test_a_topic_of_firmware_with_a_low_high_byte_is_no_management() -> None:
    bus = Bus()
    node, _ = bus.add(id8=10, profile=Profile.FIRMWARE), bus.add(id8=11, profile=Profile.FIRMWARE)
    bus.start()
    bus.run(2 * SECOND)
    node.engine.subscribe(rtcan.firmware_message_id(0, 0x21), 4)  # 0x0121
    act(node, node.engine.receive(node.now, Frame(rtcan.encode_identifier(9, 0x0121), b"abcd"), node.now))
    assert node.of(Received)[-1].payload == b"abcd"


# Driving it


def test_management_reaches_everybody_and_stop_goes_first() -> None:
    bus = Bus()
    a, b, c = network(bus, 1, 0, 0)
    hello, stop = b"hello".ljust(32, b"\0"), b"stop".ljust(32, b"\0")
    act(b, b.engine.manage(b.now, hello))
    act(b, b.engine.manage(b.now, stop, urgent=True))
    bus.run(20 * MS)
    for node in a, c:
        assert node.received(rtcan.MANAGEMENT)[-2:] == [stop, hello]
    assert [received.source for received in a.of(Received)][-1] == 11
    frames = [frame for _, frame, _ in bus.sent if frame.data.startswith(b"stop")]
    assert frames[0].id >> 23 == 1


def test_filters_let_through_what_is_needed() -> None:
    bus = Bus()
    a, b = network(bus, 1, 0)
    assert Engine(Settings(number=1)).filters() == [(0, 0)]
    message = rtcan.message_id(TOPIC, 10)
    b.engine.subscribe(message, 8)

    def passes(identifier: int) -> bool:
        return any(identifier & mask == wanted for wanted, mask in b.engine.filters())

    assert passes(rtcan.encode_sync(200, 5).id)
    assert passes(rtcan.encode_identifier(50, 0x0163, 3))
    assert passes(rtcan.encode_identifier(50, 0x0000, 3))
    assert passes(rtcan.encode_identifier(12, message, 9))
    assert passes(rtcan.encode_identifier(12, 0x770B))  # our own id8: a conflict
    assert not passes(rtcan.encode_identifier(12, 0x0563))
    b.engine.unsubscribe(message)
    assert not passes(rtcan.encode_identifier(12, message, 9))
    assert a.engine.ready


def test_utc_travels_with_network_time() -> None:
    bus = Bus()
    master, slave = network(bus, 1, 0)
    assert slave.engine.utc(slave.now) is None
    utc = 1_700_000_000 * SECOND
    slave.engine.set_utc(slave.now, 5, 0)  # only the master's counts
    master.engine.set_utc(master.now, utc, 1_500)
    begin = bus.now
    bus.run(2 * SECOND)
    told = slave.engine.utc(slave.now)
    assert told is not None
    assert told[0] - utc == pytest.approx(bus.now - begin, abs=1_000)
    assert told[1] == 2_000


def test_stop_and_start_again() -> None:
    bus = Bus()
    master, node = network(bus, 1, 0)
    publish(node, TOPIC, b"x", 50 * MS)
    act(node, node.engine.stop(node.now))
    assert node.of(Done)[-1].fate is Fate.DISCARDED
    node.boxes.clear()
    bus.run(SECOND)
    assert node.engine.next_deadline() is None
    assert node.engine.receive(node.now, rtcan.encode_sync(1, 1), node.now) == ()
    bus.start(node)
    bus.run(2 * SECOND)
    assert node.engine.id8 == 11
    assert node.engine.cycle == master.engine.cycle


def test_latencies_are_made_up_for() -> None:
    """The stamp comes late, and so does the start of a frame."""
    bus = Bus()
    master, slave = bus.add(id8=10, priority=1), bus.add(id8=11, receive_latency=9_000, transmit_latency=4_000)
    bus.start()
    bus.run(1600 * MS)
    original = slave.engine.receive

    def receive(now: int, frame: Frame, stamp: int) -> Sequence[Action]:
        return original(now, frame, stamp + 9_000)

    slave.engine.receive = receive  # type: ignore[method-assign]  # this slave's interrupts come 9 us late
    bus.run(100 * MS)
    publish(slave, TOPIC, b"x", 50 * MS)
    at = slave.engine.next_deadline()
    assert at is not None
    reference = syncs(bus)[-1][0]
    assert (at + 4_000 - reference) % SLOT == 0
    assert master.engine.role is Role.MASTER


def test_rubbish_from_the_bus_changes_nothing() -> None:
    bus = Bus()
    a, b = network(bus, 1, 0)
    before = (b.engine.role, b.engine.epoch)
    for code in management.RTCAN_TYPES:
        for version in (0, 1, 2, 255):
            data = bytes([version]) + b"\xff" * 30 + bytes([code])
            for left, part in rtcan.fragments(data):
                act(b, b.engine.receive(b.now, Frame(rtcan.encode_identifier(9, 0x01EE, left), part), b.now))
    act(b, b.engine.receive(b.now, Frame(0x00000080, b"short"), b.now))
    bus.run(100 * MS)
    assert (b.engine.role, b.engine.epoch) == before
    assert a.engine.role is Role.MASTER


def test_a_node_that_slept_finds_its_place_again() -> None:
    """The process was stopped for 10 s: both as a slave and as the master."""
    for sleeper in (0, 1):
        bus = Bus()
        nodes = network(bus, 2, 1, 0)
        counted(nodes[sleeper])
        act(nodes[sleeper], nodes[sleeper].engine.reserve(nodes[sleeper].now, TOPIC, 8, MS))
        bus.run(100 * MS)
        node = nodes[sleeper]
        asleep = bus.nodes.index(node)
        bus.nodes.remove(node)
        node.boxes.clear()
        bus.run(10 * SECOND)
        bus.nodes.insert(asleep, node)
        node.boxes.clear()
        bus.run(3 * SECOND)
        assert sorted(each.engine.role.value for each in nodes) == ["master", "slave", "slave"]
        assert len({each.engine.cycle for each in nodes}) == 1
        assert len({each.engine.master for each in nodes}) == 1
