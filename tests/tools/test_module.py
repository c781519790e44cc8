"""`r2p module`: which modules are listed, and when a command is done."""

from __future__ import annotations

import asyncio
import contextlib
import json
import re
from typing import TYPE_CHECKING

import msgspec
import pytest

import r2p
from r2p.codecs import management
from r2p.codecs.management import WIRE_VERSION
from r2p.msg import Led, Velocity3
from r2p.names import module_alias
from r2p.sim.modules import FirmwareModule, Powered, Publishes, Subscribes
from r2p.tools.module import bootload, info, list_, reboot, stop
from r2p.tools.session import Session, Settings, TimedOut, UsageError
from r2p.transports.memory import Datagram, network
from tests.tools.rig import printed, robot, tool
from tests.transports.test_aliases import OTHER_WHEEL, WHEEL

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

pytestmark = pytest.mark.virtual_time


async def hold(node: r2p.Node) -> None:
    node.advertise("leds", Led)
    await asyncio.Event().wait()


@contextlib.asynccontextmanager
async def board(*, repeats: bool = True, age: float = 0.0) -> AsyncIterator[tuple[Powered, Session]]:
    """IMU1, emulated, and a tool that joins its wire after `age` seconds."""
    imu = FirmwareModule(
        "IMU1", publishers=[Publishes("leds", Led)], subscribers=[Subscribes("cmd", Velocity3)], repeats=repeats
    )
    async with Powered(imu) as power:
        await asyncio.sleep(age)
        async with r2p.Module("_tool01", via=power.wire(), observer=True, watchdog=False) as module:
            yield power, Session(module, Settings(via=["wire:IMU1"]))


async def test_r2p_modules_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    async with robot(hold), robot(name="ARM") as arm, tool(), tool() as session:
        await arm.stop()
        await list_(session)
    assert [(row["module"], row["state"], row["kind"], row["link"]) for row in printed(capsys)] == [
        ("ARM", "stopped", "r2p", "memory:lab"),
        ("BOT", "running", "r2p", "memory:lab"),
    ]


async def test_an_alias_is_a_name(capsys: pytest.CaptureFixture[str]) -> None:
    name = "front_left_wheel_controller"
    async with robot(hold, name=name) as module, tool() as session:
        alias = module_alias(name)
        await info(session, alias)
        (record,) = printed(capsys)
        assert (record["module"], record["nodes"][0]["node"]) == (name, "hold")
        await stop(session, alias)
        assert module.stopped
        await reboot(session, alias)
        assert module.rebooted
        assert capsys.readouterr().err.splitlines()[-1].startswith(f"r2p: {name}: rebooted after")
        with pytest.raises(r2p.Error, match=f"{name} is an r2p module, a program without a boot loader"):
            await bootload(session, alias)


async def test_an_alias_of_two_modules_is_the_name_of_none() -> None:
    async with robot(hold, name=WHEEL), robot(name=OTHER_WHEEL), tool() as session:
        alias = module_alias(WHEEL)
        for command in (info, stop):
            with pytest.raises(r2p.Error, match=f"{alias} is the alias of {WHEEL} and {OTHER_WHEEL}: rename one"):
                await command(session, alias)


async def test_what_a_module_has_counted(capsys: pytest.CaptureFixture[str]) -> None:
    async with robot(hold), tool() as session:
        await info(session, "BOT")
        (record,) = printed(capsys)
        assert (record["module"], record["state"], record["kind"]) == ("BOT", "running", "r2p")
        assert record["publishers"] == [
            {"topic": name, "node": node, "publisher_class": 1, "sent": 0, "missed": 0, "late": 0}
            for name, node in (("leds", "hold"), ("log", "log"))
        ]
        assert record["links"][0]["lost"] == {}
        assert record["nodes"] == [{"node": "hold", "running": True, "restarts": 0}]
        with pytest.raises(r2p.Error, match=r"no module BOTT .*did you mean BOT\?"):
            await info(session, "BOTT")
        network("lab").send(Datagram(99, b"R2P", management.encode(management.Hello("EVE", 7, wire=2))))
        with pytest.raises(TimedOut, match="EVE does not answer"):
            await info(session, "EVE")


