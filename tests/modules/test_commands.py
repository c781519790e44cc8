"""STOP, REBOOT and BOOTLOAD: from the network, from the program, and from a node itself."""

from __future__ import annotations

import asyncio

import pytest

import r2p
from r2p.codecs.management import FLAG_REBOOTED, FLAG_STOPPED
from r2p.msg import Led
from r2p.protocols.discovery.events import ModuleChanged
from tests.bench import hold, joined, local, settle


@pytest.mark.virtual_time
async def test_stop_ends_the_nodes_and_reboot_starts_them_again() -> None:
    starts = []

    async def counts(node: r2p.Node) -> None:
        starts.append(node.name)
        node.subscribe("leds", Led)
        await asyncio.Event().wait()

    async with joined("A") as a, joined("B") as b:
        b.start(counts)
        waiting = asyncio.create_task(b.wait())
        events = a.events()
        await settle(2.0)
        for _ in range(2):
            a.command(r2p.Command.STOP, "B")
            await settle(2.0)
            assert (b.stopped, b.nodes["counts"].running, waiting.done()) == (True, False, False)
            assert a.links[0].discovery.modules["B"].flags & FLAG_STOPPED  # management goes on
            assert "leds" not in b.space.topics
            with pytest.raises(r2p.Error, match="module B is stopped: call its reboot"):
                b.start(hold)
            a.command(r2p.Command.REBOOT, "B")
            await settle(2.0)
            assert (b.stopped, b.nodes["counts"].running, waiting.done()) == (False, True, False)
            assert a.links[0].discovery.modules["B"].flags == FLAG_REBOOTED
        assert starts == ["counts"] * 3
        assert not a.stopped
        b.nodes["counts"].cancel()
        await waiting
    flags = [event.info.flags async for event in events if isinstance(event, ModuleChanged) and event.info.name == "B"]
    assert flags[-4:] == [FLAG_STOPPED, FLAG_REBOOTED, FLAG_REBOOTED | FLAG_STOPPED, FLAG_REBOOTED]


@pytest.mark.virtual_time
async def test_bootload_is_refused_and_counted(caplog: pytest.LogCaptureFixture) -> None:
    async with joined("A") as a, joined("B") as b:
        b.start(hold)
        await settle(1.0)
        for _ in range(2):
            a.command(r2p.Command.BOOTLOAD, "B")
        await settle(1.0)
        assert b.refused == {"BOOTLOAD": 2}
        assert b.nodes["hold"].running
        assert "BOOTLOAD refused" in caplog.text


@pytest.mark.virtual_time
async def test_a_flood_of_commands_is_logged_once_a_second(caplog: pytest.LogCaptureFixture) -> None:
    async with joined("A") as a, joined("B") as b:
        b.start(hold)
        await settle(1.0)
        for _ in range(300):
            a.command(r2p.Command.STOP, "B")
            a.command(r2p.Command.BOOTLOAD, "B")
            await settle(0.01)
        assert b.refused == {"BOOTLOAD": 300}
    for text in ("STOP from the network", "BOOTLOAD from the network", "BOOTLOAD refused"):
        lines = [each for each in caplog.messages if text in each]
        assert 3 <= len(lines) <= 4
        assert all("more since the last such line)" in each for each in lines[1:])


@pytest.mark.virtual_time
async def test_a_reboot_does_not_end_wait() -> None:
    async with local() as module:
        module.start(hold)
        waiting = asyncio.create_task(module.wait())
        await settle(1.0)
        for _ in range(3):
            await module.reboot()
            await settle(1.0)
            assert not waiting.done()
        waiting.cancel()


@pytest.mark.virtual_time
async def test_of_many_commands_the_last_one_counts_and_each_node_runs_once() -> None:
    running = []

    async def slow(node: r2p.Node) -> None:
        running.append(node)
        assert len(running) == 1
        try:
            await asyncio.Event().wait()
        finally:
            await asyncio.sleep(0.5)
            running.remove(node)

    async with joined("A") as a, joined("B") as b:
        b.start(slow)
        await settle(1.0)
        for last in (r2p.Command.STOP, r2p.Command.REBOOT):
            for command in (r2p.Command.STOP, r2p.Command.REBOOT, r2p.Command.REBOOT, r2p.Command.STOP, last):
                for _ in range(5):
                    a.command(command, "B")
                await settle(0.1)
            await settle(5.0)
            assert len(running) == (last is r2p.Command.REBOOT)
            assert b.stopped == (last is r2p.Command.STOP)
        for _ in range(30):  # while the first one is being obeyed, the others don't pile up
            a.command(r2p.Command.REBOOT, "B")
            await settle(0.01)
            assert len(asyncio.all_tasks()) < 10
        await settle(5.0)
        async with asyncio.TaskGroup() as tasks:
            for _ in range(3):
                tasks.create_task(b.reboot())
        await settle(1.0)
        assert len(running) == 1
    assert not running


@pytest.mark.virtual_time
async def test_closing_during_a_reboot_starts_nothing() -> None:
    async def slow(node: r2p.Node) -> None:
        starts.append(1)
        try:
            await asyncio.Event().wait()
        finally:
            await asyncio.sleep(0.5)

    starts: list[int] = []
    async with local() as module:
        module.start(slow)
        await settle(1.0)
        rebooting = asyncio.create_task(module.reboot())
        await settle(0.1)
    await rebooting
    assert starts == [1]


@pytest.mark.virtual_time
@pytest.mark.parametrize("command", ["stop", "reboot"])
async def test_a_node_may_command_its_own_module(command: str) -> None:
    starts = []

    async def boss(node: r2p.Node) -> None:
        starts.append("boss")
        if len(starts) == 1 or command == "stop":
            await (module.stop() if command == "stop" else module.reboot())
            raise AssertionError("not reached")
        await asyncio.Event().wait()

    async with local() as module:
        module.start(boss)
        others = [module.start(hold, name=name) for name in "abc"]
        await settle(1.0)
        assert all(node.closed for node in others)
        assert [module.nodes[name].running for name in "abc"] == [command == "reboot"] * 3
        assert len(starts) == (2 if command == "reboot" else 1)
