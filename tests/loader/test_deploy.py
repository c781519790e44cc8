"""Loading apps as a whole, onto the emulated module: what is refused, and what becomes of each fault."""

from __future__ import annotations

import asyncio
import contextlib

import pytest

import r2p
from r2p.codecs.loader import LinkingAddresses
from r2p.loader import LoaderClient, LoaderError, LoaderSilent
from r2p.loader.checks import check_addresses
from r2p.loader.deploy import Deployment, LoadedApp, remove_app
from r2p.loader.files import read_app
from r2p.sim.modules import EmulatedLoader, FirmwareModule, LoaderFaults, MemoryMap, Powered
from r2p.sim.modules.flash import BOARD
from tests.loader.rig import CONFIG, SmallApp, client
from tests.loader.test_image import APPS

pytestmark = pytest.mark.virtual_time

MESSAGES = 26
"""Messages to the loader, and about as many answers, from the listing before a load to the last byte that is read."""


async def names(loader: LoaderClient) -> list[str]:
    return [each.name for each in (await loader.list_apps()).apps]


async def add(loader: LoaderClient, *apps: str) -> list[LoadedApp]:
    return await Deployment(loader, [SmallApp(each) for each in apps]).add()


async def test_apps_are_loaded_in_one_start_of_the_loader_and_read_back() -> None:
    seen: list[tuple[str, int, int]] = []
    async with client() as (power, loader):
        apps = [read_app(APPS / "blink.elf"), SmallApp("two")]
        blink, two = await Deployment(loader, apps, progress=lambda *each: seen.append(each)).add()
        assert blink.config.startswith(b"\xf4\x01\0\0\xfd\xff\xff\xffblink")
        assert (two.config, two.enabled, two.kept) == (CONFIG, False, False)
        assert await names(loader) == ["blink", "two"]
        assert blink.app.ram[0].start > two.app.ram[0].start
        await loader.enable("blink")
        await loader.enable("two")
        await loader.leave()
        await asyncio.sleep(1)
        assert list(power.module.log) == ["LAUNCH blink", "LAUNCH two"]
    assert [seen[0], seen[-1]] == [("blink", 0, 25), ("two", 4, 4)]


async def test_the_linked_file_fits_where_the_first_app_goes() -> None:
    async with client() as (power, loader):
        await Deployment(loader, [read_app(APPS / "linked.hex")]).add()
        flash = power.module.loader.flash
        linked = read_app(APPS / "blink.elf").link((await loader.list_apps()).apps[0].addresses)
        assert flash.read(0x0800F450, len(linked.program)) == linked.program
        assert flash.read(0x0800F5C0, 4) == linked.data
        with pytest.raises(LoaderError, match="IMU1 has an app blink already: remove it first"):
            await Deployment(loader, [read_app(APPS / "linked.hex")]).add()
        other = read_app(APPS / "linked.hex", {"name": "other"})
        with pytest.raises(LoaderError, match="another layout: its program 0x0800f450, not 0x0800f620"):
            await Deployment(loader, [other]).add()


# Refused before anything is erased


@pytest.mark.parametrize(
    ("apps", "text"),
    [
        ([SmallApp("one", bss=0)], "IMU1 has an app one already"),
        ([SmallApp("two")], "two would get the RAM of one, .* load all its apps in one go"),
        ([SmallApp("two"), SmallApp("two")], "are both named two"),
        (
            [SmallApp("big", config=bytes(70_000))],
            "no room in the flash of IMU1: 70[0-9]{3} bytes are needed, 68[0-9]{3} are free",
        ),
        ([SmallApp("big", bss=20_480)], "no room in the RAM of IMU1: 20488 bytes are needed, it has 20480"),
        ([SmallApp("big", stack=21_000)], "a stack of 21000 bytes is more than IMU1 has RAM"),
    ],
)
async def test_what_is_refused_changes_nothing(apps: list[SmallApp], text: str) -> None:
    async with client() as (power, loader):
        await add(loader, "one")
        before = bytes(power.module.loader.flash.data)
        with pytest.raises(LoaderError, match=text):
            await Deployment(loader, apps).add()
        assert bytes(power.module.loader.flash.data) == before
        assert await names(loader) == ["one"]


async def test_an_app_of_another_module() -> None:
    async with client() as (_, loader):
        app = read_app(APPS / "blink.elf", {"module": "MOTOR1"})
        with pytest.raises(LoaderError, match=r"blink\.elf is for module MOTOR1, not for IMU1"):
            await Deployment(loader, [app]).add()


async def test_memory_that_a_damaged_loader_gives_is_not_used() -> None:
    async with client() as (_, loader):
        await loader.enter()
        listing = await loader.list_apps()
        app = SmallApp("one")
        for wrong in (
            LinkingAddresses(0x0800F000, 0x0800F050, 0x20004FF8, 0x20004FF0, 0x0800F070, 0x0800F080),
            LinkingAddresses(0x0800F400, 0x0800F450, 0x20004FFC, 0x20004FF0, 0x0800F470, 0x0800F480),
            LinkingAddresses(0x0800F400, 0x0800F450, 0x20004FF8, 0x20004FF0, 0x0800F470, 0x0800F470),
        ):
            with pytest.raises(LoaderError, match="gives one memory that is not free"):
                check_addresses(app, wrong, listing, [], "IMU1")


