"""A node that drives a robot along a square by the clock, so that command and position can be compared."""

import r2p
from r2p.msg import Velocity3
from r2p.sim.robots import triskar2
from r2p.sim.robots.latest import Traffic, sender

REST = 0.5
"""Seconds that the robot rests at each corner."""
DIRECTIONS = ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))


def velocity_at(elapsed: float, *, side: float, speed: float) -> Velocity3:
    """Return the command `elapsed` seconds after the start: sides of `side` m at `speed` m/s, without turning."""
    leg, within = divmod(elapsed, side / speed + REST)
    if elapsed < 0 or within >= side / speed:
        return Velocity3()
    x, y = DIRECTIONS[int(leg) % len(DIRECTIONS)]
    return Velocity3(x=speed * x, y=speed * y)


async def square(
    node: r2p.Node,
    side: float = 1.0,
    speed: float = 0.5,
    laps: float = float("inf"),
    traffic: Traffic = "srt",
    wait: float = 1.0,
) -> None:
    """Publish `velocity_cmd`: after `wait` seconds drive `laps` laps, and then stand still."""
    start = node.now()
    lap = len(DIRECTIONS) * (side / speed + REST)

    def command() -> Velocity3:
        elapsed = (node.now() - start) / 1e9 - wait
        return velocity_at(elapsed, side=side, speed=speed) if elapsed < laps * lap else Velocity3()

    send = sender(node, "velocity_cmd", Velocity3, command, traffic=traffic, period=triskar2.PERIOD)
    async for _ in node.every(triskar2.COMMANDS):
        send()
