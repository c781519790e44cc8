"""The client against the emulated module: there, what its loader does, and back."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

import r2p
from r2p.codecs.loader import LinkingAddresses, LinkingSetup
from r2p.loader import LoaderClient, LoaderError, LoaderSilent
from r2p.msg import Led
from r2p.sim.modules import EmulatedLoader, LoaderFaults, MemoryMap
from tests.loader.rig import board, client
from tests.loader.test_session import CONFIG, link

pytestmark = pytest.mark.virtual_time

BLINK = LinkingSetup(pgmlen=32, bsslen=8, datalen=0, stacklen=1024, name="blink")


@pytest.mark.parametrize("repeats", [True, False])
async def test_there_and_back(repeats: bool) -> None:
    async with client(repeats=repeats) as (power, loader):
        await loader.enter()
        assert loader.restarted
        view = loader.view()
        assert view is not None
        assert view.state == "boot"
        assert (await loader.list_apps()).apps == ()
        await loader.leave()
        assert power.module.flags == 2


async def test_what_a_loader_does() -> None:
    async with client() as (_, loader):
        await loader.enter()
        await loader.load(BLINK, link)
        assert [each.name for each in (await loader.list_apps()).apps] == ["blink"]
        assert await loader.get("blink", 0, 24) == CONFIG
        await loader.set("blink", 4, b"abcd")
        assert await loader.get("blink", 3, 6) == b"\x03abcd\x08"
        assert not await loader.is_enabled("blink")
        assert await loader.enable("blink")
        assert not await loader.enable("blink")
        assert await loader.is_enabled("blink")
        await loader.remove_last()
        assert (await loader.list_apps()).apps == ()
        assert loader.dropped == {}


async def test_parameters_at_an_odd_place_are_set_on_a_board_that_writes_half_words() -> None:
    async with client(EmulatedLoader(MemoryMap(word=2))) as (_, loader):
        await loader.enter()
        await loader.load(BLINK, link)
        await loader.set("blink", 1, bytes(range(100, 120)))
        assert await loader.get("blink", 0, 22) == CONFIG[:1] + bytes(range(100, 120)) + CONFIG[21:22]


async def test_a_restart_of_the_loader_frees_its_memory() -> None:
    async with client() as (_, loader):
        await loader.enter()
        given: list[LinkingAddresses] = []

        def refuse(addresses: LinkingAddresses) -> Any:
            given.append(addresses)
            raise LoaderError("not for these")

        for _ in range(2):
            with pytest.raises(LoaderError, match="not for these"):
                await loader.load(BLINK, refuse)
        assert given[1].bssadr < given[0].bssadr
        await loader.enter(restart=True)
        assert await loader.load(BLINK, link) == given[0]


async def test_what_is_read_and_set_is_begun_again() -> None:
    faults = LoaderFaults()
    async with client(EmulatedLoader(faults=faults)) as (power, loader):
        await loader.enter()
        await loader.load(BLINK, link)
        faults.lost_answers = {power.module.loader.answers + each for each in (3, 8)}
        assert await loader.get("blink", 0, 24) == CONFIG
        faults.lost_requests = {power.module.loader.requests + 3}
        await loader.set("blink", 0, bytes(24))
        assert await loader.get("blink", 0, 24) == bytes(24)


async def test_an_acknowledgement_is_no_proof(monkeypatch: pytest.MonkeyPatch) -> None:
    async with client() as (power, loader):
        await loader.enter()
        await loader.load(BLINK, link)
        monkeypatch.setattr(power.module.loader.flash, "write_page", lambda address, new: True)
        with pytest.raises(LoaderError, match="ff was written at 0, and 00 read back"):
            await loader.set("blink", 0, b"\xff")


async def test_a_module_that_is_not_there() -> None:
    async with client() as (power, loader), LoaderClient(loader._module, "IMU2") as other:
        with pytest.raises(LoaderSilent, match="IMU2 did not confirm BOOTLOAD in 10 s, and there was no sign of it"):
            await other.enter()
        await loader.enter()
        power.module.fault = "no power"
        with pytest.raises(LoaderSilent, match=r"did not answer BEGIN_APPINFO|did not answer BEGIN_LOADER"):
            await loader.list_apps()
        with pytest.raises(LoaderSilent, match=r"IMU1 did not confirm REBOOT in 10 s: it is"):
            await loader.leave()
        power.reset(boot_mode=True)
        await asyncio.sleep(2)
        assert (await loader.list_apps()).apps == ()


async def test_an_r2p_module_has_no_loader() -> None:
    async with (
        r2p.Module("BOT", via="memory:lab"),
        r2p.Module("PC", via="memory:lab") as module,
        LoaderClient(module, "BOT") as loader,
    ):
        with pytest.raises(LoaderError, match="BOT is an r2p module"):
            await loader.enter()


async def test_two_tools_do_not_share_a_loader() -> None:
    async with (
        r2p.Module("PC1", via="memory:lab") as one,
        r2p.Module("PC2", via="memory:lab") as two,
        LoaderClient(one, "IMU1") as first,
        LoaderClient(two, "IMU1"),
    ):
        await asyncio.sleep(1)
        with pytest.raises(LoaderError, match="PC2 uses the loader of IMU1 as well"):
            await first._check_alone()


async def test_one_client_after_the_other() -> None:
    async with board() as (_, module):
        for _ in range(3):
            async with LoaderClient(module, "IMU1") as loader:
                await loader.enter()
        node = module.start(hold)
        node.advertise("BOOT_IMU2", Led)
        with pytest.raises(r2p.TypeMismatch):
            await LoaderClient(module, "IMU2").__aenter__()


async def hold(node: r2p.Node) -> None:
    await asyncio.Event().wait()
