"""The line codec against the recordings, against a plain reader written here, and against whatever else may come."""

import random
import struct
from collections import Counter
from collections.abc import Iterator

import pytest
from hypothesis import given
from hypothesis import strategies as st

from r2p.codecs.debug import Line, Reader, encode, encoder
from r2p.errors import MessageError
from tests.vectors import FROM_NODE, TO_NODE, Case, cases

GOOD = Line(b"leds", b"\x02\0\0\0\x01", 0x800F55C7)
GOOD_LINE = b"@800F55C7:04leds:050200000001:A1\r\n"
HELD_MAX = 600


def read(stream: bytes, size: int | None = None) -> tuple[list[Line], dict[str, int]]:
    reader = Reader()
    step = size or max(1, len(stream))
    lines = [line for at in range(0, len(stream), step) for line in reader.feed(stream[at : at + step])]
    return lines, reader.drops


# ------------------------------------------------------------------------------------------------- recordings


@pytest.mark.golden
@pytest.mark.parametrize("case", cases(), ids=str)
def test_recorded_lines(case: Case) -> None:
    recorded = [entry for entry in case.transcript if entry.can_id is None and entry.decoded]
    for entry in recorded:
        lines, drops = read(entry.data)
        if not entry.decoded["checksum_ok"]:
            assert not lines
            assert sum(drops.values()) == 1
            continue
        (line,) = lines
        assert not drops
        assert line.deadline == entry.decoded["deadline"]
        assert line.topic == entry.decoded["topic"].encode()
        assert len(line.data) == entry.decoded["length"]
        if case.name != "publish_cmd_lowercase" or entry.dir == FROM_NODE:
            assert encode(line.topic, line.data, line.deadline) == entry.data


@pytest.mark.golden
@pytest.mark.parametrize("case", cases(), ids=str)
@pytest.mark.parametrize("direction", [FROM_NODE, TO_NODE])
def test_recorded_streams_in_chunks(case: Case, direction: str) -> None:
    stream = case.stream(direction)
    whole = read(stream)
    assert direction == TO_NODE or not whole[1]
    assert all(read(stream, size) == whole for size in (1, 7, 100, 4096))


@pytest.mark.golden
def test_recorded_damage_in_every_chunk_size() -> None:
    (case, _) = cases(name="malformed_recovers")
    stream = case.stream(TO_NODE)
    whole = read(stream)
    assert all(read(stream, size) == whole for size in range(1, 2 * HELD_MAX))


@pytest.mark.golden
@pytest.mark.parametrize("case", cases(name="malformed_recovers"), ids=str)
def test_firmware_takes_the_same_lines(case: Case) -> None:
    """Each malformed line is followed by a good one (x from 100 on); below 100 firmware took a wrong checksum."""
    logged = [float(text.split("x=")[1].split()[0]) for text in case.node_log[""] if "CALLBACK" in text]
    lines, _ = read(case.stream(TO_NODE))
    assert [struct.unpack("<3f", line.data)[0] for line in lines if line.topic == b"cmd"] == [
        x for x in logged if x >= 100
    ]


@pytest.mark.golden
def test_recorded_damage_by_reason() -> None:
    (case, _) = cases(name="malformed_recovers")
    drops = {entry.comment: read(entry.data)[1] for entry in case.transcript if entry.dir == TO_NODE}
    assert {comment: reasons for comment, reasons in drops.items() if reasons} == {
        "bad digit in deadline": {"bad hex": 1},
        "deadline too short": {"bad hex": 1},
        "deadline too long": {"bad separator": 1},
        "no colon": {"bad separator": 1},
        "topic length 0": {"topic length": 1},
        "topic length 17": {"topic length": 1},
        "topic length one too long": {"bad separator": 1},
        "topic length one too short": {"bad separator": 1},
        "unknown topic": {"checksum": 1},
        "topic known, but no remote publisher": {"checksum": 1},
        "payload length 11": {"checksum": 1},
        "payload length 13": {"checksum": 1},
        "payload length 0": {"empty payload": 1},
        "no @": {"garbage": 1},
        "noise before @: accepted": {"garbage": 1, "checksum": 1},
        "double @": {"bad hex": 1},
        "no line end: accepted": {"checksum": 1},
        "two messages on one line: both accepted": {"checksum": 2},
        "LF only, any deadline": {"checksum": 1},
        "topic names are case sensitive": {"checksum": 1},
    }


