"""`r2p param` through two gateways and a bus, over zenoh, and with a module that goes in the middle."""

from __future__ import annotations

import asyncio
import json
from typing import TYPE_CHECKING

import pytest

import r2p
from r2p.bridge import BridgeOptions
from r2p.tools.param.changing import load, save, set_
from r2p.tools.param.reading import dump, list_, watch
from r2p.tools.session import Settings, TimedOut, join
from r2p.transports.memory import network
from tests.tools.param.test_reading import drive
from tests.tools.rig import printed, robot, tool

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.virtual_time


async def test_through_two_gateways_and_a_bus(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    path = tmp_path / "gains.toml"
    near = r2p.Module("GW1", via=["memory:far", "sim:bus"], bridge=True)
    far = r2p.Module("GW2", via=["sim:bus", "memory:lab"], bridge=True)
    async with near, far, robot(drive) as module, join(Settings(via=["memory:far"])) as session:
        await asyncio.sleep(3)
        await list_(session, "BOT")
        assert [row["name"] for row in printed(capsys)] == ["kp", "limits.left", "mode", "serial", "top"]
        await set_(session, "BOT/drive", ["kp=0.7", "mode=FAST"])
        assert module.parameters["drive", "kp"].value == 0.7
        with pytest.raises(r2p.ParameterError, match=r"BOT/drive\.kp = 11\.0: it takes 10\.0"):
            await set_(session, "BOT/drive", ["kp=11"])
        with pytest.raises(r2p.Error, match="BOT has no file for parameters"):
            await save(session, ["BOT"])
        capsys.readouterr()
        await dump(session, "BOT")
        path.write_text(capsys.readouterr().out)
        module.parameters.reset()
        await load(session, path)
        assert module.parameters["drive", "kp"].value == 0.7


async def test_behind_a_prefix(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    """A dump has the robot's own names, and is loaded to it by them."""
    path = tmp_path / "gains.toml"
    options = BridgeOptions(prefix="robot1/", prefix_on=("memory:far",))
    gateway = r2p.Module("GW", via=["memory:far", "memory:lab"], bridge=options)
    async with gateway, robot(drive) as module, join(Settings(via=["memory:far"])) as session:
        await asyncio.sleep(3)
        await set_(session, "robot1/BOT/drive", ["kp=0.7"])
        (row,) = printed(capsys)
        assert (row["module"], row["node"]) == ("robot1/BOT", "drive")
        await dump(session, "robot1/BOT")
        path.write_text(text := capsys.readouterr().out)
        assert "[params.BOT.drive]\n" in text
        module.parameters.reset()
        await load(session, path)
        assert module.parameters["drive", "kp"].value == 0.7


async def test_a_module_that_does_not_answer() -> None:
    async with robot(drive), tool() as session:
        await session.settle()
        network("lab").loss = 1.0
        for target in ("BOT", None):
            with pytest.raises(TimedOut, match="module BOT does not answer"):
                await list_(session, target)


async def test_a_module_that_knows_no_parameters_is_reported(capsys: pytest.CaptureFixture[str]) -> None:
    async with robot(drive) as module, robot(drive, name="ARM"), tool() as session:
        await session.settle()
        module._opened.own_services._handlers.clear()
        await list_(session)
    captured = capsys.readouterr()
    assert "which knows no parameters: update it there" in captured.err
    assert {json.loads(line)["module"] for line in captured.out.splitlines()} == {"ARM"}


async def test_a_module_that_is_stopped() -> None:
    async with robot(drive) as module, tool() as session:
        await module.stop()
        with pytest.raises(r2p.Error, match="no node of BOT has parameters; BOT is stopped: reboot it"):
            await list_(session, "BOT")


async def test_a_module_that_falls_silent_while_it_is_set() -> None:
    def cut(_: float) -> None:
        network("lab").loss = 1.0

    async def fragile(node: r2p.Node) -> None:
        node.parameter("kp", 0.5, on_change=cut)
        await asyncio.Event().wait()

    async with robot(fragile), tool() as session:
        with pytest.raises(TimedOut, match=r"BOT does not answer, .* whether it has made the change is unknown"):
            await set_(session, "BOT/fragile", ["kp=0.7"])


async def test_watching_goes_on_when_a_module_is_back(capsys: pytest.CaptureFixture[str]) -> None:
    async with tool() as session:
        async with robot(drive):
            watching = asyncio.create_task(watch(session, "BOT/drive", ["kp"], count=1))
            await asyncio.sleep(3)
        await asyncio.sleep(10)
        async with robot(drive) as module:
            await asyncio.sleep(10)
            module.parameters.set({("drive", "kp"): 0.9})
            await watching
    (row,) = printed(capsys)
    assert (row["before"], row["value"]) == (0.5, 0.9)
