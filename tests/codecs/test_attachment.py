"""The header of messages on zenoh."""

from collections.abc import Callable

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from r2p.bridge.options import check_prefix
from r2p.codecs import PublisherClass, UnknownType, attachment
from r2p.codecs.attachment import Credit, Header, HeaderReader, Origin
from r2p.errors import DecodeError
from r2p.messages import ClockOffset
from r2p.names import module_alias

ORIGIN = Origin(PublisherClass.NON_REAL_TIME, 0xA0B1C2D3, 0x01020304, bytes(range(8)), "PC1", "blink")
HEADER = Header(ORIGIN, serial=7, sequence=9, stamp=1_700_000_000_000_000_000, deadline=1_700_000_000_020_000_000)

U32 = st.integers(0, 0xFFFFFFFF)
I64 = st.integers(-(2**63), 2**63 - 1)
NAME = "ABCxyz019_"
TOPICS = st.from_regex(r"[A-Za-z0-9_]{1,60}(/[A-Za-z0-9_]{1,60}){0,3}", fullmatch=True)
HEADERS = st.builds(
    Header,
    origin=st.builds(
        Origin,
        publisher_class=st.sampled_from(PublisherClass),
        sender=U32,
        instance=U32,
        fingerprint=st.binary(min_size=8, max_size=8),
        module=st.text(NAME, max_size=64),
        node=st.text(NAME, max_size=64),
    ),
    serial=U32,
    sequence=st.integers(0, 2**64 - attachment.PACKET_MAX),
    stamp=I64,
    deadline=I64,
    hops=st.integers(0, 255),
    stamped=st.booleans(),
    clock=st.none() | st.builds(ClockOffset, epoch=U32, offset=I64, error=U32),
    more=st.just(()) | st.lists(I64, max_size=attachment.PACKET_MAX - 1).map(tuple),
)


LENGTHS = st.just(0) | st.integers(0, 2**32 - 1)


@st.composite
def varying_headers(draw: st.DrawFn) -> Header:
    """With a length for each message."""
    header = draw(HEADERS)
    count = len(header.more) + 1
    lengths = draw(st.lists(LENGTHS, min_size=count, max_size=count))
    return msgspec.structs.replace(header, lengths=tuple(lengths))


@given(HEADERS | varying_headers())
def test_what_is_encoded_is_decoded(header: Header) -> None:
    data = attachment.encode(header)
    assert attachment.decode(data) == header
    assert data[0] == (2 if header.lengths else 1)
    assert len(data) <= attachment.HEADER_MAX


_PREFIXES = st.from_regex(r"[A-Za-z0-9_]{1,16}/|[A-Za-z0-9_]{1,14}_", fullmatch=True)


@given(_PREFIXES, st.just("") | _PREFIXES, st.text(NAME, min_size=1, max_size=64))
def test_a_module_behind_prefixes_has_a_name_that_is_carried(outer: str, inner: str, module: str) -> None:
    """Its own, where that has 81 characters at most, and is in one namespace of 16 at most."""
    for each in (outer, inner):
        check_prefix(each)
    name = outer + inner + module
    told = attachment.name_for(name)
    origin = msgspec.structs.replace(ORIGIN, module=told)
    assert attachment.decode(attachment.encode(msgspec.structs.replace(HEADER, origin=origin))).origin.module == told
    namespace, _, _ = name.rpartition("/")
    fits = len(name) <= 81 and len(namespace) <= 16 and "/" not in namespace
    assert told == (name if fits else module_alias(name))


def test_a_module_that_has_no_name_for_a_header_goes_without() -> None:
    assert attachment.name_for("lab/robot1_MOTOR1") == "lab/robot1_MOTOR1"
    assert [attachment.name_for(each) for each in ("", "A B", "A*")] == ["", "", ""]


def test_the_bytes_of_a_header() -> None:
    """As docs/PROTOCOL.md has it."""
    data = attachment.encode(HEADER)
    assert data[:16] == bytes.fromhex("01000000 07000000 0900000000000000")
    assert data[16:32] == HEADER.stamp.to_bytes(8, "little") + HEADER.deadline.to_bytes(8, "little")
    assert data[32:] == bytes.fromhex("01 d3c2b1a0 04030201 0001020304050607") + b"PC1/blink"


def test_a_fast_encoder_says_the_same() -> None:
    packer = attachment.Packer(ORIGIN)
    serial, sequence, stamp, deadline = HEADER.serial + 2**32, HEADER.sequence, HEADER.stamp, HEADER.deadline
    for hops, stamped in [(0, True), (3, False), (300, True)]:
        start = attachment.start_of(hops, stamped=stamped)
        header = msgspec.structs.replace(HEADER, hops=hops, stamped=stamped)
        assert packer.one(start, serial, sequence, stamp, deadline) == attachment.encode(header)
        several = packer.several(start, serial, sequence, deadline, [stamp, stamp + 5, stamp - 1])
        assert several == attachment.encode(msgspec.structs.replace(header, more=(stamp + 5, stamp - 1)))


