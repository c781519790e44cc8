"""`r2p param --firmware APP`: the config area of an app, in the emulated loader."""

from __future__ import annotations

import asyncio
import contextlib
import struct
from typing import TYPE_CHECKING, Any

import pytest

import r2p
from r2p.codecs.loader import LinkingSetup
from r2p.loader import LoaderClient
from r2p.sim.modules import EmulatedLoader, LoaderFaults
from r2p.tools.param.changing import set_
from r2p.tools.param.reading import get, list_
from r2p.tools.session import Session, Settings, TimedOut, UsageError
from tests.loader.rig import board
from tests.loader.test_session import link
from tests.tools.rig import printed, robot, tool

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from r2p.sim.modules import Powered

pytestmark = pytest.mark.virtual_time

DESCRIPTION = """
from typing import Annotated
import r2p

class Config(r2p.Message):
    kp: r2p.f32
    limits: tuple[r2p.u16, r2p.u16]
    name: Annotated[str, r2p.Len(8)]
    offsets: tuple[r2p.f32, r2p.f32]

class Small(r2p.Message):
    kp: r2p.f32

class Varies(r2p.Message):
    text: Annotated[str, r2p.Max(24)]
"""
PID = LinkingSetup(pgmlen=32, bsslen=8, datalen=0, stacklen=1024, name="PID")
AREA = struct.pack("<fHH8sff", 0.5, 1, 2, b"left\0\xff\xffx", 0.25, float("nan"))


@contextlib.asynccontextmanager
async def pid(loader: EmulatedLoader | None = None) -> AsyncIterator[tuple[Powered, Session]]:
    """IMU1 with the app PID, running, and a tool on its wire."""
    async with board(loader) as (power, module):
        async with LoaderClient(module, "IMU1") as client:
            await client.enter()
            await client.load(PID, link)
            await client.set("PID", 0, AREA)
            await client.leave()
        yield power, Session(module, Settings(via=["wire:IMU1"]))


@pytest.fixture
def config(tmp_path: Path) -> str:
    path = tmp_path / "pid_config.py"
    path.write_text(DESCRIPTION)
    return f"{path}:Config"


async def test_list_and_get(config: str, capsys: pytest.CaptureFixture[str]) -> None:
    async with pid() as (power, session):
        await list_(session, "IMU1", firmware="PID", as_=config, reboot=True)
        assert power.module.flags == 2, "it runs again"
        power.reset(boot_mode=True)
        await asyncio.sleep(1)
        await get(session, "IMU1", ["kp", "limits[1]", "name"], firmware="PID", as_=config)
    rows = printed(capsys)
    assert rows[:6] == [
        {"module": "IMU1", "app": "PID", "name": name, "value": value}
        for name, value in {
            "kp": 0.5,
            "limits[0]": 1,
            "limits[1]": 2,
            "name": "left",
            "offsets[0]": 0.25,
            "offsets[1]": "nan",
        }.items()
    ]
    assert [(row["name"], row["value"]) for row in rows[6:]] == [("kp", 0.5), ("limits[1]", 2), ("name", "left")]


