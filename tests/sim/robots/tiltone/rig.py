"""A balancing robot under virtual time, and a PC that drives it."""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING, Any

import r2p
from r2p.msg import Velocity3
from r2p.sim.robots.tiltone.robot import TiltOne

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

VIA = "memory:robot"


class Rider:
    """A node on a computer that drives the robot: `x` m/s ahead, and `w` rad/s to the left."""

    def __init__(self) -> None:
        self.x = self.w = 0.0

    async def __call__(self, node: r2p.Node) -> None:
        commands = node.advertise("velocity", Velocity3, r2p.Sporadic(deadline=0.05))
        async for _ in node.every(0.05):
            await commands.publish(Velocity3(x=self.x, w=self.w))


@contextlib.asynccontextmanager
async def standing(via: str = VIA, **options: Any) -> AsyncIterator[tuple[TiltOne, Rider]]:
    """A robot that balances, and its rider."""
    rider = Rider()
    async with TiltOne(via, **options) as robot, r2p.Module("PC1", via=via) as pc:
        pc.start(rider, name="rider")
        await robot.ready()
        await asyncio.sleep(1)  # until its controllers trust that it is upright
        robot.let_go()
        yield robot, rider
