"""Driving an engine, and networks of firmware."""

from collections.abc import Sequence
from itertools import pairwise

import pytest

from r2p.codecs import management, rtcan
from r2p.codecs.rtcan import Frame
from r2p.protocols.rtcan.engine import Engine
from r2p.protocols.rtcan.events import Action, Done, EngineSettings, Fate, LostSync, Profile, Received
from r2p.protocols.rtcan.master import Role
from tests.protocols.rtcan.bus import MS, SECOND, Bus
from tests.protocols.rtcan.networks import (
    SLOT,
    TOPIC,
    counted,
    current_cycle,
    firmware_management,
    network,
    publish,
    ready_engine,
    syncs,
)


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
    assert node.engine.election.role is Role.NONE
    assert {frame.id >> 7 & 0xFFFF for _, frame, _ in bus.sent} == {0}
    first = [at for at, frame, _ in bus.sent if frame.id & 0x7F == 3]
    firmware_management(bus, node, b"IMU1")
    heard = bus.now
    node.act(node.engine.manage(node.now, b"hello".ljust(32, b"\0")))
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
    node.engine.subscribe(0x0121, 4)  # the first topic of the module 0x21
    node.act(node.engine.receive(node.now, Frame(rtcan.encode_identifier(9, 0x0121), b"abcd"), node.now))
    assert node.of(Received)[-1].payload == b"abcd"


# Driving it


def test_management_reaches_everybody_and_stop_goes_first() -> None:
    bus = Bus()
    a, b, c = network(bus, 1, 0, 0)
    hello, stop = b"hello".ljust(32, b"\0"), b"stop".ljust(32, b"\0")
    b.act(b.engine.manage(b.now, hello))
    b.act(b.engine.manage(b.now, stop, urgent=True))
    bus.run(20 * MS)
    for node in a, c:
        assert node.received(rtcan.MANAGEMENT)[-2:] == [stop, hello]
    assert [received.source for received in a.of(Received)][-1] == 11
    frames = [frame for _, frame, _ in bus.sent if frame.data.startswith(b"stop")]
    assert frames[0].id >> 23 == 1


def test_filters_let_through_what_is_needed() -> None:
    bus = Bus()
    a, b = network(bus, 1, 0)
    assert Engine(EngineSettings(number=1)).filters() == [(0, 0)]
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
    node.act(node.engine.stop(node.now))
    assert node.of(Done)[-1].fate is Fate.DISCARDED
    node.boxes.clear()
    bus.run(SECOND)
    assert node.engine.next_deadline() is None
    assert node.engine.receive(node.now, rtcan.encode_sync(1, 1), node.now) == ()
    bus.start(node)
    bus.run(2 * SECOND)
    assert node.engine.id8 == 11
    assert current_cycle(node.engine) == current_cycle(master.engine)


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
    assert master.engine.election.role is Role.MASTER


def hostile(epoch: int) -> list[management.Management]:
    """What is well formed and makes no sense, from the module 0xEE."""
    u32, u64 = (1 << 32) - 1, (1 << 64) - 1
    return [
        management.Network(0xEE, 0, epoch, u64, 60, 166_000),
        management.Network(0xEF, 255, epoch, u64, 60, 166_000),
        management.Reserve(0x05EE, 0, 255, u32, u32, 255),
        management.Reserve(0x05EE, 0, 0, 0, 0),
        management.Reserve(0x05EE, 0, 1, 60, u32 - 1),
        management.Reserve(0x050A, 0, 1, 60),
        management.Grant(0x050B, 0, 1, 1, 0, u64, epoch, 65535),
        management.Refuse(0x050B, 0, 255, 0, 0),
        management.Release(0x050B),
        management.Renew(0, bytes(24)),
        management.Renewed(0x0B, 0, 0, bytes(24)),
    ]


