"""Recordings that are cut anywhere, or damaged, are recovered as far as they are whole."""

import contextlib
import io
import os
import random
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.opcode import Opcode
from mcap.records import Message
from mcap.writer import CompressionType, Writer

from r2p.errors import BagError
from r2p.recording.mcap_reader import McapReader
from r2p.recording.recovery import RecordingRecovery, RecoveryReport, recover
from r2p.recording.writer import BagWriter
from tests.recording.checker import HEADER, check, record_at

COUNT = 24


def small_bag() -> bytes:
    """A finished recording of 24 messages in 4 chunks, with an attachment in the middle."""
    file = io.BytesIO()
    writer = BagWriter(file, chunk_size=192)
    schema = "a/A", "ros2msg", b"uint8 a"
    channels = [writer.add_channel(f"/{name}", "cdr", {"topic": name}, schema) for name in "ab"]
    for number in range(COUNT):
        writer.add(channels[number % 2], number + 1, number, number, bytes([number]))
        if number == COUNT // 2:
            writer.attach("r2p.toml", "text/plain", b"a = 1\n", 5)
    writer.finish()
    return file.getvalue()


BAG = small_bag()


def records(data: bytes) -> list[tuple[int, int, int]]:
    """The opcode of each record, where it begins, and where it ends."""
    found, position = [], 8
    while position < len(data) - 8:
        opcode, length = record_at(data, position)
        found.append((opcode, position, position + length))
        position += length
    return found


CHUNKS = [(begin, end) for opcode, begin, end in records(BAG) if opcode == Opcode.CHUNK]


def recovered(data: bytes, folder: Path) -> tuple[RecoveryReport, list[Message]]:
    """Recover a file, and return the messages of the new one, if there is one; each of its bytes is right."""
    source, target = folder / "cut.mcap", folder / "new.mcap"
    source.write_bytes(data)
    target.unlink(missing_ok=True)
    report = recover(source, target)
    messages = check(target) if target.exists() else []
    assert target.exists() != report.complete
    return report, messages


def test_a_file_that_is_cut_at_any_byte_is_recovered_up_to_the_cut(tmp_path: Path) -> None:
    source, target = tmp_path / "cut.mcap", tmp_path / "new.mcap"
    source.write_bytes(BAG)
    per_chunk = COUNT // len(CHUNKS)
    checked: dict[bytes, list[int]] = {}  # by what was recovered, which many cuts have in common
    for cut in range(len(BAG) - 1, 7, -1):
        os.truncate(source, cut)
        new = io.BytesIO()
        with contextlib.closing(McapReader(source)) as file:
            *_, report = [RecoveryReport(), *RecordingRecovery(file, new).run()]
        if new.getvalue() not in checked:
            target.write_bytes(new.getvalue())
            checked[new.getvalue()] = [message.sequence for message in check(target)]
        whole = sum(end <= cut for _, end in CHUNKS)
        assert checked[new.getvalue()] == list(range(report.messages)), cut
        assert whole * per_chunk <= report.messages <= (whole + 1) * per_chunk
        assert (report.damaged, report.complete) == (0, False)


def test_a_complete_file_is_left_alone(tmp_path: Path) -> None:
    report, _ = recovered(BAG, tmp_path)
    assert (report.complete, report.messages, report.channels, report.attachments) == (True, COUNT, 2, 1)


def zeros(data: bytearray, begin: int, end: int) -> None:
    data[begin:end] = bytes(end - begin)


def flipped_bit(data: bytearray, begin: int, end: int) -> None:
    data[(begin + end) // 2] ^= 1


def wrong_length(data: bytearray, begin: int, _end: int) -> None:
    data[begin + 1] ^= 1


def cut_out(data: bytearray, begin: int, end: int) -> None:
    del data[begin + 30 : end]


@pytest.mark.parametrize("damage", [zeros, flipped_bit, wrong_length, cut_out])
def test_behind_a_damaged_chunk_the_messages_go_on(
    damage: Callable[[bytearray, int, int], None], tmp_path: Path
) -> None:
    data = bytearray(BAG)
    damage(data, *CHUNKS[2])
    report, messages = recovered(bytes(data), tmp_path)
    missing = set(range(COUNT)) - {message.sequence for message in messages}
    assert missing == set(range(12, 18))
    assert report.damaged + report.unreadable > 0


def test_channels_whose_records_are_damaged_are_found_in_the_summary(tmp_path: Path) -> None:
    begin = next(begin for opcode, begin, _ in records(BAG) if opcode == Opcode.SCHEMA)
    data = bytearray(BAG)
    zeros(data, begin, CHUNKS[0][0])
    assert len(recovered(bytes(data), tmp_path)[1]) == COUNT
    summary = next(begin for opcode, begin, _ in records(BAG) if opcode == Opcode.DATA_END)
    report, messages = recovered(bytes(data[:summary]), tmp_path)
    assert (messages, report.without_channel) == ([], COUNT)


@pytest.mark.parametrize("compression", CompressionType)
def test_files_of_another_program_are_recovered_and_stay_theirs(compression: CompressionType, tmp_path: Path) -> None:
    file = io.BytesIO()
    writer = Writer(file, chunk_size=400_000, compression=compression)
    writer.start("theirs", "another")
    channel = writer.register_channel("/a", "json", writer.register_schema("a", "jsonschema", b"{}"))
    noise = random.Random(1)
    for number in range(200):
        writer.add_message(channel, number, noise.randbytes(5000), number)
    writer.flush()
    data = file.getvalue()
    _, messages = recovered(data, tmp_path)
    assert len(messages) == 200
    assert b"\x06\0\0\0theirs" in (tmp_path / "new.mcap").read_bytes()[:40]
    cut_in_second_chunk = recovered(data[:700_000], tmp_path)[1]
    assert 100 < len(cut_in_second_chunk) < 160


@pytest.mark.parametrize(
    ("data", "text"), [(b"", "empty"), (b"\x89MCAP", "not an MCAP file"), (b"#ROSBAG V2.0\n" * 9, "bag of ROS 1")]
)
def test_what_is_not_a_recording_is_refused(data: bytes, text: str, tmp_path: Path) -> None:
    with pytest.raises(BagError, match=text):
        recovered(data, tmp_path)


def test_an_existing_file_is_never_overwritten(tmp_path: Path) -> None:
    source, target = tmp_path / "cut.mcap", tmp_path / "mine.mcap"
    source.write_bytes(BAG[:500])
    target.write_text("mine")
    with pytest.raises(FileExistsError):
        recover(source, target)
    assert target.read_text() == "mine"


@given(st.lists(st.tuples(st.integers(8, len(BAG) - 1), st.integers(0, 255)), max_size=8), st.integers(8, len(BAG)))
def test_any_damage_gives_a_file_that_is_right(
    tmp_path_factory: pytest.TempPathFactory, changes: list[tuple[int, int]], cut: int
) -> None:
    data = bytearray(BAG)
    for position, value in changes:
        data[position] = value
    recovered(bytes(data[:cut]), tmp_path_factory.mktemp("damage"))


@given(st.lists(st.tuples(st.integers(0, 20), st.binary(max_size=60)), max_size=6))
def test_records_of_any_content_do_no_harm(
    tmp_path_factory: pytest.TempPathFactory, contents: list[tuple[int, bytes]]
) -> None:
    data = BAG[:8] + b"".join(HEADER.pack(opcode, len(content)) + content for opcode, content in contents)
    recovered(data + BAG[8:], tmp_path_factory.mktemp("records"))
