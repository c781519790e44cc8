"""`r2p param list`, `get`, `info`, `dump` and `watch`."""

from __future__ import annotations

import asyncio
import enum
import json
import os
import tomllib
from typing import TYPE_CHECKING

import pytest

import r2p
from r2p.tools.param.changing import load
from r2p.tools.param.reading import dump, get, info, list_, watch
from r2p.tools.param.texts import details, dumped, with_unit
from r2p.tools.session import Settings, TimedOut, UsageError, join
from tests.tools.rig import Firmware, printed, robot, tool

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.virtual_time


class Mode(enum.Enum):
    SLOW = 1
    FAST = 2


async def drive(node: r2p.Node) -> None:
    kp = node.parameter("kp", 0.5, min=0.0, max=10.0, unit="V/(rad/s)", doc="Gain of the speed controller.")
    node.parameter("limits.left", (1, 2))
    node.parameter("mode", Mode.SLOW)
    node.parameter("serial", "a\x1bb", read_only=True)
    node.parameter("top", float("inf"))
    async for _ in kp.changes():
        pass


async def turn(node: r2p.Node) -> None:
    node.parameter("kp", 2.0)
    await asyncio.Event().wait()


async def test_list(capsys: pytest.CaptureFixture[str]) -> None:
    async with robot(drive, turn), robot(turn, name="ARM"), tool(), tool() as session:
        await list_(session)
        rows = printed(capsys)
        await list_(session, "BOT/turn")
        await list_(session, "BOT")
        await list_(session, "drive")
    assert [(row["module"], row["node"], row["name"]) for row in rows] == [
        ("ARM", "turn", "kp"),
        *(("BOT", "drive", name) for name in ("kp", "limits.left", "mode", "serial", "top")),
        ("BOT", "turn", "kp"),
    ]
    assert rows[1] == {
        "module": "BOT",
        "node": "drive",
        "name": "kp",
        "kind": "float",
        "value": 0.5,
        "default": 0.5,
        "minimum": 0.0,
        "maximum": 10.0,
        "unit": "V/(rad/s)",
        "doc": "Gain of the speed controller.",
        "read_only": False,
        "choices": [],
        "origin": "code",
        "saved": None,
        "problem": "",
    }
    assert [rows[i]["value"] for i in (2, 3, 4, 5)] == [[1, 2], "SLOW", "a\x1bb", "inf"]
    assert printed(capsys) == [rows[6], *rows[1:7], *rows[1:6]]