def test_the_bytes_of_a_header_of_several_messages() -> None:
    """As docs/PROTOCOL.md has it."""
    data = attachment.encode(msgspec.structs.replace(HEADER, clock=ClockOffset(1, 2, 3), more=(4, 5)))
    single = attachment.encode(msgspec.structs.replace(HEADER, clock=ClockOffset(1, 2, 3)))
    assert (
        data
        == single[:3] + b"\2" + single[4:48] + bytes([4, 0, 0, 0, 0, 0, 0, 0, 5, 0, 0, 0, 0, 0, 0, 0]) + single[48:]
    )


def test_the_bytes_of_a_header_with_lengths() -> None:
    """As docs/PROTOCOL.md has it; all but the version, and the lengths in front of the origin, is as without."""
    header = msgspec.structs.replace(HEADER, more=(4, 5))
    data = attachment.encode(msgspec.structs.replace(header, lengths=(0, 3, 70_000)))
    without = attachment.encode(header)
    assert data == b"\2" + without[1:48] + bytes.fromhex("00000000 03000000 70110100") + without[48:]
    packer = attachment.Packer(ORIGIN)
    start = attachment.start_of(0, stamped=True, version=2)
    args = start, HEADER.serial, HEADER.sequence, HEADER.deadline
    assert packer.varying(*args, [HEADER.stamp, 4, 5], [0, 3, 70_000]) == data
    assert attachment.decode(packer.varying(*args, [HEADER.stamp], [0])).lengths == (0,)
    for cut in range(48, 60):
        with pytest.raises(DecodeError, match="lengths"):
            attachment.decode(data[:cut])


@given(st.binary(min_size=28, max_size=140))
def test_any_bytes_are_a_header_with_lengths_or_counted(data: bytes) -> None:
    data = b"\2" + data[:2] + bytes([data[3] % 8]) + data[3:]
    try:
        header = attachment.decode(data)
    except DecodeError:
        return
    assert len(header.lengths) == len(header.more) + 1
    assert attachment.decode(attachment.encode(header)) == header


@given(st.integers(0, 70_000), st.integers(1, 8), st.data())
def test_a_payload_is_split_into_all_its_bytes_or_counted(size: int, count: int, data: st.DataObject) -> None:
    bounds = st.just(()) | st.lists(LENGTHS | st.integers(0, size), min_size=count, max_size=count).map(tuple)
    lengths = data.draw(bounds)
    try:
        ends = attachment.split(size, count, lengths)
    except DecodeError:
        assert sum(lengths) != size or not lengths or (count > 1 and size > attachment.PACKET_BYTES_MAX)
        return
    assert (len(ends), ends[-1], ends) == (count, size, sorted(ends))
    assert lengths == () or [end - at for at, end in zip([0, *ends], ends, strict=False)] == list(lengths)


def test_lengths_that_are_not_those_of_the_payload() -> None:
    assert attachment.split(10, 3, (3, 0, 7)) == [3, 3, 10]
    with pytest.raises(DecodeError, match="lengths of 10 bytes for a payload of 11"):
        attachment.split(11, 3, (3, 0, 7))
    with pytest.raises(DecodeError, match="2 messages in 65537 bytes, more than 65536"):
        attachment.split(65_537, 2, (1, 65_536))
    assert attachment.split(64 << 20, 1, (64 << 20,)) == [64 << 20]


def test_what_is_too_large_is_cut() -> None:
    header = msgspec.structs.replace(HEADER, hops=300, serial=2**32 + 1, clock=ClockOffset(1, -5, 2**40))
    read = attachment.decode(attachment.encode(header))
    assert (read.hops, read.serial, read.clock) == (255, 1, ClockOffset(1, -5, 0xFFFFFFFF))


def test_an_origin_is_remembered_once() -> None:
    made: list[Origin] = []

    def remember(origin: Origin) -> int:
        made.append(origin)
        return len(made)

    reader = HeaderReader(remember)
    data = attachment.encode(HEADER)
    other = attachment.encode(msgspec.structs.replace(HEADER, origin=msgspec.structs.replace(ORIGIN, node="other")))
    assert [reader.read(each)[0] for each in (data, other, data, other)] == [1, 2, 1, 2]


def test_a_liar_does_not_fill_the_memory() -> None:
    made: list[Origin] = []
    reader = HeaderReader(made.append)
    for sender in range(5000):
        reader.read(
            attachment.encode(msgspec.structs.replace(HEADER, origin=msgspec.structs.replace(ORIGIN, sender=sender)))
        )
    assert len(made) == 5000
    assert len(reader.known) < 4097


