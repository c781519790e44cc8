"""`r2p bag info` and `r2p bag echo`: what is in a recording."""

import json
from pathlib import Path
from typing import Any

import pytest

import r2p
from r2p.messages import Message
from r2p.msg import BusTraffic
from r2p.recording.entries import EntryWriter, MessageEntry
from r2p.recording.messages import (
    BUS_LOADS,
    EVENTS,
    LOSSES,
    SIGNALS,
    RecordedEvent,
    RecordedSignal,
    RecorderLosses,
    TopicLosses,
)
from r2p.recording.writer import BagWriter
from r2p.tools import main
from r2p.tools.bag.attachment import attachment
from r2p.tools.bag.echo import echo
from r2p.tools.bag.info import info
from r2p.tools.bag.times import moment
from r2p.tools.session import UsageError
from tests.recording.making import MS, T0, damage, led, leds, write


@pytest.fixture
def anyio_backend() -> str:
    return "asyncio"  # the commands wait for nothing but their output


SIGNALS_OF_LEDS = [
    RecordedSignal("missed", "publisher", "leds", "IMU", reason="deadline", count=1),
    RecordedSignal("missed", "publisher", "leds", "IMU", reason="deadline", count=2),
    RecordedSignal("lost", "statistics", "leds", "BASE", where="tcp", count=5),
]
EVENTS_OF_LINKS = [
    RecordedEvent("link down", link="tcp", text="as the recording began"),
    RecordedEvent("link down", link="tcp", text="connection reset"),
    RecordedEvent("link up", link="tcp", outage=2.0, count=7),
]


def printed(capsys: pytest.CaptureFixture[str]) -> list[dict[str, Any]]:
    return [json.loads(line) for line in capsys.readouterr().out.splitlines()]


def observed(path: Path, messages: list[tuple[str, Message]]) -> Path:
    with path.open("wb") as file:
        writer = BagWriter(file)
        out = EntryWriter(writer)
        for channel, message in messages:
            out.write(MessageEntry(channel, message, T0))
        writer.finish()
    return path


