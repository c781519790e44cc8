"""Messages whose length varies: their header, and what is made of frames that are lost, repeated or out of order."""

from collections import Counter
from collections.abc import Iterator

import pytest
from hypothesis import given
from hypothesis import strategies as st

from r2p.codecs import can_bits, rtcan
from r2p.codecs.rtcan import Frame
from r2p.errors import DecodeError, MessageError
from r2p.protocols.rtcan.events import Done, Fate, Received, SlotsGranted
from r2p.protocols.rtcan.reassembly import Reassembly
from tests.protocols.rtcan.bus import MS, Bus
from tests.protocols.rtcan.networks import CYCLE, TOPIC, network, starts

A, B = 0x020A, 0x020B
STAMP = 1_000_000_000
BOUND = 1020

payloads = st.one_of(
    st.binary(min_size=4, max_size=60),
    st.lists(st.integers(-1, 2), min_size=1, max_size=16).map(
        lambda xs: b"".join(x.to_bytes(4, "little", signed=True) for x in xs)
    ),
)


def frames(payload: bytes, message: int = A) -> list[Frame]:
    parts = rtcan.fragments(rtcan.encode_variable(payload))
    return [Frame(rtcan.encode_identifier(10, message, left), data) for left, data in parts]


def receive(stream: list[Frame], bound: int = BOUND) -> tuple[list[bytes], Counter[str]]:
    """Return the payloads, and what is counted as lost, of frames 150 us apart."""
    reassembly = Reassembly()
    for message in (A, B):
        reassembly.subscribe(message, bound, varies=True)
    received = [reassembly.receive(frame, STAMP + n * 150_000) for n, frame in enumerate(stream)]
    reassembly.reset()  # what is unfinished counts as interrupted
    return [each.payload for each in received if each is not None], sum(reassembly.losses.values(), Counter[str]())


@pytest.mark.parametrize("size", [4, 5, 11, 12, 13, 1019, 1020])
def test_whole_messages(size: int) -> None:
    payload = bytes(n * 7 & 0xFF for n in range(size))
    assert receive(frames(payload) * 2) == ([payload] * 2, {})


def test_the_header_is_length_and_checksum() -> None:
    assert rtcan.encode_variable(b"123456789").hex() == "0900b129" + b"123456789".hex()
    assert rtcan.decode_variable(bytes.fromhex("0000ffff")) == b""
    with pytest.raises(MessageError, match="up to 1020 bytes in a message of variable length, not 1021"):
        rtcan.encode_variable(bytes(1021))
    for wrong in ("", "000000", "0100ffff", "0000fffe", "0000ffff00"):
        with pytest.raises(DecodeError):
            rtcan.decode_variable(bytes.fromhex(wrong))


def test_what_is_received_of_a_message() -> None:
    """The start of a frame is exact to its stuff bits: they depend on the header."""
    reassembly = Reassembly()
    reassembly.subscribe(A, BOUND, varies=True)
    first, second = frames(b"a scan of 7")
    assert reassembly.receive(first, STAMP) is None
    received = reassembly.receive(second, STAMP + 150_000)
    assert received == Received(first.id, b"a scan of 7", STAMP, first.data[:4])
    assert received.started(1000) == STAMP - can_bits.frame_bits(first.id, first.data) * 1000


def test_empty_messages_are_those_of_a_topic_without_any_others() -> None:
    """Where others are possible, an empty one could be the last bytes of a message whose beginning is lost."""
    assert receive(frames(b"") * 3, bound=0) == ([b""] * 3, {})
    assert receive(frames(bytes(4)), bound=0) == ([], {"no beginning": 1})
    tail = frames(bytes(8) + b"\0\0\xff\xff")[1:]
    assert receive([*tail, *frames(bytes(4))]) == ([bytes(4)], {"no beginning": 1})


def test_another_checksum_or_length_is_damage() -> None:
    first, second, third = frames(bytes(range(20)))
    other = Frame(second.id, bytes(8))
    short = Frame(second.id, bytes(7))
    for damaged in ([first, other, third], [first, short, third], [first, second, Frame(third.id, third.data[:-1])]):
        assert receive([*damaged, *frames(b"next")]) == ([b"next"], {"damaged": 1})


def test_the_next_message_survives_the_loss_of_the_last_frame_before_it() -> None:
    """Its only frame looks like that one, of the same length even."""
    long = bytes(range(8 + 8 - 4))
    assert len(frames(long)) == 2
    assert receive([*frames(long)[:1], *frames(b"1234")]) == ([b"1234"], {"damaged": 1})
    assert receive([*frames(long)[:1], *frames(b"123456789")]) == ([b"123456789"], {"gap": 1})


