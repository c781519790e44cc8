"""CAN frames to files of other programs and back: exact but for what each format has no place for."""

from pathlib import Path

import can
import pytest
from hypothesis import given
from hypothesis import strategies as st

from r2p.codecs.can_bits import ERROR, EXTENDED, LOCAL, REMOTE, WireFrame
from r2p.errors import BagError
from r2p.recording.bag import Bag
from r2p.recording.convert.candump import parse, text_of
from r2p.recording.convert.formats import convert
from r2p.recording.frame_reader import BusReader
from r2p.recording.frames import BusInfo, FrameEntry, FrameWriter, RecordedFrame
from r2p.recording.writer import BagWriter

UTC = 1_700_000_000_123_456_000
US = 1000

frames = (
    st.builds(
        RecordedFrame,
        st.integers(0, (1 << 31) * 10**6 - 1).map(lambda us: us * US),
        st.sampled_from(["can0", "vcan12", "slcan_dev_ttyACM0"]),
        st.integers(0, 0x7FF),
        st.binary(max_size=8),
        st.just(False),
        sent=st.booleans(),
    )
    | st.builds(
        RecordedFrame,
        st.just(UTC),
        st.just("can0"),
        st.integers(0, 0x1FFF_FFFF),
        st.just(b""),
        st.just(True),
        st.integers(0, 8),
    )
    | st.builds(
        RecordedFrame,
        st.just(UTC),
        st.just("can0"),
        st.integers(0, 0x1FFF_FFFF),
        st.binary(min_size=8, max_size=8),
        st.just(False),
        error=st.just(True),
    )
)


def recording(path: Path, buses: dict[str, list[WireFrame]]) -> Path:
    with path.open("wb") as file:
        writer = BagWriter(file)
        for name, wire in buses.items():
            FrameWriter(writer).write(FrameEntry(BusInfo(name, f"rtcan:{name}"), wire))
        writer.finish()
    return path


def read(path: Path) -> list[RecordedFrame]:
    with Bag(path) as bag:
        return list(BusReader(bag).read())


KINDS: list[WireFrame] = [
    (EXTENDED | 0x1ABCDE00, b"12345678", 0, UTC),
    (0x123, b"", LOCAL, UTC + 1 * US),
    (REMOTE | 0x7FF, bytes(4), 0, UTC + 2 * US),
    (REMOTE | EXTENDED | 0x123, bytes(8), LOCAL, UTC + 999 * US),
    (0x700, b"\xff\0\1", 0, UTC + 1_000_000 * US),
    (EXTENDED | 0x1FFF_FFFF, b"x", 0, UTC + 123_456_789 * US),
]
REPORT: WireFrame = (ERROR | 0x8, b"\0\0\4" + bytes(5), 0, UTC + 200_000_000 * US)


@pytest.mark.parametrize("suffix", [".log", ".blf", ".asc"])
def test_frames_come_back_from_a_file(suffix: str, tmp_path: Path) -> None:
    source = recording(tmp_path / "bus.mcap", {"can0": KINDS, "can3": KINDS})
    there = convert(source, tmp_path / f"bus{suffix}")
    back = convert(tmp_path / f"bus{suffix}", tmp_path / "back.mcap")
    assert read(tmp_path / "back.mcap") == read(source)
    assert there.losses == back.losses == {}
    assert there.messages == back.messages == {"can0/frames": 6, "can3/frames": 6}


@pytest.mark.parametrize(
    ("suffix", "losses"),
    [
        (".log", {"times finer than a microsecond": 1}),
        (
            ".blf",
            {
                "times finer than a microsecond": 1,
                "names of the bus lab, which is channel 1 there": 2,
            },
        ),
        (
            ".asc",
            {
                "times finer than a microsecond": 1,
                "names of the bus lab, which is channel 1 there": 2,
                "contents of error frames": 1,
            },
        ),
    ],
)
def test_what_a_format_has_no_place_for_is_said(suffix: str, losses: dict[str, int], tmp_path: Path) -> None:
    source = recording(tmp_path / "bus.mcap", {"lab": [(0x123, b"", 0, UTC + 1), REPORT]})
    assert convert(source, tmp_path / f"bus{suffix}").losses == losses
    convert(tmp_path / f"bus{suffix}", tmp_path / "back.mcap")
    first, second = read(tmp_path / "back.mcap")
    assert (first.time, first.bus) == (UTC, "lab" if suffix == ".log" else "can0")
    assert (second.error, second.data == REPORT[1]) == (True, suffix != ".asc")


