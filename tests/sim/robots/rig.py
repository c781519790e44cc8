"""A robot under virtual time, and what the tests measure."""

from __future__ import annotations

import asyncio
import contextlib
import math
from typing import TYPE_CHECKING

from r2p.msg import Odometry
from r2p.sim.robots.triskar2 import REST
from r2p.testing.network import node_in

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    import r2p
    from r2p.runtime.subscriber import Subscriber
    from r2p.sim.robots.emulated import Triskar2

WAIT = 5.0
"""Seconds that networks get to find themselves."""


def lap_time(side: float, speed: float) -> float:
    return 4 * (side / speed + REST)


@contextlib.asynccontextmanager
async def odometry_of(module: r2p.Module) -> AsyncIterator[Subscriber[Odometry]]:
    """The newest odometry, in a queue of one."""
    async with node_in(module, name="watch") as node:
        yield node.subscribe("odometry", Odometry, queue=1, lossy=True)


async def until_at_rest(robot: Triskar2, *, limit: float = 5.0) -> float:
    """Seconds until no wheel turns any more."""
    loop = asyncio.get_running_loop()
    start = loop.time()
    while any(abs(motor.speed) > 0.05 for motor in robot.hardware.motors):
        assert loop.time() - start < limit, "the robot does not stop"
        await asyncio.sleep(0.01)
    return loop.time() - start


async def until_driving(robot: Triskar2, *, speed: float = 0.3, limit: float = 10.0) -> float:
    """Seconds until it goes faster than `speed` m/s."""
    loop = asyncio.get_running_loop()
    start = loop.time()
    while math.hypot(*robot.hardware.body.velocity[:2]) < speed:
        assert loop.time() - start < limit, "the robot does not drive"
        await asyncio.sleep(0.01)
    return loop.time() - start
