"""What the writer makes of any messages is right in each byte, and a chunk can be copied into another file."""

import io
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.records import Channel, Chunk, Schema
from mcap.stream_reader import StreamReader

from r2p.errors import DecodeError, MessageError
from r2p.recording.writer import BagWriter
from tests.recording.checker import check, stream_at

TIMES = st.integers(0, (1 << 64) - 1)
SCHEMA = "a/A", "ros2msg", b"uint8 a"
MESSAGES = st.lists(st.tuples(st.integers(0, 3), TIMES, TIMES, st.integers(0, (1 << 32) - 1), st.binary(max_size=300)))


@given(MESSAGES, st.sets(st.integers(0, 20)), st.integers(1, 2000))
def test_any_messages_are_read_by_a_strict_reader(
    tmp_path_factory: pytest.TempPathFactory,
    messages: list[tuple[int, int, int, int, bytes]],
    flushes: set[int],
    chunk_size: int,
) -> None:
    path = tmp_path_factory.mktemp("written") / "any.mcap"
    with path.open("wb") as file:
        writer = BagWriter(file, chunk_size=chunk_size)
        channels: dict[int, int] = {}
        for number, (channel, *rest) in enumerate(messages):
            if channel not in channels:  # channels begin in the middle of chunks
                channels[channel] = writer.add_channel(f"/{channel}", "cdr", {"number": f"{channel}"}, SCHEMA)
                writer.attach(f"{channel}", "text/plain", b"x" * channel, number)
            writer.add(channels[channel], *rest)  # type: ignore[arg-type]
            if number in flushes:
                writer.end_chunk()
        writer.finish()
    found = [(m.channel_id, m.log_time, m.publish_time, m.sequence, m.data) for m in check(path)]
    assert found == [(channels[channel], *rest) for channel, *rest in messages]


def chunks(data: bytes) -> list[tuple[Chunk, bytes]]:
    """The chunks of a file with the records of their indexes, and its channels."""
    summary = make_reader(io.BytesIO(data)).get_summary()
    assert summary is not None
    found = []
    for index in summary.chunk_indexes:
        behind = index.chunk_start_offset + index.chunk_length
        chunk = Chunk.read(stream_at(data, index.chunk_start_offset))
        found.append((chunk, data[behind : behind + index.message_index_length]))
    return found


def bag() -> bytes:
    file = io.BytesIO()
    writer = BagWriter(file, chunk_size=500)
    one, two = (writer.add_channel(f"/{name}", "cdr", {}, SCHEMA) for name in "ab")
    for number in range(100):
        writer.add(two if number % 3 else one, number, number, number, b"payload")
    writer.finish()
    return file.getvalue()


def definitions(data: bytes) -> list[tuple[Channel, Schema | None]]:
    records = list(StreamReader(io.BytesIO(data)).records)
    schemas = {record.id: record for record in records if isinstance(record, Schema)}
    return [(record, schemas.get(record.schema_id)) for record in records if isinstance(record, Channel)]


def test_chunks_are_copied_between_messages_as_they_are(tmp_path: Path) -> None:
    data = bag()
    path = tmp_path / "copy.mcap"
    with path.open("wb") as file:
        writer = BagWriter(file)
        for channel, schema in definitions(data):
            writer.copy_channel(channel, schema)
        new = writer.add_channel("/c", "cdr", {}, SCHEMA)
        writer.add(1, 0, 0, 1_000, b"first")
        for chunk, index in chunks(data)[2:5]:
            writer.copy_chunk(chunk, index)
        writer.add(new, 500, 500, 2_000, b"last")
        writer.finish()
    copied = [message.sequence for message in check(path)]
    per_chunk = 500 // (31 + len(b"payload")) + 1
    assert copied == [1_000, *range(2 * per_chunk, 5 * per_chunk), 2_000]
    assert chunks(data)[2][0].data in path.read_bytes()


@pytest.mark.parametrize(
    ("index", "text"),
    [
        (b"\7", "cut short"),
        (b"\7" + bytes(14), "damaged"),
        (2 * chunks(bag())[0][1], "damaged"),
        (chunks(bag())[0][1][:-1], "cut short"),
    ],
)
def test_a_damaged_index_is_not_copied(index: bytes, text: str) -> None:
    writer = BagWriter(io.BytesIO())
    for channel, schema in definitions(bag()):
        writer.copy_channel(channel, schema)
    with pytest.raises(DecodeError, match=text):
        writer.copy_chunk(chunks(bag())[0][0], index)


def test_channels_that_contradict_each_other_are_not_copied() -> None:
    writer = BagWriter(io.BytesIO())
    schema = Schema(1, b"uint8 a", "ros2msg", "a/A")
    writer.copy_channel(Channel(1, "/a", "cdr", {}, 1), schema)
    writer.copy_channel(Channel(1, "/a", "cdr", {}, 1), schema)
    with pytest.raises(DecodeError, match="two channels"):
        writer.copy_channel(Channel(1, "/b", "cdr", {}, 1), schema)
    with pytest.raises(DecodeError, match="two schemas"):
        writer.copy_channel(Channel(2, "/b", "cdr", {}, 1), Schema(1, b"uint8 b", "ros2msg", "a/A"))
    with pytest.raises(DecodeError, match="unknown channel 2"):
        writer.copy_chunk(*chunks(bag())[0])


def test_there_are_as_many_channels_as_fit_their_number() -> None:
    writer = BagWriter()
    writer.copy_channel(Channel(0xFFFF, "/last", "cdr", {}, 0), None)
    with pytest.raises(MessageError, match="at most 65535 channels: no room for /more"):
        writer.add_channel("/more", "cdr", {})
