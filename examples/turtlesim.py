"""Types of ROS's turtlesim, for turtles.py and turtle_client.py.

A type's package is its file, so these are turtlesim/Pose, turtlesim/Spawn and turtlesim/SetPen in ROS as well. The
fields are what `r2p msg import` prints for the .msg and .srv files of turtlesim.
"""

from typing import Annotated

import r2p

SIZE = 11.088889
"""Width and height of the sheet that the turtles draw on."""

Name = Annotated[str, r2p.Max(64)]


class Pose(r2p.Message):
    x: r2p.f32 = SIZE / 2
    y: r2p.f32 = SIZE / 2
    theta: r2p.f32 = 0.0
    linear_velocity: r2p.f32 = 0.0
    angular_velocity: r2p.f32 = 0.0


class Spawn(r2p.Service):
    class Request(r2p.Message):
        x: r2p.f32 = 0.0
        y: r2p.f32 = 0.0
        theta: r2p.f32 = 0.0
        name: Name = ""

    class Response(r2p.Message):
        name: Name = ""


class SetPen(r2p.Service):
    class Request(r2p.Message):
        r: r2p.u8 = 0
        g: r2p.u8 = 0
        b: r2p.u8 = 0
        width: r2p.u8 = 0
        off: r2p.u8 = 0

    class Response(r2p.Message):
        pass
