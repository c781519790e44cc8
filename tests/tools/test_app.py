"""`r2p app`: what each command prints, and what it leaves behind."""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING

import pytest

import r2p
from r2p.msg import Led
from r2p.sim.modules import EmulatedLoader, FirmwareModule, LoaderFaults, MemoryMap, Powered, Subscribes
from r2p.tools.app import disable, enable, info, list_, load, remove, run
from r2p.tools.session import Session, Settings, TimedOut, UsageError
from tests.loader.rig import board
from tests.loader.test_image import APPS
from tests.tools.rig import printed, tool

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

pytestmark = pytest.mark.virtual_time

BLINK = APPS / "blink.elf"


@contextlib.asynccontextmanager
async def opened(loader: EmulatedLoader | None = None) -> AsyncIterator[tuple[Powered, Session]]:
    async with board(loader) as (power, module):
        yield power, Session(module, Settings(via=["wire:IMU1"]))


async def test_from_a_file_to_a_running_app(capsys: pytest.CaptureFixture[str]) -> None:
    async with opened() as (power, session):
        await load(session, "IMU1", [BLINK])
        (loaded,) = printed(capsys)
        assert loaded == {
            "module": "IMU1",
            "app": "blink",
            "enabled": False,
            "stack": 1024,
            "entry_address": "0x0800f400",
            "program_address": "0x0800f450",
            "program": 364,
            "data_address": "0x20004fb0",
            "data": 4,
            "bss_address": "0x20004fb8",
            "bss": 72,
            "main_address": "0x0800f501",
            "config_address": "0x0800f598",
            "config": 24,
            "kept": False,
            "verified": ["entry", "enabled", "config"],
        }
        await run(session, "IMU1", ["blink"])
        assert list(power.module.log) == ["LAUNCH blink"]
        await list_(session, "IMU1", reboot=True)
        (row,) = printed(capsys)
        assert row == {
            "app": "blink",
            "enabled": True,
            "address": "0x0800f400",
            "program": 364,
            "ram": 76,
            "stack": 1024,
            "config": 24,
        }
        assert power.module.flags == 2


async def test_an_announced_topic_is_a_sign_of_life(capsys: pytest.CaptureFixture[str]) -> None:
    """On a line of its own: with many topics, the next ALIVE of firmware comes seconds later."""
    imu = FirmwareModule("IMU1", subscribers=[Subscribes(f"topic{number}", Led) for number in range(7)])
    async with Powered(imu) as power, r2p.Module("_tool01", via=power.wire(), observer=True, watchdog=False) as module:
        session = Session(module, Settings(via=["wire:IMU1"]))
        await load(session, "IMU1", [BLINK])
        loop = asyncio.get_running_loop()
        before = loop.time()
        await run(session, "IMU1", ["blink"])
        assert loop.time() - before < 3.0
    assert "IMU1 runs with blink" in capsys.readouterr().err


async def test_messages_to_the_user(capsys: pytest.CaptureFixture[str]) -> None:
    async with opened() as (_, session):
        await load(session, "IMU1", [BLINK], stack=2048)
        await disable(session, "IMU1", ["blink"])
        await enable(session, "IMU1", ["blink"], reboot=True)
        await remove(session, "IMU1", "blink")
    lines = capsys.readouterr().err.splitlines()
    assert lines == [
        "r2p: blink: 0 of 25 records",
        "r2p: blink: 7 of 25 records",
        "r2p: blink: 13 of 25 records",
        "r2p: blink: 19 of 25 records",
        "r2p: blink: 25 of 25 records",
        "r2p: IMU1 stays in its boot loader; r2p module reboot IMU1 starts its enabled apps",
        "r2p: not started yet: r2p app run IMU1 blink",
        "r2p: IMU1: blink does not start with the module, as before",
        "r2p: IMU1: blink starts with the module",
        "r2p: IMU1: blink is removed",
        "r2p: IMU1 stays in its boot loader; r2p module reboot IMU1 starts its enabled apps",
    ]


async def test_an_app_that_halts_its_module(capsys: pytest.CaptureFixture[str]) -> None:
    loader = EmulatedLoader(MemoryMap(least_stack=2048))
    async with opened(loader) as (power, session):
        await load(session, "IMU1", [BLINK])
        await run(session, "IMU1", ["blink"])
        assert "IMU1 has been silent since it started its apps" in capsys.readouterr().err
        assert power.module.fault
        power.reset(boot_mode=True)
        await asyncio.sleep(1)
        await disable(session, "IMU1", ["blink"], reboot=True)
        await asyncio.sleep(1)
        assert not power.module.fault


