"""Emulated modules at work with real ones: by a wire under virtual time, by TCP and by a pseudo terminal."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import socket
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

import r2p
from r2p.msg import Led, Velocity3
from r2p.sim.modules import FirmwareModule, Powered, Publishes, Subscribes
from r2p.sim.modules.power import BUFFER

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from r2p.sim.modules import Wire
    from r2p.transports.link import Transport

pytestmark = pytest.mark.one_loop


def imu() -> FirmwareModule:
    """Counts its messages, and gives commands back."""
    count = iter(range(1_000_000))
    return FirmwareModule(
        "IMU1",
        publishers=[Publishes("leds", Led, 0.1, lambda _time: Led(led=next(count))), Publishes("echo", Velocity3)],
        subscribers=[Subscribes("cmd", Velocity3, answer=lambda command: [("echo", command)])],
    )


async def hold(node: r2p.Node) -> None:
    await asyncio.Event().wait()


@contextlib.asynccontextmanager
async def pc(via: str | Transport, name: str = "PC1") -> AsyncIterator[r2p.Module]:
    async with r2p.Module(name, via=via) as module:
        yield module


async def converse(module: r2p.Module) -> None:
    """Both directions work."""
    node = module.start(hold)
    leds, echo = node.subscribe("leds", Led), node.subscribe("echo", Velocity3)
    commands = node.advertise("cmd", Velocity3)
    first = await leds.fetch()
    assert (await leds.fetch()).led == first.led + 1
    await commands.wait_subscriber()
    await echo.wait_publisher()
    await commands.publish(Velocity3(x=0.5))
    assert await echo.fetch() == Velocity3(x=0.5)


@contextlib.asynccontextmanager
async def wired(firmware: FirmwareModule) -> AsyncIterator[tuple[Powered, Wire, r2p.Module]]:
    async with Powered(firmware) as power:
        wire = power.wire()
        async with pc(wire) as module:
            yield power, wire, module


@pytest.mark.virtual_time
async def test_by_a_wire_under_virtual_time() -> None:
    async with wired(imu()) as (_, _, module):
        await converse(module)
        assert [view.name for view in module.network.modules()] == ["PC1", "IMU1"]
        assert module.links[0].name == "wire:IMU1"


@pytest.mark.virtual_time
async def test_firmware_uses_topics_of_long_names_by_their_aliases() -> None:
    """As docs/PROTOCOL.md 1 says; one of the aliases is chosen."""
    command, echo = "front_left/wheel/velocity_command", "front_left/wheel/velocity_estimate"
    firmware = FirmwareModule(
        "WHEEL1",
        publishers=[Publishes("front_left_w446v", Velocity3)],
        subscribers=[Subscribes("fl_cmd", Velocity3, answer=lambda said: [("front_left_w446v", said)])],
    )
    async with Powered(firmware) as power, r2p.Module("PC1", via=power.wire(), aliases={command: "fl_cmd"}) as module:
        node = module.start(hold)
        commands, echoes = node.advertise(command, Velocity3), node.subscribe(echo, Velocity3)
        await commands.wait_subscriber()
        await echoes.wait_publisher()
        await commands.publish(Velocity3(x=0.5))
        sample = await anext(echoes.samples())
        assert (sample.message, sample.source.module) == (Velocity3(x=0.5), "WHEEL1")
        assert set(module.network.topics()) == {command, echo, "log"}
        assert not firmware.drops


@pytest.mark.virtual_time
async def test_nothing_is_lost_on_a_wire() -> None:
    async with wired(imu()) as (power, _, module):
        leds = module.start(hold).subscribe("leds", Led, queue=1000)
        await asyncio.sleep(20.05)
        assert len(leds.queue) == power.module.sent["leds"] > 180
        assert not power.module.drops


@pytest.mark.virtual_time
async def test_a_pulled_wire_is_a_link_that_is_down() -> None:
    async with wired(imu()) as (power, wire, module):
        leds = module.start(hold).subscribe("leds", Led, queue=1000)
        await asyncio.sleep(2)
        wire.pull()
        wire.pull()
        received = len(leds.queue)
        sent = power.module.sent["leds"]
        await asyncio.sleep(2)
        assert not module.links[0].up
        assert len(leds.queue) == received
        assert power.module.sent["leds"] == sent + 20  # firmware does not notice
        wire.plug_in()
        wire.plug_in()
        await asyncio.sleep(2.01)
        assert module.links[0].up
        assert len(leds.queue) == received + 20


@pytest.mark.virtual_time
async def test_a_reset_is_a_new_start() -> None:
    async with wired(imu()) as (power, _, module):
        await converse(module)
        leds = module.nodes["hold"].node.subscribe("leds", Led)
        power.module.sent.clear()
        power.reset(boot_mode=True)
        await asyncio.sleep(0.1)
        assert module.network.modules()[1].state == "boot"
        power.reset()
        await leds.fetch()
        assert module.network.modules()[1].state == "running"


@pytest.mark.virtual_time
async def test_publishing_by_hand() -> None:
    async with wired(imu()) as (power, _, module):
        echo = module.start(hold).subscribe("echo", Velocity3)
        await echo.wait_publisher()
        power.publish("echo", Velocity3(w=1.0))
        assert await echo.fetch() == Velocity3(w=1.0)
        with pytest.raises(r2p.Error, match="no publisher of nothing"):
            power.publish("nothing", Led())


@pytest.mark.virtual_time
async def test_a_slow_reader_gets_everything_from_a_wire_all_the_same() -> None:
    """The link pauses the wire while it hands out what has come."""
    firmware = FirmwareModule("IMU1", publishers=[Publishes("leds", Led)])
    async with wired(firmware) as (power, _, module):
        leds = module.start(hold).subscribe("leds", Led, queue=1000)
        await leds.wait_publisher()
        for number in range(500):
            power.publish("leds", Led(led=number))
        assert [(await leds.fetch()).led for _ in range(500)] == list(range(500))


@pytest.mark.virtual_time
async def test_a_wire_without_a_module() -> None:
    async with Powered(imu()) as power:
        with pytest.raises(r2p.Broken, match="give it to a Module"):
            power.wire().plug_in()


@pytest.mark.virtual_time
async def test_power_that_goes_off_takes_the_wire_down() -> None:
    power = Powered(imu())
    async with power:
        wire = power.wire()
        module = await contextlib.AsyncExitStack().enter_async_context(pc(wire))
    assert not module.links[0].up
    await module.__aexit__(None, None, None)


@pytest.mark.anyio
async def test_by_tcp() -> None:
    async with Powered(imu()) as power:
        host, port = await power.listen()
        async with pc(f"tcp:{host}:{port}") as module:
            await converse(module)


@pytest.mark.anyio
@pytest.mark.skipif(sys.platform == "win32", reason="no pseudo terminals")
async def test_by_a_pseudo_terminal() -> None:
    async with Powered(imu()) as power, pc(f"serial:{power.open_pty()}") as module:
        await converse(module)


@pytest.mark.anyio
@pytest.mark.skipif(sys.platform == "win32", reason="no pseudo terminals")
async def test_several_can_talk_to_it_at_once() -> None:
    async with Powered(imu()) as power:
        host, port = await power.listen()
        device = power.open_pty()
        async with (
            pc(f"tcp:{host}:{port}") as one,
            pc(f"tcp:{host}:{port}", "PC2") as two,
            pc(f"serial:{device}") as three,
        ):
            await asyncio.gather(*(converse(module) for module in (one, two, three)))


@pytest.mark.anyio
async def test_half_a_line_of_one_client_does_not_spoil_the_other() -> None:
    async with Powered(imu()) as power:
        host, port = await power.listen()
        _, half = await asyncio.open_connection(host, port)
        half.write(b"@0000")
        await half.drain()
        async with pc(f"tcp:{host}:{port}") as module:
            await converse(module)
        assert not power.module.drops
        half.close()


@pytest.mark.anyio
@pytest.mark.skipif(sys.platform == "win32", reason="no pseudo terminals")
async def test_who_does_not_read_holds_nobody_up() -> None:
    """Neither on TCP nor on a pseudo terminal: what does not go is lost, and memory does not grow."""
    firmware = FirmwareModule("IMU1", publishers=[Publishes("leds", Led)])
    async with Powered(firmware) as power:
        host, port = await power.listen()
        power.open_pty()
        with socket.create_connection((host, port)):
            async with pc(f"tcp:{host}:{port}") as module:
                leds = module.start(hold).subscribe("leds", Led, lossy=True)
                await leds.wait_publisher()
                for number in itertools.count():
                    power.publish("leds", Led(led=number))
                    if number % 100 == 0:
                        await asyncio.sleep(0)
                    if number > 50_000 and leds.queue and (await leds.fetch()).led > 50_000:
                        break
                assert max(end.waiting for end in power._ends) < 2 * BUFFER


@pytest.mark.anyio
@pytest.mark.skipif(sys.platform == "win32", reason="no pseudo terminals")
async def test_it_leaves_nothing_open() -> None:
    def descriptors() -> int:
        return len(list(Path("/dev/fd").iterdir()))

    open_after = []
    for _ in range(3):  # a loop opens some for itself at first use
        async with Powered(imu()) as power:
            host, port = await power.listen()
            power.open_pty()
            async with pc(f"tcp:{host}:{port}") as module:
                await module.start(hold).subscribe("leds", Led).fetch()
        open_after.append(descriptors())
    assert open_after[2] <= open_after[1]  # what another test has left may be gone meanwhile