# --------------------------------------------------------------------------------------------------- encoding


def test_encode() -> None:
    assert encode(GOOD.topic, GOOD.data, GOOD.deadline) == GOOD_LINE


@pytest.mark.parametrize(("deadline", "sent"), [(-2, b"@FFFFFFFE:"), (1 << 32, b"@00000000:")])
def test_the_deadline_wraps(deadline: int, sent: bytes) -> None:
    line = encode(b"leds", b"\0", deadline)
    assert line.startswith(sent)
    assert read(line)[0] == [Line(b"leds", b"\0", deadline & 0xFFFFFFFF)]


@pytest.mark.parametrize("topic", [b"", b"x" * 17, b"a\r", b"\0a", "länge".encode()])
def test_a_topic_that_does_not_fit(topic: bytes) -> None:
    with pytest.raises(MessageError, match="1 to 16 printable characters"):
        encoder(topic)


def test_an_empty_message() -> None:
    """Only between r2p modules, on topics whose messages vary in length."""
    line = encoder(b"go", empty=True)(b"", 0)
    assert line == b"@00000000:02go:00:28\r\n"
    assert read(line) == ([Line(b"go", b"", 0)], {})
    with pytest.raises(MessageError, match="0 to 255 bytes, not 256"):
        encoder(b"go", empty=True)(bytes(256), 0)


@pytest.mark.parametrize("size", [0, 256])
def test_a_payload_that_does_not_fit(size: int) -> None:
    with pytest.raises(MessageError, match=f"topic leds: a line carries 1 to 255 bytes, not {size}"):
        encode(b"leds", bytes(size), 0)


messages = st.builds(
    Line,
    topic=st.text(st.characters(min_codepoint=0x20, max_codepoint=0x7E), min_size=1, max_size=16).map(str.encode),
    data=st.binary(min_size=1, max_size=255),
    deadline=st.integers(0, 0xFFFFFFFF),
)


@given(st.lists(messages))
def test_what_is_encoded_is_read(sent: list[Line]) -> None:
    stream = b"".join(encode(line.topic, line.data, line.deadline) for line in sent)
    assert read(stream) == (sent, {})


# ---------------------------------------------------------------------------------------------------- reading


def test_two_messages_share_a_line_and_none_needs_an_end() -> None:
    line = GOOD_LINE.rstrip()
    assert read(line + line) == ([GOOD, GOOD], {})


def test_either_case() -> None:
    assert read(GOOD_LINE.lower()) == ([GOOD], {})


def test_a_message_is_there_with_its_last_digit() -> None:
    reader = Reader()
    assert reader.feed(GOOD_LINE[:-3]) == []
    assert reader.feed(GOOD_LINE[-3:-2]) == [GOOD]


def test_an_early_at_is_eaten_with_what_it_breaks() -> None:
    assert read(b"@80" + GOOD_LINE + GOOD_LINE) == ([GOOD], {"bad hex": 1})


def test_line_ends_are_no_loss() -> None:
    assert read(b"\r\n\r\n" + GOOD_LINE + b"\n\r\n\r" + GOOD_LINE) == ([GOOD, GOOD], {})


@pytest.mark.parametrize("cut", range(1, len(GOOD_LINE) - 2))
def test_half_a_line_costs_itself_only(cut: int) -> None:
    assert read(GOOD_LINE[:cut] + b"\r\n" + GOOD_LINE) == ([GOOD], {"cut short": 1})
    assert read(GOOD_LINE[cut:] + GOOD_LINE) == ([GOOD], {"garbage": 1})


