"""Recordings of strangers: nothing is written outside of the target, and nothing that exists is lost."""

import os
import struct
import zlib
from pathlib import Path

import pytest

import r2p
from r2p.msg import Led
from r2p.recording.bag import Bag
from r2p.recording.convert.formats import convert
from r2p.recording.format import PACKED, ChannelInfo
from r2p.recording.writer import BagWriter
from tests.recording.making import T0, leds, write


def recorded(path: Path, topics: list[str], time: int = T0) -> Path:
    with path.open("wb") as file:
        writer = BagWriter(file)
        for topic in topics:
            channel = writer.add_channel(f"/{topic}", PACKED, ChannelInfo(topic).metadata, None)
            writer.add(channel, time, time, 1, Led(1, 1).encode())
        writer.finish()
    return path


@pytest.mark.parametrize("to", ["csv", "parquet"])
def test_no_topic_leads_out_of_the_folder(to: str, tmp_path: Path) -> None:
    if to == "parquet":
        pytest.importorskip("pyarrow")
    topics = ["../../evil", "..", "a/../../../evil", "a\0b", "\x1b[2J", "x" * 300, "c\\..\\d", "camera-1/image"]
    source = recorded(tmp_path / "evil.mcap", topics)
    (tmp_path / "work").mkdir()
    result = convert(source, tmp_path / "work" / "out", to=to)
    assert {each for each in tmp_path.rglob("*") if each.is_file()} == {
        source,
        tmp_path / "work" / "out" / "camera-1" / f"image.{to}",
    }
    assert result.losses == {f"messages of {each}, which can't be the name of a file": 1 for each in topics[:-1]}


def test_parquet_has_no_place_for_the_far_future(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    source = recorded(tmp_path / "far.mcap", ["leds"], (1 << 64) - 1)
    with pytest.raises(r2p.BagError, match="1 message of leds from after the year 2262"):
        convert(source, tmp_path / "far.parquet")


def test_a_folder_of_recordings_is_not_replaced(tmp_path: Path) -> None:
    folder = tmp_path / "drives"
    folder.mkdir()
    source, other = write(folder / "a.mcap", leds(3)), write(tmp_path / "b.mcap", leds(3))
    with pytest.raises(r2p.BagError, match=r"has a.mcap, which is to be converted"):
        convert(source, folder, overwrite=True)
    with pytest.raises(r2p.BagError, match=r"has no metadata.yaml"):
        convert(other, folder, overwrite=True)
    assert source.exists()


def test_a_pipe_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "drive.mcap")
    with pytest.raises(r2p.BagError, match="is a pipe or a device"):
        Bag(tmp_path / "drive.mcap")


def test_a_line_without_an_end_is_read_in_pieces(tmp_path: Path) -> None:
    with (tmp_path / "drive.log").open("wb") as file:
        file.truncate(10_000)
    with pytest.raises(r2p.BagError, match="3 lines that are not frames"):
        convert(tmp_path / "drive.log", tmp_path / "out.mcap")


@pytest.mark.parametrize(
    "objects", [struct.pack("<4sHHLL", b"LOBJ", 16, 1, 0, 1).ljust(99), bytes(1 << 25)], ids=["no length", "bomb"]
)
def test_objects_without_a_length_and_bombs_end_a_blf_file(objects: bytes, tmp_path: Path) -> None:
    can = pytest.importorskip("can")
    path = tmp_path / "a.blf"
    with can.BLFWriter(path) as writer:
        writer.on_message_received(can.Message(timestamp=T0 / 1e9, data=b"1"))
    packed = struct.pack("<H6xL4x", 2, len(objects)) + zlib.compress(objects)
    head = struct.pack("<4sHHLL", b"LOBJ", 16, 1, 16 + len(packed), 10)
    path.write_bytes(path.read_bytes() + head + packed)
    result = convert(path, tmp_path / "a.mcap")
    assert (result.messages, [each[:40] for each in result.losses]) == (
        {"can0/frames": 1},
        ["rest of the file, which can't be read (V"],
    )


@pytest.mark.parametrize("text", ["[" * 3000, "rosbag2_bagfile_information: [1]", "names: .."])
def test_metadata_of_ros2_that_makes_no_sense(text: str, tmp_path: Path) -> None:
    convert(write(tmp_path / "a.mcap", leds(3)), tmp_path / "drive")
    file = tmp_path / "drive" / "metadata.yaml"
    file.write_text(file.read_text().replace("drive_0.mcap", "..") if text == "names: .." else text)
    with pytest.raises(r2p.BagError):
        convert(tmp_path / "drive", tmp_path / "out.mcap")


def test_long_messages_are_not_all_held_in_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    parquet = pytest.importorskip("r2p.recording.convert.parquet")
    monkeypatch.setattr(parquet, "_HELD_MAX", 20)
    convert(write(tmp_path / "a.mcap", leds(30)), tmp_path / "leds.parquet")
    assert parquet.pq.ParquetFile(tmp_path / "leds.parquet").num_row_groups == 8  # of 5 bytes each
    convert(tmp_path / "leds.parquet", tmp_path / "back.mcap")
    with Bag(tmp_path / "back.mcap") as bag:
        assert len(list(bag.samples("leds"))) == 30
