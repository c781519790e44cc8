"""Drives a robot with a joystick of Linux (`/dev/input/js0`): a node for a PC.

    r2p run r2p.sim.robots.robocom.joystick:joystick --via tcp:127.0.0.1:2323

The stick moves the robot and turns it. When it is unplugged the robot stops, and once it is back it has to be released
before it drives again. Instead of a device there may be a pipe, or a file that was recorded with `cat`.
"""

import errno
import math
import os
import stat
import struct
from typing import Final

import r2p
from r2p.msg import Velocity3
from r2p.sim.robots.shared_nodes import COMMANDS

_EVENT: Final = struct.Struct("<IhBB")  # of the kernel's joystick interface: time (ms), value, type, number
_AXIS, _INITIAL = 2, 128  # bits of the type; initial: not a movement, but where it is when the device is opened
_FULL = 32767
_READ_MAX = 64 * _EVENT.size  # bytes
_LOOK_EVERY = 10  # periods of commands between two looks for the device
_RIGHT, _BACK = 0, 1  # the axes of the first stick: to the right, and towards the user


class Joystick:
    """An open joystick. Raises OSError if the device is not there."""

    def __init__(self, path: str) -> None:
        self.axes: dict[int, float] = {}
        """-1 to 1, by number."""
        self._fd = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
        self._is_file = stat.S_ISREG(os.fstat(self._fd).st_mode)
        self._start: int | None = None  # ms: the first time in a file
        self._held = b""

    def close(self) -> None:
        """Close the device."""
        os.close(self._fd)

    def poll(self, elapsed: float) -> None:
        """Read what has happened; a file is read only as far as `elapsed` s. Raises OSError when the device is gone."""
        while True:
            try:
                data = b"" if len(self._held) >= _EVENT.size else os.read(self._fd, _READ_MAX)
            except BlockingIOError:  # nothing new
                return
            if not data and len(self._held) < _EVENT.size:  # the end of a file, or of who wrote to a pipe
                raise OSError(errno.ENODEV, os.strerror(errno.ENODEV))
            self._held += data
            while len(self._held) >= _EVENT.size:
                time, value, kind, number = _EVENT.unpack_from(self._held)
                self._start = time if self._start is None else self._start
                if self._is_file and time - self._start > elapsed * 1000:
                    return
                self._held = self._held[_EVENT.size :]
                if kind & ~_INITIAL == _AXIS:
                    self.axes[number] = max(-1.0, value / _FULL)


async def joystick(node: r2p.Node) -> None:
    """Publish `velocity` as the stick says, while there is one."""
    device = node.parameter("device", "/dev/input/js0", doc="The joystick: a device, a pipe or a recorded file")
    speed = node.parameter("speed", 0.6, min=0.0, max=2.0, unit="m/s", doc="Forward, with the stick at its end")
    turn = node.parameter("turn", 1.0, min=0.0, max=5.0, unit="rad/s", doc="Turning, with the stick at its end")
    dead = node.parameter("dead_zone", 0.1, min=0.0, max=0.9, doc="Share of the stick's way around its middle")
    commands = node.advertise("velocity", Velocity3, r2p.Sporadic(deadline=COMMANDS))
    stick: Joystick | None = None
    released, known_missing, looks, began = False, False, 0, 0
    try:
        async for tick in node.every(COMMANDS):
            looks -= 1
            try:
                if stick is None:
                    if looks > 0:
                        continue
                    looks = _LOOK_EVERY
                    stick, released, began = Joystick(device.value), False, tick.due
                    stick.poll(0.0)
                    node.log.info("joystick %s is there: it drives once the stick is released", device.value)
                    known_missing = False
                else:
                    stick.poll((tick.due - began) / 1e9)
            except OSError as error:
                if stick is not None:
                    stick.close()
                    stick = None
                if not known_missing:
                    node.log.warning("joystick %s: %s: the robot stops until it is there", device.value, error.strerror)
                    await commands.publish(Velocity3())
                known_missing = True
                continue
            x, w = (_beyond(-stick.axes.get(axis, 0.0), dead.value) for axis in (_BACK, _RIGHT))
            released = released or x == w == 0.0
            await commands.publish(Velocity3(x=x * speed.value, w=w * turn.value) if released else Velocity3())
    finally:
        if stick is not None:
            stick.close()


def _beyond(value: float, dead: float) -> float:
    """Return how far a stick is beyond its dead zone: 0 to 1, or to -1."""
    return math.copysign(max(0.0, abs(value) - dead) / (1 - dead), value) if abs(value) > dead else 0.0