def test_the_longest_name_cut_short_does_not_eat_the_next_line() -> None:
    assert read(b"@00000000:10a\r\n\r\n" + GOOD_LINE) == ([GOOD], {"cut short": 1})


@pytest.mark.parametrize(
    ("damaged", "reason"),
    [
        (GOOD_LINE.replace(b":A1", b":A2"), "checksum"),
        (GOOD_LINE.replace(b"leds", b"le\0s"), "bad name"),
        (GOOD_LINE.replace(b"leds", b"le\xffs"), "bad name"),
        (GOOD_LINE.replace(b"0200", b"02 0"), "bad hex"),
        (GOOD_LINE.replace(b":A1", b"0:A1"), "bad separator"),
        (GOOD_LINE.replace(b":A1", b"\0A1"), "bad separator"),
        (GOOD_LINE.replace(b"@80", b"@+8"), "bad hex"),
        (GOOD_LINE.replace(b"@", b"@0x"), "bad hex"),
    ],
)
def test_a_damaged_line_is_counted_once(damaged: bytes, reason: str) -> None:
    for size in range(1, len(damaged)):
        assert read(damaged + GOOD_LINE, size) == ([GOOD], {reason: 1})


@pytest.mark.parametrize(
    ("lie", "reason"),
    [
        (b"@00000000:05leds:01AB:", "bad separator"),
        (b"@00000000:03leds:01AB:", "bad separator"),
        (b"@00000000:04leds:02AB:", "bad hex"),
        (b"@00000000:04leds:01ABCD:", "bad separator"),
        (b"@00000000:11abcdefghijklmnopq:01AB:", "topic length"),
        (b"@00000000:00:01AB:", "topic length"),
    ],
)
def test_a_right_checksum_does_not_make_a_length_right(lie: bytes, reason: str) -> None:
    deadline, name, data, _ = lie.split(b":")
    total = sum(bytes.fromhex((deadline[1:] + name[:2] + data).decode())) + sum(name[2:])
    assert read(lie + b"%02X\r\n" % (-total & 0xFF) + GOOD_LINE) == ([GOOD], {reason: 1})


def test_garbage_around_a_message_is_two_runs() -> None:
    odd_name = encode(b"a:b", b"\0", 0)
    for line in (GOOD_LINE, odd_name):
        lines, drops = read(b"x" + line.rstrip() + b"y")
        assert len(lines) == 1
        assert drops == {"garbage": 2}


def test_garbage_counts_once_a_run() -> None:
    assert read(b"one\r\ntwo two\n\n" + b"three" + GOOD_LINE + b"\0\0\0\n", 2) == ([GOOD], {"garbage": 4})


