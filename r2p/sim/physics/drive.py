"""What the motor module's firmware does between the encoder and the bridge (thesis 7.3.2): everything in ticks."""

from typing import Literal

from r2p.sim.physics.motor import Motor
from r2p.sim.physics.pid import Gains, Pid

Mode = Literal["speed", "position"]


class Drive:
    """Closed-loop control of one motor; before the first setpoint, and when it is stopped, the winding is shorted."""

    def __init__(self, motor: Motor, gains: Gains, *, mode: Mode = "speed") -> None:
        self.motor = motor
        self.mode: Mode = mode
        self.setpoint: float | None = None
        """Ticks (position) or ticks/s (speed); None: stopped."""
        self._pid = Pid(gains)
        self._seen = motor.ticks
        self._taken = motor.ticks

    def stop(self) -> None:
        """Short the winding, which brakes, until the next setpoint."""
        self.setpoint = None
        self.motor.voltage = 0.0
        self._pid.reset()

    def take_ticks(self) -> int:
        """Ticks since the last time this was asked."""
        ticks = self.motor.ticks
        taken, self._taken = self._taken, ticks
        return ticks - taken

    def step(self, dt: float) -> None:
        """Read the encoder, and set the bridge for the next `dt` seconds."""
        ticks = self.motor.ticks
        moved, self._seen = ticks - self._seen, ticks
        if self.setpoint is not None:
            measured = ticks if self.mode == "position" else moved / dt
            self.motor.voltage = self._pid.step(self.setpoint, measured, dt)
