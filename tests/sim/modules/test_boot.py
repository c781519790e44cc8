"""Boards in boot mode: on the simulated bus, behind gateways, and with power switches; and firmware over its lines."""

from __future__ import annotations

import asyncio
import contextlib
import sys
from typing import TYPE_CHECKING

import pytest

import r2p
from r2p.bridge import BridgeOptions
from r2p.loader import LoaderClient
from r2p.msg import Float32
from r2p.sim.modules import Board, FirmwareModule, Powered
from r2p.sim.robots.emulated import Triskar2
from r2p.testing.network import node_in
from r2p.tools.module import bootload, reboot
from r2p.tools.session import Settings, join
from tests.sim.modules.loader_rig import CONFIG, TEXT, get, load, names, run

if TYPE_CHECKING:
    from collections.abc import Callable

    from r2p.codecs.loader import LinkingSetup

virtual = pytest.mark.virtual_time
NO_PTY = pytest.mark.skipif(sys.platform == "win32", reason="no pseudo terminals")


async def until(condition: Callable[[], object], limit: float = 20.0) -> None:
    async with asyncio.timeout(limit):
        while not condition():  # noqa: ASYNC110  virtual time
            await asyncio.sleep(0.1)


def state(module: r2p.Module, name: str) -> str:
    return next((view.state for view in module.network.modules() if view.name == name and view.link), "")


async def order(module: r2p.Module, command: r2p.Command, name: str, state_after: str) -> None:
    """Send a command, which may get lost, until the module has obeyed."""
    for _ in range(20):
        module.command(command, name)
        with contextlib.suppress(TimeoutError):
            await until(lambda: state(module, name) == state_after, 1.0)
            return
    raise TimeoutError(f"{name} is {state(module, name)}")


async def found_on(module: r2p.Module, board: str) -> list[str]:
    found: list[LinkingSetup] = []
    async with node_in(module, name="loader") as node:
        await run(node, f"BOOT_{board}", names(found))
    return [setup.name for setup in found]


async def blink(node: r2p.Node, config: bytes) -> None:
    """An app: publishes its first parameter."""
    publisher = node.advertise("blink", Float32)
    async for _ in node.every(0.1):
        await publisher.publish(Float32(data=config[0]))


async def use_loader(pc: r2p.Module, board: Board) -> None:
    """There, load an app, read its parameters, and back: the app runs."""
    board.boot.programs["APP1"] = blink
    await until(lambda: state(pc, board.name) == "running")
    await order(pc, r2p.Command.BOOTLOAD, board.name, "boot")
    config = bytearray()
    async with node_in(pc, name="loader") as node:
        await run(node, f"BOOT_{board.name}", load())
        await run(node, f"BOOT_{board.name}", get("APP1", 0, 24, config))
    assert config == TEXT[CONFIG]
    assert await found_on(pc, board.name) == ["APP1"]
    await order(pc, r2p.Command.REBOOT, board.name, "running")
    async with node_in(pc) as node:
        subscriber = node.subscribe("blink", Float32)
        async with asyncio.timeout(10):
            assert await anext(aiter(subscriber)) == Float32(data=TEXT[CONFIG.start])


@virtual
async def test_a_board_on_the_bus_gets_an_app_and_runs_it() -> None:
    async with Board("IMU1", via="sim:robot") as board, r2p.Module("PC1", via="sim:robot") as pc:
        await use_loader(pc, board)


@virtual
async def test_a_board_behind_two_gateways_gets_an_app_and_runs_it() -> None:
    async with (
        Board("IMU1", via="sim:robot") as board,
        r2p.Module("GW", via=["sim:robot", "memory:between"], bridge=True),
        r2p.Module("LAB", via=["memory:between", "memory:lab"], bridge=True),
        r2p.Module("PC1", via="memory:lab") as pc,
    ):
        await use_loader(pc, board)


@virtual
@pytest.mark.parametrize("allow_control", [False, True])
async def test_a_loader_behind_a_gateway_is_for_ip_links_with_permission(
    monkeypatch: pytest.MonkeyPatch, allow_control: bool
) -> None:
    monkeypatch.setattr("r2p.transports.url._IP", frozenset({"memory"}))
    options = BridgeOptions(allow_control=allow_control)
    async with (
        Board("IMU1", via="sim:robot") as board,
        r2p.Module("GW", via=["sim:robot", "memory:lab"], bridge=options),
        r2p.Module("PC1", via="memory:lab") as pc,
    ):
        await until(lambda: state(pc, "IMU1") == "running")
        await board.bootload()
        await until(lambda: state(pc, "IMU1") == "boot")
        listing = asyncio.ensure_future(found_on(pc, "IMU1"))
        await asyncio.wait([listing], timeout=10.0)
        assert listing.done() == allow_control
        listing.cancel()
        assert bool(board.boot.loader.requests) == allow_control