@pytest.mark.parametrize(
    ("noise", "megabytes"), [(b"x", 10), (b"\0", 10), (b":", 10), (b"x\n", 1), (b"@", 0.5), (b"@00000000:10", 0.5)]
)
def test_megabytes_without_a_message(noise: bytes, megabytes: float) -> None:
    reader = Reader()
    chunk = noise * (65536 // len(noise))
    for _ in range(int(16 * megabytes)):
        assert reader.feed(chunk) == []
        assert len(reader._held) < HELD_MAX
    assert reader.feed(b"\r\n\r\n" + GOOD_LINE) == [GOOD]


def test_the_longest_unfinished_message_is_held_within_bounds() -> None:
    longest = encode(b"t" * 16, bytes(255), 0)
    reader = Reader()
    assert reader.feed(longest[:-3]) == []
    assert HELD_MAX > len(reader._held) > 500
    assert reader.feed(longest[-3:]) == [Line(b"t" * 16, bytes(255), 0)]
    assert len(reader._held) < 2


# ------------------------------------------------------------------------- the fast reader against a plain one


class Wrong(Exception):
    """Carries the reason and the wrong character."""


def plain_message(characters: Iterator[int]) -> Line:
    """One message, from behind its `@`, character by character as firmware takes it."""

    def character(allowed: str, reason: str) -> str:
        text = chr(next(characters))
        if text not in allowed:
            raise Wrong("cut short" if text in "\r\n" else reason, text)
        return text

    def number() -> int:
        digits = "0123456789abcdefABCDEF"
        return int(character(digits, "bad hex") + character(digits, "bad hex"), 16)

    deadline = [number() for _ in range(4)]
    character(":", "bad separator")
    name_size = number()
    if name_size not in range(1, 17):
        raise Wrong("topic length", "")
    name = [ord(character("".join(map(chr, range(32, 127))), "bad name")) for _ in range(name_size)]
    character(":", "bad separator")
    size = number()
    data = [number() for _ in range(size)]
    character(":", "bad separator")
    if sum([*deadline, name_size, *name, size, *data, number()]) % 256:
        raise Wrong("checksum" if size else "empty payload", "")
    return Line(bytes(name), bytes(data), int.from_bytes(deadline, "big"))


def plain_read(stream: bytes) -> tuple[list[Line], dict[str, int]]:
    lines: list[Line] = []
    drops: Counter[str] = Counter()
    counted = False
    characters = iter(stream)
    for found in characters:
        if chr(found) in "\r\n":
            counted = False
        elif chr(found) != "@":
            drops["garbage"] += not counted
            counted = True
        else:
            try:
                lines.append(plain_message(characters))
                counted = False
            except Wrong as wrong:
                reason, text = wrong.args
                drops[reason] += 1
                counted = not text or text not in "\r\n"
            except StopIteration:
                break
    return lines, +drops


def edit(text: bytes, at: int, removed: int, put: bytes) -> bytes:
    at %= len(text)
    return text[:at] + put + text[at + removed :]


wire_text = st.lists(st.sampled_from(list(b"@:\r\n0123Ff G\0a\xff"))).map(bytes)
sound_lines = messages.map(lambda line: encode(line.topic, line.data, line.deadline))
short_lines = st.builds(encode, st.just(b"cmd"), st.binary(min_size=1, max_size=4), st.integers(0, 0xFFFFFFFF))
damaged_lines = st.builds(edit, short_lines, st.integers(0, 60), st.integers(0, 20), wire_text)
streams = st.lists(st.one_of(short_lines, damaged_lines, damaged_lines, sound_lines, wire_text)).map(b"".join)


@given(streams, st.lists(st.integers(1, 40)))
def test_the_fast_reader_agrees_with_the_plain_one(stream: bytes, cuts: list[int]) -> None:
    reader = Reader()
    lines: list[Line] = []
    rest = stream
    for cut in cuts:
        lines += reader.feed(rest[:cut])
        rest = rest[cut:]
        assert len(reader._held) < HELD_MAX
    lines += reader.feed(rest)
    assert (lines, reader.drops) == plain_read(stream)


def bad_lines(count: int) -> Iterator[bytes]:
    """Damaged lines and noise, the same ones every time."""
    chance = random.Random(2013)
    sound = [
        encode(bytes(chance.choices(b"abcXYZ_09", k=length)), chance.randbytes(chance.choice((1, 5, 32))), length)
        for length in range(1, 17)
    ]
    for number in range(count):
        line = chance.choice(sound)
        at, kind = chance.randrange(len(line)), number % 8
        if kind == 0:
            yield chance.randbytes(at)
        elif kind == 1:
            yield line[:at]
        elif kind == 2:
            yield line[:at] + chance.choice(sound)[at:]
        elif kind == 3:
            yield bytes(chance.choices(b"@:0123456789ABCDEF\0", k=at))
        elif kind == 4:
            yield bytes(at) + line[at:]
        else:
            yield edit(line, at, chance.randrange(3), chance.randbytes(chance.randrange(3)))


def test_nothing_stops_the_reader() -> None:
    """200,000 bad lines: never an exception, little held, and the next good line is always understood."""
    reader = Reader()
    for bad in bad_lines(200_000):
        reader.feed(bad)
        assert len(reader._held) < HELD_MAX
        assert reader.feed(b"\r\n\r\n" + GOOD_LINE)[-1:] == [GOOD]
