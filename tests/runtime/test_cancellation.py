"""A program cancelled at any await leaves nothing behind."""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING, Any

import pytest

import r2p
from r2p.msg import Led
from r2p.sim import run
from tests.bench import joined, led, settle

if TYPE_CHECKING:
    from collections.abc import Iterator


async def scenario(opened: list[r2p.Module]) -> None:
    """Two modules that do a bit of everything."""

    async def busy(node: r2p.Node) -> None:
        states = node.advertise("state", Led, r2p.NonRealTime(stall=0.5), latch=True)
        events = node.advertise("event", Led, r2p.Sporadic(0.02))
        node.advertise("cycle", Led, r2p.Periodic(0.01, Led))
        async for _ in node.every(0.01):
            await states.publish(led(1))
            await events.publish(led(2))

    async def slow(node: r2p.Node) -> None:
        node.subscribe("event", Led, lambda message: None, queue=1)
        async with node.subscribe("state", Led, queue=1, timeout=5.0) as states:
            for _ in range(3):
                await states.fetch(1.0)
                await node.spin(0.005)
            async for _ in states:
                await asyncio.sleep(0.02)

    async def fragile(node: r2p.Node) -> None:
        await node.subscribe("cycle", Led).fetch()
        raise ValueError

    async with joined("A") as a:
        opened.append(a)
        async with joined("B") as b:
            opened.append(b)
            for module in (a, b):
                module.start(busy)
                module.start(slow, priority=2)
                module.start(fragile, restart=True)
            await asyncio.sleep(0.15)
            await b.stop()
            await b.reboot()
            await asyncio.sleep(0.15)


def run_and_cancel(at: int, *again: int) -> tuple[int, list[str]]:
    """Cancel the scenario in these turns of the loop; gives the turns that it took, and what was left of it."""
    opened: list[r2p.Module] = []
    turns = 0

    async def main() -> list[str]:
        loop: Any = asyncio.get_running_loop()
        task = asyncio.create_task(scenario(opened))
        run_once = loop._run_once

        def count() -> None:
            nonlocal turns
            turns += not task.done()
            if turns in {at, *again}:
                task.cancel()
            run_once()

        loop._run_once = count
        await asyncio.wait([task])
        loop._run_once = run_once
        assert task.cancelled() == (at <= turns)
        await settle()
        return list(leftovers(loop, opened))

    left = run(main)
    return turns, left


def leftovers(loop: Any, opened: list[r2p.Module]) -> list[str]:
    left = [f"task {task.get_name()}" for task in asyncio.all_tasks() if task is not asyncio.current_task()]
    left += [f"timer {timer!r}" for timer in loop._scheduled if not timer.cancelled()]
    for module in opened:
        if hasattr(module, "space"):
            left += [f"topic {name} of {module.name}" for name in module.space.topics]
            left += [f"link {link.name} of {module.name}" for link in module.links]
            left += [f"priorities of {module.name}"] if module.space.wake_scheduler._priorities else []
        left += [f"node {name}" for name, each in module.nodes.items() if each.running or not each.node.closed]
    return left


@pytest.fixture
def silent() -> Iterator[None]:
    """Formatting thousands of tracebacks would take longer than the tests."""
    logging.disable()
    yield
    logging.disable(logging.NOTSET)


@pytest.mark.usefixtures("silent")
def test_cancelled_at_any_await_nothing_is_left() -> None:
    total, left = run_and_cancel(10**9)
    assert left == []
    assert total > 100
    for at in range(1, total + 1):
        turns, left = run_and_cancel(at)
        assert left == [], f"cancelled in turn {at} of {turns}"


@pytest.mark.usefixtures("silent")
@pytest.mark.parametrize("later", [1, 2, 5])
def test_nor_when_it_is_cancelled_again_while_it_ends(later: int) -> None:
    total, _ = run_and_cancel(10**9)
    for at in range(1, total + 1, 7):
        turns, left = run_and_cancel(at, at + later)
        assert left == [], f"cancelled in turns {at} and {at + later} of {turns}"
