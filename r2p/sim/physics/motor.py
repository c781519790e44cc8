"""A brushed DC motor with gear and encoder, its load, its control, the battery, and thresholds.

The inductance of the winding is left out: its time constant, 0.2 ms, is shorter than every useful step. What is left is
a first-order system, which `MotorSpec.gain` and `MotorSpec.time_constant` describe completely. The control is that of
the motor module's firmware, from the encoder to the bridge (thesis 7.3.2), with everything in ticks.
"""

import math
from collections.abc import Iterable
from typing import Literal

import msgspec

Mode = Literal["speed", "position", "voltage", "torque"]

_TURN = 2 * math.pi  # rad


class MotorSpec(msgspec.Struct, frozen=True, kw_only=True):
    """Data sheet of a motor with gear and encoder. Default: 70 W, 14:1, 2000 ticks/turn (thesis 8.1.1)."""

    voltage: float = 24.0
    """Voltage of the supply, V."""
    resistance: float = 1.11
    """Resistance of the winding, ohm."""
    torque_constant: float = 36.4
    """mNm/A; also the constant of the back EMF in mV s/rad."""
    rotor_inertia: float = 67.7
    """g cm^2."""
    gear: float = 14.0
    """Turns of the motor per turn of the wheel."""
    ticks_per_turn: int = 2000
    """Resolution of the encoder, on the motor's shaft."""
    friction: float = 60.0
    """Dry friction of motor, gear and bearings, at the wheel, mNm."""
    damping: float = 0.5
    """Viscous friction at the wheel, mNm s/rad."""
    current_limit: float = 10.0
    """A; what `Motor.current_limit` is at first (thesis 7.3.2)."""

    @property
    def ticks_per_radian(self) -> float:
        """Encoder ticks per radian of the wheel."""
        return self.ticks_per_turn * self.gear / _TURN

    @property
    def constant(self) -> float:
        """Torque at the wheel per ampere, Nm/A; also the back EMF, V s/rad of the wheel."""
        return self.torque_constant * 1e-3 * self.gear

    @property
    def inertia(self) -> float:
        """Inertia of the rotor at the wheel, kg m^2."""
        return self.rotor_inertia * 1e-7 * self.gear**2

    @property
    def gain(self) -> float:
        """Steady-state speed of the wheel per volt, without dry friction, rad/s per V."""
        return self.constant / (self.constant**2 + self.resistance * self.damping * 1e-3)

    def time_constant(self, load: float) -> float:
        """Return the seconds to 63 % of the final speed; `load` is the inertia at the wheel with the rotor, kg m^2."""
        return self.resistance * load / (self.constant**2 + self.resistance * self.damping * 1e-3)


class Motor:
    """The winding, the gear and the encoder; the model of the load calls `turn` with the wheel's speed."""

    def __init__(self, spec: MotorSpec) -> None:
        self.spec = spec
        self.voltage = 0.0
        """Voltage of the bridge at the winding, V; 0 brakes."""
        self.current = 0.0
        """A, of the last `torque()`."""
        self.angle = 0.0
        """Angle of the wheel, rad."""
        self.speed = 0.0
        """Speed of the wheel, rad/s."""
        self.current_limit = spec.current_limit
        """A; above it the bridge chops the current."""
        self.regulated: float | None = None
        """The current that the bridge regulates as far as its supply reaches, A; None: `voltage` counts."""
        self._constant = spec.constant
        self._ticks_per_radian = spec.ticks_per_radian
        self._dry, self._damping = spec.friction * 1e-3, spec.damping * 1e-3

    @property
    def ticks(self) -> int:
        """The count of the encoder."""
        return math.floor(self.angle * self._ticks_per_radian)

    def torque(self) -> float:
        """Return the torque on the wheel at its present speed, including friction, Nm."""
        return self.torque_at(self.speed)

    def torque_at(self, speed: float) -> float:
        """Return the torque on the wheel at any speed (rad/s), including friction, Nm."""
        limit, constant, resistance = self.current_limit, self._constant, self.spec.resistance
        if self.regulated is not None:
            supply = self.spec.voltage
            wanted = self.regulated * resistance + constant * speed
            self.voltage = max(-supply, min(supply, wanted))
        current = (self.voltage - constant * speed) / resistance
        self.current = current = max(-limit, min(limit, current))
        dry = self._dry and self._dry * max(-1.0, min(1.0, speed * 10))  # from 0.1 rad/s on, so that it never drives
        return current * constant - dry - self._damping * speed

    def turn(self, speed: float, dt: float) -> None:
        """Turn the wheel for `dt` seconds, at the end of which it has this speed (rad/s)."""
        self.angle += (self.speed + speed) / 2 * dt
        self.speed = speed


