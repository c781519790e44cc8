"""Turtles that draw as those of ROS's turtlesim do. There is no window: the drawing is printed at the end.

r2p run turtles.py:turtlesim --via ros1:        for programs of ROS, and for turtle_client.py
r2p service call spawn x=2 y=2 name=leo --type turtlesim.py:Spawn --via ros1:        a second turtle
rostopic pub -r 10 /leo/cmd_vel geometry_msgs/Twist '{linear: {x: 2}, angular: {z: 1}}'
"""

import math

from turtlesim import SIZE, Pose, SetPen, Spawn

import r2p
from r2p.msg import Velocity3

PERIOD, COLUMNS, ROWS = 0.016, 70, 35  # s, and the size of the drawing in characters


class Turtle:
    def __init__(self, node: r2p.Node, name: str, pose: Pose, drawing: set[tuple[int, int]]) -> None:
        self.pose, self.drawing = pose, drawing
        self.velocity, self.pen = Velocity3(), SetPen.Request()
        node.subscribe(f"{name}/cmd_vel", Velocity3, self.move, timeout=1.0, on_timeout=lambda: self.move(Velocity3()))
        node.serve(f"{name}/set_pen", SetPen, self.set_pen)
        node.advertise(f"{name}/pose", Pose, r2p.Periodic(PERIOD, self.step))

    def move(self, velocity: Velocity3) -> None:
        self.velocity = velocity

    async def set_pen(self, pen: SetPen.Request) -> SetPen.Response:
        self.pen = pen
        return SetPen.Response()

    def step(self) -> Pose:
        speed, turn = self.velocity.x, self.velocity.w
        theta = math.remainder(self.pose.theta + turn * PERIOD, math.tau)
        x, y = self.pose.x + speed * math.cos(theta) * PERIOD, self.pose.y + speed * math.sin(theta) * PERIOD
        self.pose = Pose(max(0.0, min(x, SIZE)), max(0.0, min(y, SIZE)), theta, speed, turn)
        if not self.pen.off:
            self.drawing.add((int(self.pose.x / SIZE * COLUMNS), int(self.pose.y / SIZE * ROWS)))
        return self.pose


async def turtlesim(node: r2p.Node) -> None:
    drawing: set[tuple[int, int]] = set()
    turtles = {"turtle1": Turtle(node, "turtle1", Pose(), drawing)}

    @node.service("spawn", Spawn)
    async def spawn(request: Spawn.Request) -> Spawn.Response:
        name = request.name or f"turtle{len(turtles) + 1}"
        if name in turtles:
            raise r2p.ServiceError(f"there is a turtle {name} already")
        turtles[name] = Turtle(node, name, Pose(request.x, request.y, request.theta), drawing)
        return Spawn.Response(name)

    try:
        while True:
            await node.spin()
    finally:
        for row in reversed(range(ROWS + 1)):
            print("".join(" *"[(column, row) in drawing] for column in range(COLUMNS + 1)).rstrip())
