"""Who becomes the master and when, and the first moments of a master: on a full bus, beside another one, alone."""

import itertools

import pytest

from r2p.codecs import can_bits, management, rtcan
from r2p.codecs.rtcan import Frame
from r2p.protocols.can_orders import Mailbox, Outcome, Transmit, Withdraw
from r2p.protocols.rtcan.cycle import timing
from r2p.protocols.rtcan.engine import Engine
from r2p.protocols.rtcan.events import (
    EngineContext,
    EngineSettings,
    LostSync,
    NewMaster,
    Profile,
    Ready,
    SlotsGranted,
    SlotsLost,
)
from r2p.protocols.rtcan.master import FRESH, Election, Role
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
    starts,
    syncs,
)

WINDOW = 3 * timing().cycle


class Candidate:
    def __init__(self, id8: int, priority: int) -> None:
        self.id8 = id8
        context = EngineContext(EngineSettings(number=1, priority=priority))
        self.timers = context.timers
        self.election = Election(context)

    def takes_over_at(self) -> int | None:
        """When it becomes the master, if nothing happens."""
        while (at := self.timers.next()) is not None:
            list(self.timers.pop(at))
            if self.election.decide(at, self.id8):
                return at
        return None


def test_the_highest_priority_then_the_highest_id8_takes_over_first() -> None:
    candidates = [Candidate(10, 5), Candidate(12, 5), Candidate(200, 4), Candidate(11, 7)]
    for each in candidates:
        each.election.begin(0, forget=True)
        for other in candidates:
            if other is not each:
                each.election.on_claim(1 * MS, other.id8, 7 if other.id8 == 11 else 4 if other.id8 == 200 else 5)
    at = {each.id8: each.takes_over_at() for each in candidates}
    assert at == {11: WINDOW, 12: 2 * WINDOW, 10: 3 * WINDOW, 200: 4 * WINDOW}


def test_priority_0_never_takes_over() -> None:
    never = Candidate(10, 0)
    never.election.begin(0, forget=True)
    assert never.takes_over_at() is None
    assert never.election.role is Role.NONE
    lowest = Candidate(9, 1)
    lowest.election.begin(0, forget=True)
    lowest.election.on_claim(0, 10, 0)
    assert lowest.takes_over_at() == WINDOW


def test_those_of_long_ago_do_not_count() -> None:
    candidate = Candidate(10, 5)
    candidate.election.on_claim(0, 11, 9)
    candidate.election.begin(FRESH, forget=False)
    assert candidate.takes_over_at() == FRESH + WINDOW
    candidate.election.on_claim(FRESH, 11, 9)
    candidate.election.begin(FRESH + 1, forget=True)
    assert candidate.takes_over_at() == FRESH + 1 + WINDOW


def test_a_master_ends_it() -> None:
    candidate = Candidate(10, 5)
    candidate.election.begin(0, forget=True)
    candidate.election.end(Role.SLAVE)
    assert candidate.takes_over_at() is None
    assert candidate.election.role is Role.SLAVE


def test_of_two_masters_the_higher_stays() -> None:
    election = Candidate(10, 5).election
    assert election.beats(10, 4, 200)
    assert election.beats(10, 5, 9)
    assert not election.beats(10, 5, 11)
    assert not election.beats(10, 6, 1)


# On a bus


def wanting(node: Node) -> None:
    """It wants slots as soon as it may send."""
    counted(node)
    node.on_ready = lambda: node.engine.reserve(node.now, TOPIC, 8, 10 * MS)


def listens(node: Node) -> int:
    """How long after its start it will claim its id8, random numbers included, less 1.2 s (ns)."""
    twin = Engine(EngineSettings(number=node.engine.settings.number))
    twin.start(0)
    return (twin.next_deadline() or 0) - 1_200 * MS


def deaf_to_management(frame: Frame) -> bool:
    return frame.id >> 15 & 0xFF == rtcan.MANAGEMENT


def hears_all(_frame: Frame) -> bool:
    return False


@pytest.mark.parametrize("priorities", [(1, 1), (2, 1), (1, 2)])
def test_two_that_take_over_at_the_same_instant(priorities: tuple[int, int]) -> None:
    """They send the very same sync, which no controller can notice. Their slaves follow the better one in no time."""
    bus = Bus()
    rivals = [bus.add(id8=10 + i, priority=each) for i, each in enumerate(priorities)]
    slaves = [bus.add(id8=30 + i) for i in range(3)]
    for rival in rivals:
        rival.deaf = deaf_to_management  # each believes to be the best
    for slave in slaves:
        wanting(slave)
    bus.start(*slaves)
    for rival in sorted(rivals, key=listens, reverse=True):
        bus.run(SECOND - listens(rival) - bus.now)
        bus.start(rival)
    bus.run_until(lambda: all(rival.engine.election.role is Role.MASTER for rival in rivals))
    met = bus.now
    for rival in rivals:
        rival.deaf = hears_all
    bus.run(100 * MS)
    best = max(rivals, key=lambda rival: (priorities[rivals.index(rival)], rival.engine.id8 or 0))
    assert [rival for rival in rivals if rival.engine.election.role is Role.MASTER] == [best]
    assert {node.engine.network.master for node in bus.nodes} == {best.engine.id8}
    assert {node.engine.network.epoch for node in bus.nodes} == {best.engine.network.epoch}
    assert all(slave.of(SlotsGranted) for slave in slaves)
    assert not any(slave.of(LostSync) for slave in slaves)
    assert {(at - syncs(bus, met)[0][0]) % CYCLE for at, _ in syncs(bus, met)} == {0}