class Axle:
    """A wheel off the ground with a load of its own, for a motor without a robot."""

    def __init__(self, motor: Motor, inertia: float) -> None:
        """`inertia` of the load at the wheel, without the rotor's, kg m^2."""
        self.motor = motor
        self.inertia = inertia + motor.spec.inertia
        """Rotor included, kg m^2."""

    def step(self, dt: float) -> None:
        """Advance by `dt` seconds, which must be short against the motor's time constant."""
        motor = self.motor
        motor.turn(motor.speed + motor.torque() / self.inertia * dt, dt)


class Gains(msgspec.Struct, frozen=True):
    """Gains of a PID controller: V per tick/s (speed) or tick (position), their integral (ki) and derivative (kd)."""

    kp: float
    ki: float = 0.0
    kd: float = 0.0
    limit: float = 24.0
    """The output saturates at plus and minus this voltage, V."""


class Pid:
    """A PID controller with saturation; its integrator stops while the output is saturated."""

    def __init__(self, gains: Gains) -> None:
        self._gains = gains
        self._integral = 0.0
        self._error = self._slope = self._output = 0.0  # of the last step
        self._measured: float | None = None

    @property
    def gains(self) -> Gains:
        """The gains. New ones do not make the output jump: the integral part makes up for what the others change.

        Without an integral part (ki is 0) nothing can, and what was integrated before is forgotten.
        """
        return self._gains

    @gains.setter
    def gains(self, gains: Gains) -> None:
        self._gains = gains
        wanted = gains.kp * self._error + self._integral - gains.kd * self._slope
        if _clamp(wanted, gains.limit) != _clamp(self._output, gains.limit):
            self._integral += self._output - wanted
        self._integral = _clamp(self._integral, gains.limit) if gains.ki else 0.0

    def reset(self) -> None:
        """Reset the integrator and the derivative."""
        self._integral = self._error = self._slope = self._output = 0.0
        self._measured = None

    def step(self, setpoint: float, measured: float, dt: float, slope: float | None = None) -> float:
        """Return the output for the next `dt` seconds. `slope`: of what is measured, if a sensor has it."""
        gains = self._gains
        self._error = error = setpoint - measured
        if slope is None:
            slope = 0.0 if self._measured is None else (measured - self._measured) / dt
        self._slope = slope
        self._measured = measured
        integral = self._integral + gains.ki * error * dt
        wanted = gains.kp * error + integral - gains.kd * slope
        self._output = output = _clamp(wanted, gains.limit)
        if wanted == output or wanted * error < 0:  # while saturated, integrate only what leads out of it
            self._integral = integral
        return output


def _clamp(value: float, limit: float) -> float:
    return max(-limit, min(limit, value))


def speed_gains(spec: MotorSpec, load: float, *, frequency: float, damping: float) -> Gains:
    """Return PI gains for a closed loop with this natural frequency (rad/s) and damping, by pole placement.

    `load` is the inertia at the wheel, rotor included, kg m^2. Speeds are in ticks/s. With the motor gain/(time s + 1)
    the closed loop is (gain kp s + gain ki) / (time s^2 + (1 + gain kp) s + gain ki).
    """
    gain, time = spec.gain * spec.ticks_per_radian, spec.time_constant(load)
    return Gains((2 * damping * frequency * time - 1) / gain, frequency**2 * time / gain, limit=spec.voltage)


def rounded_gains(gains: Gains, spec: MotorSpec) -> Gains:
    """Return gains with two digits per radian of the wheel, as they are typed: 1.9 V/(rad/s) and 30 V/rad."""
    ticks = spec.ticks_per_radian
    kp, ki = (float(f"{each * ticks:.2g}") / ticks for each in (gains.kp, gains.ki))
    return Gains(kp, ki, limit=gains.limit)