@virtual
async def test_firmware_behind_a_gateway_gets_an_app() -> None:
    async with (
        Powered(FirmwareModule("IMU1", behind_gateway=True)) as power,
        r2p.Module("GW", via=[power.wire(), "memory:lab"], bridge=True),
        r2p.Module("PC1", via="memory:lab") as pc,
    ):
        await until(lambda: state(pc, "IMU1") == "running")
        await order(pc, r2p.Command.BOOTLOAD, "IMU1", "boot")
        async with node_in(pc) as node:
            await run(node, "BOOT_IMU1", load())
        assert await found_on(pc, "IMU1") == ["APP1"]


@pytest.mark.anyio
@pytest.mark.parametrize("kind", ["tcp", pytest.param("serial", marks=NO_PTY)])
async def test_firmware_on_a_real_line_gets_an_app(kind: str) -> None:
    async with Powered(FirmwareModule("IMU1", repeats=False)) as power:
        url = "serial:" + power.open_pty() if kind == "serial" else "tcp:{}:{}".format(*await power.listen())
        async with r2p.Module("PC1", via=url) as pc:
            await order(pc, r2p.Command.BOOTLOAD, "IMU1", "boot")
            async with node_in(pc) as node:
                await run(node, "BOOT_IMU1", load())
            assert await found_on(pc, "IMU1") == ["APP1"]


@virtual
async def test_commands_lead_to_the_loader_of_a_robots_board_and_back() -> None:
    """Its nodes end meanwhile; its flash keeps the app without power."""
    async with (
        Triskar2("memory:robot", modules=["PROX1", "GW"]) as robot,
        join(Settings(via=["memory:robot"])) as session,
    ):
        await bootload(session, "PROX1")
        board = robot.modules["PROX1"]
        assert state(session.module, "PROX1") == "boot"
        assert not any(node.running for node in board.nodes.values())
        async with node_in(session.module) as node:
            await run(node, "BOOT_PROX1", load())
        await robot.switch_off("PROX1")
        board = await robot.switch_on("PROX1")
        assert list(board.boot.log) == ["LAUNCH APP1"]
        assert all(node.running for node in board.nodes.values())
        await bootload(session, "PROX1")
        assert await found_on(session.module, "PROX1") == ["APP1"]
        await reboot(session, "PROX1")
        assert state(session.module, "PROX1") == "running"
        assert all(node.running for node in board.nodes.values())


@virtual
async def test_the_client_of_loaders_works_with_a_robots_board_through_its_gateway() -> None:
    async with (
        Triskar2("sim:robot", modules=["PS", "GW"], outside=["memory:lab"]) as robot,
        r2p.Module("PC1", via="memory:lab") as pc,
    ):
        async with LoaderClient(pc, "PS") as loader:
            await loader.enter()
            assert (await loader.list_apps()).apps == ()
            await loader.enter(restart=True)
            assert (await loader.list_apps()).apps == ()
            await loader.leave()
        board = robot.modules["PS"]
        assert all(node.running for node in board.nodes.values())
        assert state(pc, "PS") == "running"


@virtual
async def test_a_stop_in_boot_mode_makes_a_board_deaf_until_its_power_is_cut() -> None:
    async with Board("IMU1", via="memory:lab") as board, r2p.Module("PC1", via="memory:lab") as pc:
        await board.bootload()
        await board.stop()
        await board.reboot()
        assert "STOP in boot mode" in board.boot.fault
        await until(lambda: state(pc, "IMU1") == "boot")
        assert await found_on(pc, "IMU1") == []
    again = Board("IMU1", via="memory:lab")
    again.boot = board.boot
    async with again:
        assert not again.boot.fault
        assert not again.stopped


@virtual
async def test_a_node_may_restart_its_board_and_ends_by_that() -> None:
    """To the loader and back, and an app that fails leaves the board alone."""

    async def restart(node: r2p.Node, _config: bytes) -> None:
        node.log.info("to the loader")
        await board.bootload()

    async def fail(node: r2p.Node, _config: bytes) -> None:
        raise RuntimeError("a bug")

    async with Board("IMU1", via="memory:lab") as board, r2p.Module("PC1", via="memory:lab") as pc:
        board.boot.programs = {"FAILS": fail, "RESTARTS": restart}
        await board.bootload()
        async with node_in(pc) as node:
            await run(node, "BOOT_IMU1", load("FAILS"))
            await run(node, "BOOT_IMU1", load("RESTARTS"))
        await board.reboot()
        await until(lambda: board.boot.in_boot_mode)
        assert list(board.boot.log) == ["LAUNCH FAILS", "LAUNCH RESTARTS"]
        assert [view.has_loader for view in pc.network.modules()] == [False, True]


@virtual
async def test_an_app_that_halts_a_board_ends_its_nodes(caplog: pytest.LogCaptureFixture) -> None:
    async with Board("IMU1", via="memory:lab") as board, r2p.Module("PC1", via="memory:lab") as pc:
        await board.bootload()
        async with node_in(pc) as node:
            await run(node, "BOOT_IMU1", load(stack=64))
        await board.reboot()
        assert "a stack of 64 bytes is too small" in board.boot.fault
        assert board.boot.fault in caplog.text
        assert board.stopped
