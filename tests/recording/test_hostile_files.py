"""Files whose numbers lie, or that unpack to far more than they are: they cost neither memory nor the order."""

from pathlib import Path

import pytest

from r2p.recording import bag as bag_module
from r2p.recording import mcap_reader, summary
from r2p.recording.bag import Bag
from tests.recording.making import leds, read, write


def test_a_chunk_with_too_many_messages_is_counted_as_damaged(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write(tmp_path / "bomb.mcap", leds(300), chunk_size=1 << 20)
    monkeypatch.setattr(mcap_reader, "MESSAGES_MAX", 400)  # with their companions, there are 400
    assert len(read(path)) == 300
    monkeypatch.setattr(mcap_reader, "MESSAGES_MAX", 399)
    with Bag(path) as bag:
        assert list(bag.records()) == []
        assert bag.damaged == 1


def test_schemas_without_end_end_the_search_for_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write(tmp_path / "bomb.mcap", leds(9), finish=False)
    monkeypatch.setattr(summary, "_DEFINITIONS_MAX", 10)
    with Bag(path) as bag:
        assert bag.problems
        assert bag.topics == {}


def test_recordings_of_the_same_time_stay_in_order_however_long_they_are(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bag_module, "_HELD_MAX", 20_000)
    for name in ("a", "b"):
        write(tmp_path / f"{name}.mcap", leds(1000, source=name))
    times = [log_time for _, _, log_time in read(tmp_path)]
    assert len(times) == 2000
    assert times == sorted(times)