def test_sizes_and_kinds_that_change() -> None:
    reassembly = Reassembly()
    reassembly.subscribe(A, BOUND, varies=True)
    first, second = frames(b"twelve bytes")
    reassembly.receive(first, STAMP)
    reassembly.subscribe(A, 500, varies=True)  # another bound changes nothing
    assert reassembly.receive(second, STAMP) is not None
    reassembly.receive(first, STAMP)
    reassembly.subscribe(A, 16)
    assert reassembly.receive(second, STAMP) is None
    assert reassembly.losses == {10: {"interrupted": 1, "no beginning": 1}}


def mutations(stream: list[Frame]) -> Iterator[tuple[set[int], list[Frame]]]:
    """Each frame dropped, repeated, and swapped with the next one: the frames concerned, and all."""
    for at in range(len(stream)):
        yield {at}, stream[:at] + stream[at + 1 :]
        yield {at}, stream[: at + 1] + stream[at:]
        yield {at, at + 1}, [*stream[:at], *reversed(stream[at : at + 2]), *stream[at + 2 :]]


@given(st.lists(st.tuples(st.sampled_from([A, A, B]), payloads), min_size=1, max_size=6))
def test_never_a_wrong_message(messages: list[tuple[int, bytes]]) -> None:
    owners = [number for number, (message, payload) in enumerate(messages) for _ in frames(payload, message)]
    stream = [frame for message, payload in messages for frame in frames(payload, message)]
    sent = Counter(payload for _, payload in messages)
    received, lost = receive(stream)
    assert (Counter(received), lost) == (sent, {})
    for changed, came in mutations(stream):
        received, lost = receive(came)
        touched = {owners[at] for at in changed if at < len(owners)}
        again = Counter(messages[number][1] for number in touched)
        untouched = Counter(payload for number, (_, payload) in enumerate(messages) if number not in touched)
        assert Counter(received) <= sent + again  # a message of one frame that comes twice is received twice
        assert untouched <= Counter(received)
        whole = len(came) < len(stream) and owners.count(min(touched)) == 1  # of which nothing is left that tells
        assert lost or whole or sent <= Counter(received)


@given(st.lists(st.tuples(st.integers(0, 127), st.binary(max_size=8)), max_size=60), st.sampled_from([0, 4, BOUND]))
def test_any_frames(stream: list[tuple[int, bytes]], bound: int) -> None:
    """Whatever comes: no exception, nothing longer than a message may be, and at most one unfinished message."""
    received, _ = receive([Frame(rtcan.encode_identifier(10, A, left), data) for left, data in stream], bound)
    assert all(len(payload) <= BOUND for payload in received)


# In slots


def test_slots_are_reserved_for_the_bound_and_shorter_messages_leave_some_empty() -> None:
    bus = Bus()
    _master, owner, listener = network(bus, 1, 0, 0)
    listener.engine.subscribe(rtcan.message_id(TOPIC, 11), 20, varies=True)
    sizes = [4, 20, 5, 13, 12, 0x13]
    filled: list[bytes] = []

    def fill(due: object) -> bytes:
        filled.append(bytes([len(filled) & 0xFF]) * sizes[len(filled) % len(sizes)])
        return rtcan.encode_variable(filled[-1])

    owner.fill = fill
    owner.act(
        owner.engine.reserve(owner.now, TOPIC, rtcan.size_on_bus(20, varies=True), CYCLE, varies=True, handle="hrt")
    )
    bus.run(50 * MS)
    assert owner.of(SlotsGranted)
    mask = listener.engine.cycle.mask
    assert mask is not None
    assert mask.bit_count() == 1 + 3
    begin, known = bus.now, len(filled)
    bus.run(60 * CYCLE)
    count = sum(rtcan.fragment_count(4 + len(each)) for each in filled[known:])
    assert abs(len([at for at in starts(bus, TOPIC, 0) if at > begin]) - count) <= 3
    got = listener.received(TOPIC)
    assert got == filled[-len(got) :] or got == filled[-len(got) - 1 : -1]
    assert listener.engine.reassembly.losses == {}
    assert {done.fate for done in owner.of(Done)} == {Fate.SENT}
    with pytest.raises(ValueError, match="25 bytes for a periodic message of 24"):
        owner.engine.fill(owner.now, TOPIC, bytes(25))