async def test_set(config: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Only the bytes of what is set change; what is behind the end of a text, or is not a number, stays."""
    monkeypatch.setattr("sys.stdout.isatty", lambda: True)
    async with pid() as (_, session):
        await set_(session, "IMU1", ["kp=0.75", "limits=[1, 3]"], firmware="PID", as_=config, reboot=True)
        captured = capsys.readouterr()
        assert captured.out == "IMU1 PID.kp = 0.75 (was 0.5)\nIMU1 PID.limits[1] = 3 (was 2)\n"
        assert "PID on IMU1: 5 bytes written and read back" in captured.err
        await set_(session, "IMU1", ["name", "fr"], firmware="PID", as_=config, reboot=True)
        await set_(session, "IMU1", ["kp=0.75"], firmware="PID", as_=config, reboot=True)
        assert "PID on IMU1: as it was" in capsys.readouterr().err
        monkeypatch.undo()
        await list_(session, "IMU1", firmware="PID", reboot=True)
    (row,) = printed(capsys)
    changed = struct.pack("<fHH8s", 0.75, 1, 3, b"fr") + AREA[16:]
    assert (row["length"], row["hex"]) == (24, changed.hex())


async def test_bytes(capsys: pytest.CaptureFixture[str]) -> None:
    async with pid() as (_, session):
        await set_(session, "IMU1", ["01", "0203"], firmware="PID", raw="4:3", reboot=True)
        await get(session, "IMU1", firmware="PID", raw="0x2:6", reboot=True)
    written, read = printed(capsys)
    assert written == {"module": "IMU1", "app": "PID", "offset": 4, "length": 3, "hex": "010203"}
    assert read == {
        "module": "IMU1",
        "app": "PID",
        "offset": 2,
        "length": 6,
        "hex": f"{AREA[2:4].hex()}010203{AREA[7:8].hex()}",
    }


async def test_behind_two_gateways_and_a_bus(config: str, capsys: pytest.CaptureFixture[str]) -> None:
    async with pid() as (power, _):
        near = r2p.Module("GW1", via=["memory:lab", "sim:bus"], bridge=True)
        far = r2p.Module("GW2", via=["sim:bus", power.wire()], bridge=True)
        async with near, far, tool() as session:
            await asyncio.sleep(5)
            await set_(session, "IMU1", ["kp=0.75"], firmware="PID", as_=config, reboot=True)
            assert power.module.flags == 2
    (row,) = printed(capsys)
    assert (row["name"], row["value"], row["before"]) == ("kp", 0.75, 0.5)


async def test_a_module_that_is_not_in_its_boot_loader_is_left_alone(config: str) -> None:
    async with pid() as (power, session):
        with pytest.raises(r2p.Error, match=r"IMU1 is running: its parameters can be read in its boot loader only"):
            await list_(session, "IMU1", firmware="PID", as_=config)
        assert power.module.flags == 2


@pytest.mark.parametrize(
    ("words", "options", "error", "text"),
    [
        ([], {"firmware": "PDI"}, r2p.Error, r"IMU1 has no app PDI; did you mean PID\?"),
        ([], {"as_": "{}:Small"}, r2p.Error, "Small has 4 bytes, but the config area of PID 24: nothing is done"),
        ([], {"as_": "{}:Varies"}, UsageError, "the length of .*Varies varies, that of a config area is fixed"),
        ([], {"as_": "{}:Confg"}, UsageError, "did you mean .*:Config"),
        ([], {"raw": "20:8"}, r2p.Error, "the config area of PID has 24 bytes: 20:8 is not inside of it"),
        ([], {"raw": "20"}, UsageError, "--raw 20: write it as OFFSET:LENGTH"),
        ([], {"raw": "0:4", "as_": "{}:Config"}, UsageError, "--as shows fields, and --raw bytes"),
        (["kp=x"], {"as_": "{}:Config"}, UsageError, "kp"),
        (["pk=1"], {"as_": "{}:Config"}, UsageError, "has no field pk"),
        (["0102"], {"raw": "0:4"}, UsageError, "give --raw OFFSET:LENGTH and the bytes, as hex, such as 00000000"),
        (["kp=1"], {}, UsageError, "give --raw OFFSET:LENGTH and the bytes, as hex"),
        (["--kp"], {"as_": "{}:Config"}, UsageError, "there is no option --kp"),
    ],
)  # fmt: skip
async def test_what_is_refused_changes_nothing(
    words: list[str], options: dict[str, Any], error: type[Exception], text: str, config: str
) -> None:
    """And the module runs again."""
    given: dict[str, Any] = {"firmware": "PID"} | {
        name: each.format(config.rpartition(":")[0]) for name, each in options.items()
    }
    async with pid() as (power, session):
        with pytest.raises(error, match=text):
            await (set_ if words else get)(session, "IMU1", words, reboot=True, **given)
        assert power.module.flags == 2
        power.reset(boot_mode=True)
        await asyncio.sleep(1)
        async with LoaderClient(session.module, "IMU1") as client:
            await client.enter()
            assert await client.get("PID", 0, 24) == AREA


async def test_a_loader_that_falls_silent_in_the_middle(config: str, capsys: pytest.CaptureFixture[str]) -> None:
    faults = LoaderFaults()
    async with pid(EmulatedLoader(faults=faults)) as (power, session):
        power.reset(boot_mode=True)
        await asyncio.sleep(1)
        faults.lost_answers |= set(range(power.module.loader.answers + 8, 10_000))
        with pytest.raises(TimedOut, match="the loader did not answer"):
            await set_(session, "IMU1", ["kp=1"], firmware="PID", as_=config)
    assert not capsys.readouterr().out


@pytest.mark.parametrize("after", [0.02, 0.1, 0.2])
async def test_ctrl_c_goes_back(after: float, config: str) -> None:
    async with pid() as (power, session):
        setting = asyncio.create_task(set_(session, "IMU1", ["kp=1"], firmware="PID", as_=config, reboot=True))
        await asyncio.sleep(after)
        setting.cancel()
        with pytest.raises(asyncio.CancelledError):
            await setting
        assert power.module.flags == 2


async def test_other_modules() -> None:
    async def idle(node: r2p.Node) -> None:
        await asyncio.Event().wait()

    async with robot(idle), tool() as session:
        with pytest.raises(r2p.Error, match="BOT is an r2p module, not firmware: leave out --firmware"):
            await list_(session, "BOT", firmware="PID")
        with pytest.raises(TimedOut, match=r"there is no module BOTT on memory:lab; .* did you mean BOT\?"):
            await list_(session, "BOTT", firmware="PID")
        with pytest.raises(UsageError, match="--firmware needs a MODULE"):
            await list_(session, firmware="PID")
        with pytest.raises(UsageError, match="--as is for the parameters of firmware: give --firmware APP, too"):
            await list_(session, as_="Led")
