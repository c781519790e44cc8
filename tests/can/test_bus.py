"""`r2p bus` beside a recorded robot of 2 modules: canplayer plays it, so all frames are known."""

from __future__ import annotations

import asyncio
import json
import subprocess
import sys
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

import pytest

from r2p.bus import BusMonitor
from r2p.codecs import management, rtcan
from r2p.codecs.can_bits import Frame
from r2p.tools.main import app
from tests.can.rig import GUARD, cansend, ip, until

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

pytestmark = pytest.mark.can

SLOTS, SLOT = 4, 0.1
"""Seconds, so long that a frame that the slow kernel sends late is still in its slot."""
CYCLES = 100
MASTER, MOTOR = 1, 7
ENCODER = rtcan.message_id(5, MOTOR)
SOFT, BULK = rtcan.message_id(6, MOTOR), rtcan.message_id(7, MASTER)
GRID = f"slots={SLOTS},cycle={SLOTS * SLOT * 1000:.0f}ms"


def said(message: management.Management, source: int) -> Iterator[Frame]:
    for left, data in rtcan.fragments(management.encode(message)):
        yield Frame(rtcan.encode_identifier(40, rtcan.message_id(rtcan.MANAGEMENT, source), left), data)


def recording(name: str) -> Iterator[str]:
    """Lines for canplayer. Slot 1 is the encoder's, which misses it in every second cycle; slot 3 is free."""
    params = ENCODER.to_bytes(2, "little").ljust(10, b"\0")
    for cycle in range(CYCLES):
        frames = [(0.0, rtcan.encode_sync(cycle, 0b0011))]
        if cycle % 2 == 0:
            frames.append((1.5, Frame(rtcan.encode_identifier(rtcan.HRT, ENCODER, 0), bytes((cycle, 0, 0, 0, 1)))))
        frames += [(2.3, frame) for frame in said(management.Alive("MOTOR", 0), MOTOR)]
        frames += [(2.4, frame) for frame in said(management.SubscribeResponse("encoder", 5, 1, params), MOTOR)]
        frames.append((2.5, Frame(rtcan.encode_identifier(20, SOFT, 0), bytes(2))))
        frames.append((3.5, Frame(rtcan.encode_identifier(rtcan.NRT, BULK, 0), bytes(8))))
        for slot, frame in frames:
            yield f"({(cycle * SLOTS + slot) * SLOT:.6f}) {name} {frame.id:08X}#{frame.data.hex().upper()}"


@pytest.fixture
def played(vcan: str, tmp_path: Path) -> Iterator[str]:
    """The URL of an interface on which the recording is being played."""
    file = tmp_path / "recording.log"
    file.write_text("\n".join(recording(vcan)) + "\n", encoding="ascii")
    player = subprocess.Popen(("canplayer", "-I", str(file)))
    try:
        yield f"rtcan:{vcan},{GRID}"
    finally:
        player.kill()
        player.wait()


def command(*arguments: str) -> int:
    """Run `r2p bus` with these arguments. Returns its exit code."""
    with pytest.raises(SystemExit) as ended:
        app(["bus", *arguments], prog_name="r2p")
    code = ended.value.code
    assert isinstance(code, int)
    return code


def records(capsys: pytest.CaptureFixture[str]) -> list[dict[str, Any]]:
    return [json.loads(line) for line in capsys.readouterr().out.splitlines()]


