"""How networks form, and survive: masters, parameters, ids."""

from itertools import pairwise

import pytest

from r2p.codecs import management, rtcan
from r2p.codecs.rtcan import Frame
from r2p.protocols.can_orders import Mailbox, Outcome, Withdraw
from r2p.protocols.rtcan.events import (
    Action,
    Done,
    Fate,
    ForeignSyncs,
    IdConflict,
    LostSync,
    NewMaster,
    ParameterMismatch,
    ParametersMatch,
    Ready,
    SlotsGranted,
    SlotsLost,
)
from r2p.protocols.rtcan.master import Role
from tests.protocols.rtcan.bus import MS, SECOND, Bus, Node
from tests.protocols.rtcan.networks import (
    CYCLE,
    SLOT,
    TOPIC,
    counted,
    current_cycle,
    is_sync,
    network,
    publish,
    ready_engine,
    starts,
    syncs,
)


def said(node: Node, message: management.Network) -> None:
    """A master says something to this node alone."""
    for left, data in rtcan.fragments(management.encode(message)):
        identifier = rtcan.encode_identifier(10, rtcan.message_id(rtcan.MANAGEMENT, message.id8), left)
        node.act(node.engine.receive(node.now, Frame(identifier, data), node.now))


def test_the_highest_priority_becomes_the_master_and_all_know_it() -> None:
    bus = Bus()
    nodes = network(bus, 3, 7, 7, 0)
    assert [node.engine.election.role for node in nodes] == [Role.SLAVE, Role.SLAVE, Role.MASTER, Role.SLAVE]
    assert {node.engine.network.master for node in nodes} == {12}
    assert len({node.engine.network.epoch for node in nodes}) == 1
    assert len({current_cycle(node.engine) for node in nodes}) == 1
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


