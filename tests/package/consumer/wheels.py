"""A program of a user who checks types strictly: `test_package` does, against the installed package."""

from typing import assert_type

import r2p
from r2p.msg import Encoder, Led


class Wheel(r2p.Message):
    speed: r2p.f32
    slips: bool = False


async def drive(node: r2p.Node) -> None:
    wheels = node.advertise("wheel", Wheel, r2p.Sporadic(deadline=0.05))
    async for tick in node.every(0.1):
        await wheels.publish(Wheel(speed=tick.late))
        await wheels.publish(Led(led=3))  # type: ignore[arg-type]  # a mistake that checkers find


async def watch(node: r2p.Node) -> None:
    async for encoder in node.subscribe("encoder", Encoder):
        assert_type(encoder, Encoder)
        assert_type(encoder.delta, float)
