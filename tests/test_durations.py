"""Durations in programs: numbers of seconds, and everything else is refused at once, with what to write instead."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import pytest

import r2p
import r2p.sim
from r2p.bus import BusMonitor
from r2p.msg import Led
from r2p.sim.robots.emulated import Triskar2
from r2p.testing.network import Network
from tests.bench import local, pair

if TYPE_CHECKING:
    from collections.abc import Callable

# What is given as a duration -> what the error says
WRONG: list[tuple[Any, str]] = [
    ("10ms", "not '10ms': write 0.01"),
    ("1.5", "not '1.5': write 1.5"),
    ("soon", "not 'soon'$"),
    (math.nan, "not nan"),
    (math.inf, "not inf"),
    (1e300, "not 1e[+]300"),
    (True, "not True"),
    (b"1", "not b'1'"),
]


@pytest.mark.virtual_time
@pytest.mark.parametrize(("wrong", "text"), WRONG)
async def test_each_duration_is_refused_at_once(wrong: Any, text: str) -> None:
    async with local() as module:
        node, other = pair(module)
        leds = other.subscribe("leds", Led)
        publisher = node.advertise("leds", Led)
        await publisher.publish(Led())  # fetch() could go on with it
        calls: list[Callable[[], Any]] = [
            lambda: node.advertise("a", Led, r2p.NonRealTime(stall=wrong)),
            lambda: node.advertise("a", Led, r2p.Sporadic(deadline=wrong)),
            lambda: node.advertise("a", Led, r2p.Periodic(wrong, Led)),
            lambda: node.advertise("a", Led, r2p.Periodic(1.0, Led, lead=wrong)),
            lambda: node.subscribe("a", Led, max_age=wrong),
            lambda: node.subscribe("a", Led, timeout=wrong),
            lambda: node.every(wrong),
            lambda: r2p.sim.run(local().wait, limit=wrong),
            lambda: Network(delay=wrong),
            lambda: Network(jitter=wrong),
        ]
        for call in calls:
            with pytest.raises(r2p.MessageError, match=text):
                call()
        for wait in (node.spin, leds.fetch, publisher.ready):
            with pytest.raises(r2p.MessageError, match=text):
                await wait(wrong)
        assert not node.subscribers


@pytest.mark.virtual_time
@pytest.mark.parametrize("wrong", [0, -1.0, 1e-9, None])
async def test_a_period_is_a_microsecond_or_more(wrong: Any) -> None:
    async with local() as module:
        node, _ = pair(module)
        with pytest.raises(r2p.MessageError, match=r"period of every.* is in seconds, 1e-06 to 1e[+]09, not"):
            node.every(wrong)


@pytest.mark.virtual_time
@pytest.mark.parametrize("over", [0, 0.0, -1, -1.5, -math.inf])
async def test_a_time_out_that_is_over_is_one(over: float) -> None:
    async with local() as module:
        node, other = pair(module)
        leds = other.subscribe("leds", Led, print)
        with pytest.raises(TimeoutError):
            await leds.fetch(over)
        assert not await other.spin(over)
        node.advertise("leds", Led).publish_nowait(Led(7))
        assert await leds.fetch(over) == Led(7)


@pytest.mark.virtual_time
async def test_watching_a_bus_and_waiting_for_a_robot_take_seconds() -> None:
    with pytest.raises(r2p.MessageError, match=r"write 0\.01"):
        await Triskar2.ready(None, "10ms")  # type: ignore[arg-type]
    with pytest.raises(r2p.MessageError, match=r"write 0\.01"):
        await anext(BusMonitor.loads(None, "10ms"))  # type: ignore[arg-type]
    with pytest.raises(r2p.MessageError, match=r"write 0\.01"):
        await BusMonitor.cycles(None, 1, "10ms")  # type: ignore[arg-type]
