"""Triskar2, the omnidirectional robot of thesis 8.1: its nodes.

    velocity_cmd -> obstacle -> velocity -> invkin -> speed -> three motor modules
                        ^                     ^                       |
                    proximity              encoders  <----------------+--> fwdkin -> odometry

They use only the public API, so each of them runs on any module, of this robot or another one:

    r2p run r2p.sim.robots.triskar2:inverse_kinematics=invkin --via rtcan:can0

`square` is a node for a PC, which drives the robot. The battery monitor, and what other robots share, is in
`r2p.sim.robots.shared_nodes`.

`r2p.sim.robots.emulated` puts the whole robot together, with its modules and its body.
"""

import math

import r2p
from r2p.msg import Encoder, Proximity, Speed3, Velocity3
from r2p.sim.physics.motor import MotorSpec
from r2p.sim.physics.world import OmniSpec
from r2p.sim.robots import shared_nodes
from r2p.sim.robots.shared_nodes import COMMANDS, FRESH, Latest, Traffic, sender

BODY = OmniSpec()
MOTOR = MotorSpec()

PERIOD = 0.02
"""Period of speeds and encoders, s; of the whole command chain if all of it is hard real-time."""

WHEELS = 3
SIDES = {"prox_front": 0.0, "prox_rear": 180.0}
"""Topics of the two proximity modules, and their directions, degrees from ahead."""
BEARINGS = (67.5, 22.5, -22.5, -67.5)
"""Directions of the four sensors of each module, degrees from there."""

REST = 0.5
"""Seconds that a robot rests at each corner of the square."""
DIRECTIONS = ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))
"""Directions of the square's sides, in the robot's frame."""

_AHEAD = math.cos(math.radians(60))
_ROUNDS = 5  # encoder readings per message of odometry: 10 Hz, thesis table 4.1


async def obstacle_avoidance(node: r2p.Node, traffic: Traffic = "srt") -> None:
    """Forward `velocity_cmd` as `velocity`; if an obstacle is in the way, only its rotation.

    If a proximity module is silent, the robot does not move in its direction.
    """
    stop = node.parameter(
        "stop_distance",
        0.15,
        min=0.0,
        max=0.8,
        unit="m",
        doc="Distance to an obstacle at which the robot stops when it is slow",
    )
    braking = node.parameter(
        "braking_time",
        0.4,
        min=0.0,
        max=2.0,
        unit="s",
        doc="The faster, the earlier: the distance grows by what it drives in this time",
    )
    sides = {angle: Latest(node, topic, Proximity, fresh=2 * FRESH) for topic, angle in SIDES.items()}

    def blocked(command: Velocity3) -> bool:
        speed = math.hypot(command.x, command.y)
        for angle, latest in sides.items():
            ranges = latest.message.ranges if latest.message else (0, 0, 0, 0)
            for bearing, reading in zip(BEARINGS, ranges, strict=True):
                at = math.radians(angle + bearing)
                towards = command.x * math.cos(at) + command.y * math.sin(at)
                if towards > _AHEAD * speed and reading / 1000 < stop.value + braking.value * towards:
                    return True
        return False

    def velocity() -> Velocity3 | None:
        command = commands.message
        if command is None or not blocked(command):
            return command
        return Velocity3(w=command.w)

    send = sender(node, "velocity", Velocity3, velocity, traffic=traffic, period=PERIOD)
    commands = Latest(node, "velocity_cmd", Velocity3, fresh=FRESH, changed=send)
    while True:
        await node.spin()


async def inverse_kinematics(node: r2p.Node, traffic: Traffic = "hrt") -> None:
    """Convert `velocity` to speeds of the wheels (`speed`, rad/s); all wheels stop while one of them is silent."""
    wheels = [Latest(node, f"encoder{wheel + 1}", Encoder, fresh=FRESH) for wheel in range(WHEELS)]

    def speeds() -> Speed3 | None:
        velocity = velocities.message
        if velocity is None:
            return None
        if any(wheel.message is None for wheel in wheels):
            return Speed3()
        return Speed3(value=BODY.wheel_speeds(velocity.x, velocity.y, velocity.w))

    send = sender(node, "speed", Speed3, speeds, traffic=traffic, period=PERIOD)
    velocities = Latest(node, "velocity", Velocity3, fresh=FRESH, changed=send)
    while True:
        await node.spin()


async def forward_kinematics(node: r2p.Node) -> None:
    """Compute `odometry` from the encoders of the three wheels: the pose since the node started, and the velocity."""
    await shared_nodes.forward_kinematics(
        node, BODY.body_velocity, wheels=WHEELS, motor=MOTOR, encoder_period=PERIOD, rounds=_ROUNDS
    )


async def square(
    node: r2p.Node,
    side: float = 1.0,
    speed: float = 0.5,
    laps: float = math.inf,
    traffic: Traffic = "srt",
    wait: float = 1.0,
) -> None:
    """Publish `velocity_cmd`: after `wait` seconds drive `laps` squares, and then stand still.

    It drives by the clock, not by odometry, so that command and position can be compared.
    """
    start = node.now()
    leg = side / speed + REST  # s

    def command() -> Velocity3:
        elapsed = (node.now() - start) / 1e9 - wait
        number, within = divmod(elapsed, leg)
        if not 0 <= elapsed < laps * len(DIRECTIONS) * leg or within >= side / speed:
            return Velocity3()
        x, y = DIRECTIONS[int(number) % len(DIRECTIONS)]
        return Velocity3(x=speed * x, y=speed * y)

    send = sender(node, "velocity_cmd", Velocity3, command, traffic=traffic, period=PERIOD)
    async for _ in node.every(COMMANDS):
        send()
