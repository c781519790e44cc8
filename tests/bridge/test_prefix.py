"""A gateway's prefix covers topics, modules and nodes: several robots on one network stay apart."""

from __future__ import annotations

import asyncio
import logging
from contextlib import AsyncExitStack, asynccontextmanager
from types import SimpleNamespace
from typing import TYPE_CHECKING

import pytest

import r2p
from r2p.bridge import BridgeOptions
from r2p.bridge.options import Policy
from r2p.bridge.orders import ModuleNames
from r2p.codecs import management
from r2p.msg import Led
from r2p.names import module_alias
from r2p.protocols.discovery.events import Command
from r2p.runtime.events import LinkNotice
from r2p.testing.network import node_in
from tests.bridge.test_bridge import CONVERGED, Tap

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

pytestmark = pytest.mark.virtual_time


@asynccontextmanager
async def robots(*names: str, prefix: str = "{}/") -> AsyncIterator[list[r2p.Module]]:
    """Robots with a module MOTOR1 and a gateway each, to the network `lab`."""
    async with AsyncExitStack() as stack:
        motors = []
        for number, name in enumerate(names):
            options = BridgeOptions(prefix=prefix.format(name), prefix_on=("memory:lab",))
            via = [f"memory:{name}", "memory:lab"]
            await stack.enter_async_context(r2p.Module(f"GW{number}", via=via, bridge=options))
            motors.append(await stack.enter_async_context(r2p.Module("MOTOR1", via=f"memory:{name}")))
        await asyncio.sleep(CONVERGED)
        yield motors


def seen(module: r2p.Module) -> set[str]:
    return {view.name for view in module.network.modules() if view.link}


@pytest.mark.parametrize("prefix", ["{}/", "{}_"])
async def test_two_robots_with_the_same_modules(prefix: str, caplog: pytest.LogCaptureFixture) -> None:
    one, two = (f"{prefix.format(name)}MOTOR1" for name in ("robot1", "robot2"))
    async with (
        robots("robot1", "robot2", prefix=prefix) as (motor1, motor2),
        r2p.Module("PC", via="memory:lab") as pc,
        node_in(motor1, name="drive") as drive,
    ):
        drive.advertise("leds", Led)
        await asyncio.sleep(10)
        assert seen(pc) == {"GW0", "GW1", one, two}
        assert (one, "drive") in pc.network.nodes()
        pc.command(Command.STOP, two)
        await asyncio.sleep(0.1)
        assert (motor1.stopped, motor2.stopped) == (False, True)
        pc.command(Command.STOP, "MOTOR1")
        await asyncio.sleep(0.1)
        assert not motor1.stopped
        states = {view.name: view.state for view in pc.network.modules()}
        assert (states[one], states[two]) == ("running", "stopped")
        if prefix.endswith("/"):
            assert seen(motor1) == {"GW0", "PC", "GW1"}
    assert not [record for record in caplog.records if record.levelno >= logging.WARNING and "name" in record.message]


async def test_a_module_that_goes_is_gone_under_its_long_name() -> None:
    async with robots("robot1") as (motor,), r2p.Module("PC", via="memory:lab") as pc:
        await asyncio.sleep(1)
        assert "robot1/MOTOR1" in seen(pc)
        await motor.__aexit__(None, None, None)
        await asyncio.sleep(0.1)
        assert seen(pc) == {"GW0"}