# Removing and loading anew


async def test_only_the_last_app_can_be_removed_alone() -> None:
    async with client() as (_, loader):
        await add(loader, "one", "two", "three")
        text = (
            r"one is not the last app .* with it would go two, three. To keep these, give the files of two three: r2p"
        )
        with pytest.raises(LoaderError, match=text):
            await remove_app(loader, "one")
        with pytest.raises(LoaderError, match="IMU1 has no app four; it has one, two, three"):
            await remove_app(loader, "four")
        await remove_app(loader, "three")
        assert await names(loader) == ["one", "two"]


async def test_apps_that_are_loaded_anew_keep_what_was_set() -> None:
    async with client() as (_, loader):
        await add(loader, "one", "two", "three")
        await loader.set("two", 2, b"gain")
        await loader.enable("three")
        two, three = await Deployment(loader, [SmallApp("two"), SmallApp("three")]).replace(without="one")
        assert await names(loader) == ["two", "three"]
        assert (two.config, two.enabled, two.kept) == (b"\1\2gain\7\x08", False, True)
        assert (three.config, three.enabled) == (CONFIG, True)
        reports: list[str] = []
        await Deployment(
            loader, [SmallApp("two", config=bytes(16)), SmallApp("three")], report=reports.append
        ).replace()
        assert reports == [
            (
                "two: its config area has 16 bytes now, not 8: it begins with that of the file; before it was "
                "01026761696e0708"
            )
        ]
        with pytest.raises(LoaderError, match="that would remove three of IMU1 as well: give the files of all apps"):
            await Deployment(loader, [SmallApp("two")]).replace()
        with pytest.raises(LoaderError, match="IMU1 has no app four"):
            await Deployment(loader, []).replace(without="four")
        assert await names(loader) == ["two", "three"]


# Faults


def emulated() -> tuple[LoaderFaults, EmulatedLoader]:
    faults = LoaderFaults()
    return faults, EmulatedLoader(faults=faults)


async def test_all_messages_of_a_load_are_counted() -> None:
    _, emulation = emulated()
    async with client(emulation) as (_, loader):
        await add(loader, "one")
        assert max(emulation.requests, emulation.answers) == MESSAGES


@pytest.mark.parametrize("kind", ["lost_requests", "lost_answers", "refused"])
@pytest.mark.parametrize("number", range(1, MESSAGES + 1))
async def test_each_message_may_fail_once(kind: str, number: int) -> None:
    faults, emulation = emulated()
    async with client(emulation) as (_, loader):
        getattr(faults, kind).add(number)
        (loaded,) = await add(loader, "one")
        assert (loaded.app.name, loaded.config) == ("one", CONFIG)
        assert await names(loader) == ["one"]


@pytest.mark.parametrize("number", range(1, MESSAGES + 1))
async def test_the_power_fails_at_each_message_and_loading_anew_works(number: int) -> None:
    """The module comes back in its running state, where its loader is silent."""
    _, emulation = emulated()
    async with client(emulation) as (power, loader):
        await loader.enter()
        cutting = asyncio.create_task(cut_at(power, number))
        with contextlib.suppress(LoaderError):
            await add(loader, "one")
        cutting.cancel()
        await loader.enter()
        await loader.go_idle()
        if await names(loader) == ["one"]:
            await remove_app(loader, "one")
        await add(loader, "one")
        assert await names(loader) == ["one"]
        assert await loader.get("one", 0, 8) == CONFIG


@pytest.mark.parametrize("number", range(1, 75, 5))
async def test_the_power_fails_during_a_reload_and_loading_anew_works(number: int) -> None:
    async with client(EmulatedLoader(times=BOARD)) as (power, loader):
        await add(loader, "one", "two")
        apps = [SmallApp("one"), SmallApp("two")]
        cutting = asyncio.create_task(cut_at(power, power.module.loader.requests + number))
        with contextlib.suppress(LoaderError):
            await Deployment(loader, apps).replace()
        cutting.cancel()
        await loader.enter(restart=True)
        await Deployment(loader, apps).replace()
        assert await names(loader) == ["one", "two"]
        assert await loader.get("two", 0, 8) == CONFIG


async def cut_at(power: Powered, number: int) -> None:
    """Cut the power for a moment when the loader gets this message."""
    while power.module.loader.requests < number:  # noqa: ASYNC110 - the emulation has no event for it
        await asyncio.sleep(0.005)
    power.reset()