def test_rubbish_from_the_bus_changes_nothing() -> None:
    bus = Bus()
    a, b = network(bus, 1, 0)
    before = (b.engine.election.role, b.engine.network.epoch)
    for code in management.RTCAN_TYPES:
        for version in (0, 1, 2, 255):
            data = bytes([version]) + b"\xff" * 30 + bytes([code])
            for left, part in rtcan.fragments(data):
                b.act(b.engine.receive(b.now, Frame(rtcan.encode_identifier(9, 0x01EE, left), part), b.now))
    b.act(b.engine.receive(b.now, Frame(0x00000080, b"short"), b.now))
    for message in hostile(a.engine.network.epoch or 0):
        for left, part in rtcan.fragments(management.encode(message)):
            for node in a, b:
                node.act(node.engine.receive(node.now, Frame(rtcan.encode_identifier(9, 0x01EE, left), part), node.now))
    bus.run(3 * SECOND)
    assert (b.engine.election.role, b.engine.network.epoch) == before
    assert a.engine.election.role is Role.MASTER


def test_a_node_that_slept_finds_its_place_again() -> None:
    """The process was stopped for 10 s: both as a slave and as the master."""
    for sleeper in (0, 1):
        bus = Bus()
        nodes = network(bus, 2, 1, 0)
        counted(nodes[sleeper])
        nodes[sleeper].act(nodes[sleeper].engine.reserve(nodes[sleeper].now, TOPIC, 8, MS))
        bus.run(100 * MS)
        node = nodes[sleeper]
        asleep = bus.nodes.index(node)
        bus.nodes.remove(node)
        node.boxes.clear()
        bus.run(10 * SECOND)
        bus.nodes.insert(asleep, node)
        node.boxes.clear()
        before = len(node.of(LostSync))
        bus.run(3 * SECOND)
        if sleeper == 0:
            assert "its computer was busy or stopped: give r2p a real-time priority" in node.of(LostSync)[before].reason
        assert sorted(each.engine.election.role.value for each in nodes) == ["master", "slave", "slave"]
        assert len({current_cycle(each.engine) for each in nodes}) == 1
        assert len({each.engine.network.master for each in nodes}) == 1


def test_discovery_that_waits_already_is_not_sent_twice() -> None:
    engine, now = ready_engine()
    alive, other = (management.encode(management.Alive(name)) for name in ("A", "B"))
    for data in (alive, other, alive, other, alive):
        engine.manage(now, data)
    assert engine.management_waiting == 2
    engine.manage(now, alive, handle="its fate matters")
    assert engine.management_waiting == 3


def waiting_management(engine: Engine) -> list[management.Management]:
    payloads = [each.payload for each in engine.transmitter.queue.messages()]
    return [management.decode(rtcan.unpack_management(each, management.SIZE)) for each in payloads]


def test_a_message_of_the_network_replaces_the_one_before_that_still_waits() -> None:
    engine, now = ready_engine()
    sender = engine.management
    engine.manage(now, management.encode(management.Alive("A")))  # it has started, so it stays the first one
    sender.send(now, management.Reserve(0x050A, 1, 1, 60))
    sender.send(now, management.Reserve(0x060A, 2, 1, 60))
    sender.send(now, management.Reserve(0x050A, 3, 1, 60))
    sender.send(now, management.Grant(0x050B, 1, 1, 60, 5, 1, 7, 3000))
    sender.send(now, management.Refuse(0x050B, 2, 4, 1, 60))
    waiting = waiting_management(engine)
    assert waiting[1:] == [
        management.Refuse(0x050B, 2, 4, 1, 60),
        management.Reserve(0x060A, 2, 1, 60),
        management.Reserve(0x050A, 3, 1, 60),
    ]


def test_a_good_bye_stays_behind_what_was_said_before_it() -> None:
    engine, now = ready_engine()
    hello = management.Hello("A", 1, 0, 0, 5000)
    leaving = management.Hello("A", 1, management.HELLO_LEAVING, 0, 5000)
    said: list[management.Management] = [
        management.Advertise("leds", 5),
        management.Advertise("pwm", 2),
        hello,
        leaving,
    ]
    for message in said:
        engine.manage(now, management.encode(message))
    waiting = waiting_management(engine)
    assert waiting == [said[0], hello, said[1], leaving]  # the first one has started
