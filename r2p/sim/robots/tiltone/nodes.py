"""tiltOne, the robot of thesis 8.3 that balances on two wheels: its nodes, two nested controllers.

    velocity ----+-> velocity control, 20 Hz -> tilt_setpoint -> balance control, 100 Hz -> effort -> motor modules
    encoder1, 2 -+                                                ^        ^                               |
        ^                                                       tilt    velocity (turn)                    |
        +--------------------------------------------------------------------------------------------------+

Velocity control leans the robot: forward to go faster, back to go slower. Balance control keeps it at that tilt, by
what the motors are to exert, and adds what turns it to one wheel and subtracts it from the other. Both run on the IMU
module, and use only the public API. Forward kinematics and battery monitor are in `r2p.sim.robots.shared_nodes`.
"""

import functools
import math
from typing import Literal

import msgspec

import r2p
from r2p.msg import Effort2, Encoder, Tilt, TiltRate, Velocity3
from r2p.sim.physics.motor import Gains, MotorSpec, Pid
from r2p.sim.physics.pendulum import (
    NXTWAY,
    NXTWAY_MOTOR,
    TILTONE,
    TILTONE_MOTOR,
    TORQUE_MOTOR,
    PendulumSpec,
)
from r2p.sim.robots.shared_nodes import FRESH, Latest, Traffic, sender

PERIOD = 0.01
"""Period of the tilt, of the balance control and of the encoders, s."""
VELOCITY_PERIOD = 0.05
"""Period of the velocity control, s."""
WITHIN = 0.05
"""Seconds for which a tilt and the reading of an encoder are used."""
TIMEOUT = 0.1
"""Seconds without an effort after which a motor stops."""
ARMED_AFTER = 0.5
"""Seconds for which the robot has to be upright before the motors start."""

_ROUNDS = round(VELOCITY_PERIOD / PERIOD)
_DEADLINE = PERIOD  # s, of soft real-time messages
_MICROSECONDS = 1 << 32


class BalanceSpec(msgspec.Struct, frozen=True, kw_only=True):
    """A body with its motors, and the gains that balance it. Angles are in rad, speeds in m/s, efforts in V or Nm."""

    body: PendulumSpec = TILTONE
    motor: MotorSpec = TILTONE_MOTOR
    mode: Literal["voltage", "torque"] = "voltage"
    """What is commanded of each motor: its voltage, or its torque at the wheel."""
    balance: Gains = Gains(kp=120.0, ki=200.0, kd=8.0, limit=24.0)
    """Effort per rad, rad s and rad/s of the tilt."""
    velocity: Gains = Gains(kp=0.15, ki=0.003, limit=math.radians(8))
    """Tilt per m/s and m of the velocity."""
    turn: float = 3.16
    """Effort per rad/s to turn: the difference of a motor's from the other one's is twice that."""
    turn_damping: float = 0.0
    """... and per rad/s with which it turns, against it."""
    count: float = 0.001
    """V or Nm in one count of an effort's message."""
    top_speed: float = 1.0
    """m/s."""

    @property
    def unit(self) -> str:
        """Of the efforts."""
        return "V" if self.mode == "voltage" else "Nm"


GEARED = BalanceSpec()
"""tiltOne with its geared motors, commanded by voltage."""
TORQUE = BalanceSpec(
    motor=TORQUE_MOTOR,
    mode="torque",
    balance=Gains(kp=169.2, kd=45.4, limit=60.0),
    velocity=Gains(kp=0.186, ki=0.096, limit=math.radians(8)),
    turn=5.0,
    turn_damping=5.0,
    count=0.01,
)
"""tiltOne with ideal motors, commanded by torque: nothing but control keeps it from falling."""
LEGO = BalanceSpec(
    body=NXTWAY,
    motor=NXTWAY_MOTOR,
    balance=Gains(kp=60.0, ki=400.0, kd=0.9, limit=8.0),
    velocity=Gains(kp=0.3, ki=0.05, limit=math.radians(8)),
    turn=0.9,
    top_speed=0.3,
)
"""NXTway-GS, which falls three times as fast as tiltOne, with gains for controllers as slow as those of tiltOne."""


