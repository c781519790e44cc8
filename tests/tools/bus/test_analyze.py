"""`r2p bus analyze`: its reports, what it refuses, and what it measures on a bus."""

from __future__ import annotations

import asyncio
import json
from contextlib import asynccontextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
import typer
from typer.testing import CliRunner

import r2p
from r2p.analysis.dbc import read_dbc
from r2p.bus import BusMonitor
from r2p.msg import Led
from r2p.protocols.rtcan.cycle import timing
from r2p.protocols.rtcan.monitor import Monitor
from r2p.sim import SimCan, run
from r2p.sim.can import CanNode
from r2p.sim.transport import SimPort
from r2p.testing.network import node_in
from r2p.tools.bus import analyze as analyze_command
from r2p.tools.bus import app
from r2p.tools.bus.live import LiveBus, watch
from r2p.units import MILLISECOND, SECOND
from tests.protocols.rtcan.test_packed_management import CLAIM, FULL, RENEW
from tests.protocols.rtcan.test_packed_management import frames as packed_frames

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

SETS = Path(__file__).parents[2] / "golden" / "sets"
ROBOT = """
[bus]
slots = 60

[[message]]
name = "speed"
node = "DCM"
class = "hrt"
bytes = 18
period = "1ms"

[[message]]
name = "bumper"
node = "BUMP"
class = "srt"
bytes = 8
period = "50ms"
deadline = "20ms"

[[message]]
name = "log"
node = "DCM"
class = "nrt"
bytes = 64
"""


def analyze(*arguments: str) -> tuple[int, list[dict[str, Any]], str]:
    result = CliRunner().invoke(app, ["analyze", *arguments])
    return result.exit_code, [json.loads(line) for line in result.stdout.splitlines()], result.stderr


def robot(tmp_path: Path, text: str = ROBOT) -> str:
    path = tmp_path / "robot.toml"
    path.write_text(text, encoding="utf-8")
    return str(path)


def test_a_set_whose_deadlines_hold() -> None:
    code, rows, error = analyze(str(SETS / "broster12_250k.csv"), "--bitrate", "250000", "--fault-rate", "30")
    assert (code, error) == (0, "")
    assert rows[0] == {
        "name": "b1",
        "node": "n1",
        "class": "can",
        "id": "0x1",
        "bytes": 8,
        "period_ms": 10.0,
        "deadline_ms": 10.0,
        "jitter_ms": 0.0,
        "bound_ms": 1.028,
        "result": "in time",
        "p_late": pytest.approx(0.0, abs=1e-9),
    }
    assert [row["bound_ms"] for row in rows[-2:]] == [4.708, 4.72]
    faulty = analyze(str(SETS / "broster12_250k.csv"), "--bitrate", "250000", "--faults", "2")[1]
    assert faulty[0]["bound_ms"] == 1.028 + 2 * 0.644


def test_a_deadline_that_may_be_missed_is_exit_code_1() -> None:
    code, rows, error = analyze(str(SETS / "davis_counterexample_125k.csv"), "--bitrate", "125000")
    assert code == 1
    assert [row["result"] for row in rows] == ["in time", "in time", "late"]
    assert "1 of 3 messages may be late: C" in error
    code, [summary], _ = analyze(str(SETS / "davis_counterexample_125k.csv"), "--bitrate", "125000", "--summary")
    assert (code, summary["load"], summary["breakdown_scale"]) == (1, 0.9714, 0.993)


def test_messages_with_classes_are_those_of_rtcan(tmp_path: Path) -> None:
    code, rows, _ = analyze(robot(tmp_path))
    assert code == 0
    assert [(row["name"], row["result"]) for row in rows] == [
        ("speed", "in time"),
        ("bumper", "in time"),
        ("log", "no bound"),
    ]
    assert rows[0]["bound_ms"] == (2 * 166 + 157) / 1000
    alone = analyze(robot(tmp_path), "--no-control")[1]
    assert alone[1]["bound_ms"] < rows[1]["bound_ms"]
    [summary] = analyze(robot(tmp_path), "--summary", "--jitter", "3us")[1]
    assert (summary["order"], summary["slot_us"], summary["guard_us"]) == ("any", 166.0, 6.0)
    assert summary["guard_needed_us"] == 12.996
    assert summary["smallest_slot_us"] == 177.0


