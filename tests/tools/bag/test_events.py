"""`r2p bag events`, `r2p bag slots` and `r2p bag attachment`."""

import asyncio
import json
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner, Result

import r2p
from r2p.msg import Led
from r2p.recording.entries import AttachmentEntry, MessageEntry
from r2p.tools.bag.record import record
from r2p.tools.main import app
from tests.recording.test_timeline import START, bag_of, path, utc
from tests.tools.rig import robot, tool

__all__ = ["path", "utc"]  # fixtures


def called(command: str, *arguments: str | Path) -> Result:
    return CliRunner().invoke(app, ["bag", command, *map(str, arguments)])


def rows(result: Result) -> list[dict[str, Any]]:
    assert result.exit_code == 0, result.stderr
    return [json.loads(line) for line in result.stdout.splitlines()]


def test_a_window_by_the_time_of_day(path: Path) -> None:
    result = called("events", path, "--start", "22:13:35.1", "--end", "22:13:37")
    assert [each["kind"] for each in rows(result)] == ["overdue", "missed", "master", "master", *["slots"] * 3]
    assert rows(result)[0] == {
        "stamp": START + 15_100_000_000,
        "kind": "overdue",
        "about": "leds of ARM/blink",
        "text": "received after its deadline",
        "count": 1,
        "late": 0.0032,
        "sequence": 8,
    }
    assert "from 2023-11-14 22:13:35.100 to 22:13:37.000: 1 missed, 1 overdue" in " ".join(result.stderr.split())


def test_only_what_is_asked_for(path: Path) -> None:
    result = called("events", path, "--only", "misses", "--start", "12", "--end", "14")
    assert [each["sequence"] for each in rows(result)] == [1, 2, 3, 4, 0, 9]
    assert "5 missed, 1 degraded" in " ".join(result.stderr.split())
    wrong = called("events", path, "--only", "deadline")
    assert wrong.exit_code == 2
    assert "--only deadline: choose of misses, link, module" in " ".join(wrong.stderr.split())


def test_nothing_happened_or_nothing_is_known(path: Path, tmp_path: Path) -> None:
    quiet = called("events", path, "--start", "2", "--end", "5")
    assert (quiet.exit_code, quiet.stdout) == (0, "")
    assert "nothing from 2023-11-14 22:13:22.000 to 22:13:25.000" in " ".join(quiet.stderr.split())
    bare = bag_of(tmp_path / "bare.mcap", [MessageEntry("/leds", Led(), START)])
    assert "has only messages" in " ".join(called("events", bare).stderr.split())
    missing = called("events", tmp_path / "none.mcap")
    assert missing.exit_code != 0
    assert "none.mcap" in missing.stderr


@pytest.mark.parametrize(("at", "owner"), [("22:13:33", [3, 33]), ("-1s", [4])])
def test_who_owned_which_slot(path: Path, at: str, owner: list[int]) -> None:
    result = called("slots", path, "--at", at)
    found = {each["topic"]: each for each in rows(result)}
    assert found["encoder"] == {"bus": "rtcan:can0", "slots": owner, "topic": "encoder", "module": "BOSS"}
    assert "60 slots in a cycle of 10 ms; the master is " in " ".join(result.stderr.split())


def test_slots_at_a_time_outside_of_the_recording(path: Path) -> None:
    result = called("slots", path, "--at", "1h")
    assert result.exit_code == 2
    assert "--at 1h: the recording is from 2023-11-14 22:13:20.000 to" in " ".join(result.stderr.split())


def test_attachments_are_listed_printed_and_written(tmp_path: Path) -> None:
    text, binary = "[params.ARM.reach]\nkp = 0.5\n", b"\xff\0"
    entries = [
        AttachmentEntry("parameters.toml", "application/toml", text.encode(), START),
        AttachmentEntry("map.bin", "application/octet-stream", binary, START),
    ]
    bag = bag_of(tmp_path / "drive.mcap", [*entries])
    assert [(each["name"], each["size"]) for each in rows(called("attachment", bag))] == [
        ("parameters.toml", len(text)),
        ("map.bin", 2),
    ]
    assert called("attachment", bag, "parameters.toml").stdout == text
    out = tmp_path / "map.bin"
    assert "write it to a file with -o" in " ".join(called("attachment", bag, "map.bin").stderr.split())
    assert called("attachment", bag, "map.bin", "-o", out).exit_code == 0
    assert out.read_bytes() == binary
    assert "is not overwritten" in " ".join(called("attachment", bag, "map.bin", "-o", out).stderr.split())
    other = called("attachment", bag, "r2p.toml")
    assert other.exit_code == 2
    assert "has no attachment r2p.toml; it has parameters.toml, map.bin" in " ".join(other.stderr.split())


@pytest.mark.virtual_time
@pytest.mark.parametrize("no_events", [False, True])
async def test_events_can_be_left_out(tmp_path: Path, no_events: bool) -> None:
    async with robot(), tool() as session:
        task = asyncio.create_task(
            record(session, all=True, output=tmp_path / "drive.mcap", no_events=no_events, min_free=0)
        )
        await asyncio.sleep(2.0)
        task.cancel()
        await asyncio.wait([task])
    with r2p.Bag(tmp_path / "drive.mcap") as bag:
        channels = {each.name for each in bag.channels}
    assert ({"/r2p/events", "/r2p/statistics/BOT"} <= channels) is not no_events
    assert "/r2p/recorder" in channels
