"""A PC drives an omnidirectional robot along a square, by the robot's own odometry.

r2p sim triskar2 --via tcp-listen:2323                   in one terminal
r2p run square.py:square --via tcp:127.0.0.1:2323        in another one
"""

import itertools
import math

import r2p
from r2p.msg import Odometry, Pose3, Velocity3

CORNERS = ((1.0, 0.0), (1.0, 1.0), (0.0, 1.0), (0.0, 0.0))  # m, where the robot was switched on
SPEED = 0.4  # m/s
NEAR = 0.03  # m


def towards(target: tuple[float, float], pose: Pose3) -> Velocity3:
    """The velocity, in the robot's frame, that leads there; slower close to it, and without turning."""
    x, y = target[0] - pose.x, target[1] - pose.y
    speed = min(SPEED, 1.5 * math.hypot(x, y))
    direction = math.atan2(y, x) - pose.w
    return Velocity3(x=speed * math.cos(direction), y=speed * math.sin(direction), w=-pose.w)


async def square(node: r2p.Node) -> None:
    commands = node.advertise("velocity_cmd", Velocity3, r2p.Sporadic(deadline=0.05))
    corners = itertools.cycle(CORNERS)
    target = next(corners)
    # The newest position only: when odometry stops coming, so do commands, and the robot stops by itself.
    async for odometry in node.subscribe("odometry", Odometry, queue=1, lossy=True):
        pose = odometry.pose
        if math.dist(target, (pose.x, pose.y)) < NEAR:
            node.log.info("corner %s reached", target)
            target = next(corners)
        await commands.publish(towards(target, pose))


if __name__ == "__main__":
    r2p.run(square, module="PC1")
