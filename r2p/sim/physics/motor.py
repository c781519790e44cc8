"""A brushed DC motor with gear and encoder, and the axle that it turns.

The winding's inductance is left out: its time constant, 0.2 ms, is under every step that makes sense here. What is left
is a first-order system, so `MotorSpec.gain` and `MotorSpec.time_constant` say all that there is to say about a step.
"""

import math

import msgspec

_TURN = 2 * math.pi


class MotorSpec(msgspec.Struct, frozen=True, kw_only=True):
    """Data sheet of a motor with gear and encoder. Default: 70 W, 14:1, 2000 ticks/turn (thesis 8.1.1)."""

    voltage: float = 24.0
    """Of the supply, V."""
    resistance: float = 1.11
    """Of the winding, ohm."""
    torque_constant: float = 36.4
    """mNm/A; in mV s/rad it is that of the back EMF, too."""
    rotor_inertia: float = 67.7
    """g cm^2."""
    gear: float = 14.0
    """Turns of the motor for one of the wheel."""
    ticks_per_turn: int = 2000
    """Of the encoder, on the motor's shaft."""
    friction: float = 60.0
    """Dry friction of motor, gear and bearings, at the wheel, mNm."""
    damping: float = 0.5
    """Viscous friction at the wheel, mNm s/rad."""
    current_limit: float = 10.0
    """A; above it the bridge chops the current (thesis 7.3.2)."""

    @property
    def ticks_per_radian(self) -> float:
        """Encoder ticks for one radian of the wheel."""
        return self.ticks_per_turn * self.gear / _TURN

    @property
    def constant(self) -> float:
        """Torque at the wheel for each ampere, Nm/A; and V s/rad of the wheel."""
        return self.torque_constant * 1e-3 * self.gear

    @property
    def inertia(self) -> float:
        """Of the rotor, as felt at the wheel, kg m^2."""
        return self.rotor_inertia * 1e-7 * self.gear**2

    @property
    def gain(self) -> float:
        """Speed of the wheel for each volt, in the long run and without dry friction, rad/s per V."""
        return self.constant / (self.constant**2 + self.resistance * self.damping * 1e-3)

    def time_constant(self, load: float) -> float:
        """Seconds to 63 % of the final speed with a load of this inertia (kg m^2) at the wheel, rotor included."""
        return self.resistance * load / (self.constant**2 + self.resistance * self.damping * 1e-3)


class Motor:
    """The winding, the gear and the encoder; whoever owns the load tells it how the wheel turns."""

    def __init__(self, spec: MotorSpec) -> None:
        self.spec = spec
        self.voltage = 0.0
        """That the bridge puts on the winding, V; 0 brakes."""
        self.current = 0.0
        """A, since the last `torque`."""
        self.angle = 0.0
        """Of the wheel, rad."""
        self.speed = 0.0
        """Of the wheel, rad/s."""
        self._constant = spec.constant
        self._ticks_per_radian = spec.ticks_per_radian
        self._dry, self._damping = spec.friction * 1e-3, spec.damping * 1e-3

    @property
    def ticks(self) -> int:
        """What the encoder has counted."""
        return math.floor(self.angle * self._ticks_per_radian)

    def torque(self) -> float:
        """What acts on the wheel at its present speed, friction included, Nm."""
        limit = self.spec.current_limit
        current = (self.voltage - self._constant * self.speed) / self.spec.resistance
        self.current = current = max(-limit, min(limit, current))
        return current * self._constant - self._friction()

    def turn(self, speed: float, dt: float) -> None:
        """The wheel's speed (rad/s) after the next `dt` seconds."""
        self.angle += (self.speed + speed) / 2 * dt
        self.speed = speed

    def _friction(self) -> float:
        """Dry friction grows with the speed up to 0.1 rad/s, so that it never drives what it shall stop."""
        return self._dry * max(-1.0, min(1.0, self.speed * 10)) + self._damping * self.speed


class Axle:
    """A wheel that turns a load of its own, off the ground: what one motor drives when there is no robot."""

    def __init__(self, motor: Motor, inertia: float) -> None:
        """`inertia` of the load at the wheel, without the rotor's, kg m^2."""
        self.motor = motor
        self.inertia = inertia + motor.spec.inertia
        """Rotor included, kg m^2."""

    def step(self, dt: float) -> None:
        """Move on by `dt` seconds, which is short against the motor's time constant."""
        motor = self.motor
        motor.turn(motor.speed + motor.torque() / self.inertia * dt, dt)