def test_a_message_without_slots_is_late_and_says_why(tmp_path: Path) -> None:
    crowd = "".join(
        f'[[message]]\nname = "m{number}"\nclass = "hrt"\nbytes = 24\nperiod = "1ms"\n' for number in range(2)
    )
    code, rows, error = analyze(robot(tmp_path, crowd))
    assert (code, rows[1]["bound_ms"]) == (1, None)
    assert rows[1]["result"] == "no 3 slots in a row are free every 6 slots"
    assert "1 of 2 messages may be late: m1" in error


def test_the_messages_go_into_a_dbc_file_and_out_of_it(tmp_path: Path) -> None:
    target = tmp_path / "net.dbc"
    assert analyze(robot(tmp_path), "--dbc", str(target))[0] == 0
    found = read_dbc(target.read_text(encoding="utf-8"))
    assert (found.bitrate, [each.name for each in found.messages]) == (1_000_000, ["speed", "bumper", "log"])
    assert analyze(str(target))[1] == analyze(robot(tmp_path))[1]


@pytest.mark.parametrize(
    ("arguments", "code", "reason"),
    [
        ([], 2, "give a FILE with messages, or --via"),
        (["a.csv", "--via", "rtcan:can0"], 2, "give a FILE with messages, or --via"),
        (["a.xml"], 2, "ends with .csv, .toml, .dbc"),
        (["missing.csv"], 1, "can't read missing.csv"),
    ],
)
def test_what_can_not_be_read(
    arguments: list[str], code: int, reason: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    result = CliRunner().invoke(app, ["analyze", *arguments])
    assert result.exit_code == code
    assert reason in " ".join(result.stderr.replace("│", "").split())


def test_a_bad_file_says_which_and_why(tmp_path: Path) -> None:
    path = tmp_path / "net.csv"
    path.write_text("name,bytes\na,9\n", encoding="utf-8")
    code, _, error = analyze(str(path))
    assert code == 1
    assert f"{path}: a: 9 bytes: a frame has up to 8" in " ".join(error.split())


@asynccontextmanager
async def two_modules(*vias: Any) -> AsyncIterator[None]:
    """A sends B an event each 50 ms, a periodic topic in slots, and nothing of a third topic."""
    a, b = (r2p.Module(name, via=via, watchdog=False) for name, via in zip("AB", vias, strict=True))
    async with a, b, node_in(a) as sender, node_in(b) as receiver:
        leds = sender.advertise("leds", Led, r2p.Sporadic(deadline=0.020))
        speed = sender.advertise("speed", Led, r2p.Periodic(period=0.010, fill=lambda: Led(led=1)))
        sender.advertise("idle", Led)
        for topic in ("leds", "speed", "idle"):
            receiver.subscribe(topic, Led)
        sending = asyncio.create_task(_send(leds))
        try:
            await speed.ready(10)
            yield
        finally:
            sending.cancel()


async def _send(leds: r2p.SporadicPublisher[Led]) -> None:
    while True:
        await leds.publish(Led(led=2))
        await asyncio.sleep(0.050)


async def analyze_here(*arguments: str) -> None:
    """Run the command with these arguments in this event loop, as its network is only in there."""
    group: Any = typer.main.get_command(app)
    given = group.commands["analyze"].make_context("analyze", list(arguments)).params
    await analyze_command.analyze(**{name: value for name, value in given.items() if name not in ("verbose", "quiet")})


def test_what_the_modules_of_a_bus_say_is_analyzed(capsys: pytest.CaptureFixture[str]) -> None:
    """Through a gateway, from a network without slots: by announcements, bus_load and bus_slots."""

    async def main() -> None:
        gateway = r2p.Module("GW", via=["sim:lab", "memory:outside"], bridge=True, watchdog=False)
        async with gateway, two_modules("sim:lab", "sim:lab"):
            await analyze_here("--via", "memory:outside", "--for", "3s", "--format", "json", "--no-control")

    run(main, seed=1)
    printed = capsys.readouterr()
    rows = {row["name"]: row for row in map(json.loads, printed.out.splitlines())}
    leds, speed = rows["leds"], rows["speed"]
    assert (leds["node"], leds["class"], leds["bytes"], leds["result"]) == ("A", "srt", 5, "in time")
    assert leds["period_ms"] == leds["deadline_ms"] == pytest.approx(50, rel=0.05)
    assert (speed["node"], speed["class"], speed["bytes"], speed["period_ms"]) == ("A", "hrt", 5, 9.96)
    assert "assumed: periods: messages come evenly" in printed.err
    assert "nothing was sent: idle of A\n" in printed.err


def test_the_sums_of_a_bus_have_its_slots(capsys: pytest.CaptureFixture[str]) -> None:
    async def main() -> None:
        async with two_modules("sim:lab", "sim:lab"):
            await asyncio.sleep(2)  # what modules announce after their start is over
            for control in ("--control", "--no-control"):
                await analyze_here("--via", "sim:lab", "--for", "2s", "--format", "json", "--summary", control)

    run(main, seed=1)
    summary, without = map(json.loads, capsys.readouterr().out.splitlines())
    assert summary["messages"] == without["messages"]
    assert summary["load"] > without["load"]
    assert summary["reserved"] == pytest.approx(2 / 60, abs=1e-4)
    assert summary["slot_us"] == 166.0


def test_nothing_is_said_of_a_bus() -> None:
    async def main() -> None:
        async with r2p.Module("A", via="memory:lab", watchdog=False):
            await analyze_here("--via", "memory:lab")

    with pytest.raises(r2p.Error, match="no module of memory:lab reports an RTCAN bus"):
        run(main, seed=1)


def test_identifiers_are_not_reported(tmp_path: Path) -> None:
    code, _, error = analyze("--via", "memory:lab", "--dbc", str(tmp_path / "net.dbc"))
    assert code == 2
    assert "--dbc needs the identifiers of the frames" in " ".join(error.split())


def test_frames_of_a_live_bus_are_analyzed(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    async def main() -> None:
        can = SimCan(seed=1)
        listener = SimPort(can, CanNode("listener", listen_only=True))
        monkeypatch.setattr(analyze_command, "listen", lambda _settings: BusMonitor(listener))
        watching = asyncio.create_task(analyze_here("--via", "rtcan:can0", "--for", "8s", "--format", "json"))
        async with two_modules(can.transport(), can.transport()):
            await watching

    run(main, seed=1)
    printed = capsys.readouterr()
    rows = {row["name"]: row for row in map(json.loads, printed.out.splitlines())}
    assert rows["leds"]["deadline_ms"] == 19.0
    assert rows["speed"]["class"] == "hrt"
    assert "assumed: periods: the shortest of 8 s; deadlines: the laxity of the frames" in printed.err
    assert "nothing was sent: idle of A\n" in printed.err


def test_a_live_bus_is_measured() -> None:
    async def main() -> LiveBus:
        can = SimCan(seed=1)
        listener = SimPort(can, CanNode("listener", listen_only=True))
        watching = asyncio.create_task(_watched(listener))
        async with two_modules(can.transport(), can.transport()):
            return await watching

    async def _watched(listener: SimPort) -> LiveBus:
        async with BusMonitor(listener) as bus:
            return await watch(bus, 6.0)

    live = run(main)
    declared = {each.name: each for each in live.declared}
    assert {"leds", "speed"} <= declared.keys()
    leds, speed = declared["leds"], declared["speed"]
    assert (leds.message_class.value, leds.size, leds.deadline) == ("srt", 5, 19_000_000)
    assert leds.period == pytest.approx(50_000_000, rel=0.02)
    assert (speed.message_class.value, speed.size) == ("hrt", 5)
    assert speed.period == pytest.approx(9_960_000, abs=20_000)
    assert live.supply.share == pytest.approx(58 / 60)
    assert {each.node for each in live.control} <= {"A", "B"}


def test_management_is_counted_however_many_frames_a_message_has() -> None:
    monitor, live = Monitor(timing()), LiveBus(timing(), SECOND)
    said = [RENEW, CLAIM, FULL, CLAIM]
    for number, frame in enumerate(frame for data in said for frame in packed_frames(data)):
        live.see(monitor.frame(frame, number * MILLISECOND))
    (seen,) = live.messages.values()
    assert len(seen.begins) == len(said)
