"""The hexapod's nodes: a gait, positions of joints, and odometry.

    velocity -> gait -> leg_lf .. leg_rr -> 18 motor modules -> joint_lf1 .. joint_rr3 -> odometry
                 ^                                                                           |
                 +---------------------------------------------------------------------------+

`gait` makes one message for each leg, which its three motor modules receive: one frame with three angles. It stands
still while there is no odometry, which needs the positions of all joints.
"""

import functools
import math

import msgspec

import r2p
from r2p.messages import i16
from r2p.msg import AbsoluteEncoder, Odometry, Velocity3
from r2p.sim.physics.legs import LegSpec, moved
from r2p.sim.physics.motor import Drive
from r2p.sim.physics.world import Triple
from r2p.sim.robots.shared_nodes import COMMANDS, FRESH, DeadReckoning, Latest

LEGS = ("lf", "lm", "lr", "rf", "rm", "rr")
"""Left and right: front, middle, rear."""
JOINTS = 3
"""Of each leg: hip, shoulder, knee."""
BODY = LegSpec()

PERIOD = 0.02
"""Period of the legs' setpoints, s."""
JOINT_PERIOD = 0.04
"""Period of the joints' positions, s."""
TIMEOUT = 0.2
"""Seconds without a setpoint after which a motor brakes."""
COUNT = 1e-4
"""rad in one count of a setpoint."""

_PRESENT = 0.3  # s for which a message of odometry is used
_ROUNDS = 3  # readings of the joints per message of odometry
_MOVING = 1e-3  # m/s or m/s of a foot: a slower command is none


class LegAngles(r2p.Message):
    """Angles of a leg's joints from the home posture (topics `leg_lf` to `leg_rr`). 1 fragment."""

    value: tuple[i16, i16, i16] = (0, 0, 0)
    """Hip, shoulder and knee, in 0.1 mrad."""


class GaitSpec(msgspec.Struct, frozen=True, kw_only=True):
    """The tripod gait: three legs stand while the other three swing."""

    frequency: float = 1.0
    """Steps of each leg per second."""
    duty: float = 0.55
    """The share of a step in which a foot is on the ground."""
    lift: float = 0.03
    """How high a foot is lifted, m."""
    top_speed: float = 0.12
    """Of a foot over the ground, m/s: a leg reaches only so far."""

    def foot(self, phase: float) -> tuple[float, float]:
        """Return where a foot is at this phase (0 to 1): along its stride, from +1/2 to -1/2 and back; and its lift."""
        if phase < self.duty:
            return 0.5 - phase / self.duty, 0.0
        swing = (phase - self.duty) / (1 - self.duty)
        # It lifts off and touches down as fast as the ground moves below the body: so it does not drag.
        ends = (1 - self.duty) / self.duty * swing * (2 * swing * swing - 3 * swing + 1)
        return swing * swing * (3 - 2 * swing) - 0.5 - ends, math.sin(math.pi * swing) ** 2