@pytest.mark.anyio
async def test_info(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write(tmp_path / "drive.mcap", [*leds(9), ("raw", led(20), None, T0 + 20 * MS)])
    await info(path)
    (found,) = printed(capsys)
    assert found["topics"] == [
        {
            "topic": "leds",
            "type": "r2p_msgs/Led",
            "count": 9,
            "rate": 1000.0,
            "publishers": ["IMU/leds"],
            "class": ["nrt"],
            "link": ["tcp"],
        },
        {
            "topic": "raw",
            "type": None,
            "count": 1,
            "rate": None,
            "publishers": ["IMU/leds"],
            "class": ["nrt"],
            "link": ["tcp"],
        },
    ]
    assert (found["messages"], found["duration"], found["attachments"]) == (10, 0.018, ["r2p.toml"])
    assert (found["start"], found["problems"]) == ("2023-11-14T22:13:20.002000000Z", [])
    assert found["losses"] == []


@pytest.mark.anyio
async def test_info_at_a_terminal(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.stdout.isatty", lambda: True)
    await info(write(tmp_path / "drive.mcap", leds(9), chunk_size=1 << 16))
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith(f"file         {tmp_path}/drive.mcap, ")
    assert lines[1].startswith("recorded     8 ms, ")
    assert lines[3] == "messages     9 of 1 topic"
    assert lines[-2:] == [
        "TOPIC  TYPE          COUNT  RATE     PUBLISHERS  CLASS  LINK",
        "leds   r2p_msgs/Led  9      1000 Hz  IMU/leds    nrt    tcp",
    ]


@pytest.mark.anyio
async def test_info_at_a_terminal_joins_the_parts_of_a_load(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.stdout.isatty", lambda: True)
    names = ("sim:a", "sim:a/hrt/speed/MOTOR1", "sim:a/nrt/log/PS", "sim:b")
    await info(observed(tmp_path / "drive.mcap", [(f"{BUS_LOADS}/{each}", BusTraffic()) for each in names]))
    assert capsys.readouterr().out.splitlines()[-3:] == [
        "/r2p/bus_load/sim:a    r2p_msgs/BusTraffic  1",
        "/r2p/bus_load/sim:a/*  r2p_msgs/BusTraffic  2",
        "/r2p/bus_load/sim:b    r2p_msgs/BusTraffic  1",
    ]


@pytest.mark.anyio
async def test_info_has_losses_by_cause(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    messages: list[tuple[str, Message]] = [(SIGNALS, each) for each in SIGNALS_OF_LEDS]
    messages += [(EVENTS, each) for each in EVENTS_OF_LINKS]
    messages += [(LOSSES, RecorderLosses(9, 0, (TopicLosses("leds", count, 2),))) for count in (0, 4)]
    await info(observed(tmp_path / "drive.mcap", messages))
    (found,) = printed(capsys)
    assert [(each["of"], each["cause"], each["count"]) for each in found["losses"]] == [
        ("tcp", "messages lost while the link was down", 7),
        ("leds", "lost: by tcp", 5),
        ("leds", "the recorder's disk was too slow or full", 4),
        ("leds", "missed: deadline", 3),
        ("leds", "lost before the recorder", 2),
        ("tcp", "link down", 1),
    ]
    assert [each["channel"] for each in found["channels"]] == [EVENTS, LOSSES, SIGNALS]


@pytest.mark.anyio
async def test_info_of_all_finds_damaged_chunks(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = damage(write(tmp_path / "drive.mcap", leds(99)), 5)
    await info(path, all=True)
    assert printed(capsys)[0]["damaged_chunks"] == 1
    monkeypatch.setattr("sys.stdout.isatty", lambda: True)
    await info(path, all=True)
    assert "damaged      1 chunk, whose messages can't be read" in capsys.readouterr().out
    await info(damage(path, 7), all=True)
    assert "damaged      2 chunks, whose messages can't be read" in capsys.readouterr().out


@pytest.mark.anyio
async def test_info_of_a_file_that_is_being_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write(tmp_path / "drive.mcap", leds(9), finish=False)
    await info(path)
    (found,) = printed(capsys)
    assert (found["topics"][0]["count"], found["topics"][0]["rate"]) == (9, 1000.0)
    assert found["problems"][0].endswith(f"r2p bag recover {path} makes a whole file of it")


@pytest.mark.anyio
async def test_echo(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write(tmp_path / "drive.mcap", [*leds(9), ("raw", led(20), None, T0 + 20 * MS)])
    await echo(path, ["leds"], start=moment("2ms"), end=moment("4ms"))
    assert printed(capsys) == [{"led": 3, "value": 1}, {"led": 4, "value": 1}]
    await echo(path, field=["led"], meta=True, count=1)
    meta = {"topic": "leds", "stamp": T0 + MS, "stamp_from": "sender", "source": "IMU/leds", "sequence": 1}
    assert printed(capsys) == [{"led": 1, "_": meta | {"received": T0 + 2 * MS}}]
    await echo(path, ["raw", "l*"], filter=None, start=moment("-1ms"), type="Led")
    assert printed(capsys) == [
        {"led": 4, "value": 1, "_": {**meta, "topic": "raw", "stamp": T0 + 20 * MS, "sequence": 20}}
    ]


@pytest.mark.anyio
async def test_echo_filters_and_counts(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write(tmp_path / "drive.mcap", leds(9))
    await echo(path, filter="led > 5", once=True)
    assert printed(capsys) == [{"led": 6, "value": 1}]
    with pytest.raises(r2p.Error, match="no message passed the filter of leds in this part"):
        await echo(path, filter="led > 50")
    with pytest.raises(UsageError, match="no field"):
        await echo(path, field=["x"])
    with pytest.raises(UsageError, match="no topic or channel led; did you mean leds"):
        await echo(path, ["led"])
    with pytest.raises(
        UsageError, match="was recorded as r2p_msgs/Led, whose fields are not those of r2p_msgs/Odometry"
    ):
        await echo(path, type="Odometry")


@pytest.mark.anyio
async def test_echo_of_bytes_and_of_other_channels(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    await echo(write(tmp_path / "drive.mcap", [("raw", led(4), None, T0)]))
    captured = capsys.readouterr()
    assert captured.out == '{"data": "0400000001"}\n'
    assert "messages of raw are shown in hex" in captured.err
    await echo(observed(tmp_path / "b.mcap", [(EVENTS, each) for each in EVENTS_OF_LINKS]), ["/r2p/*"], field=["kind"])
    assert [each["kind"] for each in printed(capsys)] == ["link down", "link down", "link up"]


@pytest.mark.anyio
async def test_echo_as_csv_has_one_header_for_all_topics(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write(tmp_path / "drive.mcap", [*leds(1), ("raw", led(4), None, T0)])
    await echo(path, meta=True, format="csv")
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "topic,led,value,_.topic,_.stamp,_.stamp_from,_.source,_.sequence,data,_.received"
    assert lines[1].startswith("raw,,,raw,")
    assert lines[1].endswith(f",4,0400000001,{T0}")


@pytest.mark.anyio
async def test_an_attachment_that_can_not_be_written_is_no_wrong_use(tmp_path: Path) -> None:
    path = write(tmp_path / "drive.mcap", leds(1))
    with pytest.raises(r2p.Error, match=r"can't write .*nowhere/r2p\.toml: No such file or directory"):
        await attachment(path, "r2p.toml", target=tmp_path / "nowhere" / "r2p.toml")


def test_the_list_of_commands_says_of_each_what_its_own_help_says() -> None:
    group = main._load("bag")
    for name, stub in group.commands.items():
        assert stub.help == group.load(name).help.splitlines()[0]