async def test_list_for_people(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stdout.isatty", lambda: True)
    monkeypatch.setattr("shutil.get_terminal_size", lambda *_, **__: os.terminal_size((80, 24)))
    async with robot(drive), tool() as session:
        await list_(session)
    assert capsys.readouterr().out.splitlines() == [
        "NODE       NAME         VALUE          RANGE        ORIGIN",
        "BOT/drive  kp           0.5 V/(rad/s)  0.0 to 10.0  code",
        "BOT/drive  limits.left  [1, 2]                      code",
        "BOT/drive  mode         SLOW           SLOW, FAST   code",
        'BOT/drive  serial       "a\\u001bb"     read-only    code',
        "BOT/drive  top          inf                         code",
    ]


@pytest.mark.parametrize("reference", [("BOT/drive", "kp"), ("BOT/drive.kp",), ("BOT/drive/kp",), ("drive.kp",)])
async def test_get(reference: tuple[str, ...], capsys: pytest.CaptureFixture[str]) -> None:
    """As a node and a name, or in one word."""
    async with robot(drive, turn), tool() as session:
        await get(session, reference[0], list(reference[1:]))
    assert printed(capsys) == [{"module": "BOT", "node": "drive", "name": "kp", "value": 0.5, "unit": "V/(rad/s)"}]


async def test_several_values(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stdout.isatty", lambda: True)
    async with robot(drive), tool() as session:
        await get(session, "drive", ["mode", "kp"])
    assert capsys.readouterr().out == "BOT/drive.mode = SLOW\nBOT/drive.kp = 0.5 V/(rad/s)\n"


async def test_info(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Where a value comes from, and what is saved of it."""
    saved = tmp_path / "saved.toml"
    saved.write_text('format = 1\n[params.BOT.drive]\nkp = 0.6\nmode = "WILD"\n')
    async with r2p.Module("BOT", via=["memory:lab"], params_file=saved, params={"drive.top": 3}) as module:
        module.start(drive)
        async with tool() as session:
            await info(session, "BOT/drive", ["kp", "top"])
            records = printed(capsys)
            monkeypatch.setattr("sys.stdout.isatty", lambda: True)
            monkeypatch.setenv("COLUMNS", "120")
            await info(session, "BOT/drive", ["kp", "mode"])
    assert [(each["value"], each["origin"], each["saved"]) for each in records] == [
        (0.6, "saved file", 0.6),
        (3.0, "params=", None),
    ]
    assert capsys.readouterr().out == (
        "parameter: BOT/drive.kp\n"
        "value: 0.6\n"
        "origin: saved file\n"
        "saved: 0.6\n"
        "default: 0.5\n"
        "kind: float\n"
        "range: 0.0 to 10.0\n"
        "unit: V/(rad/s)\n"
        "doc: Gain of the speed controller.\n"
        "\n"
        "parameter: BOT/drive.mode\n"
        "value: SLOW\n"
        "origin: code\n"
        "default: SLOW\n"
        "kind: enum\n"
        "range: SLOW, FAST\n"
        "problem: the saved value does not fit: BOT/drive.mode = 'WILD': it takes one of SLOW, FAST\n"
        "\n"
    )


async def test_dump_is_what_load_and_params_read(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    async with robot(drive, turn) as module, tool() as session:
        module.parameters.set({("drive", "kp"): 0.7, ("drive", "limits.left"): (3, 4), ("drive", "mode"): "FAST"})
        await dump(session, "BOT")
        text = capsys.readouterr().out
        path = tmp_path / "gains.toml"
        path.write_text(text)
        module.parameters.reset()
        await load(session, path)
        assert module.parameters["drive", "mode"].value is Mode.FAST
    assert 'kp = 0.7  # V/(rad/s), 0.0 to 10.0: Gain of the speed controller.\n"limits.left" = [3, 4]\n' in text
    assert tomllib.loads(text) == {
        "format": 1,
        "params": {
            "BOT": {
                "drive": {"kp": 0.7, "limits.left": [3, 4], "mode": "FAST", "serial": "a\x1bb", "top": float("inf")},
                "turn": {"kp": 2.0},
            }
        },
    }


def test_what_other_modules_send_stays_on_its_line() -> None:
    hostile = r2p.ParameterInfo(
        module="BOT", node='a]\n"', name="k\np", kind="str", value="v\n\x1b\"", default="", unit="\x1b\n", doc="\n[p]"
    )  # fmt: skip
    text = dumped([hostile])
    assert tomllib.loads(text) == {"format": 1, "params": {"BOT": {'a]\n"': {"k\np": 'v\n\x1b"'}}}}
    assert len(text.splitlines()) == 4
    assert len(details(hostile).splitlines()) == 8
    assert with_unit(hostile, "v").isprintable()


async def test_watch_prints_changes(capsys: pytest.CaptureFixture[str]) -> None:
    """Those that are meant, and nothing where a value is set again."""
    async with robot(drive, turn) as module, tool() as session:
        watching = asyncio.create_task(watch(session, "BOT/drive", count=2))
        await asyncio.sleep(2.0)
        for value in (0.5, 0.7):
            module.parameters.set({("turn", "kp"): value, ("drive", "kp"): value})
            await asyncio.sleep(1.0)
        module.parameters.reset("drive", ["kp"])
        await watching
    captured = capsys.readouterr()
    assert "watching 5 parameters of BOT; Ctrl-C ends it" in captured.err
    changes = [json.loads(line) for line in captured.out.splitlines()]
    assert [(each["node"], each["name"], each["before"], each["value"], each["origin"]) for each in changes] == [
        ("drive", "kp", 0.5, 0.7, "run time"),
        ("drive", "kp", 0.7, 0.5, "code"),
    ]


async def test_watch_ends_without_changes(capsys: pytest.CaptureFixture[str]) -> None:
    async with robot(drive), tool() as session:
        with pytest.raises(TimedOut, match="no change of 1 parameter of BOT for 5 s"):
            await watch(session, "BOT/drive", ["kp"], timeout=5.0)


@pytest.mark.parametrize(
    ("target", "names", "error", "text"),
    [
        ("BOTT", [], TimedOut, r"no module or node BOTT with parameters on memory:lab; did you mean BOT\?"),
        ("BOTT/drive", [], TimedOut, r"there is no module BOTT on memory:lab; .* did you mean BOT\?"),
        ("BOT/drvie", [], r2p.Error, r"there is no node BOT/drvie with parameters; did you mean BOT/drive\?"),
        ("BOT/drive", ["kpp"], r2p.Error, r"BOT/drive has no parameter kpp; did you mean kp\?"),
        ("BOT/drive.zz", [], r2p.Error, "BOT/drive has no parameter zz; it has: kp, limits.left, mode, serial, top"),
        ("IMU1", [], r2p.Error, "IMU1 is firmware: its parameters are bytes of its apps. With --firmware APP"),
    ],
)
async def test_wrong_names(target: str, names: list[str], error: type[Exception], text: str) -> None:
    async with robot(drive, turn), tool() as session:
        firmware = Firmware("IMU1")
        asyncio.get_running_loop().call_later(0.1, firmware.alive)
        with pytest.raises(error, match=text):
            await get(session, target, names)


async def test_a_network_without_parameters(capsys: pytest.CaptureFixture[str]) -> None:
    async def idle(node: r2p.Node) -> None:
        await asyncio.Event().wait()

    async with robot(idle), tool() as session:
        await list_(session)
        assert "no parameters yet on memory:lab (heard 1 module: BOT)" in capsys.readouterr().err
        with pytest.raises(r2p.Error, match="no node of BOT has parameters"):
            await list_(session, "BOT")
        with pytest.raises(r2p.Error, match="no parameters yet"):
            await dump(session)
    async with join(Settings()) as session:
        with pytest.raises(UsageError, match="no network to look for parameters on: give --via"):
            await list_(session)
