"""Watching a bus: kinds, names, loads and the slot map, from the frames of a network of engines."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from r2p.codecs import call_parts, can_bits, management, rtcan
from r2p.codecs.can_bits import INTERMISSION
from r2p.codecs.rtcan import Frame, OtherFrame
from r2p.protocols.rtcan.cycle import timing
from r2p.protocols.rtcan.events import SlotsGranted
from r2p.protocols.rtcan.monitor import FrameKind, Monitor, SeenFrame, TrafficCount
from tests.protocols.rtcan.bus import MS, SECOND, Bus, Node
from tests.protocols.rtcan.networks import CYCLE, TOPIC, counted, network, publish

BIT = 1000


class Watched:
    """A master, an owner of slots and a talker, and a monitor that hears them."""

    def __init__(self) -> None:
        self.bus = Bus()
        self.monitor = Monitor(timing())
        self.seen: list[SeenFrame] = []
        self._heard = 0
        self.master, self.owner, self.talker = network(self.bus, 1, 0, 0)

    def run(self, duration: int) -> None:
        self.bus.run(duration)
        for start, frame, _ in self.bus.sent[self._heard :]:
            end = start + can_bits.frame_bits(frame.id, frame.data) * BIT
            self.seen.append(self.monitor.frame(frame, end))
        self._heard = len(self.bus.sent)

    def say(self, node: Node, message: management.Management) -> None:
        node.act(node.engine.manage(node.now, management.encode(message)))

    def reserve(self, interval: int = 5 * MS) -> SlotsGranted:
        counted(self.owner)
        self.owner.act(self.owner.engine.reserve(self.owner.now, TOPIC, 8, interval))
        self.run(3 * CYCLE)
        return self.owner.of(SlotsGranted)[-1]

    def watch(self, cycles: int) -> None:
        """Count from now on, for so many cycles."""
        self.monitor.reset(self.bus.now)
        self.run(cycles * CYCLE)


def test_a_frame_is_told_by_its_laxity_and_id() -> None:
    watched = Watched()
    watched.reserve()
    publish(watched.talker, 7, b"soon", 20 * MS)
    publish(watched.talker, 8, b"some time")
    watched.run(CYCLE)
    assert {(seen.kind, seen.frame.id >> 15 & 0xFF) for seen in watched.seen} == {
        (FrameKind.SYNC, 0),
        (FrameKind.MANAGEMENT, 1),
        (FrameKind.SRT, TOPIC),  # before it had slots
        (FrameKind.HRT, TOPIC),
        (FrameKind.SRT, 7),
        (FrameKind.NRT, 8),
    }
    longer = [seen for seen in watched.seen if seen.kind is FrameKind.NRT]
    assert [seen.left for seen in longer] == [1, 0]
    assert all(seen.laxity == 63 for seen in longer)


def test_names_are_learnt_from_what_the_modules_tell_each_other() -> None:
    watched = Watched()
    watched.reserve()
    watched.run(CYCLE)
    assert (watched.seen[-1].topic or "sync", watched.monitor.directory.module(0x050B)) != ("encoder", "MOTOR1")
    params = rtcan.message_id(TOPIC, 11).to_bytes(2, "little") + bytes(8)
    watched.say(watched.owner, management.Hello("MOTOR1", 7, 0, 0, 5000))
    watched.say(watched.owner, management.SubscribeResponse("encoder", 8, 1, params))
    watched.say(watched.owner, management.Advertise("encoder", 8, 0, bytes(10)))
    watched.run(5 * CYCLE)
    hrt = [seen for seen in watched.seen if seen.kind is FrameKind.HRT]
    assert (hrt[0].topic, hrt[0].module) == ("0x050B", "id 11")
    assert (hrt[-1].topic, hrt[-1].module, hrt[-1].fragments) == ("encoder", "MOTOR1", 1)
    texts = [seen.text for seen in watched.seen if seen.kind is FrameKind.MANAGEMENT and seen.text]
    assert any(text.startswith("SubscribeResponse topic=encoder size=8") and "id=0x050B" in text for text in texts)


def test_a_forwarded_hello_does_not_rename_the_gateway() -> None:
    watched = Watched()
    watched.say(watched.owner, management.Hello("GW", 7, 0, 0, 5000))
    watched.run(5 * CYCLE)
    watched.say(watched.owner, management.Hello("FAR", 8, 0, 1, 5000))
    watched.say(watched.owner, management.Alive("FAR2", 0))
    watched.run(5 * CYCLE)
    assert watched.monitor.directory.modules[11] == "GW"


def test_the_slot_map_shows_owners_and_what_they_missed() -> None:
    watched = Watched()
    granted = watched.reserve()
    own = set(range(granted.phase, 60, granted.period))
    watched.watch(21)
    slots, cycles = watched.monitor.slots, watched.monitor.cycles
    assert cycles in {19, 20}
    assert {i for i, slot in enumerate(slots) if "0x050B" in slot.owners} == own
    assert slots[0].owners.keys() == {"sync"}
    assert all(slots[i].reserved == slots[i].used == cycles and not slots[i].missed for i in own)
    assert all(not slot.reserved for i, slot in enumerate(slots[1:], 1) if i not in own)
    watched.bus.kill(watched.owner)
    watched.watch(11)
    assert {slot.missed for i, slot in enumerate(watched.monitor.slots) if i in own} == {watched.monitor.cycles}


def test_the_load_counts_every_bit() -> None:
    watched = Watched()
    watched.reserve()
    begin = len(watched.bus.sent)
    watched.monitor.reset(watched.bus.now)
    for number in range(300):
        publish(watched.talker, 7, number.to_bytes(8, "little"), 20 * MS)
        publish(watched.talker, 8, number.to_bytes(8, "little"))
        watched.run(3 * MS)
    load = watched.monitor.load(watched.bus.now)
    bits = [can_bits.frame_bits(frame.id, frame.data) + INTERMISSION for _, frame, _ in watched.bus.sent[begin:]]
    assert load.total == pytest.approx(sum(bits) * BIT / (900 * MS))
    assert sum(tally.frames for tally in load.tallies.values()) == len(bits)
    assert load.tallies["0x070C", "id 12", FrameKind.SRT].frames == 300
    assert load.reserved == pytest.approx(3 / 60, rel=0.03)  # the sync and two slots in each cycle
    in_free = sum(
        tally.bits for (_, _, kind), tally in load.tallies.items() if kind not in {FrameKind.SYNC, FrameKind.HRT}
    )
    assert load.share(in_free) / (1 - load.reserved) < load.free_used < 1.0
    events = sum(
        tally.frames for (_, _, kind), tally in load.tallies.items() if kind not in {FrameKind.SYNC, FrameKind.HRT}
    )
    assert load.free_used == pytest.approx(events / (900 * MS / CYCLE * 57), rel=0.03)  # a frame takes a whole slot
    assert load.nrt_gap is not None
    assert load.nrt_gap < 10 * MS


def test_how_long_nrt_starves() -> None:
    watched = Watched()
    publish(watched.talker, 8, b"first")
    watched.run(CYCLE)
    watched.monitor.reset(watched.bus.now)
    watched.run(SECOND)
    assert watched.monitor.load(watched.bus.now).nrt_gap is None  # there was none at all
    publish(watched.talker, 8, b"again")
    watched.run(300 * MS)
    gap = watched.monitor.load(watched.bus.now).nrt_gap
    assert gap is not None
    assert SECOND <= gap < SECOND + 2 * MS
    watched.run(2 * SECOND)
    gap = watched.monitor.load(watched.bus.now).nrt_gap
    assert gap is not None
    assert gap > 2 * SECOND


def test_without_syncs_there_are_no_slots() -> None:
    watched = Watched()
    watched.run(CYCLE)
    assert watched.seen[-1].slot is not None
    watched.bus.kill(watched.master)
    watched.run(10 * CYCLE)
    publish(watched.talker, 7, b"late", SECOND)
    watched.run(CYCLE)
    assert [seen.slot for seen in watched.seen if seen.frame.data == b"late"] == [None]
    monitor = Monitor(timing())
    assert monitor.frame(Frame(rtcan.encode_identifier(63, 0x070C), b"x"), SECOND).slot is None
    assert monitor.slots == []


def test_the_network_tells_its_own_timing() -> None:
    bus = Bus()
    network(bus, 1, 0, slots=10, cycle=10 * MS)
    monitor = Monitor(timing())
    for start, frame, _ in bus.sent:
        monitor.frame(frame, start + can_bits.frame_bits(frame.id, frame.data) * BIT)
    assert monitor.directory.timing_known
    assert (monitor.directory.timing.slots, monitor.directory.timing.slot) == (10, MS)
    assert len(monitor.slots) == 10  # not those of before
    assert monitor.cycles > 10


@pytest.mark.parametrize(("slots", "slot"), [(60, 0), (0, 166_000), (1, 166_000), (65, 166_000)])
def test_a_timing_that_cannot_be_is_not_learnt(slots: int, slot: int) -> None:
    monitor = Monitor(timing())
    monitor.frame(rtcan.encode_sync(1, 0b11), MS)
    announced = management.encode(management.Network(10, 1, 1, 1, slots, slot))
    for left, data in rtcan.fragments(announced):
        identifier = rtcan.encode_identifier(10, rtcan.message_id(rtcan.MANAGEMENT, 10), left)
        monitor.frame(Frame(identifier, data), 2 * MS)
    monitor.frame(rtcan.encode_sync(2, 0b11), MS + CYCLE)
    assert (monitor.directory.timing_known, monitor.directory.timing, monitor.cycles) == (False, timing(), 1)


def test_an_owner_whose_name_comes_late_is_one_owner() -> None:
    watched = Watched()
    granted = watched.reserve()
    watched.watch(5)
    assert list(watched.monitor.slots[granted.phase].owners) == [f"0x{TOPIC:02X}0B"]
    params = rtcan.message_id(TOPIC, 11).to_bytes(2, "little").ljust(10, b"\0")
    watched.say(watched.owner, management.SubscribeResponse("encoder", 8, 1, params))
    watched.run(5 * CYCLE)
    assert watched.monitor.slots[granted.phase].owners == {"encoder": 10}


@given(
    st.lists(
        st.tuples(st.integers(0, (1 << 29) - 1), st.binary(max_size=8), st.integers(0, 20 * MS)),
        max_size=60,
    )
)
def test_nothing_on_the_bus_upsets_it(frames: list[tuple[int, bytes, int]]) -> None:
    monitor = Monitor(timing())
    now = 0
    for identifier, data, pause in frames:
        now += pause
        monitor.frame(Frame(identifier, data), now)
    assert sum(tally.frames for tally in monitor.load(now).tallies.values()) == len(frames)
    assert len(monitor.slots) <= 64


def test_parts_of_calls_are_described_and_damaged_ones_are_not() -> None:
    monitor = Monitor(timing())
    message = rtcan.message_id(rtcan.MANAGEMENT, 5)
    part = call_parts.encode(0xA1B2C3D4, 7, bytes(40))[1]
    for data, text in (
        (part, "CallPart sender=a1b2c3d4 serial=7 part=1 length=40"),
        (part[:6] + b"\xff" + part[7:], "unknown management 0x5b"),
    ):
        frames = [Frame(rtcan.encode_identifier(10, message, left), each) for left, each in rtcan.fragments(data)]
        assert [monitor.frame(frame, number * MS).text for number, frame in enumerate(frames, 1)][-1] == text


def test_management_of_firmware_that_has_no_time_left_is_not_shown_as_a_sync() -> None:
    monitor = Monitor(timing())
    stop = management.encode(management.Stop("PC1"))
    frames = [Frame(left, data) for left, data in rtcan.fragments(stop)]
    seen = [monitor.frame(frame, number * MS) for number, frame in enumerate(frames, 1)]
    assert [each.kind for each in seen] == [FrameKind.MANAGEMENT] * 4
    assert seen[-1].text == "Stop module=PC1"
    assert monitor.frame(Frame(0, bytes(8)), 9 * MS).kind is FrameKind.SYNC


def test_a_frame_counts_for_the_period_in_which_it_was_on_the_bus() -> None:
    """However late it is read: periods that are over wait until they are asked for."""
    monitor = Monitor(timing())
    monitor.reset(SECOND, SECOND)
    for number in range(50):
        monitor.frame(Frame(rtcan.encode_identifier(20, 0x0501), b"%8d" % number), SECOND + number * 100 * MS)
    frames = [sum(tally.frames for tally in monitor.next_load().tallies.values()) for _ in range(7)]
    assert frames == [10, 10, 10, 10, 10, 0, 0]
    monitor.reset(9 * SECOND)
    monitor.frame(Frame(1, b""), 20 * SECOND)
    assert monitor.load(29 * SECOND).elapsed == 20 * SECOND


def test_frames_that_rtcan_does_not_use_are_counted_as_other_ones() -> None:
    monitor = Monitor(timing())
    monitor.reset(0)
    frames = [OtherFrame(0x123, bytes(8)), OtherFrame(0x7FF, b"", False, 8), OtherFrame(1 << 28, b"", True, 2)]
    texts = [monitor.other(frame, SECOND // 2).text for frame in frames]
    assert texts == [
        "11-bit identifier 123",
        "11-bit identifier 7FF, asks for 8 bytes",
        "29-bit identifier 10000000, asks for 2 bytes",
    ]
    load = monitor.load(SECOND)
    bits = sum(can_bits.other_frame_bits(frame) + INTERMISSION for frame in frames)
    assert load.tallies == {("", "", FrameKind.OTHER): TrafficCount(3, bits)}
    assert load.total == bits * BIT / SECOND