def test_the_frames_with_their_names_and_slots(played: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert command("dump", "--kind", "sync", "--kind", "hrt", "-n", "6", "--format", "json", "--via", played) == 0
    seen = records(capsys)
    assert sorted(each["kind"] for each in seen) == ["hrt", "hrt", "sync", "sync", "sync", "sync"]
    hrt = [each for each in seen if each["kind"] == "hrt"][-1]
    fields = {name: hrt[name] for name in ("id", "topic", "module", "laxity", "left", "fragments", "slot", "data")}
    assert fields == {
        "id": f"0x{ENCODER << 7:08X}",
        "topic": "encoder",
        "module": "MOTOR",
        "laxity": 0,
        "left": 0,
        "fragments": 1,
        "slot": 1,
        "data": f"{hrt['cycle']:02x}00000001",
    }


def test_the_load(played: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert command("load", "--once", "--format", "json", "--via", played) == 0
    (report,) = records(capsys)
    kinds = {row["kind"]: row for row in report["traffic"]}
    assert set(kinds) == {"sync", "hrt", "srt", "nrt", "management"}
    assert kinds["nrt"]["frames_s"] == pytest.approx(1 / (SLOTS * SLOT), abs=1)
    assert 0 < report["load"] < 0.01
    assert report["reserved"] == pytest.approx(0.5, abs=0.25)
    assert report["faults"] == {}


def test_frames_of_others_are_in_the_load(vcan: str, capsys: pytest.CaptureFixture[str]) -> None:
    """As in `canbusload`: frames with 11-bit identifiers and remote frames occupy the bus, too."""
    players = [
        subprocess.Popen(("cangen", vcan, *kind, "-g", "20", "-L", "8"))
        for kind in (("-I", "123"), ("-I", "124", "-R"), ("-e", "-R"), ("-e",))
    ]
    try:
        assert command("load", "-n", "2", "--format", "json", "--via", f"rtcan:{vcan}") == 0
    finally:
        for player in players:
            player.kill()
            player.wait()
    report = records(capsys)[-1]
    other = next(row for row in report["traffic"] if row["kind"] == "other")
    ours = [row for row in report["traffic"] if row["kind"] != "other"]
    assert other["frames_s"] == pytest.approx(3 * sum(row["frames_s"] for row in ours), rel=0.5)
    assert (other["topic"], other["module"]) == ("", "")
    assert report["load"] == pytest.approx(sum(row["share"] for row in report["traffic"]), abs=1e-3)


def test_the_slots_as_text_and_as_a_drawing(
    played: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    drawing = tmp_path / "cycle.svg"
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    expected = (["0", "S", "A!", "+", "+"], "slot 1: encoder: 2 of 4 used, 0 events")
    for _ in range(5):  # on a busy machine, the kernel may send a frame in the slot after its own, or in the next cycle
        assert command("schedule", "-n", "4", "--svg", str(drawing), "--via", played) == 0
        lines = capsys.readouterr().out.splitlines()
        notes = [each.text for each in ElementTree.parse(drawing).iter("{http://www.w3.org/2000/svg}title")]
        seen = lines[2].split(), notes[1]
        if seen == expected:
            break
    assert seen == expected
    assert lines[0] == "4 slots of 100000 us, over 4 cycles"
    assert lines[4].split() == ["A", "encoder"]
    assert len(notes) == SLOTS


def test_a_silent_bus(vcan: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert command("dump", "--timeout", "50ms", "--via", f"rtcan:{vcan}") == 3
    assert "nothing received on the bus for 0.05 s" in capsys.readouterr().err


@pytest.mark.anyio
async def test_the_interface_goes_and_comes_while_a_monitor_runs(vcan: str) -> None:
    states: list[str] = []
    via = f"rtcan:{vcan}"
    async with BusMonitor(via, on_status=states.append) as bus:
        frames = aiter(bus)
        for number in range(2):
            cansend(vcan, f"{SOFT << 7:08X}#{number:02X}")
            async with asyncio.timeout(GUARD):
                assert (await anext(frames)).frame.data == bytes((number,))
            ip("set", vcan, "down")
            await until(lambda: len(states) % 3 == 0)
            ip("set", vcan, "up")
            await until(lambda: states[-1] == f"{via} is up")
    waits = f"{via}: {vcan} is down: sudo ip link set {vcan} up; trying again"
    again = [f"{via} is down: the interface is down", waits]
    assert states == [f"{via} is up", *again, f"{via} is up", *again, f"{via} is up"]


def test_no_such_interface(capsys: pytest.CaptureFixture[str]) -> None:
    assert command("load", "--via", "rtcan:can17") == 1
    assert "rtcan:can17: no CAN interface has this name" in capsys.readouterr().err