async def test_firmware_counts_nothing_that_a_tool_can_ask_for(capsys: pytest.CaptureFixture[str]) -> None:
    async with board() as (_, session):
        await info(session, "IMU1", wait=5)
    captured = capsys.readouterr()
    assert json.loads(captured.out)["kind"] == "firmware"
    assert "IMU1 is firmware: it counts nothing that others can ask for" in captured.err


async def test_versions_are_listed_also_behind_a_gateway(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    gateway = r2p.Module("GW", via=["memory:lab", "memory:bus"], bridge=True)
    async with gateway, r2p.Module("ARM", via="memory:bus"), tool() as session:
        newer = management.encode(management.Hello("NEW", 7, 0, 0, 60_000, 9, "9.9"))
        network("bus").send(Datagram(99, b"R2P", newer))
        await asyncio.sleep(5)
        await list_(session)
        rows = {row["module"]: (row["version"], row["wire"]) for row in printed(capsys)}
        this = r2p.__version__, WIRE_VERSION
        assert rows == {"ARM": this, "GW": this, "NEW": ("9.9", 9)}
        monkeypatch.setattr("sys.stdout.isatty", lambda: True)
        await list_(session)
        assert re.search(rf"NEW +running +False +r2p +9.9 +9, not {WIRE_VERSION} ", capsys.readouterr().out)


async def test_ages_have_a_unit_for_people(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stdout.isatty", lambda: True)
    async with robot(), tool() as session:
        await list_(session)
    header, row = capsys.readouterr().out.splitlines()
    assert header.endswith("AGE")
    assert re.search(r"  [0-9]\.[0-9] s$", row)


async def test_tools_are_listed_on_demand(capsys: pytest.CaptureFixture[str]) -> None:
    async with robot(), tool() as other, tool() as session:
        await list_(session, all=True)
    assert [(row["module"], row["state"]) for row in printed(capsys)] == [
        ("BOT", "running"),
        (other.module.name, "observer"),
    ]


async def test_firmware_is_given_time_to_say_its_name(capsys: pytest.CaptureFixture[str]) -> None:
    async with board(age=1.03) as (_, session):  # it has just said it
        await list_(session)
    captured = capsys.readouterr()
    row = json.loads(captured.out)
    assert (row["module"], row["state"], row["kind"], row["age"]) == ("IMU1", "running", "firmware", 0.0)
    assert "there may be more modules: listen longer with --wait 5" in captured.err


async def test_nobody_there_is_said(capsys: pytest.CaptureFixture[str]) -> None:
    async with tool() as session:
        await list_(session)
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err == (
        "r2p: waiting for ALIVE of firmware on memory:lab\n"
        "r2p: no modules yet on memory:lab (heard 0 modules): such a network is inside one program; "
        "tcp-listen: and tcp: join two\n"
    )


async def test_stop_and_reboot_an_r2p_module(capsys: pytest.CaptureFixture[str]) -> None:
    async with robot(hold) as bot, tool() as session:
        await stop(session, "BOT")
        assert bot.stopped
        assert not bot.nodes["hold"].running
        for _ in range(3):
            await reboot(session, "BOT")
            assert bot.nodes["hold"].running
    assert capsys.readouterr().err.count("BOT: rebooted after 0.0 s") == 3


async def test_a_reboot_is_confirmed_by_what_happens_not_by_old_flags(monkeypatch: pytest.MonkeyPatch) -> None:
    """A module that has been rebooted before and ignores the command does not seem to obey."""
    async with robot(hold) as bot, tool() as session:
        await bot.reboot()
        await asyncio.sleep(1)
        monkeypatch.setattr(bot._link_manager, "_on_command", lambda _command: None)
        with pytest.raises(
            TimedOut, match=r"BOT did not confirm REBOOT in 4 s: it is running, last seen .* rebooted before"
        ):
            await reboot(session, "BOT", timeout=4.0)


async def test_a_gateway_that_refuses_an_order_says_so_at_once(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("r2p.transports.url._IP", frozenset({"memory"}))
    gateway = r2p.Module("GW", via=["memory:lab", "memory:bus"], bridge=True)
    async with gateway, r2p.Module("IMU1", via="memory:bus"), tool() as session:
        await asyncio.sleep(3)
        started = asyncio.get_running_loop().time()
        with pytest.raises(r2p.Error, match="gateway GW does not let REBOOT of IMU1 through: it lacks --allow-control"):
            await reboot(session, "IMU1")
        assert asyncio.get_running_loop().time() - started < 0.1
    assert "lacks --allow-control" not in caplog.text, "the command ends with the reason: once is enough"


async def test_an_order_that_a_gateway_may_have_refused_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    async with robot(hold) as bot, tool() as session:
        monkeypatch.setattr(bot._link_manager, "_on_command", lambda _command: None)
        await session.settle()
        (seen,) = (view for view in session.module.network.modules() if view.name == "BOT")
        far = msgspec.structs.replace(seen, link="zenoh:tcp/10.0.0.5:7447")
        monkeypatch.setattr("r2p.tools.module._find", lambda _session, _name: far)
        with pytest.raises(
            TimedOut,
            match=r"did not confirm REBOOT in 4 s: .* gateway is in between, it must have --allow-control",
        ):
            await reboot(session, "BOT", timeout=4.0)


async def test_reboot_waits_for_the_clean_up() -> None:
    cleaned_up: list[float] = []

    async def slow(node: r2p.Node) -> None:
        try:
            await asyncio.Event().wait()
        finally:
            await asyncio.sleep(0.7)
            cleaned_up.append(node.now())

    async with robot(slow) as bot, tool() as session:
        for count in (1, 2):
            await reboot(session, "BOT")
            assert len(cleaned_up) == count
            assert bot.nodes["slow"].running


async def test_orders_to_firmware() -> None:
    async with board() as (power, session):
        await stop(session, "IMU1")
        assert power.module.flags == 1
        await reboot(session, "IMU1")
        await reboot(session, "IMU1")
        assert power.module.flags == 2
        await bootload(session, "IMU1")
        assert power.module.flags == 6
        await reboot(session, "IMU1")
        assert power.module.flags == 2


async def test_a_module_in_its_boot_loader_is_not_stopped() -> None:
    """That would hang it until its power is cut."""
    async with board() as (power, session):
        await bootload(session, "IMU1")
        with pytest.raises(r2p.Error, match=r"IMU1 is in its boot loader, .* reboot it"):
            await stop(session, "IMU1")
        assert not power.module.fault
        await reboot(session, "IMU1")
        await stop(session, "IMU1")


async def test_a_gateway_does_not_stop_a_module_in_its_boot_loader() -> None:
    """Whoever orders it may not know."""
    async with Powered(FirmwareModule("IMU1")) as power:
        power.reset(boot_mode=True)
        gateway = r2p.Module("GW", via=["memory:lab", power.wire()], bridge=True)
        async with gateway, tool() as session:
            await asyncio.sleep(3)
            network("lab").send(Datagram(99, b"R2P", management.encode(management.Stop("IMU1"))))
            await asyncio.sleep(3)
            assert not power.module.fault
            assert gateway.gateway_statistics().ports[0].dropped == {"order refused": 1}
            with pytest.raises(r2p.Error, match="IMU1 is in its boot loader"):
                await stop(session, "IMU1")


async def test_firmware_that_repeats_nothing_confirms_a_new_start() -> None:
    async with board(repeats=False) as (power, session):
        await asyncio.sleep(3)
        await reboot(session, "IMU1")
        assert power.module.flags == 2
        with pytest.raises(TimedOut, match="it is running"):
            await stop(session, "IMU1")
        assert power.module.flags == 3  # stopped, and never says so


async def test_a_lost_order_is_repeated() -> None:
    async with robot(hold) as bot, tool() as session:
        await session.settle()
        network("lab").loss = 1.0
        asyncio.get_running_loop().call_later(3.5, setattr, network("lab"), "loss", 0.0)
        await stop(session, "BOT")
        assert bot.stopped


async def test_a_program_has_no_boot_loader_and_gets_no_command() -> None:
    async with robot(hold) as bot, tool() as session:
        with pytest.raises(r2p.Error, match="BOT is an r2p module, a program without a boot loader"):
            await bootload(session, "BOT")
        assert "BOOTLOAD" not in bot.refused
        assert bot.nodes["hold"].running


async def test_an_unknown_module_is_reported_soon() -> None:
    async with robot(name="ARM"), tool(), tool() as session:
        started = asyncio.get_running_loop().time()
        with pytest.raises(r2p.Error, match=r"no module ARMS on memory:lab; modules found: ARM; did you mean ARM\?$"):
            await stop(session, "ARMS")
        assert asyncio.get_running_loop().time() - started < 1.6


def robot_of_two(number: int) -> tuple[r2p.Module, r2p.Module]:
    """A robot's module ARM, and its gateway to the lab."""
    own = f"memory:robot{number}"
    prefixed = r2p.BridgeOptions(prefix=f"robot{number}/", prefix_on=("memory:lab",))
    return r2p.Module("ARM", via=own), r2p.Module(f"GW{number}", via=[own, "memory:lab"], bridge=prefixed)


async def test_a_name_that_each_robot_has_suggests_all_of_them() -> None:
    async with contextlib.AsyncExitStack() as stack:
        for module in robot_of_two(1) + robot_of_two(2):
            await stack.enter_async_context(module)
        await asyncio.sleep(5.0)
        session = await stack.enter_async_context(tool())
        with pytest.raises(r2p.Error, match=r"did you mean robot1/ARM or robot2/ARM\?$"):
            await stop(session, "ARM")


async def test_firmware_is_waited_for_as_it_announces_itself_seldom(capsys: pytest.CaptureFixture[str]) -> None:
    async with board(age=1.03) as (power, session):
        started = asyncio.get_running_loop().time()
        with pytest.raises(r2p.Error, match=r"no module IMU2 on wire:IMU1; modules found: IMU1; did you mean IMU1\?$"):
            await stop(session, "IMU2")
        assert 4.0 < asyncio.get_running_loop().time() - started < 7.0
        assert power.module.flags == 0
    assert "waiting for IMU2 (firmware announces itself within 5 s) on wire:IMU1" in capsys.readouterr().err


async def test_a_command_may_time_out_before_firmware_was_heard() -> None:
    async with board(age=1.03) as (_, session):
        with pytest.raises(TimedOut, match=r"no module IMU2 on wire:IMU1; .*; gave up after 2 s$"):
            await stop(session, "IMU2", timeout=2.0)


async def test_usage() -> None:
    async with tool() as session:
        with pytest.raises(r2p.NameTooLong):
            await stop(session, "TOOLONG" * 12)
    async with r2p.Module("_tool01", via=[], observer=True) as module:
        with pytest.raises(UsageError, match="give --via"):
            await stop(Session(module, Settings()), "BOT")


async def test_a_module_that_is_late_is_waited_for(capsys: pytest.CaptureFixture[str]) -> None:
    async with tool() as session:
        showing = asyncio.create_task(info(session, "BOT"))
        await asyncio.sleep(3.0)
        async with robot():
            await showing
    assert printed(capsys)[0]["module"] == "BOT"