class Drive:
    """Control of one motor; without a setpoint the winding is shorted, which brakes.

    Speed and position are closed loops around the encoder, a torque is one around the current, a voltage is none.
    """

    def __init__(self, motor: Motor, gains: Gains | None = None, *, mode: Mode = "speed") -> None:
        """`gains` are for speed and position; of a voltage, only their limit counts."""
        gains = gains or Gains(0.0, limit=motor.spec.voltage)
        self.motor = motor
        self.gains = gains
        """The gains that it was made with."""
        self.mode: Mode = mode
        self.setpoint: float | None = None
        """Ticks (position), ticks/s (speed), V, or Nm at the wheel (torque); None: stopped."""
        self.pid = Pid(gains)
        """The controller, whose gains may change at any time."""
        self._last_ticks = motor.ticks
        self._returned = motor.ticks

    def stop(self) -> None:
        """Short the winding, which brakes, until the next setpoint."""
        self.setpoint = self.motor.regulated = None
        self.motor.voltage = 0.0
        self.pid.reset()

    def take_ticks(self) -> int:
        """Return the ticks since the last call."""
        ticks = self.motor.ticks
        taken, self._returned = self._returned, ticks
        return ticks - taken

    def step(self, dt: float) -> None:
        """Read the encoder, and set the bridge for the next `dt` seconds."""
        ticks = self.motor.ticks
        moved, self._last_ticks = ticks - self._last_ticks, ticks
        if self.setpoint is None:
            return
        if self.mode == "torque":
            self.motor.regulated = self.setpoint / self.motor.spec.constant
        elif self.mode == "voltage":
            self.motor.voltage = _clamp(self.setpoint, self.pid.gains.limit)
        else:
            measured = ticks if self.mode == "position" else moved / dt
            self.motor.voltage = self.pid.step(self.setpoint, measured, dt)


class BatterySpec(msgspec.Struct, frozen=True, kw_only=True):
    """Data sheet of a lead battery. Default: two 12 V, 7.2 Ah batteries in series."""

    capacity: float = 7.2
    """Ah."""
    full: float = 25.6
    """Voltage at rest when it is full, V."""
    empty: float = 23.2
    """Voltage at rest when it is empty, V."""
    resistance: float = 60.0
    """Internal, milliohm."""


class Threshold:
    """One side of an analog watchdog (thesis 7.2.2): is a value beyond a level, with a hysteresis on the way back?"""

    def __init__(self, side: Literal["below", "above"], level: float = 0.0, hysteresis: float = 0.0) -> None:
        self.level = level
        self.hysteresis = hysteresis
        """How far behind the level the value has to return, 0 or more."""
        self.exceeded = False
        """Whether the last value was beyond the level, or has not returned far enough since then."""
        self._sign = -1 if side == "below" else 1

    def update(self, value: float) -> bool:
        """Compare a new value; return whether it crossed the threshold, in either direction."""
        before = self.exceeded
        beyond = (value - self.level) * self._sign
        self.exceeded = beyond > -self.hysteresis if before else beyond > 0
        return self.exceeded != before


class LeadBattery:
    """A battery whose voltage falls with its charge and with the current; a negative current charges it."""

    def __init__(self, spec: BatterySpec | None = None, *, charge: float = 1.0) -> None:
        """`charge` from 0 (empty) to 1 (full)."""
        self.spec = spec or BatterySpec()
        self.charge = charge
        self.current = 0.0
        """The current that flows out of it, A."""

    @property
    def voltage(self) -> float:
        """At its terminals, V."""
        spec = self.spec
        rest = spec.empty + (spec.full - spec.empty) * self.charge
        return rest - self.current * spec.resistance * 1e-3

    def supply(self, motors: Iterable[Motor], electronics: float, dt: float) -> None:
        """Advance by `dt` seconds with what motors draw, and the modules: `electronics` in A."""
        power = sum(motor.voltage * motor.current for motor in motors)
        self.current = electronics + power / self.voltage
        self.step(dt)

    def step(self, dt: float) -> None:
        """Advance by `dt` seconds at the present current."""
        self.charge = max(0.0, min(1.0, self.charge - self.current * dt / 3600 / self.spec.capacity))
