"""`r2p bag cut` and `r2p bag merge`."""

import json
from pathlib import Path

import pytest

from r2p.tools.bag.edit import cut, merge
from r2p.tools.bag.times import moment
from r2p.tools.session import UsageError
from tests.recording.making import MS, T0, damage, leds, of, read, write

pytestmark = pytest.mark.anyio


@pytest.fixture
def anyio_backend() -> str:
    return "asyncio"  # the commands wait for nothing but their output


async def test_cut(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    samples = leds(30)
    path = write(tmp_path / "drive.mcap", samples)
    await cut(path, start=moment("5ms"), end=moment("-5ms"), topics=["l*"])
    new = tmp_path / "drive-cut.mcap"
    assert read(new) == of(samples[5:24])
    found = json.loads(capsys.readouterr().out)
    assert found == {
        "file": str(new),
        "size": new.stat().st_size,
        "start": "2023-11-14T22:13:20.007000000Z",
        "duration": 0.018,
        "topics": 1,
        "messages": 19,
    }
    with pytest.raises(UsageError, match="is there already, and is not overwritten: give another -o FILE"):
        await cut(path)
    with pytest.raises(UsageError, match="camera is neither a topic nor a channel of the recording; its topics: leds"):
        await cut(path, output=tmp_path / "b.mcap", exclude=["camera"])
    with pytest.raises(UsageError, match="--start 2s is after the end"):
        await cut(path, output=tmp_path / "b.mcap", start=moment("2s"))
    assert not (tmp_path / "b.mcap").exists()


async def test_cut_says_what_is_damaged(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, out = damage(write(tmp_path / "drive.mcap", leds(30)), 2), tmp_path / "out.mcap"
    await cut(path, output=out)
    printed = capsys.readouterr()
    assert f"1 chunk could not be read, and is missing in {out}" in printed.err
    assert json.loads(printed.out)["messages"] == len(read(out)) < 30
    damage(path, 4)
    await cut(path, output=tmp_path / "again.mcap")
    assert "2 chunks could not be read, and are missing in" in capsys.readouterr().err


async def test_merge(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    robot, laptop = leds(3), leds(3, 4, source="BASE")
    files = [write(tmp_path / "robot.mcap", robot), write(tmp_path / "laptop.mcap", laptop)]
    out = tmp_path / "all.mcap"
    await merge(files, output=out, offset=[f"{files[1]}=-1s"])
    assert [(topic, time) for topic, _, time in read(out)] == [
        *(("leds", T0 + (i + 1) * MS - 1000 * MS) for i in (4, 5, 6)),
        *(("leds", T0 + (i + 1) * MS) for i in (1, 2, 3)),
    ]
    assert json.loads(capsys.readouterr().out)["messages"] == 6
    with pytest.raises(UsageError, match="merge needs a new file: -o"):
        await merge(files)
    with pytest.raises(UsageError, match="two recordings or more"):
        await merge(files[:1], output=tmp_path / "b.mcap")
    with pytest.raises(UsageError, match="write FILE=TIME, with one of the files"):
        await merge(files, output=tmp_path / "b.mcap", offset=["-2.5"])
    with pytest.raises(UsageError, match=r"write the time as 2\.5, -2\.5 or 300ms"):
        await merge(files, output=tmp_path / "b.mcap", offset=[f"{files[0]}=soon"])