def phase_of(leg: int, phase: float) -> float:
    """Return the phase of a leg: neighbours are half a step apart."""
    return (phase + 0.5 * ((leg % JOINTS + leg // JOINTS) % 2)) % 1.0


async def gait(node: r2p.Node, body: LegSpec = BODY, spec: GaitSpec = GaitSpec()) -> None:  # noqa: B008 - it is frozen
    """Walk as `velocity` says: publish the angles of all legs 50 times a second.

    Without a fresh velocity or odometry it finishes its step, and stands.
    """
    frequency = node.parameter(
        "frequency", spec.frequency, min=0.2, max=2.0, unit="Hz", doc="Steps of each leg per second"
    )
    lift = node.parameter("lift", spec.lift, min=0.01, max=0.05, unit="m", doc="How high a foot is lifted")
    top = node.parameter("top_speed", spec.top_speed, min=0.01, max=0.2, unit="m/s", doc="Highest speed of a foot")
    commands = Latest(node, "velocity", Velocity3, fresh=FRESH)
    odometry = Latest(node, "odometry", Odometry, fresh=_PRESENT)
    homes = [body.on_body(leg, (0.0, body.reach, -body.height)) for leg in range(len(LEGS))]
    phase, walk = 0.0, Velocity3()

    def advance() -> None:
        """Begin each half of a step with the newest command, so that no foot that stands slips."""
        nonlocal phase, walk
        before = phase
        moving = walk != Velocity3()
        if moving:
            phase = (phase + frequency.value * PERIOD) % 1.0
        if not moving or int(before * 2) != int(phase * 2):
            wanted = commands.message if odometry.message is not None else None
            walk = limited(wanted or Velocity3(), homes, top.value)

    def angles(leg: int) -> LegAngles:
        if leg == 0:  # its slots are the first ones of each period
            advance()
        return leg_angles(body, spec, homes[leg], leg, phase, walk, frequency.value, lift.value)

    for leg, name in enumerate(LEGS):
        node.advertise(f"leg_{name}", LegAngles, r2p.Periodic(PERIOD, functools.partial(angles, leg)))
    while True:
        await node.spin()


def limited(command: Velocity3, homes: list[Triple], top: float) -> Velocity3:
    """Return the command, scaled down so that no foot is faster than `top` m/s; tiny commands become zero."""
    fastest = max(math.hypot(command.x - command.w * y, command.y + command.w * x) for x, y, _ in homes)
    if fastest < _MOVING:
        return Velocity3()
    scale = min(1.0, top / fastest)
    return Velocity3(command.x * scale, command.y * scale, command.w * scale)


def leg_angles(
    body: LegSpec, spec: GaitSpec, home: Triple, leg: int, phase: float, walk: Velocity3, frequency: float, lift: float
) -> LegAngles:
    """Return the angles of a leg at a phase of the gait, while the body walks."""
    along, up = spec.foot(phase_of(leg, phase))
    x, y, z = home
    if walk != Velocity3():
        span = spec.duty / frequency * along  # s that the foot is ahead of where it is at home
        x, y, z = x + (walk.x - walk.w * y) * span, y + (walk.y + walk.w * x) * span, z + lift * up
    hip, shoulder, knee = (round(angle / COUNT) for angle in body.from_body(leg, x, y, z))
    return LegAngles((hip, shoulder, knee))


async def position(node: r2p.Node, drive: Drive, topic: str, period: float = JOINT_PERIOD) -> None:
    """Publish the angle of a joint, which an absolute encoder measures: firmware of a motor module."""
    motor = drive.motor
    scale = 1 / motor.spec.ticks_per_radian
    node.advertise(topic, AbsoluteEncoder, r2p.Periodic(period, lambda: AbsoluteEncoder(motor.ticks * scale)))
    while True:
        await node.spin()


async def legged_odometry(node: r2p.Node, body: LegSpec = BODY, period: float = JOINT_PERIOD) -> None:
    """Compute `odometry` from the angles of all joints, by the lowest feet. It pauses while one is silent."""
    angles: list[list[float | None]] = [[None] * JOINTS for _ in LEGS]
    waits = len(LEGS) * JOINTS
    odometry = node.advertise("odometry", Odometry, r2p.Sporadic(deadline=_ROUNDS * period))
    reckoning, last, rounds = DeadReckoning(), None, 0

    def read(leg: int, joint: int, message: AbsoluteEncoder) -> None:
        nonlocal waits
        waits -= angles[leg][joint] is None
        angles[leg][joint] = message.position

    for leg, name in enumerate(LEGS):
        for joint in range(JOINTS):
            callback = functools.partial(read, leg, joint)
            node.subscribe(f"joint_{name}{joint + 1}", AbsoluteEncoder, callback, queue=2, lossy=True)
    while True:
        await node.spin()
        if waits:
            continue
        feet = [body.on_body(leg, body.foot([each or 0.0 for each in one])) for leg, one in enumerate(angles)]
        angles, waits = [[None] * JOINTS for _ in LEGS], len(LEGS) * JOINTS
        if last is not None:
            ground = min(min(old[2], new[2]) for old, new in zip(last, feet, strict=True)) + body.touching
            stand = [(old, new) for old, new in zip(last, feet, strict=True) if max(old[2], new[2]) <= ground]
            reckoning.move(*moved(stand))
            rounds += 1
        last = feet
        if rounds == _ROUNDS:
            odometry.publish_nowait(Odometry(reckoning.pose, reckoning.velocity(rounds * period)))
            rounds = 0


async def walker(node: r2p.Node, speed: float = 0.1, turn: float = 0.3, rounds: float = math.inf) -> None:
    """Publish `velocity`: ahead, to the left, around, and a rest, `rounds` times. A node for a PC."""
    start = node.now()
    commands = node.advertise("velocity", Velocity3, r2p.Sporadic(deadline=COMMANDS))
    parts = (Velocity3(x=speed), Velocity3(x=speed, w=turn), Velocity3(y=speed), Velocity3(w=turn), Velocity3())
    async for _ in node.every(COMMANDS):
        number = int((node.now() - start) / 4e9)
        done = number >= rounds * len(parts)
        await commands.publish(Velocity3() if done else parts[number % len(parts)])
