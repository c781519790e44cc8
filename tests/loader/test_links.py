"""A load by each kind of link: a debug line over TCP and over a serial port, and through gateways."""

from __future__ import annotations

import contextlib
import sys
from typing import TYPE_CHECKING

import pytest

import r2p
from r2p.loader import LoaderClient, LoaderError
from r2p.loader.deploy import Deployment, remove_app
from r2p.sim.modules import Board, FirmwareModule, Powered
from tests.loader.rig import CONFIG, SmallApp

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

CONTROL = r2p.BridgeOptions(allow_control=True)


async def there_and_back(module: r2p.Module, name: str = "IMU1") -> None:
    """Load two apps, set one's config, remove the other."""
    async with LoaderClient(module, name) as loader:
        await Deployment(loader, [SmallApp("one"), SmallApp("two")]).add()
        await loader.set("one", 0, CONFIG[::-1])
        await remove_app(loader, "two")
        (left,) = (await loader.list_apps()).apps
        assert left.name == "one"
        assert await loader.get("one", 0, 8) == CONFIG[::-1]
        await loader.leave()


@pytest.mark.anyio
@pytest.mark.parametrize("anyio_backend", ["asyncio"])
async def test_a_debug_line_over_tcp() -> None:
    async with Powered(FirmwareModule("IMU1", repeats=False)) as power:
        _, port = await power.listen()
        async with r2p.Module("_tool01", via=f"tcp:127.0.0.1:{port}", observer=True) as module:
            await there_and_back(module)


@pytest.mark.anyio
@pytest.mark.parametrize("anyio_backend", ["asyncio"])
@pytest.mark.skipif(sys.platform == "win32", reason="no pseudo terminals")
async def test_a_debug_line_over_a_serial_port() -> None:
    async with (
        Powered(FirmwareModule("IMU1")) as power,
        r2p.Module("_tool01", via=f"serial:{power.open_pty()}", observer=True) as module,
    ):
        await there_and_back(module)


@pytest.mark.virtual_time
async def test_a_bus() -> None:
    async with Board("IMU1", via="sim:robot"), r2p.Module("_tool01", via="sim:robot", observer=True) as module:
        await there_and_back(module)


@contextlib.asynccontextmanager
async def two_gateways(options: r2p.BridgeOptions = CONTROL) -> AsyncIterator[r2p.Module]:
    """IMU1 on a wire, a gateway from there to the robot's bus, and one from that to the tool's network."""
    async with (
        Powered(FirmwareModule("IMU1")) as power,
        r2p.Module("GW1", via=[power.wire(), "sim:robot"], bridge=CONTROL, watchdog=False),
        r2p.Module("GW2", via=["sim:robot", "memory:office"], bridge=options, watchdog=False),
        r2p.Module("_tool01", via="memory:office", observer=True, watchdog=False) as module,
    ):
        yield module


@pytest.mark.virtual_time
async def test_two_gateways_with_a_bus_between_them() -> None:
    async with two_gateways() as module:
        await there_and_back(module)


@pytest.mark.virtual_time
async def test_a_gateway_that_gives_the_robot_a_prefix() -> None:
    options = r2p.BridgeOptions(allow_control=True, prefix="robot1/", prefix_on=("memory",))
    async with two_gateways(options) as module:
        await there_and_back(module, "robot1/IMU1")


@pytest.mark.virtual_time
async def test_a_gateway_that_does_not_let_orders_in(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("r2p.transports.url._IP", frozenset({"memory"}))
    async with two_gateways(r2p.BridgeOptions()) as module, LoaderClient(module, "IMU1") as loader:
        with pytest.raises(LoaderError, match=r"GW2 .*--allow-control"):
            await loader.enter()
