"""`r2p bus admit`: the answer of the calendar to a plan, and the drawing of a cycle."""

from __future__ import annotations

import json
import xml.etree.ElementTree as ET
from typing import TYPE_CHECKING

import pytest
import typer
from typer.testing import CliRunner

from r2p.protocols.rtcan.calendar import Calendar
from r2p.tools.bus import app
from r2p.tools.bus.slots import Cell, Wanted, admit_all, drawing, grid, parse, planned_cells, summary, svg_of

if TYPE_CHECKING:
    from pathlib import Path


def admit(*arguments: str) -> tuple[int, list[dict[str, object]], str]:
    result = CliRunner().invoke(app, ["admit", *arguments])
    return result.exit_code, [json.loads(line) for line in result.stdout.splitlines()], result.stderr


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ("imu:18@200Hz", Wanted("imu", 18, 5_000_000)),
        ("imu:18@5ms", Wanted("imu", 18, 5_000_000)),
        ("enc:8@1kHz", Wanted("enc", 8, 1_000_000)),
        ("e:1024@0.5hz", Wanted("e", 1024, 2_000_000_000)),
    ],
)
def test_a_plan_is_name_bytes_and_rate_or_period(text: str, wanted: Wanted) -> None:
    assert parse(text) == wanted


@pytest.mark.parametrize(
    "text",
    [
        "imu",
        "imu:18",
        "imu@5ms",
        "imu:0@5ms",
        "imu:1025@5ms",
        "imu:8@0Hz",
        "imu:8@x",
        "imu:8@200",
        "imu:8@1e-12s",
        "imu:8@1e300s",
        "imu:8@1e-300Hz",
    ],
)
def test_what_can_not_be_a_plan_is_refused(text: str) -> None:
    with pytest.raises(typer.BadParameter):
        parse(text)


def test_a_cycle_that_nobody_can_mean_is_refused() -> None:
    with pytest.raises(typer.BadParameter):
        grid(60, 1e300, 1_000_000)


def test_the_networks_of_the_thesis_fill_39_of_59_slots() -> None:
    """Section 4.4: three nodes with a message every 6, 30 and 60 slots each."""
    plan = [f"{name}{i}:8@{time}" for time, name in (("1000Hz", "a"), ("5ms", "b"), ("10ms", "c")) for i in range(3)]
    code, rows, _ = admit(*plan)
    assert code == 0
    assert [row["period"] for row in rows] == [6] * 3 + [30] * 3 + [60] * 3
    assert sum(int(str(row["in_cycle"])) for row in rows) == 39
    wanted, timing = [parse(each) for each in plan], grid(60, None, 1_000_000)
    calendar = Calendar(timing.slots)
    admit_all(calendar, wanted, timing)
    assert summary(calendar, timing).startswith("40 of 60 slots reserved (including the sync), 20 left")


@pytest.mark.parametrize(("slow", "said"), [(5, ""), (10, "; they keep the slots of 0 modules, and the master")])
def test_what_is_left_says_whose_slots_it_keeps(slow: int, said: str) -> None:
    """The master refuses what would leave too little for renewals: PROTOCOL.md 6."""
    plan = [parse(f"a{i}:8@1kHz") for i in range(9)] + [parse(f"b{i}:8@100Hz") for i in range(slow)]
    timing = grid(60, None, 1_000_000)
    calendar = Calendar(timing.slots)
    admit_all(calendar, plan, timing)
    assert said in summary(calendar, timing)
    assert ("refuses" in summary(calendar, timing)) is bool(said)


def test_a_refusal_has_its_reason_and_another_order_is_told() -> None:
    plan = ["imu:18@200Hz", "a1:8@996us", "a2:8@996us", "a3:8@996us", "a4:8@996us"]
    code, rows, err = admit(*plan, "--periods", "harmonic")
    assert code == 1
    assert "no slot is free every 6 slots" in str(rows[-1]["refused"])
    assert "2 of 5 messages do not fit" in err
    _, _, err = admit("b:8@5ms", "c:8@5ms", "d:8@5ms", "e:8@5ms", "f:8@5ms", "a:8@996us", "--periods", "harmonic")
    assert "all of them fit in this order: a b c d e f" in err


def test_slots_that_are_too_short_are_a_wrong_usage() -> None:
    code, _, err = admit("a:8@1Hz", "--bitrate", "100000")
    assert code == 2
    assert "fewer --slots" in err


def test_the_drawing_shows_every_slot(tmp_path: Path) -> None:
    file = tmp_path / "cycle.svg"
    assert admit("imu:18@200Hz", "slow:12@25Hz", "--svg", str(file))[0] == 0
    titles = [each.text for each in ET.parse(file).getroot().iter("{http://www.w3.org/2000/svg}title")]
    assert len(titles) == 60
    assert titles[0] == "slot 0: sync"
    assert [title.split(": ")[1] for title in titles if title].count("imu") == 6
    assert [title.split(": ")[1] for title in titles if title].count("slow, every 4 cycles") == 2
    code, _, err = admit("a:8@1Hz", "--svg", str(tmp_path / "none" / "x.svg"))
    assert code == 1
    assert "can't write" in err


def test_the_picture_marks_what_was_missed_and_what_events_use() -> None:
    cells = [Cell("sync"), Cell("imu"), Cell("imu", missed=2), Cell(shared=3), Cell()]
    assert drawing(cells)[0] == "  0  S  A  A! +  ."
    calendar = Calendar(60)
    wanted, timing = [parse("a:8@996us")], grid(60, None, 1_000_000)
    admit_all(calendar, wanted, timing)
    planned = planned_cells(calendar, wanted, timing)
    assert [i for i, cell in enumerate(planned) if cell.owner == "a"] == [*range(1, 60, 6)]


def test_slots_that_several_own_in_turns() -> None:
    """A period of whole slots stays as it is, although it does not divide the cycle."""
    wanted, timing = [parse("gps:8@14.94ms"), parse("slow:8@19.92ms")], grid(60, None, 1_000_000)
    calendar = Calendar(60)
    gps, slow = admit_all(calendar, wanted, timing)
    assert (gps.period, slow.period) == (90, 120)
    notes = [cell.note for cell in planned_cells(calendar, wanted, timing)]
    assert notes.count("gps, every 3 cycles") == 2
    assert notes.count("slow, every 2 cycles") == 1


def test_more_owners_than_letters_are_still_drawn() -> None:
    cells = [Cell(f"t{i}") for i in range(80)]
    assert drawing(cells).index("") == 4
    assert svg_of(cells, "x").count("<title>") == 80
