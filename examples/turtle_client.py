"""A second turtle draws a star in ROS's turtlesim, or in turtles.py: two services, a topic out and a topic in.

r2p run turtle_client.py:star --via ros1:
"""

import contextlib
import math

from turtlesim import SIZE, Pose, SetPen, Spawn

import r2p
from r2p.msg import Velocity3

NAME = "leo"
CORNERS = [
    (SIZE / 2 + 4 * math.cos(angle), SIZE / 2 + 4 * math.sin(angle))
    for angle in (math.pi / 2 + corner * 4 / 5 * math.pi for corner in range(6))
]
NEAR = 0.1


def towards(target: tuple[float, float], pose: Pose) -> Velocity3:
    """Turn until the target is in front, then go there."""
    x, y = target[0] - pose.x, target[1] - pose.y
    turn = math.remainder(math.atan2(y, x) - pose.theta, math.tau)
    speed = min(3.0, 2 * math.hypot(x, y)) if abs(turn) < 0.1 else 0.0
    return Velocity3(x=speed, w=4 * turn)


async def star(node: r2p.Node) -> None:
    spawn, set_pen = node.client("spawn", Spawn), node.client(f"{NAME}/set_pen", SetPen)
    x, y = CORNERS[0]
    await spawn.ready(timeout=5.0)
    with contextlib.suppress(r2p.ServiceError):  # it is there, from an earlier run
        await spawn.call(Spawn.Request(x, y, theta=-math.pi / 2, name=NAME), timeout=5.0)
    await set_pen.ready(timeout=5.0)
    await set_pen.call(SetPen.Request(r=255, width=3), timeout=5.0)
    commands = node.advertise(f"{NAME}/cmd_vel", Velocity3)
    target = 1
    async for pose in node.subscribe(f"{NAME}/pose", Pose, queue=1, lossy=True):
        if math.dist(CORNERS[target], (pose.x, pose.y)) < NEAR:
            target += 1
            if target == len(CORNERS):
                break
        await commands.publish(towards(CORNERS[target], pose))
    await commands.publish(Velocity3())
    node.log.info("the star is done")


if __name__ == "__main__":
    r2p.run(star)