class WheelSpeeds:
    """The speeds of the wheels against the frame, from `encoder1` (left) and `encoder2`. The node has to `spin()`."""

    def __init__(self, node: r2p.Node, spec: BalanceSpec, period: float = PERIOD) -> None:
        self._latest = [
            Latest(node, f"encoder{wheel + 1}", Encoder, fresh=WITHIN, changed=functools.partial(self._count, wheel))
            for wheel in range(2)
        ]
        self._scale = 1 / spec.motor.ticks_per_radian / period
        self._sums, self._counts = [0.0, 0.0], [0, 0]
        self._speeds = [0.0, 0.0]

    @property
    def present(self) -> bool:
        """Return whether both motor modules send their encoders."""
        return all(latest.message is not None for latest in self._latest)

    def read(self) -> tuple[float, float]:
        """Return the mean speeds since the last call, rad/s."""
        for wheel in range(2):
            if self._counts[wheel]:
                self._speeds[wheel] = self._sums[wheel] / self._counts[wheel] * self._scale
            self._sums[wheel], self._counts[wheel] = 0.0, 0
        left, right = self._speeds
        return left, right

    def _count(self, wheel: int) -> None:
        encoder = self._latest[wheel].message
        if encoder is not None:
            self._sums[wheel] += encoder.delta
            self._counts[wheel] += 1


async def velocity_control(node: r2p.Node, spec: BalanceSpec = GEARED, traffic: Traffic = "hrt") -> None:
    """Lean the robot so that it gets the wanted velocity: publish `tilt_setpoint` 20 times a second.

    Without a fresh command, the wanted velocity is 0. It is silent without a fresh tilt, and while a wheel is silent.
    """
    gains = spec.velocity
    pid = Pid(gains)

    def tune(_value: float) -> None:
        pid.gains = Gains(kp.value, ki.value, limit=math.radians(lean.value))

    kp = node.parameter(
        "kp", gains.kp, min=0.0, max=10.0, unit="rad/(m/s)", doc="Tilt for each m/s that it is too slow", on_change=tune
    )
    ki = node.parameter(
        "ki", gains.ki, min=0.0, max=10.0, unit="rad/m", doc="Tilt for each m that it stayed behind", on_change=tune
    )
    lean = node.parameter(
        "lean", round(math.degrees(gains.limit), 6), min=0.0, max=20.0, unit="deg", doc="Highest tilt", on_change=tune
    )
    top = node.parameter(
        "top_speed", spec.top_speed, min=0.0, max=2.0, unit="m/s", doc="Highest velocity that it tries to have"
    )
    wheels = WheelSpeeds(node, spec)
    commands = Latest(node, "velocity", Velocity3, fresh=FRESH)
    rounds = 0

    def setpoint() -> Tilt | None:
        reading = tilts.message
        if reading is None or not wheels.present:
            pid.reset()
            return None
        wanted = commands.message.x if commands.message is not None else 0.0
        # The encoders count the wheels against the frame, which turns, too.
        speed = spec.body.wheel_radius * (sum(wheels.read()) / 2 + reading.rate)
        return Tilt(angle=pid.step(max(-top.value, min(top.value, wanted)), speed, VELOCITY_PERIOD))

    def measured() -> None:
        nonlocal rounds
        rounds = (rounds + 1) % _ROUNDS
        if not rounds:
            send()

    tilts = Latest(node, "tilt", TiltRate, fresh=WITHIN, changed=measured)
    send = sender(node, "tilt_setpoint", Tilt, setpoint, traffic=traffic, period=VELOCITY_PERIOD)
    while True:
        await node.spin()


class Upright:
    """Whether the motors may run: from when the robot has been upright for a while until it falls over."""

    def __init__(self, node: r2p.Node) -> None:
        self._node = node
        self._start = node.parameter(
            "start_angle",
            5.0,
            min=0.5,
            max=20.0,
            unit="deg",
            doc="Held within this tilt for 0.5 s, it starts to balance",
        )
        self._fall = node.parameter(
            "fall_angle", 35.0, min=10.0, max=60.0, unit="deg", doc="Beyond this tilt it has fallen: the motors stop"
        )
        self.armed = False
        self._count = 0

    def update(self, tilt: float) -> bool:
        """Return whether the motors may run, at this tilt (rad), each PERIOD."""
        degrees = abs(math.degrees(tilt))
        if self.armed and degrees > self._fall.value:
            self.armed, self._count = False, 0
            self._node.log.warning("fell over: the motors stop until the robot stands upright")
        elif not self.armed:
            self._count = self._count + 1 if degrees < self._start.value else 0
            self.armed = self._count * PERIOD >= ARMED_AFTER
        return self.armed

    def disarm(self) -> None:
        """Wait for the robot to be upright again."""
        self.armed, self._count = False, 0