async def test_long_names_behind_a_prefix() -> None:
    """On each network a topic has the alias of its name there; programs and tools see names only."""
    topic, name = "front_left/wheel/velocity", "front_left_wheel_controller"
    async with (
        robots("robot1") as (motor,),
        r2p.Module(name, via="memory:robot1") as wheel,
        r2p.Module("laptop_of_the_lab", via="memory:lab") as pc,
        node_in(wheel, name="velocity_estimator") as estimator,
        node_in(motor, name="watcher") as watcher,
        node_in(pc, name="plot_the_velocity") as plot,
    ):
        out, back = estimator.advertise(topic, Led), plot.advertise(f"robot1/{topic}_command", Led)
        here, there = watcher.subscribe(topic, Led), plot.subscribe(f"robot1/{topic}", Led)
        commands = estimator.subscribe(f"{topic}_command", Led)
        await asyncio.sleep(2)
        await out.publish(Led(led=1))
        await back.publish(Led(led=2))
        assert [await each.fetch(1.0) for each in (here, there, commands)] == [Led(led=1), Led(led=1), Led(led=2)]
        await out.publish(Led(led=3))
        sample = await anext(there.samples())
        assert (sample.source.module, sample.source.node) == (f"robot1/{name}", "velocity_estimator")
        assert set(pc.network.topics()) == {f"robot1/{topic}", f"robot1/{topic}_command", "robot1/log", "log"}
        assert (f"robot1/{name}", "velocity_estimator") in pc.network.nodes()
        assert ("laptop_of_the_lab", "plot_the_velocity") in motor.network.nodes()
        pc.command(Command.STOP, f"robot1/{name}")
        await asyncio.sleep(0.1)
        assert (wheel.stopped, motor.stopped) == (True, False)


async def test_firmware_behind_a_prefix() -> None:
    async with robots("robot1"), r2p.Module("PC", via="memory:lab") as pc:
        imu = Tap("robot1")
        imu.say(management.Alive("IMU1"))
        await asyncio.sleep(1)
        assert "robot1/IMU1" in seen(pc)
        pc.command(Command.REBOOT, "robot1/IMU1")
        await asyncio.sleep(0.1)
        assert imu.orders() == [management.Reboot("IMU1")]


async def test_modules_of_the_network_are_seen_by_the_robot_unless_it_has_one_of_the_name() -> None:
    async with (
        robots("robot1") as (motor,),
        r2p.Module("PC", via="memory:lab") as pc,
        r2p.Module("MOTOR1", via="memory:lab") as other,
    ):
        await asyncio.sleep(3)
        assert "PC" in seen(motor)
        motor.command(Command.STOP, "PC")
        pc.command(Command.STOP, "MOTOR1")
        await asyncio.sleep(0.1)
        assert (pc.stopped, motor.stopped, other.stopped) == (True, False, True)
        assert {view.instance for view in pc.network.modules() if "MOTOR1" in view.name} == {
            motor.instance,
            other.instance,
        }


async def test_who_orders_what_is_denied_is_told_the_long_name(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("r2p.transports.url._IP", frozenset({"memory"}))
    async with robots("robot1"), r2p.Module("PC", via="memory:lab") as pc:
        events = pc.events()
        await asyncio.sleep(1)
        pc.command(Command.REBOOT, "robot1/MOTOR1")
        await asyncio.sleep(0.1)
    texts = [event.text async for event in events if isinstance(event, LinkNotice) and "denied" in event.kind]
    assert texts == ["gateway GW0 does not let REBOOT of robot1/MOTOR1 through: it lacks --allow-control"]


async def test_what_an_alias_stands_for_may_come_after_it() -> None:
    async with r2p.Module("PC", via="memory:lab") as pc:
        tap = Tap("lab")
        alias = module_alias("robot1/IMU1")
        tap.say(management.Alive(alias))
        await asyncio.sleep(0.1)
        assert seen(pc) == {alias}
        tap.say(management.Name(alias, 0, "robot1/IMU1"))
        await asyncio.sleep(0.1)
        assert seen(pc) == {"robot1/IMU1"}


def test_an_alias_of_two_modules_is_nobodys(caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("r2p.bridge.orders.module_alias", lambda name: "robxxxx")
    directory = SimpleNamespace(own_modules=lambda: ["A", "B"])
    names = ModuleNames(Policy(BridgeOptions(prefix="robot1/")), directory)  # type: ignore[arg-type]
    assert names.to_canonical("robxxxx", "zenoh:") is None
    assert names.to_canonical("robxxxx", "zenoh:") is None
    assert [record.message for record in caplog.records] == [
        "robot1/A and robot1/B have the same alias robxxxx: orders reach neither; rename one"
    ]
