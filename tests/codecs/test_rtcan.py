"""The RTCAN codec: against what the original firmware sent."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

import r2p
from r2p.codecs.rtcan import (
    FIRMWARE_MANAGEMENT,
    HRT,
    MANAGEMENT,
    MESSAGE_MASK,
    NRT,
    PAYLOAD_MAX,
    SYNC,
    Frame,
    Identifier,
    Sync,
    decode_identifier,
    decode_sync,
    encode_identifier,
    encode_sync,
    fragment_count,
    fragments,
    high_byte,
    high_filter,
    id8_filter,
    id8_of,
    is_sync,
    laxity_of,
    message_filter,
    message_id,
    message_of,
    srt_laxity,
)
from r2p.errors import DecodeError, MessageError
from tests.can_vectors import CanCase, arriving, can_cases, payload

MS = 1_000_000
identifiers = st.integers(0, (1 << 29) - 1)

# The recordings that the codec disagrees with, and the rule of PROTOCOL.md 7 (or 2) that says so.
OVERDUE = "overdue, or within a ms of it, is laxity 1: firmware takes HRT's 0, and from 1 ms over behind NRT's 63"
CLAMP = "over 62 ms is laxity 62: firmware takes NRT's 63, and with exactly 64 ms HRT's 0"
EXTRA = "an HRT message of a multiple of 8 bytes, over 8, has no empty extra fragment"
RESTART = "an HRT message that missed a slot starts anew: firmware sends what lies behind the message"
TOO_LONG = "over 1024 bytes is an error: firmware sends the first few"
EMPTY = "a message has at least one byte"
DIFFERENT = {
    "srt_laxity_0_size4": OVERDUE,
    "srt_laxity_63_size4": CLAMP,
    "srt_laxity_63_size20": CLAMP,
    "srt_laxity_64_size20": CLAMP,
    "srt_laxity_65_size4": CLAMP,
    "srt_laxity_65_size20": CLAMP,
    "srt_laxity_66_size4": CLAMP,
    "srt_laxity_66_size20": CLAMP,
    "srt_laxity_100_size4": CLAMP,
    "srt_laxity_100_size20": CLAMP,
    "srt_laxity_127_size4": CLAMP,
    "srt_laxity_127_size20": CLAMP,
    "srt_laxity_1000_size20": CLAMP,
    "srt_overdue_by_1": OVERDUE,
    "srt_overdue_by_5": OVERDUE,
    "srt_overdue_by_64": OVERDUE,
    "srt_fragments_time_advances_10_20": OVERDUE,
    "srt_fragments_time_advances_15_15": OVERDUE,
    "srt_fragments_time_advances_7_70": CLAMP,
    "srt_fragments_time_advances_30_90": CLAMP,
    "srt_fragments_time_advances_1_64": CLAMP,
    "srt_wait_in_queue_until_overdue": OVERDUE,
    "srt_oddsize_0": EMPTY,
    "srt_oversize_1025": TOO_LONG,
    "srt_oversize_1032": TOO_LONG,
    "srt_oversize_1040": TOO_LONG,
    "srt_oversize_2049": TOO_LONG,
    "hrt_size_16": EXTRA,
    "hrt_size_24": EXTRA,
    "hrt_too_few_slots_for_fragments": RESTART,
}


# Recorded


class Replay:
    """What a recording sent, frame by frame, and what the codec makes of the same messages."""

    def __init__(self, case: CanCase) -> None:
        self.case = case
        self.messages: dict[str, tuple[int, bytes]] = {}
        self.deadlines: dict[int, int] = {}  # of message ids, in ms; none: HRT
        self.now = 0

    def differences(self) -> list[str]:
        found = []
        for number, step in enumerate(self.case.steps):
            match step.verb, step.words:
                case "time", (now,):
                    self.now = int(now, 0)
                case "adv", (delay,):
                    self.now += int(delay)
                case "msg", (name, message, data, *_):
                    self.messages[name] = int(message, 16), payload(data)
                case "hrt", (name, message, _slot, _period, data):
                    self.messages[name] = int(message, 16), payload(data)
                case "tx", (name, timeout):
                    self.deadlines[self.messages[name][0]] = self.now + int(timeout)
            sent = [sent for sent in self.case.sent if sent.step == number]
            found += [repr(sent) for sent in sent if sent.frame not in self.expected(sent.cycle)]
        return found

    def expected(self, cycle: int) -> list[Frame]:
        """All frames that could be sent now."""
        frames = []
        for message, data in self.messages.values():
            laxity = HRT
            if message in self.deadlines:
                remaining = (self.deadlines[message] - self.now + 2**31) % 2**32 - 2**31
                laxity = srt_laxity(remaining * MS)
            try:
                parts = fragments(data)
            except MessageError:
                continue
            frames += [Frame(encode_identifier(laxity, message, left), part) for left, part in parts]
        mask = [int(word, 0) for step in self.case.steps if step.verb == "mask" for word in step.words]
        if self.case.master and mask:
            frames.append(encode_sync(cycle, mask[0] | mask[1] << 32))
        return frames


@pytest.mark.golden
@pytest.mark.parametrize("case", can_cases(), ids=str)
def test_sends_what_firmware_sent(case: CanCase) -> None:
    differences = Replay(case).differences()
    assert bool(differences) == (case.name in DIFFERENT), differences


@pytest.mark.golden
@pytest.mark.parametrize("case", can_cases("rx"), ids=str)
def test_filters_as_firmware_does(case: CanCase) -> None:
    received = [step for step in case.steps if step.verb == "rx" and len(step.words) < 4]
    filters = {(int(event.fields["id"], 16), int(event.fields["mask"], 16)) for event in case.of("filter")}
    for step in received:
        assert (int(step.words[1], 16) << 7, MESSAGE_MASK) in filters or case.name == "rx_source_check_low_byte_only"


@pytest.mark.golden
@pytest.mark.parametrize("case", can_cases("rx"), ids=str)
def test_reads_the_message_id_of_what_firmware_received(case: CanCase) -> None:
    for event in case.of("rx_callback"):
        frame = decode_identifier(arriving(case.steps[event.step]).id)
        message = int(event.fields["id"], 16)
        if case.name == "rx_source_check_low_byte_only":  # firmware looks no further; r2p drops this message
            assert id8_of(frame.message_id) == id8_of(message)
        else:
            assert frame.message_id == message
        assert frame.left == 0


@pytest.mark.golden
@pytest.mark.parametrize("case", can_cases("hrt-slave"), ids=str)
def test_takes_for_sync_what_a_slave_takes_for_sync(case: CanCase) -> None:
    cycles: list[int] = []
    more = 2 if case.name == "slave_id_highbyte0_is_sync" else 0  # any frame with high byte 0 counts there; not with us
    states = {event.step: event for event in case.of("driver")}
    for number, step in enumerate(case.steps):
        if step.verb == "frame" and len((frame := arriving(step)).data) == 8:
            sync = decode_sync(frame)
            assert encode_sync(sync.cycle, sync.mask) == frame
            cycles.append(sync.cycle)
        if number in states and states[number].fields["state"] == "SLAVE":
            assert states[number].fields["cycle"] == cycles[-1] + more


# Identifiers


@given(st.integers(0, 63), st.integers(0, 0xFFFF), st.integers(0, 127))
def test_identifier_round_trip(laxity: int, message: int, left: int) -> None:
    assert decode_identifier(encode_identifier(laxity, message, left)) == Identifier(laxity, message, left)


@given(identifiers)
def test_every_29_bits_are_an_identifier(identifier: int) -> None:
    parts = decode_identifier(identifier)
    assert encode_identifier(parts.laxity, parts.message_id, parts.left) == identifier


def test_identifier_by_hand() -> None:
    assert encode_identifier(50, 0x00FF) == 0x19007F80
    assert encode_identifier(NRT, 0xFFFF, 127) == (1 << 29) - 1


@pytest.mark.parametrize(
    ("laxity", "message", "left"), [(64, 0, 0), (-1, 0, 0), (0, 0x10000, 0), (0, -1, 0), (0, 0, 128), (0, 0, -1)]
)
def test_identifier_has_limits(laxity: int, message: int, left: int) -> None:
    with pytest.raises(MessageError):
        encode_identifier(laxity, message, left)


@pytest.mark.parametrize("identifier", [1 << 29, -1])
def test_more_than_29_bits_are_no_identifier(identifier: int) -> None:
    with pytest.raises(DecodeError):
        decode_identifier(identifier)


@given(st.integers(0, 255), st.integers(0, 255))
def test_message_id(high: int, id8: int) -> None:
    message = message_id(high, id8)
    assert (high_byte(message), id8_of(message)) == (high, id8)


@pytest.mark.parametrize(("high", "id8"), [(256, 0), (0, 256), (-1, 0), (0, -1)])
def test_message_id_has_limits(high: int, id8: int) -> None:
    with pytest.raises(MessageError):
        message_id(high, id8)


def test_management_of_2014_has_the_high_byte_of_a_sync() -> None:
    assert high_byte(FIRMWARE_MANAGEMENT) == SYNC != MANAGEMENT


def test_laxity_is_whole_milliseconds_within_its_class() -> None:
    remaining = [-5 * MS, 0, MS - 1, 2 * MS - 1, 2 * MS, 50 * MS, 62 * MS, 63 * MS, 64 * MS, 10**12]
    assert [srt_laxity(ns) for ns in remaining] == [1, 1, 1, 1, 2, 50, 62, 62, 62, 62]


# Fragments


@given(st.binary(min_size=1, max_size=PAYLOAD_MAX))
def test_fragments_count_down_and_are_full_but_the_last(data: bytes) -> None:
    parts = fragments(data)
    assert [left for left, _ in parts] == list(range((len(data) - 1) // 8, -1, -1))
    assert b"".join(part for _, part in parts) == data
    assert all(len(part) == 8 for _, part in parts[:-1])
    assert len(parts) == fragment_count(len(data))


@pytest.mark.parametrize("size", [0, PAYLOAD_MAX + 1])
def test_a_message_has_1_to_1024_bytes(size: int) -> None:
    with pytest.raises(MessageError, match=f"not {size}"):
        fragments(bytes(size))


def test_the_longest_message_uses_the_whole_countdown() -> None:
    assert fragments(bytes(PAYLOAD_MAX))[0] == (127, bytes(8))


# Sync


@given(st.integers(0, 10_000), st.integers(0, (1 << 64) - 1))
def test_sync_round_trip(cycle: int, mask: int) -> None:
    frame = encode_sync(cycle, mask)
    assert is_sync(frame.id)
    assert decode_sync(frame) == Sync(cycle % 256, mask)


def test_sync_starts_with_slot_0_in_bit_0() -> None:
    assert encode_sync(0x102, 1 | 1 << 9 | 1 << 63) == Frame(0x100, bytes([1, 2, 0, 0, 0, 0, 0, 0x80]))


def test_sync_has_64_slots_at_most() -> None:
    with pytest.raises(MessageError):
        encode_sync(0, 1 << 64)


@pytest.mark.parametrize(
    "frame",
    [
        Frame(encode_identifier(50, FIRMWARE_MANAGEMENT), bytes(8)),  # management of SRT-only firmware
        Frame(encode_identifier(HRT, message_id(MANAGEMENT, 5)), bytes(8)),
        Frame(encode_identifier(HRT, 5, left=1), bytes(8)),
        Frame(encode_identifier(HRT, 5), bytes(7)),
    ],
)
def test_what_is_no_sync(frame: Frame) -> None:
    with pytest.raises(DecodeError):
        decode_sync(frame)


def test_the_parts_of_an_identifier() -> None:
    identifier = encode_identifier(40, 0x1828, 3)
    assert (laxity_of(identifier), message_of(identifier)) == (40, 0x1828)
    for value, mask in (high_filter(0x18), id8_filter(0x28), message_filter(0x1828)):
        assert identifier & mask == value
        assert encode_identifier(40, 0x1929, 3) & mask != value


def test_no_other_module_knows_the_layout_of_an_identifier() -> None:
    """By its numbers: shifts are named constants of the codec. Those of instructions are others."""
    numbers = {7, 15, 18, 23, 29}
    for path in sorted(Path(r2p.__file__).parent.rglob("*.py")):
        if path.parts[-2:] in {("codecs", "rtcan.py"), ("codecs", "can_bits.py"), ("loader", "relocations.py")}:
            continue
        source = path.read_text()
        if re.search(r"(<<|>>)=?\s*(7|15|18|23|29)\b", source) is None:  # to parse all takes seconds
            continue
        for node in ast.walk(ast.parse(source)):
            if isinstance(node, ast.BinOp) and isinstance(node.op, ast.LShift | ast.RShift):
                amount = node.right.value if isinstance(node.right, ast.Constant) else None
                assert amount not in numbers, f"{path}:{node.lineno} shifts by {amount}: use r2p.codecs.rtcan"