async def balance_control(node: r2p.Node, spec: BalanceSpec = GEARED, traffic: Traffic = "hrt") -> None:
    """Keep the robot at the wanted tilt, and turn it: publish `effort` 100 times a second.

    Without a fresh tilt it is silent, so that the motors stop. They are stopped as well while there is no setpoint,
    because a motor module is silent, and from when the robot has fallen until it is upright again.
    """
    pid, turn, damping = _balance_parameters(node, spec)
    upright = Upright(node)
    wheels = WheelSpeeds(node, spec) if spec.turn_damping else None
    setpoints = Latest(node, "tilt_setpoint", Tilt, fresh=FRESH)
    commands = Latest(node, "velocity", Velocity3, fresh=FRESH)

    def effort() -> Effort2 | None:
        reading, setpoint = tilts.message, setpoints.message
        if reading is None:
            upright.disarm()
            return None
        measured = tilts.received // 1000 % _MICROSECONDS
        if setpoint is None:
            upright.disarm()
        if setpoint is None or not upright.update(reading.angle):
            pid.reset()
            return Effort2(measured=measured)
        forward = -pid.step(
            setpoint.angle, reading.angle, PERIOD, reading.rate
        )  # the wheels have to get under what leans
        rate = commands.message.w if commands.message is not None else 0.0
        sideways = turn.value * rate
        if wheels is not None:
            left, right = wheels.read()
            sideways -= damping.value * spec.body.body_velocity(left, right)[2]
        return Effort2((_counts(spec, forward - sideways), _counts(spec, forward + sideways)), measured)

    send = sender(node, "effort", Effort2, effort, traffic=traffic, period=PERIOD, deadline=_DEADLINE)
    tilts = Latest(node, "tilt", TiltRate, fresh=WITHIN, changed=send)
    while True:
        await node.spin()


def _balance_parameters(node: r2p.Node, spec: BalanceSpec) -> tuple[Pid, r2p.Parameter[float], r2p.Parameter[float]]:
    """Declare the gains; return the controller that has them, and the two gains of turning."""
    gains, unit = spec.balance, spec.unit
    pid = Pid(gains)

    def tune(_value: float) -> None:
        pid.gains = Gains(kp.value, ki.value, kd.value, limit.value)

    def gain(name: str, default: float, most: float, per: str, doc: str) -> r2p.Parameter[float]:
        return node.parameter(name, default, min=0.0, max=most, unit=f"{unit}{per}", doc=doc, on_change=tune)

    kp = gain("kp", gains.kp, 1000.0, "/rad", "For each rad that it leans too far")
    ki = gain("ki", gains.ki, 2000.0, "/(rad s)", "For how long it has done so")
    kd = gain("kd", gains.kd, 200.0, "/(rad/s)", "For each rad/s with which it leans further")
    limit = gain("limit", gains.limit, 100.0, "", "Highest voltage or torque of each motor")
    doc = "For each rad/s that it is to turn, of each motor"
    turn = node.parameter("turn", spec.turn, min=0.0, max=50.0, unit=f"{unit}/(rad/s)", doc=doc)
    doc = "For each rad/s with which it turns, against it"
    damping = node.parameter("turn_damping", spec.turn_damping, min=0.0, max=50.0, unit=f"{unit}/(rad/s)", doc=doc)
    return pid, turn, damping


def age_of(effort: Effort2, now: int) -> float:
    """Return the age (s) of the measurement that an effort follows from; `now` is UTC in ns."""
    return (now // 1000 - effort.measured) % _MICROSECONDS * 1e-6


def _counts(spec: BalanceSpec, effort: float) -> int:
    return max(-32768, min(32767, round(effort / spec.count)))