async def test_the_memory_of_a_module(capsys: pytest.CaptureFixture[str]) -> None:
    async with opened() as (_, session):
        await info(session, "IMU1")
        await load(session, "IMU1", [BLINK], enable=True)
        await info(session, "IMU1", "blink")
        with pytest.raises(r2p.Error, match="IMU1 has no app blnk; it has blink"):
            await info(session, "IMU1", "blnk")
    memory, loaded, app = printed(capsys)
    assert memory == {
        "module": "IMU1",
        "apps": 0,
        "flash": ["0x0800f400", "0x08020000"],
        "flash_free": 68608,
        "next_program": "0x0800f450",
        "ram": ["0x20000000", "0x20005000"],
        "ram_used": 0,
    }
    assert app["enabled"]
    assert app.items() <= loaded.items()


async def test_the_others_are_loaded_again(capsys: pytest.CaptureFixture[str]) -> None:
    async with opened() as (_, session):
        await load(session, "IMU1", [BLINK])
        with pytest.raises(r2p.Error, match="other would get the RAM of blink"):
            await load(session, "IMU1", [BLINK], name="other")
        with pytest.raises(r2p.Error, match="that would remove blink of IMU1 as well"):
            await load(session, "IMU1", [BLINK], name="other", reload=True)
        await load(session, "IMU1", [BLINK], stack=2048, reload=True)
        with pytest.raises(UsageError, match="give --reload and the files of the other apps, or neither"):
            await remove(session, "IMU1", "blink", [BLINK])
        with pytest.raises(r2p.Error, match="IMU1 has no app red; it has blink"):
            await remove(session, "IMU1", "red", [BLINK], reload=True)
        await info(session, "IMU1", "blink")
    assert printed(capsys)[-1]["stack"] == 2048


async def test_what_is_lost_by_ctrl_c_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    async with opened() as (power, session):
        await load(session, "IMU1", [BLINK])
        loader = power.module.loader
        loading = asyncio.create_task(load(session, "IMU1", [BLINK], reload=True))
        while list(loader.apps):  # noqa: ASYNC110 - the emulation has no event for it
            await asyncio.sleep(0.005)
        loading.cancel()
        await asyncio.wait([loading])
    assert (
        "interrupted: IMU1 may lack blink; its apps were removed, blink with config f4010000fdffffff626c696e6b"
        f"{'00' * 11}. The same command begins anew"
    ) in capsys.readouterr().err


@pytest.mark.parametrize(
    ("files", "given", "text"),
    [
        (["lost.elf"], {}, "can't read .*lost.elf"),
        (["firmware.ld"], {}, "is not an Intel HEX file"),
        (["linked.hex"], {"name": "far too long"}, "can't be the name of an app"),
        (["linked.hex"], {"stack": 100}, "a stack of 100 bytes is too small"),
        (["blink.elf", "linked.hex"], {"name": "one"}, "--name is for one file"),
        (["blink.elf"], {"symbols": APPS / "linked.hex"}, "linked.hex is not a valid ELF file"),
    ],
)
async def test_wrong_files_are_errors_of_usage(files: list[str], given: dict[str, object], text: str) -> None:
    async with opened() as (power, session):
        with pytest.raises(UsageError, match=text):
            await load(session, "IMU1", [APPS / each for each in files], **given)  # type: ignore[arg-type]
        assert power.module.flags == 0


async def test_no_answer_is_a_time_out() -> None:
    faults = LoaderFaults()
    async with opened(EmulatedLoader(faults=faults)) as (_, session):
        with pytest.raises(TimedOut, match="IMU2 did not confirm BOOTLOAD in 10 s, and there was no sign of it"):
            await list_(session, "IMU2")
        faults.lost_requests = set(range(1000))
        with pytest.raises(TimedOut, match=r"did not answer BEGIN_LOADER within 0\.5 s, sent 10 times"):
            await list_(session, "IMU1", timeout=0.5)


async def test_without_a_network() -> None:
    async with tool() as session:
        session.settings.via.clear()
        with pytest.raises(UsageError, match="no network to find the module on: give --via"):
            await list_(session, "IMU1")
