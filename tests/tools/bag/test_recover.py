"""`r2p bag recover`."""

from pathlib import Path

import pytest

from r2p.errors import BagError
from r2p.tools.bag.recover import recover
from r2p.tools.session import UsageError
from tests.recording.checker import check
from tests.recording.making import damage
from tests.recording.test_recovery import BAG, CHUNKS, COUNT
from tests.tools.rig import printed

pytestmark = pytest.mark.virtual_time


@pytest.fixture
def cut(tmp_path: Path) -> Path:
    """A recording that was cut in its third chunk."""
    path = tmp_path / "drive.mcap"
    path.write_bytes(BAG[: CHUNKS[2][0] + 20])
    return path


async def test_a_recording_that_was_cut_becomes_a_whole_one(cut: Path, capsys: pytest.CaptureFixture[str]) -> None:
    await recover(cut, format="json")
    new = cut.with_name("drive-recovered.mcap")
    assert printed(capsys) == [
        {
            "file": str(new),
            "messages": 12,
            "channels": 2,
            "seconds": 11e-9,
            "attachments": 1,
            "unreadable_bytes": 20,
            "damaged": 0,
            "without_channel": 0,
        }
    ]
    assert len(check(new)) == 12


async def test_stderr_says_what_is_missing(cut: Path, capsys: pytest.CaptureFixture[str]) -> None:
    await recover(cut)
    assert "20 bytes could not be read, as it was cut off or is damaged" in capsys.readouterr().err
    cut.write_bytes(BAG[:-20])  # noqa: ASYNC240
    await recover(cut, output=cut.with_name("end.mcap"))
    assert "its end is missing; all messages that were in it are recovered" in capsys.readouterr().err
    cut.write_bytes(BAG)  # noqa: ASYNC240
    await recover(cut, output=cut.with_name("whole.mcap"))
    assert "is complete: there is nothing to recover" in capsys.readouterr().err
    assert not cut.with_name("whole.mcap").exists()
    assert len(check(cut)) == COUNT


async def test_what_is_left_out_is_counted(cut: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cut.write_bytes(BAG)  # noqa: ASYNC240
    for number, text in enumerate(("1 damaged part is left out", "2 damaged parts are left out")):
        await recover(damage(cut, number), output=cut.with_name(f"{number}.mcap"))
        assert text in capsys.readouterr().err


async def test_what_can_not_be_done_is_said(cut: Path) -> None:
    await recover(cut)
    with pytest.raises(UsageError, match=r"drive-recovered\.mcap is there already, and is not overwritten"):
        await recover(cut)
    with pytest.raises(BagError, match=r"can't write .*: No such file"):
        await recover(cut, output=cut.parent / "nowhere" / "new.mcap")
    with pytest.raises(BagError, match=r"can't read .*: No such file"):
        await recover(cut.with_name("other.mcap"))
