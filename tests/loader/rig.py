"""An emulated module, and a client of its loader."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING

import r2p
from r2p.loader import LoaderClient
from r2p.sim.modules import EmulatedLoader, FirmwareModule, Powered

if TYPE_CHECKING:
    from collections.abc import AsyncIterator


@contextlib.asynccontextmanager
async def board(
    loader: EmulatedLoader | None = None, *, repeats: bool = True
) -> AsyncIterator[tuple[Powered, r2p.Module]]:
    """IMU1, running, and a tool on its wire."""
    imu = FirmwareModule("IMU1", loader=loader, repeats=repeats)
    async with Powered(imu) as power, r2p.Module("_tool01", via=power.wire(), observer=True, watchdog=False) as module:
        yield power, module


@contextlib.asynccontextmanager
async def client(
    loader: EmulatedLoader | None = None, *, repeats: bool = True
) -> AsyncIterator[tuple[Powered, LoaderClient]]:
    """A client of the loader of IMU1."""
    async with board(loader, repeats=repeats) as (power, module), LoaderClient(module, "IMU1") as opened:
        yield power, opened
