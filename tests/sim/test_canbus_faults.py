"""The simulated CAN bus with faults: error frames and counters, collisions, nodes that die or go mad, bus-off."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

from r2p.codecs.can_bits import EXTENDED, IDENTIFIER_MASK, AnyFrame, Frame, FrameField, OtherFrame, field_at, wire_bits
from r2p.codecs.rtcan import encode_identifier
from r2p.sim.can import CanBus, CanController, CanNode, ControllerState, ErrorKind, FrameRecord
from r2p.sim.can.error_frames import bits_until_noticed, error_frame_bits, first_difference, flip
from tests import can_watch

BIT = 1000  # ns at 1 Mbit/s
GAP = 3 * BIT
DELIMITER = 8
SEQUENCE = 11 * BIT

FRAME = Frame(encode_identifier(10, 0x0205), b"whatever")
OTHER = Frame(encode_identifier(20, 0x0206), b"anything")


def bits(frame: Frame) -> int:
    return len(wire_bits(frame))


class Watch(can_watch.Watch):
    """Records the callbacks of its controllers, and the frames of its bus."""

    def __init__(self, **settings: Any) -> None:
        self.bus = CanBus(asyncio.get_running_loop(), **settings)
        self.controllers: list[CanController] = []
        super().__init__(self.bus)

    def attach(self, name: str, **settings: Any) -> CanController:
        self.controllers.append(self.add(self.bus.attach(CanNode(name, **settings))))
        return self.controllers[-1]

    @property
    def outcomes(self) -> list[tuple[AnyFrame, ErrorKind | None]]:
        return [(record.frame, record.error) for record in self.records]


async def at(watch: Watch, instant: int) -> None:
    await asyncio.sleep((instant - watch.bus.timeline.now()) / 1e9)


def counters(controller: CanController) -> tuple[int, int]:
    return controller.confinement.transmit, controller.confinement.receive


# Error frames


def test_how_long_error_flags_overlap() -> None:
    wire = wire_bits(FRAME)
    assert error_frame_bits("0101", wire, active=True, others=False) == 6 + 8  # no other node has to notice
    assert error_frame_bits("0101", wire, active=True, others=True) == 12 + 8  # noticed with the 6th dominant bit
    assert error_frame_bits("0100", wire, active=True, others=True) == 10 + 8  # two were dominant before the flag
    assert error_frame_bits("0" * 6, wire, active=True, others=True) == 6 + 8  # noticed by all at once
    assert error_frame_bits("0101", wire, active=False, others=True) == 11 + 8  # silence: the sixth recessive bit
    assert error_frame_bits(wire[:-8], wire, active=True, others=True) == 7 + 8  # after the CRC the first bit says it
    assert bits_until_noticed("0" * 9, wire, "0") == 0


def test_flip_and_first_difference() -> None:
    assert (flip("0110", 2), flip("0110", 4)) == ("00", "0111")
    assert first_difference(["0110", "0101"]) == 3
    assert first_difference(["0110", "0110", "1"]) == 1


@pytest.mark.virtual_time
@pytest.mark.parametrize("bit", [1, 20, 50, 90])
async def test_a_bit_error_destroys_the_frame_and_it_is_sent_again(bit: int) -> None:
    watch = Watch()
    a, b = watch.attach("A"), watch.attach("B")
    watch.bus.disturb_next(bit)
    a.request(FRAME)
    await asyncio.sleep(0.01)
    level = "1" if wire_bits(FRAME)[bit - 1] == "0" else "0"
    seen = wire_bits(FRAME)[: bit - 1] + level
    dominant = len(seen) - len(seen.rstrip("0"))
    error = FrameRecord(
        0, (bit + 12 - dominant + DELIMITER) * BIT, FRAME, ("A",), bit + 12 - dominant + DELIMITER, ErrorKind.BIT
    )
    assert watch.records[0] == error
    again = error.end + GAP
    assert watch.records[1:] == [FrameRecord(again, again + bits(FRAME) * BIT, FRAME, ("A",), bits(FRAME), None)]
    assert watch.heard == [("sent", "A", FRAME, watch.records[1].end), ("received", "B", FRAME, watch.records[1].end)]
    assert (counters(a), counters(b)) == ((7, 0), (0, 0))  # +8 and +1, and each -1 for the frame that got through
    total = watch.bus.statistics.total
    assert (total.errors, total.error_bits, total.frames) == (1, error.bits, 1)


@pytest.mark.virtual_time
async def test_one_shot_reports_an_error_and_gives_up() -> None:
    watch = Watch()
    a, b = watch.attach("A", one_shot=True), watch.attach("B")
    watch.bus.disturb_next(40)
    a.request(FRAME)
    await asyncio.sleep(0.01)
    assert watch.heard == [("error", "A", FRAME, ErrorKind.BIT, 40 * BIT)]
    assert a.pending() is None
    assert (counters(a), counters(b)) == ((8, 0), (0, 1))


@pytest.mark.virtual_time
async def test_noise_hits_its_share_of_frames() -> None:
    watch = Watch(noise=0.05)
    a = watch.attach("A", one_shot=True)
    watch.attach("B")
    for number in range(1000):
        await at(watch, number * 300_000)
        a.request(FRAME)
    await asyncio.sleep(0.01)
    failed = [record for record in watch.records if record.error]
    assert len(watch.records) == 1000
    assert 25 < len(failed) < 80
    assert len({record.bits for record in failed}) > 15  # anywhere in the frame


@pytest.mark.virtual_time
async def test_a_bit_error_rate_hits_long_frames_more_often_than_short_ones() -> None:
    watch = Watch()
    watch.bus.bit_error_rate = 0.002
    a = watch.attach("A", one_shot=True)
    watch.attach("B")
    for number in range(1000):
        await at(watch, number * 300_000)
        a.request(Frame(FRAME.id, bytes([0x55] * 8 if number % 2 else b"")))
    await asyncio.sleep(0.01)
    failed = [record for record in watch.records if record.error]
    long = sum(bool(record.frame.data) for record in failed)
    assert 70 < long < 140  # of 500 frames of some 130 bits: 23 %
    assert 35 < len(failed) - long < 85  # ... of some 67 bits: 12 %


@pytest.mark.virtual_time
async def test_noise_at_one_node_destroys_frames_for_all_until_it_is_error_passive() -> None:
    watch = Watch()
    a, deaf = watch.attach("A"), watch.attach("deaf", noise=1.0)
    good = watch.attach("good")
    a.request(FRAME)
    await asyncio.sleep(0.1)
    assert deaf.state is ControllerState.PASSIVE
    assert watch.outcomes == [(FRAME, ErrorKind.BIT)] * (len(watch.records) - 1) + [(FRAME, None)]
    assert [name for name, *_ in watch.of("received")] == ["good"]
    assert good.confinement.receive == len(watch.records) - 2


@pytest.mark.virtual_time
async def test_a_node_that_is_alone_gets_no_acknowledge() -> None:
    watch = Watch()
    a = watch.attach("A", one_shot=True)
    a.request(FRAME)
    await asyncio.sleep(0.01)
    known = bits(FRAME) - 8  # the acknowledge slot is the 9th bit from the end
    assert watch.heard == [("error", "A", FRAME, ErrorKind.ACK, known * BIT)]
    assert watch.records == [FrameRecord(0, (known + 14) * BIT, FRAME, ("A",), known + 14, ErrorKind.ACK)]


@pytest.mark.virtual_time
async def test_a_lone_node_tries_for_ever_and_never_goes_to_bus_off() -> None:
    watch = Watch()
    a, b = watch.attach("A"), watch.attach("B")
    b.power_off()
    a.request(FRAME)
    await asyncio.sleep(1)
    assert (a.state, a.confinement.transmit) == (ControllerState.PASSIVE, 128)
    assert len(watch.records) > 4000
    b.power_on()
    await asyncio.sleep(0.001)
    assert [frame for _, frame, _ in watch.of("received")] == [FRAME]
    assert a.state is ControllerState.ACTIVE
    assert [state for name, state, _ in watch.of("state") if name == "A"] == [
        ControllerState.PASSIVE,
        ControllerState.ACTIVE,
    ]


@pytest.mark.virtual_time
async def test_an_error_passive_sender_waits_8_bits_longer() -> None:
    watch = Watch()
    a, b = watch.attach("A"), watch.attach("B")
    a.confinement.transmit = 200
    for box in range(2):
        a.request(FRAME, box)
    await asyncio.sleep(0.01)
    first, second = watch.records
    assert second.start - first.end == GAP + 8 * BIT
    assert a.state is ControllerState.PASSIVE
    b.request(OTHER)
    await asyncio.sleep(0.001)
    assert b.state is ControllerState.ACTIVE


# What controllers see of an error


def seen(watch: Watch) -> dict[str, tuple[ErrorKind, int, FrameField, bool, int]]:
    """What each controller saw, with the bit after which it was told."""
    return {name: (e.kind, e.bit, e.field, e.sending, at // BIT) for name, e, at in watch.errors}


@pytest.mark.virtual_time
async def test_the_sender_sees_the_error_and_the_others_its_flag() -> None:
    watch = Watch()
    for name in "ABC":
        watch.attach(name, one_shot=True, listen_only=name == "C")
    a = next(iter(watch.controllers))
    watch.bus.disturb_next(50)
    a.request(FRAME)
    await asyncio.sleep(0.01)
    level = "1" if wire_bits(FRAME)[49] == "0" else "0"
    bus = wire_bits(FRAME)[:49] + level
    noticed = 50 + 6 - (len(bus) - len(bus.rstrip("0")))  # the sixth dominant bit
    flag = (ErrorKind.STUFF, noticed, field_at(FRAME, noticed), False, noticed)
    assert seen(watch) == {"A": (ErrorKind.BIT, 50, field_at(FRAME, 50), True, 50), "B": flag, "C": flag}
    assert [(each.transmit_errors, each.receive_errors) for each in watch.controllers] == [(8, 0), (0, 1), (0, 0)]


@pytest.mark.virtual_time
async def test_after_the_crc_an_error_flag_is_a_form_error() -> None:
    watch = Watch()
    a, _ = watch.attach("A"), watch.attach("B")
    watch.bus.disturb_next(bits(FRAME) - 3)
    a.request(FRAME)
    await at(watch, bits(FRAME) * BIT)
    bit = bits(FRAME) - 3
    assert seen(watch) == {
        "A": (ErrorKind.BIT, bit, FrameField.END, True, bit),
        "B": (ErrorKind.FORM, bit + 1, FrameField.END, False, bit + 1),
    }


@pytest.mark.virtual_time
async def test_a_collision_and_a_death_are_seen() -> None:
    watch = Watch()
    a, b, c = (watch.attach(name, one_shot=True) for name in "ABC")
    for controller, length in ((a, 1), (b, 2)):
        controller.request(OtherFrame(0x123, b"", False, length))
    await at(watch, 100 * BIT)
    # start, 11 bits of identifier, RTR; IDE, reserved and two of the length are dominant; then one sends 0, the other 1
    assert {name: each[:4] for name, each in seen(watch).items()} == {
        "B": (ErrorKind.BIT, 18, FrameField.LENGTH, True),
        "A": (ErrorKind.BIT, 19, FrameField.LENGTH, True),  # its stuff bit
        "C": (ErrorKind.STUFF, 19, FrameField.LENGTH, False),
    }
    watch.errors.clear()
    c.request(FRAME)
    await at(watch, 150 * BIT)
    c.power_off()
    await asyncio.sleep(0.001)
    assert {name: kind for name, (kind, *_) in seen(watch).items()} == {"A": ErrorKind.STUFF, "B": ErrorKind.STUFF}


@pytest.mark.virtual_time
async def test_a_receiver_that_is_not_error_active_loses_a_frame_alone() -> None:
    watch = Watch()
    a, deaf, ear = watch.attach("A"), watch.attach("deaf", noise=1.0), watch.attach("ear", noise=1.0, listen_only=True)
    good = watch.attach("good")
    deaf.disturb(200)
    a.request(FRAME)
    await asyncio.sleep(0.001)
    bit = bits(FRAME) - 7
    crc = (ErrorKind.CRC, bit, FrameField.ACK_DELIMITER, False, bit)
    assert seen(watch) == {"deaf": crc, "ear": crc}
    assert watch.of("received") == [("good", FRAME, bits(FRAME) * BIT)]
    assert [each.receive_errors for each in (deaf, ear, good)] == [208, 0, 0]


# Controllers that only listen


@pytest.mark.virtual_time
async def test_a_controller_that_only_listens_does_not_acknowledge() -> None:
    """A lone sender gets no acknowledge, goes error passive and never to bus-off (ISO 11898-1, fault confinement).

    Until then its error flag destroys the frame for the listener; after that it is recessive, and the listener
    receives each attempt.
    """
    watch = Watch()
    a, ear = watch.attach("A"), watch.attach("ear", listen_only=True)
    a.request(FRAME)
    await asyncio.sleep(0.1)
    assert (a.state, a.transmit_errors) == (ControllerState.PASSIVE, 128)
    assert {error for _, error in watch.outcomes} == {ErrorKind.ACK}
    kinds = [(error.kind, error.field) for name, error, _ in watch.errors if name == "ear"]
    assert kinds == [(ErrorKind.FORM, FrameField.ACK_DELIMITER)] * 16
    received = [stamp for name, _, stamp in watch.of("received") if name == "ear"]
    assert received == [record.start + bits(FRAME) * BIT for record in watch.records[16:]]
    assert (ear.state, ear.receive_errors) == (ControllerState.ACTIVE, 0)


@pytest.mark.virtual_time
async def test_a_controller_that_only_listens_hears_as_the_others_do_and_sends_nothing() -> None:
    watch = Watch()
    a, b, ear = watch.attach("A"), watch.attach("B"), watch.attach("ear", listen_only=True)
    b.request(OTHER)
    a.request(FRAME)
    await at(watch, 50 * BIT)
    with pytest.raises(IndexError, match="ear only listens"):
        ear.request(FRAME)
    with pytest.raises(IndexError, match="ear only listens"):
        ear.babble(FRAME)
    await asyncio.sleep(0.01)
    assert [(frame, stamp) for name, frame, stamp in watch.of("received") if name == "ear"] == [
        (record.frame, record.end) for record in watch.records
    ]
    ear.power_off()
    a.request(FRAME)
    await asyncio.sleep(0.01)
    ear.power_on()
    a.request(OTHER)
    await asyncio.sleep(0.01)
    assert [frame for name, frame, _ in watch.of("received") if name == "ear"] == [FRAME, OTHER, OTHER]


# Errors to order


@pytest.mark.virtual_time
async def test_the_next_frames_of_an_identifier_are_destroyed() -> None:
    watch = Watch()
    a, _ = watch.attach("A", one_shot=True), watch.attach("B")
    watch.bus.disturb_next(20, 2, identifier=0x123)
    frames: list[AnyFrame] = [
        OtherFrame(0x123),
        Frame(0x123, b""),
        OtherFrame(0x123, b"", False, 0),
        *[OtherFrame(0x123)] * 2,
    ]
    for frame in frames:
        a.request(frame)
        await asyncio.sleep(0.001)
    bit = ErrorKind.BIT
    assert watch.outcomes == list(zip(frames, [bit, None, None, bit, None], strict=True))
    watch.bus.disturb_next(20, identifier=0x123 | EXTENDED)
    for frame in frames:
        a.request(frame)
        await asyncio.sleep(0.001)
    assert [error for _, error in watch.outcomes[5:]] == [None, bit, None, None, None]


@pytest.mark.virtual_time
async def test_the_next_frames_of_a_node_are_destroyed() -> None:
    watch = Watch()
    a, b = watch.attach("A"), watch.attach("B")
    watch.bus.disturb_next(count=3, sender="B")
    watch.bus.disturb_next(count=0)
    for controller, frame in ((a, FRAME), (b, OTHER)):
        controller.request(frame)
    await asyncio.sleep(0.01)
    assert watch.outcomes == [(FRAME, None), *[(OTHER, ErrorKind.BIT)] * 3, (OTHER, None)]
    assert len({record.bits for record in watch.records[1:4]}) > 1  # anywhere in the frame


# Collisions


def colliding(*data: bytes) -> list[Frame]:
    return [Frame(encode_identifier(50, 0x0000), part) for part in data]


@pytest.mark.virtual_time
async def test_one_identifier_with_other_data_is_a_bit_error_for_both() -> None:
    watch = Watch()
    a, b, c = (watch.attach(name, one_shot=True) for name in "ABC")
    first, second = colliding(bytes([0x55] * 8), bytes([0x55] * 3 + [0x54] + [0x55] * 4))
    a.request(first)
    b.request(second)
    await asyncio.sleep(0.01)
    differs = next(
        i for i, levels in enumerate(zip(wire_bits(first), wire_bits(second), strict=False)) if len(set(levels)) > 1
    )
    known = (differs + 1) * BIT
    assert watch.heard == [("error", "A", first, ErrorKind.BIT, known), ("error", "B", second, ErrorKind.BIT, known)]
    (record,) = watch.records
    assert (record.senders, record.error) == (("A", "B"), ErrorKind.BIT)
    assert [counters(node) for node in (a, b, c)] == [(8, 0), (8, 0), (0, 1)]


@pytest.mark.virtual_time
async def test_a_collision_of_lengths() -> None:
    watch = Watch()
    a, b = (watch.attach(name, one_shot=True) for name in "AB")
    for controller, frame in zip((a, b), colliding(b"12", b"123"), strict=True):
        controller.request(frame)
    await asyncio.sleep(0.01)
    assert [kind for _, _, kind, _ in watch.of("error")] == [ErrorKind.BIT, ErrorKind.BIT]


@pytest.mark.virtual_time
async def test_colliding_for_ever_ends_when_the_one_that_sees_it_is_error_passive() -> None:
    watch = Watch()
    a, b, _ = (watch.attach(name) for name in "ABC")
    recessive, dominant = colliding(b"\xff", b"\x0f")
    a.request(recessive)
    b.request(dominant)
    await asyncio.sleep(0.1)
    *collisions, first, second = watch.outcomes
    assert len(collisions) == 16  # 8 each, up to 128: error passive
    assert {kind for _, kind in collisions} == {ErrorKind.BIT}
    assert (first, second) == ((dominant, None), (recessive, None))
    assert [frame for name, frame, _ in watch.of("received") if name == "C"] == [dominant, recessive]
    assert a.confinement.transmit == 16 * 8 + 8 - 1
    assert b.confinement.transmit == 16 * 8 - 1


@pytest.mark.virtual_time
async def test_error_passive_colliders_do_not_acknowledge() -> None:
    watch = Watch()
    a, b = watch.attach("A", one_shot=True), watch.attach("B", one_shot=True)
    a.confinement.transmit = b.confinement.transmit = 150
    a.disturb(0)
    b.disturb(0)
    for controller, frame in zip((a, b), colliding(b"\xff", b"\x0f"), strict=True):
        controller.request(frame)
    await asyncio.sleep(0.1)
    assert [(name, kind) for name, _, kind, _ in watch.of("error")] == [("A", ErrorKind.BIT), ("B", ErrorKind.ACK)]


@pytest.mark.virtual_time
async def test_the_error_passive_ones_leave_one_after_the_other() -> None:
    watch = Watch()
    nodes = [watch.attach(name, one_shot=True) for name in "ABC"]
    watch.attach("D")
    for node, frame in zip(nodes, colliding(b"\x80", b"\x01", b"\x00"), strict=True):
        node.confinement.transmit = 150
        node.disturb(0)
        node.request(frame)
    await asyncio.sleep(0.01)
    assert [name for name, *_ in watch.of("error")] == ["A", "B"]
    assert [(name, frame.data) for name, frame, _ in watch.of("received")] == [("D", b"\x00")]


# Nodes that lose, go mad, die


@pytest.mark.virtual_time
async def test_a_receiver_can_lose_frames_alone() -> None:
    watch = Watch()
    a, b = watch.attach("A"), watch.attach("B")
    watch.attach("C")
    b.lose_next(2)
    for box in range(3):
        a.request(Frame(FRAME.id + box, b""), box)
    await asyncio.sleep(0.01)
    assert [frame.id - FRAME.id for name, frame, _ in watch.of("received") if name == "B"] == [2]
    assert [frame.id - FRAME.id for name, frame, _ in watch.of("received") if name == "C"] == [0, 1, 2]
    assert len(watch.of("sent")) == 3
    assert (b.missed, counters(b)) == (2, (0, 0))


@pytest.mark.virtual_time
async def test_a_share_of_frames_is_lost() -> None:
    watch = Watch()
    a, b = watch.attach("A"), watch.attach("B", loss=0.25)
    for number in range(1000):
        await at(watch, number * 300_000)
        a.request(FRAME)
    await asyncio.sleep(0.01)
    assert 200 < b.missed < 300
    assert len(watch.of("received")) == 1000 - b.missed


@pytest.mark.virtual_time
async def test_a_babbling_node_takes_the_bus() -> None:
    watch = Watch()
    mad, b = watch.attach("mad"), watch.attach("B")
    one_shot = watch.attach("C", one_shot=True)
    mad.babble(Frame(0, b""))
    b.request(FRAME)
    one_shot.request(OTHER)
    await asyncio.sleep(0.1)
    assert {record.senders for record in watch.records} == {("mad",)}
    assert watch.bus.load() > 0.99
    assert [name for name, *_ in watch.of("lost")] == ["C"]
    assert not watch.of("sent")  # its software knows nothing of it
    mad.babble(None)
    await asyncio.sleep(0.001)
    assert watch.outcomes[-1] == (FRAME, None)


@pytest.mark.virtual_time
async def test_a_babbling_node_comes_back_from_bus_off_as_mad_as_before() -> None:
    watch = Watch(noise=1.0)
    mad = watch.attach("mad")
    watch.attach("B")
    mad.babble(FRAME)
    await asyncio.sleep(0.1)
    states = [state for name, state, _ in watch.of("state") if name == "mad"]
    assert states[:4] == [
        ControllerState.PASSIVE,
        ControllerState.BUS_OFF,
        ControllerState.ACTIVE,
        ControllerState.PASSIVE,
    ]
    assert not watch.of("error")
    mad.power_off()
    await asyncio.sleep(0.001)
    mad.power_on()
    before = len(watch.records)
    await asyncio.sleep(0.01)
    assert len(watch.records) == before


@pytest.mark.virtual_time
async def test_a_node_that_dies_in_the_middle_of_its_frame() -> None:
    watch = Watch()
    a, b, _ = (watch.attach(name) for name in "ABC")
    a.request(FRAME)
    await at(watch, 59 * BIT + 1)
    a.power_off()
    b.request(OTHER)
    await asyncio.sleep(0.01)
    sent = wire_bits(FRAME)[:60]
    silent = 6 - (len(sent) - len(sent.rstrip("1")))
    taken = 60 + silent + 6 + DELIMITER  # all receivers notice at once
    assert watch.records[0] == FrameRecord(0, taken * BIT, FRAME, ("A",), taken, ErrorKind.STUFF)
    assert watch.records[1].start == taken * BIT + GAP
    assert watch.heard == [
        ("sent", "B", OTHER, watch.records[1].end),
        ("received", "C", OTHER, watch.records[1].end),
    ]
    assert b.confinement.receive == 1
    assert a.state is ControllerState.DOWN
    assert not a.request(FRAME)


@pytest.mark.virtual_time
async def test_frames_that_a_node_filters_out_make_up_for_errors_all_the_same() -> None:
    watch = Watch()
    a, b = watch.attach("A"), watch.attach("B")
    b.filters = [(OTHER.id, IDENTIFIER_MASK)]
    b.disturb(2)
    for number, frame in enumerate([FRAME, OTHER, FRAME, FRAME]):
        a.request(frame)
        await asyncio.sleep(0.001)
        assert b.confinement.receive == max(0, 1 - number)
    assert [(name, frame) for name, frame, _ in watch.of("received")] == [("B", OTHER)]
    b.filters = ()
    a.request(FRAME)
    await asyncio.sleep(0.001)
    assert [frame for _, frame, _ in watch.of("received")] == [OTHER, FRAME]


@pytest.mark.virtual_time
async def test_a_node_that_dies_after_its_frame_was_acknowledged() -> None:
    watch = Watch()
    a, _ = watch.attach("A"), watch.attach("B")
    a.request(FRAME)
    await at(watch, (bits(FRAME) - 7) * BIT)
    a.power_off()
    await asyncio.sleep(0.01)
    assert watch.heard == [("received", "B", FRAME, bits(FRAME) * BIT)]


@pytest.mark.virtual_time
async def test_a_node_that_dies_while_it_is_decided_who_sends() -> None:
    watch = Watch()
    a, b, _ = (watch.attach(name) for name in "ABC")
    a.request(FRAME)
    b.request(OTHER)
    await at(watch, BIT // 2)
    a.power_off()
    await asyncio.sleep(0.01)
    assert watch.outcomes == [(OTHER, None)]


@pytest.mark.virtual_time
async def test_one_of_two_senders_of_the_same_dies() -> None:
    watch = Watch()
    a, b, _ = (watch.attach(name) for name in "ABC")
    a.request(FRAME)
    b.request(FRAME)
    await at(watch, 50 * BIT)
    a.power_off()
    await asyncio.sleep(0.01)
    assert watch.outcomes == [(FRAME, None)]
    assert watch.of("sent") == [("B", FRAME, bits(FRAME) * BIT)]


@pytest.mark.virtual_time
async def test_the_only_receiver_dies_before_it_could_acknowledge() -> None:
    watch = Watch()
    a, b = watch.attach("A", one_shot=True), watch.attach("B")
    a.request(FRAME)
    await at(watch, 50 * BIT)
    b.power_off()
    await asyncio.sleep(0.01)
    assert watch.heard == [("error", "A", FRAME, ErrorKind.ACK, (bits(FRAME) - 8) * BIT)]


@pytest.mark.virtual_time
async def test_the_only_receiver_dies_after_it_has_acknowledged() -> None:
    watch = Watch()
    a, b = watch.attach("A", one_shot=True), watch.attach("B")
    a.request(FRAME)
    await at(watch, (bits(FRAME) - 7) * BIT)
    b.power_off()
    await asyncio.sleep(0.01)
    assert watch.heard == [("sent", "A", FRAME, bits(FRAME) * BIT)]


@pytest.mark.virtual_time
async def test_everybody_dies() -> None:
    watch = Watch()
    a, b = watch.attach("A"), watch.attach("B")
    a.request(FRAME)
    await at(watch, 50 * BIT)
    b.power_off()
    a.power_off()
    a.power_off()
    await asyncio.sleep(0.01)
    assert not watch.heard
    a.power_on()
    b.power_on()
    a.request(OTHER)
    await asyncio.sleep(0.01)
    assert [name for name, *_ in watch.of("received")] == ["B"]


@pytest.mark.virtual_time
async def test_a_node_that_returns_is_new_and_waits_for_11_recessive_bits() -> None:
    watch = Watch()
    a, b = watch.attach("A"), watch.attach("B")
    a.request(FRAME)
    a.confinement.transmit = 100
    a.power_off()
    await at(watch, 1_000_000)
    a.power_on()
    assert counters(a) == (0, 0)
    assert a.pending() is None
    a.request(OTHER)
    await asyncio.sleep(0.001)
    assert [(record.start, record.frame) for record in watch.records] == [(1_000_000 + SEQUENCE, OTHER)]
    assert watch.of("received") == [("B", OTHER, watch.records[0].end)]
    assert b.state is ControllerState.ACTIVE


@pytest.mark.virtual_time
async def test_what_a_node_was_about_to_hear_dies_with_it() -> None:
    watch = Watch()
    a, b = watch.attach("A"), watch.attach("B")
    b.on_receive = lambda *_: b.power_off()
    a.on_sent = lambda *_: None
    watch.attach("C").on_receive = lambda *_: a.power_off()
    a.request(FRAME)
    a.request(OTHER, 1)
    await asyncio.sleep(0.01)
    assert watch.outcomes == [(FRAME, None)]


# Bus-off


async def into_bus_off(watch: Watch, node: CanController) -> None:
    node.confinement.transmit = 255
    watch.bus.disturb_next(30)
    node.request(FRAME)
    await asyncio.sleep(0.000_2)
    assert node.state is ControllerState.BUS_OFF


@pytest.mark.virtual_time
async def test_bus_off_gives_up_what_is_pending() -> None:
    watch = Watch()
    a, _ = watch.attach("A", recovery=False), watch.attach("B")
    a.request(OTHER, 1)
    await into_bus_off(watch, a)
    assert [(frame, kind) for _, frame, kind, _ in watch.of("error")] == [
        (OTHER, ErrorKind.BUS_OFF),
        (FRAME, ErrorKind.BUS_OFF),
    ]
    assert not a.request(FRAME)
    await asyncio.sleep(1)
    assert a.state is ControllerState.BUS_OFF


@pytest.mark.virtual_time
async def test_recovery_on_an_idle_bus_takes_128_times_11_bits() -> None:
    watch = Watch()
    a, _ = watch.attach("A"), watch.attach("B")
    write = a.on_state

    def again(state: ControllerState, stamp: int) -> None:
        write(state, stamp)
        a.request(OTHER)

    a.on_state = again
    await into_bus_off(watch, a)
    await asyncio.sleep(0.01)
    record, after = watch.records
    # the delimiter and the intermission of the error frame are the first time
    assert watch.of("state")[-1] == ("A", ControllerState.ACTIVE, record.end + GAP + 127 * SEQUENCE)
    assert counters(a) == (0, 0)
    assert (after.start, after.error) == (record.end + GAP + 127 * SEQUENCE, None)


@pytest.mark.virtual_time
async def test_recovery_on_a_saturated_bus_takes_128_frames() -> None:
    watch = Watch()
    a, b = watch.attach("A"), watch.attach("B")
    watch.attach("C")
    b.babble(OTHER)
    await into_bus_off(watch, a)
    failed = next(number for number, record in enumerate(watch.records) if record.error)
    await asyncio.sleep(0.1)
    *_, (_, state, recovered) = [entry for entry in watch.of("state") if entry[0] == "A"]
    assert (state, recovered) == (ControllerState.ACTIVE, watch.records[failed + 127].end + GAP)


@pytest.mark.virtual_time
async def test_recovery_counts_the_idle_time_between_frames() -> None:
    watch = Watch()
    a, b = watch.attach("A"), watch.attach("B")
    watch.attach("C")
    await into_bus_off(watch, a)
    first = watch.records[0]
    began = first.end + GAP + 50 * SEQUENCE + SEQUENCE // 2
    await at(watch, began)
    b.request(OTHER)
    await asyncio.sleep(0.01)
    *_, (_, state, recovered) = watch.of("state")
    # 1 in the error frame, 50 idle, half of one broken off, 1 in the frame
    assert (state, recovered) == (ControllerState.ACTIVE, watch.records[1].end + GAP + (128 - 52) * SEQUENCE)


@pytest.mark.virtual_time
async def test_restart_by_hand_and_death_in_bus_off() -> None:
    watch = Watch()
    a, _ = watch.attach("A", recovery=False), watch.attach("B")
    a.restart()  # nothing to do
    await into_bus_off(watch, a)
    await asyncio.sleep(0.1)
    a.restart()
    await asyncio.sleep(0.1)
    assert watch.of("state")[-1][:2] == ("A", ControllerState.ACTIVE)
    await into_bus_off(watch, a)
    a.restart()
    a.power_off()
    await asyncio.sleep(0.1)
    assert not a.live
    assert watch.of("state")[-1][:2] == ("A", ControllerState.BUS_OFF)


@pytest.mark.virtual_time
async def test_a_noisy_bus_drives_its_senders_to_bus_off() -> None:
    watch = Watch(noise=1.0)
    a, b = watch.attach("A"), watch.attach("B")
    a.request(FRAME)
    await asyncio.sleep(0.02)
    assert [state for name, state, _ in watch.of("state") if name == "A"][:2] == [
        ControllerState.PASSIVE,
        ControllerState.BUS_OFF,
    ]
    assert len(watch.records) == 32  # 8 for each, over 255
    assert b.confinement.receive == 32
    watch.bus.noise = 0.0  # it can be set at any time
    for _ in range(40):
        a.request(FRAME)
        await asyncio.sleep(0.001)
    assert b.confinement.receive == 0


@pytest.mark.virtual_time
async def test_a_good_frame_takes_the_receive_counter_back_below_passive() -> None:
    watch = Watch()
    a, b = watch.attach("A"), watch.attach("B")
    b.disturb(200)
    assert b.state is ControllerState.PASSIVE
    a.request(FRAME)
    await asyncio.sleep(0.001)
    assert (b.confinement.receive, b.state) == (119, ControllerState.ACTIVE)


# A bus that is stuck at dominant


@pytest.mark.virtual_time
async def test_a_short_circuit_of_a_free_bus() -> None:
    watch = Watch()
    a, b, ear = watch.attach("A"), watch.attach("B"), watch.attach("ear", listen_only=True)
    await at(watch, 1_000_000)
    watch.bus.short(50 * BIT)
    a.request(FRAME)
    await asyncio.sleep(0.01)
    first, second = watch.records
    # 6 dominant bits are an error, the flags take 6 more, and only after the short the delimiter begins
    assert first == FrameRecord(1_000_000, 1_000_000 + 58 * BIT, OtherFrame(0), (), 50 + DELIMITER, ErrorKind.STUFF)
    assert (second.start, second.frame, second.error) == (first.end + GAP, FRAME, None)
    # 1 for the error, 8 for the first dominant bit after the flag, and 8 for each 8 that follow: 38 = 4 * 8 + 6
    assert [(each.transmit_errors, each.receive_errors) for each in (a, b, ear)] == [(0, 41), (0, 40), (0, 0)]
    assert {error.bit for _, error, _ in watch.errors} == {6}
    assert watch.bus.statistics.total.error_bits == 58


@pytest.mark.virtual_time
async def test_a_glitch_is_a_start_of_frame_without_a_frame() -> None:
    watch = Watch()
    a, b = watch.attach("A"), watch.attach("B")
    watch.bus.short(1)
    await asyncio.sleep(0.001)
    assert [(record.bits, record.error) for record in watch.records] == [(1 + 6 + 6 + DELIMITER, ErrorKind.STUFF)]
    assert [counters(each) for each in (a, b)] == [(0, 1), (0, 1)]


@pytest.mark.virtual_time
async def test_a_long_short_circuit_takes_the_sender_to_bus_off_and_the_others_to_error_passive() -> None:
    watch = Watch()
    a, b = watch.attach("A"), watch.attach("B")
    a.request(FRAME)
    await at(watch, 60 * BIT)
    watch.bus.short(1_000_000_000)
    a.request(OTHER, 1)
    await asyncio.sleep(0.9)
    assert a.state is ControllerState.BUS_OFF
    assert (b.state, b.transmit_errors, b.receive_errors) == (ControllerState.PASSIVE, 0, 129)
    (off,) = [stamp for name, state, stamp in watch.of("state") if (name, state) == ("A", ControllerState.BUS_OFF)]
    error = watch.errors[0][1]
    # after its flag of 6 bits, 31 times 8 more dominant bits: 8 + 31 * 8 = 256; the flag of B begins up to 6 bits later
    assert 0 <= off // BIT - (error.bit + 6 + 31 * 8) <= 6
    assert not watch.records
    await asyncio.sleep(0.2)
    (record,) = watch.records
    assert record.end == (60 + 1_000_000 + DELIMITER) * BIT
    assert watch.of("state")[-1] == ("A", ControllerState.ACTIVE, record.end + GAP + 127 * SEQUENCE)


@pytest.mark.virtual_time
async def test_a_short_circuit_in_the_arbitration_field_wins_the_arbitration() -> None:
    watch = Watch()
    a, b = watch.attach("A", one_shot=True), watch.attach("B")
    frame = OtherFrame(0x155, b"x")
    a.request(frame)
    await at(watch, 5 * BIT)
    watch.bus.short(30 * BIT)
    await asyncio.sleep(0.001)
    assert watch.of("lost") == [("A", frame, 6 * BIT)]  # 0 0010 1: the first recessive bit that is overwritten
    assert [error for _, error in watch.outcomes] == [ErrorKind.STUFF]
    assert a.transmit_errors == 0
    assert a.receive_errors == b.receive_errors > 8


@pytest.mark.virtual_time
async def test_a_short_circuit_that_overwrites_no_recessive_bit_is_harmless() -> None:
    watch = Watch()
    a, _ = watch.attach("A"), watch.attach("B")
    frame = Frame(0, bytes(8))
    wire = wire_bits(frame)
    a.request(frame)
    await at(watch, wire.index("000", 50) * BIT)
    watch.bus.short(2 * BIT)
    await asyncio.sleep(0.001)
    assert watch.outcomes == [(frame, None)]


# A node whose wire is cut


@pytest.mark.virtual_time
async def test_a_node_whose_wire_is_cut_tries_for_ever_and_is_heard_when_it_is_mended() -> None:
    watch = Watch()
    a, b, _ = (watch.attach(name) for name in "ABC")
    b.cut_wire()
    b.cut_wire()
    b.request(OTHER)
    a.request(FRAME)
    await asyncio.sleep(0.1)
    assert watch.outcomes == [(FRAME, None)]
    assert [name for name, *_ in watch.of("received")] == ["C"]
    assert (b.state, b.transmit_errors) == (ControllerState.PASSIVE, 128)
    assert b.pending() is OTHER
    b.mend_wire()
    b.mend_wire()
    await asyncio.sleep(0.01)
    assert watch.outcomes == [(FRAME, None), (OTHER, None)]
    assert watch.records[1].start == 100_000_000 + SEQUENCE
    assert b.transmit_errors == 127
    a.request(FRAME)
    await asyncio.sleep(0.01)
    assert {name for name, *_ in watch.of("received")[-2:]} == {"B", "C"}


@pytest.mark.virtual_time
@pytest.mark.parametrize(("left", "seen"), [(60, ErrorKind.ACK), (9, ErrorKind.ACK), (8, None), (1, None)])
async def test_a_sender_is_cut_off_in_the_middle_of_its_frame(left: int, seen: ErrorKind | None) -> None:
    """To the others it falls silent, and it misses their acknowledge, or has it already."""
    watch = Watch()
    a, b = watch.attach("A", one_shot=True), watch.attach("B")
    a.request(FRAME)
    await at(watch, (bits(FRAME) - left) * BIT)
    a.cut_wire()
    await asyncio.sleep(0.001)
    assert [kind for _, _, kind, _ in watch.of("error")] == ([seen] if seen else [])
    assert [stamp for *_, stamp in watch.of("sent")] == ([] if seen else [bits(FRAME) * BIT])
    assert [error for _, error in watch.outcomes] == ([ErrorKind.STUFF] if left > 10 else [None])
    assert counters(b) == ((0, 1) if left > 10 else (0, 0))
    assert a.pending() is None


@pytest.mark.virtual_time
async def test_a_receiver_is_cut_off_in_the_middle_of_a_frame() -> None:
    watch = Watch()
    a, b = watch.attach("A", one_shot=True), watch.attach("B")
    a.request(FRAME)
    await at(watch, 60 * BIT)
    b.cut_wire()
    await asyncio.sleep(0.001)
    assert [kind for _, _, kind, _ in watch.of("error")] == [ErrorKind.ACK]
    assert (counters(a), counters(b)) == ((8, 0), (0, 1))


@pytest.mark.virtual_time
async def test_bus_off_power_and_a_cut_wire() -> None:
    watch = Watch()
    a, b = watch.attach("A"), watch.attach("B")
    await into_bus_off(watch, a)
    a.cut_wire()
    await asyncio.sleep(0.1)
    assert a.state is ControllerState.ACTIVE  # it hears nothing but recessive bits
    await into_bus_off_again(watch, a)
    a.mend_wire()
    await asyncio.sleep(0.1)
    assert a.state is ControllerState.ACTIVE
    a.cut_wire()
    a.power_off()
    a.mend_wire()
    a.power_on()
    b.request(OTHER)
    await asyncio.sleep(0.1)
    assert watch.of("received")[-1][:2] == ("A", OTHER)


async def into_bus_off_again(watch: Watch, node: CanController) -> None:
    node.mend_wire()
    await asyncio.sleep(0.001)
    await into_bus_off(watch, node)
    node.cut_wire()