def test_an_origin_in_use_is_not_forgotten_when_many_others_come() -> None:
    """With it the serial, the sequence and the stamp of its last message would go, and duplicates would pass."""
    made: list[Origin] = []

    def remember(origin: Origin) -> int:
        made.append(origin)
        return len(made)

    reader = HeaderReader(remember)
    data = attachment.encode(HEADER)
    for sender in range(10_000):
        origin = msgspec.structs.replace(ORIGIN, sender=sender)
        reader.read(attachment.encode(msgspec.structs.replace(HEADER, origin=origin)))
        if sender % 1000 == 0:
            reader.read(data)
    reader.read(data)
    assert made.count(ORIGIN) == 1
    for key in reader.known:
        reader.forget(key)
    assert not reader.known


@given(st.binary(max_size=120))
def test_any_bytes_are_a_header_or_counted(data: bytes) -> None:
    try:
        header = attachment.decode(data)
    except DecodeError:
        return
    assert attachment.decode(attachment.encode(header)) == header


@pytest.mark.parametrize("cut", range(len(attachment.encode(HEADER)) - len("PC1/blink") + 1))
def test_a_header_that_was_cut(cut: int) -> None:
    with pytest.raises(DecodeError):
        attachment.decode(attachment.encode(HEADER)[:cut])


def test_a_header_that_ends_in_its_stamps() -> None:
    data = attachment.encode(msgspec.structs.replace(HEADER, more=(1, 2)))
    for cut in range(32, 48):
        with pytest.raises(DecodeError, match="stamps"):
            attachment.decode(data[:cut])


def test_a_sequence_that_ends_in_the_packet() -> None:
    """A gateway could not send on what it counts."""
    last = msgspec.structs.replace(HEADER, sequence=2**64 - 2, more=(1,))
    assert attachment.decode(attachment.encode(last)) == last
    with pytest.raises(DecodeError, match="sequence"):
        attachment.decode(attachment.encode(msgspec.structs.replace(last, more=(1, 2))))


def test_another_version_is_left_alone() -> None:
    for data in (b"\3", b"\3" + attachment.encode(HEADER)[1:]):
        with pytest.raises(UnknownType, match="version 3"):
            attachment.decode(data)


@pytest.mark.parametrize("tail", [b"PC1", b"A" * 82 + b"/node", b"PC1/" + b"n" * 65, b"PC 1/a", b"a/b/c/d"])
def test_names_that_are_none(tail: bytes) -> None:
    with pytest.raises(DecodeError, match="module/node"):
        attachment.decode(attachment.encode(HEADER)[: -len("PC1/blink")] + tail)


def test_a_class_that_does_not_exist() -> None:
    header = msgspec.structs.replace(HEADER, origin=msgspec.structs.replace(ORIGIN, publisher_class=4))
    with pytest.raises(DecodeError, match="4 is not a publisher class"):
        attachment.decode(attachment.encode(header))


@given(
    st.builds(
        Credit,
        session=U32,
        publisher_class=st.sampled_from(PublisherClass),
        serial=U32,
        topic=TOPICS,
        leaving=st.booleans(),
    )
)
def test_credits(credit: Credit) -> None:
    assert attachment.decode_credit(attachment.encode_credit(credit)) == credit


@pytest.mark.parametrize("decode", [attachment.decode, attachment.decode_credit, attachment.decode_sender])
def test_without_bytes_there_is_no_version_to_ignore(decode: Callable[[bytes], object]) -> None:
    with pytest.raises(DecodeError) as caught:
        decode(b"")
    assert caught.type is DecodeError
    with pytest.raises(UnknownType, match="version 3"):
        decode(b"\3")


@pytest.mark.parametrize(
    ("decode", "data", "text"),
    [
        (attachment.decode, b"\1" * 7, "header too short: 7 bytes, at least 32 needed"),
        (attachment.decode_credit, b"\1" * 7, "credit too short: 7 bytes, at least 11 needed"),
        (attachment.decode_credit, b"\1" * 10 + b"a b", "credit for b'a b', which is not a valid topic"),
        (attachment.decode_credit, b"\1\4" + bytes(8) + b"leds", "4 is not a publisher class"),
        (attachment.decode_sender, b"\1" * 7, "sender of 7 bytes, 5 needed"),
    ],
)
def test_an_error_says_what_is_wrong(decode: Callable[[bytes], object], data: bytes, text: str) -> None:
    with pytest.raises(DecodeError) as caught:
        decode(data)
    assert str(caught.value) == text


@given(st.binary(max_size=7) | st.integers(0, 2**32 - 1).map(attachment.encode_sender))
def test_any_bytes_are_a_sender_or_counted(data: bytes) -> None:
    try:
        session = attachment.decode_sender(data)
    except DecodeError:
        return
    assert attachment.encode_sender(session) == data


@given(st.binary(max_size=40))
def test_any_bytes_are_a_credit_or_counted(data: bytes) -> None:
    try:
        credit = attachment.decode_credit(data)
    except DecodeError:
        return
    assert attachment.encode_credit(credit) == data