async def test_the_cable_is_pulled_in_the_middle() -> None:
    _, emulation = emulated()
    imu = FirmwareModule("IMU1", loader=emulation)
    async with Powered(imu) as power:
        wire = power.wire()
        async with (
            r2p.Module("_tool01", via=wire, observer=True, watchdog=False) as module,
            LoaderClient(module, "IMU1") as loader,
        ):

            def pull(name: str, done: int, total: int) -> None:
                if (name, done) == ("two", 2):
                    wire.pull()

            deployment = Deployment(loader, [SmallApp("one"), SmallApp("two")], progress=pull)
            with pytest.raises(LoaderSilent) as failed:
                await deployment.add()
            assert str(failed.value) == (
                "the loader did not answer IHEX_RECORD within 1 s, sent 4 times, and its link is down. IMU1 was left "
                "in its boot loader, without two and with one. Check its link, look at r2p app list IMU1, and load "
                "again what is missing"
            )
            wire.plug_in()
            await asyncio.sleep(5)
            assert await names(loader) == ["one"]
            await Deployment(loader, [SmallApp("one"), SmallApp("two")]).replace()
            assert await names(loader) == ["one", "two"]


async def test_what_was_removed_for_a_reload_is_named_when_that_fails() -> None:
    async with client() as (power, loader):
        await add(loader, "one", "two")
        await loader.set("two", 0, b"\xaa\xbb")

        def cut(name: str, done: int, total: int) -> None:
            if name == "two":
                power.module.fault = "no power"

        deployment = Deployment(loader, [SmallApp("one"), SmallApp("two")], progress=cut)
        with pytest.raises(LoaderSilent, match="with one; its apps were removed, two with config aabb03"):
            await deployment.replace()
        power.reset()
        await asyncio.sleep(1)
        await loader.enter()
        assert await names(loader) == ["one"]


async def test_what_was_removed_is_named_when_the_load_can_not_be_begun_again(monkeypatch: pytest.MonkeyPatch) -> None:
    faults, emulation = emulated()
    async with client(emulation) as (_, loader):
        await add(loader, "one")

        async def is_in_use(*, restart: bool) -> None:
            raise LoaderError("PC2 uses the loader of IMU1 as well: end that first")

        def refuse(name: str, done: int, total: int) -> None:
            faults.refused.add(emulation.requests + 1)
            monkeypatch.setattr(loader, "enter", is_in_use)

        with pytest.raises(
            LoaderError, match=r"^PC2 uses .*; its apps were removed, one with config 01.*\. Look at r2p"
        ):
            await Deployment(loader, [SmallApp("one")], progress=refuse).replace()


async def test_what_was_loaded_again_and_then_removed_for_another_try_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    faults, emulation = emulated()
    async with client(emulation) as (power, loader):
        await add(loader, "one", "two")
        remove_last = loader.remove_last

        async def remove_and_cut() -> None:
            await remove_last()
            power.module.fault = "no power"

        def refuse(name: str, done: int, total: int) -> None:
            if name == "two":
                faults.refused.add(emulation.requests + 1)
                monkeypatch.setattr(loader, "remove_last", remove_and_cut)

        with pytest.raises(
            LoaderSilent, match=r"without one, two; its apps were removed, one with config 01.*, two with"
        ):
            await Deployment(loader, [SmallApp("one"), SmallApp("two")], progress=refuse).replace()


async def test_a_listing_of_a_damaged_flash() -> None:
    async with client() as (power, loader):
        await add(loader, "one")
        flash = power.module.loader.flash
        at = bytes(flash.data).index((0x0800F450).to_bytes(4, "little") + b"\x08\0\0\0") + 4  # its config area's length
        flash.data[at : at + 4] = b"\xff\xff\xff\x7f"
        reports: list[str] = []
        await Deployment(loader, [SmallApp("one")], report=reports.append).replace()
        assert reports[0] == ("one: its config area would have 2147483647 bytes, more than its program: it is not kept")


async def test_a_board_whose_flash_takes_its_time() -> None:
    emulation = EmulatedLoader(MemoryMap(word=2, ram_align=16), times=BOARD)
    async with client(emulation) as (_, loader):
        await Deployment(loader, [SmallApp("one"), read_app(APPS / "blink.elf")]).add()
        await Deployment(loader, [SmallApp("one")]).replace(without="blink")
        assert await names(loader) == ["one"]
        assert await loader.get("one", 0, 8) == CONFIG


async def test_a_loader_that_was_not_restarted_is_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Else the app would get RAM below that of loads that were aborted before, until there is none left."""
    async with client() as (_, loader):
        await loader.enter()

        def refuse(addresses: LinkingAddresses) -> None:
            raise LoaderError("not for these")

        with pytest.raises(LoaderError, match="not for these"):
            await loader.load(SmallApp("one", bss=4096).setup, refuse)  # type: ignore[arg-type]
        command, lost = loader._module.command, iter(range(3))

        def lose(order: r2p.Command, module: str) -> None:
            if next(lost, None) is None:
                command(order, module)

        monkeypatch.setattr(loader._module, "command", lose)
        reports: list[str] = []
        await Deployment(loader, [SmallApp("one")], report=reports.append).add()
        assert reports == ["the loader still keeps RAM of before: its restart was lost: beginning again"]
