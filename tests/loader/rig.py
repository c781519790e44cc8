"""An emulated module, a client of its loader, and small apps."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import TYPE_CHECKING

import r2p
from r2p.codecs.loader import LinkingAddresses, LinkingOutcome
from r2p.loader import LoaderClient
from r2p.loader.image import AppDescription, AppImage, LinkedApp
from r2p.sim.modules import EmulatedLoader, FirmwareModule, Powered

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

CONFIG = bytes(range(1, 9))


class SmallApp(AppImage):
    """An app without relocations, with 8 bytes of config."""

    def __init__(self, name: str, *, config: bytes = CONFIG, bss: int = 8, stack: int = 1024) -> None:
        self.config = config
        sizes = (len(config) + 24, 4, bss)
        super().__init__(Path(f"{name}.elf"), AppDescription(stack=stack), sizes)

    def link(self, addresses: LinkingAddresses) -> LinkedApp:
        begin = addresses.pgmadr
        outcome = LinkingOutcome(begin + len(self.config) + 1, begin, len(self.config), 0, 0, 0, 0)
        return LinkedApp(self.config + bytes(24), begin, b"data", addresses.datapgmadr, outcome)


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