def test_a_sync_gets_through_where_the_bus_is_full() -> None:
    """No node has slots before there is a sync; one that had to hit an instant would not get through for long."""
    bus = Bus()
    masters = [bus.add(priority=1, number=n << 40 | n) for n in range(1, 5)]
    stranger = bus.add(id8=99)
    stranger.deaf = lambda frame: True

    def babble() -> None:
        while stranger.engine.ready and stranger.engine.waiting < 4 and not any(node.of(NewMaster) for node in masters):
            publish(stranger, TOPIC, bytes(64), 5 * MS, drop=False)

    bus.start(stranger)
    bus.run(SECOND)
    bus.start(*masters)
    bus.run(SECOND)
    while not any(node.of(NewMaster) for node in masters):
        babble()
        bus.run(MS // 4)
    bus.run(300 * MS)
    assert [node.engine.election.role for node in masters].count(Role.MASTER) == 1
    assert [len(node.of(NewMaster)) for node in masters] == [1] * 4
    (first, *others), (master, *_) = zip(*syncs(bus), strict=True)
    before = [(at, at + can_bits.frame_bits(frame.id, frame.data) * 1_000) for at, frame, _ in bus.sent if at < first]
    assert first - before[-1][1] == can_bits.INTERMISSION * 1_000  # the bus was full
    assert {(at - first) % CYCLE for at in others} == {0}  # the grid begins where the frame did
    assert master.engine.counts["syncs not sent"] == 0


def test_messages_may_be_sent_when_the_election_is_over() -> None:
    """Till then nothing but management goes, so nothing else could be promised."""
    bus = Bus()
    nodes = [bus.add(priority=priority, number=n << 40 | n) for n, priority in enumerate((1, 1, 0, 1), 1)]
    for node in nodes:
        wanting(node)
    bus.start()
    bus.run_until(lambda: any(node.of(NewMaster) for node in nodes))
    assert not any(node.of(Ready) for node in nodes if not node.of(NewMaster))
    bus.run(SECOND)
    assert [len(node.of(Ready)) for node in nodes] == [1] * 4
    assert [len(node.of(SlotsGranted)) for node in nodes] == [1] * 4
    assert not any(node.of(SlotsLost) for node in nodes)
    assert sum(node.engine.counts["missed"] for node in nodes) == 0


def test_without_anybody_to_be_the_master_messages_may_be_sent_all_the_same() -> None:
    bus = Bus()
    nodes = [bus.add(id8=10 + n) for n in range(2)]
    bus.start()
    bus.run_until(lambda: all(node.engine.ready for node in nodes))
    assert bus.now < 1_200 * MS + 50 * MS + 250 * MS + 4 * CYCLE


def test_a_node_of_priority_0_waits_for_those_that_could_be_the_master() -> None:
    """It would fill the bus in which they try to agree."""
    bus = Bus()
    slow, pc = bus.add(id8=10, priority=1, number=1 << 40), bus.add(id8=11, number=1 << 40)
    bus.start()
    bus.run_until(lambda: pc.engine.ready)
    assert (slow.engine.election.role, pc.engine.election.role) == (Role.MASTER, Role.SLAVE)


def test_who_is_alone_becomes_the_master_of_nobody_and_others_join() -> None:
    bus = Bus()
    alone = bus.add(id8=10, priority=1)
    bus.start()
    bus.run(2 * SECOND)
    assert alone.engine.election.role is Role.MASTER
    assert bus.sent == []
    other = bus.add(id8=11, priority=9)
    bus.start(other)
    bus.run(2 * SECOND)
    assert (alone.engine.election.role, other.engine.election.role) == (Role.MASTER, Role.SLAVE)
    assert other.engine.network.master == 10


@pytest.mark.parametrize("heard", [300 * MS, 1_190 * MS])
def test_a_master_that_dies_while_another_node_still_listens(heard: int) -> None:
    """The newcomer follows its cycle without a word, so it must notice the end without a word, too."""
    bus = Bus()
    (master,) = network(bus, 1)
    late = bus.add(id8=20, priority=1)
    bus.start(late)
    bus.run(heard)
    bus.kill(master)
    bus.run(5 * CYCLE)
    assert [type(news) for news in late.of(LostSync)] == [LostSync]
    bus.run(2 * SECOND)
    assert late.engine.election.role is Role.MASTER


def until_first_sync(engine: Engine) -> int:
    """All else is sent at once; comes back: when."""
    while True:
        now = engine.next_deadline() or 0
        actions = list(engine.poll(now))
        for action in actions:
            if isinstance(action, Transmit) and is_sync(action.frame):
                return now
            if isinstance(action, Transmit):
                actions += engine.confirm(now, action.mailbox, Outcome.SENT, now)


@pytest.mark.parametrize("outcome", [Outcome.LATE, Outcome.LOST, Outcome.SENT])
def test_a_sync_of_somebody_else_comes_first(outcome: Outcome) -> None:
    """Ours is taken back, if that is still possible."""
    engine = Engine(EngineSettings(number=1 << 40, id8=10, priority=1, profile=Profile.RTCAN))
    engine.start(0)
    now = until_first_sync(engine)
    other = rtcan.encode_sync(200, 1)
    taken = engine.receive(now, other, now)
    assert Withdraw(Mailbox.HRT) in taken
    news = [*taken, *engine.confirm(now, Mailbox.HRT, outcome, now)]
    assert not any(isinstance(action, NewMaster) for action in news)
    assert (engine.election.role, current_cycle(engine)) == (Role.SLAVE, 200)
    assert engine.counts == {}


def test_a_first_sync_that_was_given_up_makes_no_master_when_it_comes_through_at_last() -> None:
    """It says nothing of the cycle that this node would lead now."""
    engine = Engine(EngineSettings(number=1 << 40, id8=10, priority=1, profile=Profile.RTCAN))
    engine.start(0)
    now = until_first_sync(engine)
    engine.receive(now, rtcan.encode_sync(200, 1), now)
    for at in range(now, now + 20 * CYCLE, MS):  # the master is gone, and that frame still with the controller
        for action in engine.poll(at):
            if isinstance(action, Transmit):
                engine.confirm(at, action.mailbox, Outcome.SENT, at)
    news = engine.confirm(at, Mailbox.HRT, Outcome.SENT, at)
    assert not any(isinstance(action, NewMaster) for action in news)
    now = until_first_sync(engine)
    engine.confirm(now, Mailbox.HRT, Outcome.SENT, now)
    assert engine.election.role is Role.MASTER


def test_who_learns_that_its_slots_are_wrong_does_not_become_the_master_any_more() -> None:
    """Its first sync is on the bus already."""
    engine = Engine(EngineSettings(number=1 << 40, id8=10, priority=1, profile=Profile.RTCAN))
    engine.start(0)
    now = until_first_sync(engine)
    network_message = management.encode(management.Network(20, 1, 77, 5, 30, 2 * SLOT))
    for left, data in rtcan.fragments(network_message):
        frame = Frame(rtcan.encode_identifier(10, rtcan.message_id(rtcan.MANAGEMENT, 20), left), data)
        engine.receive(now, frame, now)
    assert engine.network.mismatch
    engine.confirm(now, Mailbox.HRT, Outcome.SENT, now)
    assert engine.election.role is not Role.MASTER
    assert until_first_sync(engine) > now + 3 * SECOND  # it was not said again


def test_a_new_master_of_an_old_network_may_begin_late_and_nobody_minds() -> None:
    """The others send management meanwhile, which its first sync may have to wait for."""
    bus = Bus()
    first, second, owner, talker = network(bus, 9, 5, 0, 0)
    wanting(owner)
    owner.act(owner.on_ready())
    bus.run(100 * MS)
    epoch = owner.engine.network.epoch
    bus.kill(first)
    died = bus.now

    numbers = itertools.count()  # a message that waits already is not queued again

    def chatter() -> None:
        while talker.engine.waiting < 3:
            talker.act(talker.engine.manage(talker.now, next(numbers).to_bytes(31) + b"\xff"))

    while not syncs(bus, died):
        chatter()
        bus.run(MS // 4)
    bus.run(5 * CYCLE // 2)
    late = (syncs(bus, died)[0][0] - syncs(bus)[0][0]) % CYCLE
    assert 2_000 < late < SLOT
    assert (second.engine.election.role, owner.engine.network.epoch, owner.engine.network.master) == (
        Role.MASTER,
        epoch,
        11,
    )
    assert current_cycle(owner.engine) == current_cycle(second.engine)
    bus.run(100 * MS)
    assert len(owner.of(SlotsGranted)) == 2
    assert starts(bus, TOPIC, 0)[-1] > bus.now - 2 * CYCLE


@pytest.mark.parametrize("latency", [0, 5_000, 10_000, 20_000])
def test_a_sync_that_is_heard_late_is_not_a_missed_one(latency: int) -> None:
    bus = Bus()
    master, slave = network(bus, 1, 0, receive_latency=latency, transmit_latency=latency)
    received = slave.engine.receive

    def slow(now: int, frame: Frame, stamp: int) -> object:
        return received(now + latency, frame, stamp + latency)

    slave.engine.receive = slow  # type: ignore[method-assign, assignment]
    wanting(slave)
    slave.act(slave.on_ready())
    bus.run(SECOND)
    assert slave.engine.counts["missed syncs"] == 0
    slave.deaf = is_sync
    bus.run(2 * CYCLE)
    slave.deaf = hears_all
    bus.run(3 * CYCLE)
    assert slave.engine.counts["missed syncs"] == 2
    assert master.engine.election.role is Role.MASTER