@pytest.mark.parametrize("suffix", [".log", ".blf", ".asc"])
def test_python_can_reads_what_was_written(suffix: str, tmp_path: Path) -> None:
    source = recording(tmp_path / "bus.mcap", {"can0": [KINDS[0], KINDS[1], KINDS[4]]})
    convert(source, tmp_path / f"bus{suffix}")
    with can.LogReader(tmp_path / f"bus{suffix}") as messages:
        found = list(messages)
    assert [(each.arbitration_id, each.is_extended_id, bytes(each.data), each.is_rx) for each in found] == [
        (0x1ABCDE00, True, b"12345678", True),
        (0x123, False, b"", False),
        (0x700, False, b"\xff\0\1", True),
    ]
    assert [round((each.timestamp - found[0].timestamp) * 1e6) for each in found] == [0, 1, 1_000_000]


@pytest.mark.parametrize("suffix", [".log", ".blf", ".asc"])
def test_files_of_python_can_are_read(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"bus{suffix}"
    with can.Logger(path) as writer:
        for number in range(3):
            writer.on_message_received(
                can.Message(timestamp=UTC / 1e9 + number, arbitration_id=0x100 + number, data=bytes(number), channel=0)
            )
        writer.on_message_received(can.Message(timestamp=UTC / 1e9 + 4, is_fd=True, data=bytes(64), channel=0))
    result = convert(path, tmp_path / "bus.mcap")
    assert result.losses == {"frames of CAN FD": 1}
    found = read(tmp_path / "bus.mcap")
    assert [(each.bus, each.id, each.data) for each in found] == [("can0", 0x100 + i, bytes(i)) for i in range(3)]
    assert [each.time - found[0].time for each in found] == [0, 10**9, 2 * 10**9]


@given(frame=frames)
def test_a_line_of_candump_is_the_frame(frame: RecordedFrame) -> None:
    assert parse(text_of(frame)) == frame


@given(text=st.text("()0123456789.# canRTABF#\n") | st.binary(max_size=60).map(lambda data: data.decode("latin1")))
def test_any_line_is_a_frame_or_counted(text: str) -> None:
    found = parse(text)
    assert isinstance(found, RecordedFrame | str)


def test_a_log_that_is_cut_is_read_as_far_as_it_goes(tmp_path: Path) -> None:
    path = tmp_path / "bus.log"
    path.write_text("(1700000000.123456) can0 123#0102\n\n(1700000001.5) can0 1ABCDE00#R\n(1700000001.123456) can0 12")
    assert convert(path, tmp_path / "bus.mcap").losses == {"lines that are not frames": 1}
    assert [(each.time, each.id, each.remote) for each in read(tmp_path / "bus.mcap")] == [
        (1_700_000_000_123_456_000, 0x123, None),
        (1_700_000_001_500_000_000, 0x1ABCDE00, 0),
    ]


@pytest.mark.parametrize("suffix", [".blf", ".asc", ".log"])
def test_a_file_of_something_else_is_refused(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"x{suffix}"
    path.write_bytes(b"\0something else\n" * 20)
    with pytest.raises(BagError, match=r"can't be read|nothing to write"):
        convert(path, tmp_path / "bus.mcap")
    assert not (tmp_path / "bus.mcap").exists()


def test_a_blf_that_is_cut_is_read_as_far_as_it_goes(tmp_path: Path) -> None:
    many = [(0x123, number.to_bytes(8, "little"), 0, UTC + number * US) for number in range(20_000)]
    convert(recording(tmp_path / "bus.mcap", {"can0": many}), tmp_path / "bus.blf")
    content = (tmp_path / "bus.blf").read_bytes()
    (tmp_path / "bus.blf").write_bytes(content[: len(content) // 2])
    result = convert(tmp_path / "bus.blf", tmp_path / "back.mcap")
    assert 1000 < result.messages["can0/frames"] < 20_000
