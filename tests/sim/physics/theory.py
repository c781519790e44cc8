"""What theory predicts for a motor under closed-loop control."""

import math

from r2p.sim.physics.motor import Gains, MotorSpec


def step_response(spec: MotorSpec, load: float, gains: Gains, time: float) -> float:
    """The speed `time` seconds after a step of the setpoint from 0 to 1, with the gains of `speed_gains`.

    It holds for a damping below 1, without saturation of voltage or current, and without dry friction.
    """
    gain, tau = spec.gain * spec.ticks_per_radian, spec.time_constant(load)
    decay = (1 + gain * gains.kp) / (2 * tau)
    swing = math.sqrt(gain * gains.ki / tau - decay**2)
    sine = (gain * gains.kp / tau - decay) / swing
    return 1 - math.exp(-decay * time) * (math.cos(swing * time) - sine * math.sin(swing * time))
