"""Soft and non real-time messages: in slots and without."""

from itertools import pairwise

import pytest

from r2p.codecs import can_bits, rtcan
from r2p.errors import MessageError
from r2p.protocols.can_orders import Mailbox, Outcome, Transmit
from r2p.protocols.rtcan.engine import Engine
from r2p.protocols.rtcan.events import Done, EngineSettings, Fate, Received, SlotsGranted
from tests.protocols.rtcan.bus import MS, Bus
from tests.protocols.rtcan.networks import (
    SLOT,
    TOPIC,
    counted,
    network,
    next_transmit,
    publish,
    ready_engine,
    starts,
    syncs,
)


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
    slave.act(slave.engine.reserve(slave.now, TOPIC, 8, MS))
    bus.run(100 * MS)
    begin = bus.now
    for _ in range(40):
        publish(master, 6, bytes(16), 40 * MS)
    bus.run(40 * MS)
    reference = syncs(bus, begin)[0][0]
    slots = {(start - reference) // SLOT for start in starts(bus, 6)}
    assert len(slots) == len(starts(bus, 6)) == 80
    assert all((start - reference) % SLOT == 0 for start in starts(bus, 6))
    (granted,) = slave.of(SlotsGranted)
    assert all(slot % 60 and slot % 6 != granted.phase for slot in slots)
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
    length = (can_bits.frame_bits(transmit.frame.id, transmit.frame.data) + 3) * 1_000
    assert transmit.not_after == following + 2 * SLOT - length
    assert master.engine.counts["late_to_slot"] == 0


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
    master.act(master.engine.reserve(master.now, TOPIC, 8, 2 * MS))
    bus.run(100 * MS)
    publish(slave, 6, bytes(8), 50 * MS)
    at = slave.engine.next_deadline()
    assert at is not None
    (transmit,) = slave.engine.poll(at + 90_000)
    assert isinstance(transmit, Transmit)
    assert transmit.not_after - at > 3 * SLOT
    assert slave.engine.cycle.mask is not None
    reference = syncs(bus)[-1][0]
    assert not slave.engine.cycle.mask >> ((transmit.not_after - reference) // SLOT) & 1


def test_coarse_ports_send_one_frame_after_the_other_in_a_slot() -> None:
    bus = Bus()
    _, slave = network(bus, 1, 0, coarse=True, slots=10)
    for number in range(20):
        publish(slave, 6, bytes([number]) * 8, 50 * MS)
    bus.run(20 * MS)
    sent = starts(bus, 6)
    assert len(sent) == 20
    assert sent[-1] - sent[0] < 5 * MS  # 1 ms is a slot
    assert slave.engine.waiting == 0


def test_a_coarse_port_that_comes_too_late_waits_for_the_next_free_slot() -> None:
    bus = Bus()
    _, slave = network(bus, 1, 0, coarse=True, slots=10)
    bus.run(10 * MS)
    reference = syncs(bus)[-1][0]
    now = reference + 10 * MS - 50_000  # no frame fits into what is left
    slave.act(slave.engine.poll(now))
    assert [*slave.engine.publish(now, 6, bytes(8), deadline=now + 50 * MS), *slave.engine.poll(now)] == []
    at = slave.engine.next_deadline()
    assert at is not None
    assert at > now
    assert slave.engine.counts["late_to_slot"] == 1


def test_an_unknown_outcome_is_not_sent_again() -> None:
    engine, now = ready_engine()
    first = engine.publish(now, TOPIC, bytes(12), handle="x")
    second = engine.confirm(now + 1, Mailbox.NRT, Outcome.UNKNOWN, now + 1)
    third = engine.confirm(now + 2, Mailbox.NRT, Outcome.SENT, now + 2)
    frames = [action.frame for action in (*first, *second, *third) if isinstance(action, Transmit)]
    assert [frame.id & 0x7F for frame in frames] == [1, 0]
    assert third == [Done("x", Fate.UNKNOWN, False, now + 2)]


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
    engine = Engine(EngineSettings(number=1))
    assert engine.publish(0, 2, b"x", handle="h") == [Done("h", Fate.DISCARDED, False, 0)]
    assert engine.manage(0, bytes(32)) == ()
    assert (engine.id8, engine.next_deadline(), engine.poll(5)) == (None, None, ())
    with pytest.raises(MessageError, match="1 to 1024"):
        engine.publish(0, 2, bytes(1025))
    with pytest.raises(MessageError, match="high byte 1: topics have 2 to 255"):
        engine.publish(0, 1, b"x")
    with pytest.raises(MessageError, match="high byte 256"):
        engine.reserve(0, 256, 8, MS)
    with pytest.raises(ValueError, match="id8 0"):
        Engine(EngineSettings(number=1, id8=0))
    ready, now = ready_engine(capacity=2)
    last = [ready.publish(now, high, b"x", handle=high) for high in (2, 3, 4)][-1]
    assert last == [Done(4, Fate.FULL, False, now)]
    assert ready.transmitter.queue.size == 2