def test_no_node_sends_before_having_listened() -> None:
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
    assert (late.engine.election.role, master.engine.election.role) == (Role.SLAVE, Role.MASTER)
    assert current_cycle(late.engine) == current_cycle(master.engine)
    assert late.engine.cycle.running
    assert late.engine.cycle.counter > 256  # it has the whole counter
    at = [start for start, _ in syncs(bus, joined)]
    assert {b - a for a, b in pairwise(at)} == {CYCLE}
    mine = [start for start, _, node in bus.sent if node is late]
    assert mine[0] > joined + 1_200 * MS
    reference = at[0]
    assert {(start - reference) % CYCLE // SLOT for start in mine}.isdisjoint({0})


def test_without_anybody_to_be_the_master_there_are_no_slots() -> None:
    bus = Bus()
    a, b = network(bus, 0, 0)
    assert [node.engine.election.role for node in (a, b)] == [Role.NONE, Role.NONE]
    b.engine.subscribe(rtcan.message_id(TOPIC, 10), 4)
    publish(a, TOPIC, b"abcd", 20 * MS)
    sent = bus.now
    bus.run(MS)
    assert b.received(TOPIC) == [b"abcd"]
    assert starts(bus, TOPIC) == [sent]


def test_a_node_alone_on_the_bus_gives_up_message_by_message() -> None:
    """No node acknowledges."""
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


# Losing sync, losing the master


def test_one_missed_sync_silences_soft_messages_for_a_cycle_and_nothing_else() -> None:
    bus = Bus()
    _, owner, _ = network(bus, 1, 0, 0)
    counted(owner)
    owner.act(owner.engine.reserve(owner.now, TOPIC, 8, MS))
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
    owner.act(owner.engine.reserve(owner.now, TOPIC, 8, MS))
    bus.run(100 * MS)
    owner.deaf = is_sync
    begin = bus.now
    bus.run(10 * CYCLE)
    assert len(owner.of(LostSync)) == 1
    assert owner.of(SlotsLost) == [SlotsLost(TOPIC, "no sync for too long")]
    hard = [at for at in starts(bus, TOPIC, 0) if at > begin]
    assert 3 * CYCLE < hard[-1] - begin < 5 * CYCLE
    owner.deaf = lambda frame: False
    bus.run(200 * MS)
    assert owner.engine.election.role is Role.SLAVE
    assert current_cycle(owner.engine) == current_cycle(master.engine)
    assert len(owner.of(SlotsGranted)) == 2
    assert starts(bus, TOPIC, 0)[-1] > bus.now - MS - SLOT


def test_the_next_best_takes_over_and_everything_goes_on() -> None:
    bus = Bus()
    first, second, third, owner = network(bus, 9, 5, 7, 0)
    filled = counted(owner)
    for node in second, third:
        node.engine.subscribe(rtcan.message_id(TOPIC, 13), 8)
    owner.act(owner.engine.reserve(owner.now, TOPIC, 8, MS))
    counted(second)
    second.act(second.engine.reserve(second.now, 6, 8, 10 * MS))
    bus.run(100 * MS)
    epoch, cycle, grid = owner.engine.network.epoch, owner.engine.cycle.counter, syncs(bus)[-1][0]
    phases = {node: node.of(SlotsGranted)[-1].phase for node in (owner, second)}
    bus.kill(first)
    died = bus.now
    bus.run(SECOND)
    assert [node.engine.election.role for node in (second, third, owner)] == [Role.SLAVE, Role.MASTER, Role.SLAVE]
    assert {node.engine.network.master for node in (second, third, owner)} == {12}
    assert {node.engine.network.epoch for node in (second, third, owner)} == {epoch}
    after = syncs(bus, died)
    assert {node for _, node in after} == {third}
    assert after[0][0] - died < 10 * CYCLE
    assert (after[0][0] - grid) % CYCLE < 2_000  # the same grid, but for the drift of no clock here
    assert owner.engine.cycle.running
    assert cycle is not None
    assert owner.engine.cycle.counter - cycle == pytest.approx(SECOND // CYCLE, abs=2)
    assert {node: node.of(SlotsGranted)[-1].phase for node in (owner, second)} == phases
    assert third.received(TOPIC)[-1] in filled[-2:]
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
    assert (second.engine.election.role, again.engine.election.role) == (Role.MASTER, Role.SLAVE)
    assert again.engine.network.epoch == second.engine.network.epoch


@pytest.mark.parametrize("count", [(1 << 64) - 1, 1 << 63, (1 << 63) // CYCLE + 1])
def test_a_count_of_cycles_that_cannot_be_is_not_taken_over(count: int) -> None:
    """It would get into grants and stamps, whose fields it does not fit."""
    bus = Bus()
    first, second, owner = network(bus, 9, 5, 0)
    epoch = second.engine.network.epoch or 0
    for node in second, owner:
        said(node, management.Network(first.engine.id8 or 0, 9, epoch, count, 60, SLOT))
        assert node.engine.counts == {"undecodable": 1}
    bus.kill(first)
    wanting = counted(owner)
    owner.act(owner.engine.reserve(owner.now, TOPIC, 8, 10 * MS))
    bus.run(SECOND)
    assert (second.engine.election.role, owner.engine.network.epoch, len(owner.of(SlotsGranted))) == (
        Role.MASTER,
        epoch,
        1,
    )
    assert wanting
    assert current_cycle(owner.engine) == current_cycle(second.engine)
    assert (current_cycle(owner.engine) or 0) < 1_000


def test_two_masters_that_meet_the_lesser_one_yields_at_once() -> None:
    """Two networks that did not hear each other are connected."""
    bus = Bus()
    groups = [[bus.add(id8=id8, priority=priority) for id8, priority in ((n, n), (n + 1, 0))] for n in (10, 20)]
    apart = True
    for group, others in (groups, groups[::-1]):
        for node in group:
            node.deaf = lambda frame, others=others: apart and bus.sent[-1][2] in others  # type: ignore[misc]  # bound
    bus.start(*groups[0])
    bus.run(3 * MS)
    bus.start(*groups[1])
    bus.run(3 * SECOND)
    roles = [[node.engine.election.role for node in group] for group in groups]
    assert roles == [[Role.MASTER, Role.SLAVE]] * 2
    apart = False
    met = bus.now
    bus.run(500 * MS)
    assert [node.engine.election.role for group in groups for node in group] == [
        Role.SLAVE,
        Role.SLAVE,
        Role.MASTER,
        Role.SLAVE,
    ]
    assert {node.engine.network.master for node in bus.nodes} == {20}
    assert len({node.engine.network.epoch for node in bus.nodes}) == 1
    lesser = [at for at, node in syncs(bus, met) if node is groups[0][0]]
    assert len(lesser) <= 3
    assert not any(node.of(ForeignSyncs) for node in bus.nodes)
    assert len({current_cycle(node.engine) for node in bus.nodes}) == 1


def test_syncs_of_another_node_are_reported_once_in_ten_seconds() -> None:
    """By the master, whose own they are not, and by a slave, as they are off the grid."""
    bus = Bus()
    master, slave, *_ = network(bus, 1, 0, 0)
    for _ in range(11 * 100):
        bus.run(master.engine.cycle.end + CYCLE // 2 - bus.now)
        forged = rtcan.encode_sync(master.engine.cycle.counter, 1)
        for node in master, slave:
            node.act(node.engine.receive(node.now, forged, node.now))
    times = [[at for at, action in node.actions if isinstance(action, ForeignSyncs)] for node in (master, slave)]
    assert [len(each) for each in times] == [2, 2]
    assert all(second - first >= 10 * SECOND for first, second in times)
    assert master.of(ForeignSyncs)[0].reason == "10 within a second are not the master's"


def test_a_few_syncs_of_another_node_are_not_reported() -> None:
    bus = Bus()
    master, slave, *_ = network(bus, 1, 0, 0)
    for _ in range(30):
        bus.run(120 * MS)
        for node in master, slave:
            node.act(node.engine.receive(node.now, rtcan.encode_sync(0, 1), node.now))
    assert master.engine.counts["foreign syncs"] == slave.engine.counts["foreign syncs"] == 30
    assert not any(node.of(ForeignSyncs) for node in (master, slave))


def test_new_slots_are_not_given_away_before_the_old_owners_have_asked() -> None:
    bus = Bus()
    first, second, owner, newcomer = network(bus, 9, 5, 0, 0)
    counted(owner)
    counted(newcomer)
    owner.act(owner.engine.reserve(owner.now, TOPIC, 8, 10 * MS))
    bus.run(100 * MS)
    (granted,) = owner.of(SlotsGranted)
    bus.kill(first)
    newcomer.act(newcomer.engine.reserve(newcomer.now, 6, 8, 10 * MS))
    bus.run(SECOND)
    assert second.engine.election.role is Role.MASTER
    assert owner.of(SlotsGranted)[-1].phase == granted.phase
    assert newcomer.of(SlotsGranted)[-1].phase != granted.phase


# Parameters and ids


def test_a_node_with_other_parameters_does_not_transmit() -> None:
    bus = Bus()
    master, _ = network(bus, 1, 0)
    other = bus.add(id8=20, slots=50)
    bus.start(other)
    bus.run(3 * SECOND)
    (silenced,) = other.of(ParameterMismatch)
    assert silenced.reason == "the network has 60 slots of 166 us, this node 50 of 200 us"
    assert not any(node is other for _, _, node in bus.sent)
    bus.kill(master)
    bus.run(5 * SECOND)
    assert other.of(ParametersMatch)
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
    assert "this node's 10000 us" in other.of(ParameterMismatch)[0].reason
    begin = bus.now
    publish(node, TOPIC, b"x", 50 * MS)
    bus.run(50 * MS)
    assert (starts(bus, TOPIC)[0] - syncs(bus, begin)[0][0]) % SLOT == 0
    assert node.engine.network_time(node.now) is None


def test_a_cycle_of_the_same_length_does_not_make_up_for_other_slots() -> None:
    bus = Bus()
    network(bus, 1, 0)
    other = bus.add(id8=20, slots=30, cycle=CYCLE)
    bus.start(other)
    bus.run(6 * SECOND)
    assert other.engine.timing.cycle == CYCLE
    assert [each.reason for each in other.of(ParameterMismatch)] == [
        "the network has 60 slots of 166 us, this node 30 of 332 us"
    ]
    assert [each.id8 for each in other.of(NewMaster)] in ([], [10])
    assert not any(node is other for _, _, node in bus.sent)


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


def test_two_that_find_each_other_with_one_id_part_in_no_time() -> None:
    """Neither received the other one's claims before: two buses were joined."""
    bus = Bus()
    nodes = [bus.add(id8=id8, number=number << 40) for number, id8 in enumerate((10, 10, 20), 1)]
    for node in nodes[:2]:
        node.deaf = lambda frame: frame.id >> 7 & 0xFF == 10
    bus.start(*nodes[::2])
    bus.run(700 * MS)
    bus.start(nodes[1])
    bus.run(2 * SECOND)
    assert [node.engine.id8 for node in nodes[:2]] == [10, 10]
    for node in nodes[:2]:
        node.deaf = lambda frame: False
    bus.run_until(lambda: any(node.of(IdConflict) for node in nodes))
    bus.run(300 * MS)
    assert [node.engine.id8 for node in nodes[:2]] == [10, None]


def test_what_waits_is_discarded_when_the_id8_is_lost() -> None:
    engine, now = ready_engine()
    engine.reserve(now, 6, 8, 10 * MS)
    engine.publish(now, TOPIC, b"1", handle=1)
    engine.publish(now, TOPIC, b"2", handle=2)
    claim = management.encode(management.Claim(10, 0))
    actions: list[Action] = []
    for left, data in rtcan.fragments(claim) * 2:
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
