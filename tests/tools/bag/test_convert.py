"""`r2p bag convert`."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import pytest

import r2p
from r2p.msg import Led
from r2p.recording.bag import Bag
from r2p.recording.entries import EntryWriter, MessageEntry
from r2p.recording.messages import EVENTS, RecordedEvent
from r2p.recording.samples import SampleWriter
from r2p.recording.writer import BagWriter
from r2p.tools.bag.convert import convert
from r2p.tools.bag.times import moment
from r2p.tools.session import UsageError
from tests.recording.convert.samples import START, record
from tests.recording.making import damage, leds

if TYPE_CHECKING:
    from pathlib import Path


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    return record(tmp_path / "drive.mcap")


@pytest.mark.anyio
async def test_what_is_lost_is_printed(recording: Path, capsys: pytest.CaptureFixture[str]) -> None:
    target = recording.with_suffix(".bag")
    await convert(recording, target, topics=["/unknown", "t_r2p_msgs_l*"], type=["/unknown=Led"], end=moment("3ms"))
    printed = json.loads(capsys.readouterr().out)
    assert printed["messages"] == {"t_r2p_msgs_led": 2}
    assert printed["lost"] == {
        "attachments": 1,
        "messages of unknown of another type than r2p_msgs/Led, kept as bytes": 2,
        "messages of unknown, whose type is unknown: --type unknown=TYPE states it": 2,
        "stamps of publishers": 2,
        "sequence numbers": 2,
        "deadlines": 1,
    }


@pytest.mark.anyio
async def test_types_of_the_settings_count_for_tables(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "r2p.toml").write_text('[types]\nleds = "Led"\n')
    monkeypatch.chdir(tmp_path)
    (tmp_path / "leds.csv").write_text(f"_.log_time,led,value\n{START},3,1\n")
    await convert(tmp_path / "leds.csv", tmp_path / "leds.mcap")
    with Bag(tmp_path / "leds.mcap") as bag:
        assert [each.message for each in bag.samples("leds")] == [Led(3, 1)]


@pytest.mark.anyio
async def test_a_time_outside_of_the_recording(recording: Path) -> None:
    with pytest.raises(UsageError, match="--start 1h is after the end: the recording is from"):
        await convert(recording, recording.with_suffix(".bag"), start=moment("1h"))


@pytest.mark.anyio
async def test_a_damaged_chunk_is_counted_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "drive.mcap"
    with path.open("wb") as file:
        writer = BagWriter(file)
        topics, others = SampleWriter(writer), EntryWriter(writer)
        for topic, sample, cls, log_time in leds(2):
            topics.write(topic, sample, cls, log_time)
            others.write(MessageEntry(EVENTS, RecordedEvent("link up"), log_time))
            writer.end_chunk()
        writer.finish()
    await convert(damage(path), tmp_path / "new.mcap", format="json")
    lost = json.loads(capsys.readouterr().out)["lost"]
    assert lost == {"chunks of the file that can't be read, with the messages there": 1}


@pytest.mark.anyio
async def test_what_can_not_be_written_or_read_is_no_wrong_use(recording: Path, tmp_path: Path) -> None:
    target = tmp_path / f"{'x' * 250}.csv"  # the name of the unfinished file is too long
    with pytest.raises(r2p.Error, match=r"can't write .*x\.csv: File name too long"):
        await convert(recording, target, topics=["t_r2p_msgs_led"])
    (tmp_path / "leds.csv").mkdir()
    (tmp_path / "leds.csv" / "a.csv").mkdir()
    with pytest.raises(r2p.Error, match=r"can't read .*a\.csv: Is a directory"):
        await convert(tmp_path / "leds.csv", tmp_path / "new.mcap", type=["a=Led"])
