"""The PID controller of the motor module: saturation, and an integrator that waits while it is saturated.

Thesis 7.3.2: saturation filters and conditional integration. The derivative is taken from the measurement, so a step of
the setpoint gives no kick.
"""

import math

import msgspec

from r2p.sim.physics.motor import MotorSpec


class Gains(msgspec.Struct, frozen=True):
    """V for each tick/s (speed) or tick (position), and for their integral (ki, s) and derivative (kd, 1/s)."""

    kp: float
    ki: float = 0.0
    kd: float = 0.0
    limit: float = 24.0
    """The output saturates at plus and minus this, V."""


class Pid:
    """The controller."""

    def __init__(self, gains: Gains) -> None:
        self.gains = gains
        self._integral = 0.0
        self._measured: float | None = None

    def reset(self) -> None:
        """Forget the past."""
        self._integral = 0.0
        self._measured = None

    def step(self, setpoint: float, measured: float, dt: float) -> float:
        """The output for the next `dt` seconds."""
        gains = self.gains
        error = setpoint - measured
        slope = 0.0 if self._measured is None else (measured - self._measured) / dt
        self._measured = measured
        integral = self._integral + gains.ki * error * dt
        wanted = gains.kp * error + integral - gains.kd * slope
        output = max(-gains.limit, min(gains.limit, wanted))
        if wanted == output or wanted * error < 0:  # saturated: integrate only what leads out of it
            self._integral = integral
        return output


def speed_gains(spec: MotorSpec, load: float, *, frequency: float, damping: float) -> Gains:
    """PI gains that give the closed loop this natural frequency (rad/s) and damping, by placing its two poles.

    `load` is the inertia at the wheel, rotor included, kg m^2. Speeds are in ticks/s. With the motor gain/(time s + 1)
    the closed loop is (gain kp s + gain ki) / (time s^2 + (1 + gain kp) s + gain ki).
    """
    gain, time = spec.gain * spec.ticks_per_radian, spec.time_constant(load)
    return Gains((2 * damping * frequency * time - 1) / gain, frequency**2 * time / gain, limit=spec.voltage)


def step_response(spec: MotorSpec, load: float, gains: Gains, time: float) -> float:
    """Speed `time` seconds after a step of the setpoint from 0 to 1: what the theory says of `speed_gains`.

    For damping under 1, where neither the voltage nor the current saturates, and without dry friction.
    """
    gain, tau = spec.gain * spec.ticks_per_radian, spec.time_constant(load)
    decay = (1 + gain * gains.kp) / (2 * tau)
    swing = math.sqrt(gain * gains.ki / tau - decay**2)
    sine = (gain * gains.kp / tau - decay) / swing
    return 1 - math.exp(-decay * time) * (math.cos(swing * time) - sine * math.sin(swing * time))
