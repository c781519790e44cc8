"""The tools beside firmware, which has a heap of 20 kB and breaks where that of 2014 does."""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING

import pytest

import r2p
from r2p.msg import Led, Text, Velocity3
from r2p.sim.modules import FirmwareModule, Powered, Publishes, Subscribes
from r2p.tools.session import Session, Settings, TimedOut
from r2p.tools.topic.echo import echo
from r2p.tools.topic.pub import pub
from r2p.tools.topic.rates import bw, hz
from tests.tools.rig import printed

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable

pytestmark = pytest.mark.virtual_time

LONG = "x" * 60


def imu(*, repeats: bool = True) -> FirmwareModule:
    return FirmwareModule(
        "IMU1",
        publishers=[
            Publishes("leds", Led, 0.1, lambda time: Led(led=time // 100_000_000)),
            Publishes("text", Text, 0.1, lambda _time: Text(text=LONG)),
        ],
        repeats=repeats,
    )


@contextlib.asynccontextmanager
async def beside(module: FirmwareModule, age: float = 0.0) -> AsyncIterator[tuple[Powered, Session]]:
    """A tool that joins the module's line after `age` seconds."""
    async with Powered(module) as power:
        await asyncio.sleep(age)
        async with r2p.Module("_tool01", via=power.wire(), observer=True, watchdog=False) as tool:
            yield power, Session(tool, Settings(via=["wire:IMU1"]))


@pytest.mark.parametrize("measure", [hz, bw])
@pytest.mark.parametrize("topic", ["leds", "text"])
async def test_measuring_leaves_it_alive(
    measure: Callable[..., Awaitable[None]], topic: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """Whatever the queue of the tool itself."""
    async with beside(imu()) as (power, session):
        await measure(session, topic, count=2)
        assert not power.module.fault
        assert power.module.heap_free > 18_000
    assert len(printed(capsys)) == 2


@pytest.mark.parametrize("type", [None, "Led"])
async def test_echo_leaves_it_alive(type: str | None, capsys: pytest.CaptureFixture[str]) -> None:
    async with beside(imu()) as (power, session):
        await echo(session, ["leds"], type=type, count=3)
        assert not power.module.fault
    assert len(printed(capsys)) == 3


async def test_what_it_does_not_announce_needs_a_type(capsys: pytest.CaptureFixture[str]) -> None:
    """A build that repeats nothing, and has been there for longer than the tool."""
    async with beside(imu(repeats=False), age=3) as (power, session):
        with pytest.raises(TimedOut):
            await echo(session, ["leds"], timeout=3)
        captured = capsys.readouterr()
        assert "leds has not been advertised: if its firmware announces nothing, give --type" in captured.err
        assert not power.module.fault
        await echo(session, ["leds"], type="Led", count=1, timeout=0.3)
        assert len(printed(capsys)) == 1
        await hz(session, "text", type="Text", once=True, timeout=2)
        assert len(printed(capsys)) == 1


@pytest.mark.parametrize("behind_gateway", [False, True])
@pytest.mark.parametrize("age", [0.0, 7.3])
async def test_all_that_is_published_arrives(behind_gateway: bool, age: float) -> None:
    """Also through a gateway of firmware, which passes data on after a second round of request and response."""
    motor = FirmwareModule("MOTOR1", subscribers=[Subscribes("cmd", Velocity3)], behind_gateway=behind_gateway)
    async with beside(motor, age) as (power, session):
        await pub(session, "cmd", ["x=1"], type="Velocity3", count=20, rate=100.0)
        await asyncio.sleep(0.1)
        assert power.module.received["cmd"] == 20
        assert not power.module.drops


async def test_firmware_that_does_not_ask_again_gets_it_all_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    motor = FirmwareModule("MOTOR1", subscribers=[Subscribes("cmd", Velocity3)])
    async with beside(motor) as (power, session):
        monkeypatch.setattr(motor, "_on_advertise", lambda _now, _topic: None)
        monkeypatch.setattr(motor, "_repeats", False)
        await pub(session, "cmd", ["x=1"], type="Velocity3", count=3, rate=100.0)
        await asyncio.sleep(0.1)
        assert power.module.received["cmd"] == 3


async def test_a_gateway_asks_as_little_of_it() -> None:
    """For a tool that does not know the type, and has a long queue of its own."""
    async with Powered(imu()) as power:
        gateway = r2p.Module("GW", via=["memory:lab", power.wire()], bridge=True)
        async with gateway, r2p.Module("_tool01", via="memory:lab", observer=True, watchdog=False) as tool:
            session = Session(tool, Settings(via=["memory:lab"]))
            await hz(session, "text", count=2, timeout=10)
            await echo(session, ["leds"], count=2, timeout=10)
            assert not power.module.fault
            assert power.module.heap_free > 18_000
