"""tiltOne in one piece: its hardware modules on one network, and the pendulum that their motors keep upright.

    async with TiltOne("memory:robot", seed=1) as robot:
        await robot.release()
        ...
        robot.shove(5.0)

The robot has the modules of the thesis (8.3.2): two motor modules, inertial measurement unit, power supply and gateway.
Hands hold it upright at first, as its modules take a while to start.
"""

import asyncio
import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple, Unpack

import msgspec

from r2p.clock import Clock, clock_of
from r2p.msg import Effort2
from r2p.sim.modules.boards import MotorConfig, MotorModule, Plant, PowerModule
from r2p.sim.modules.sensors import ImuModule, InertialUnit, Motion
from r2p.sim.physics.inertial import (
    ACCELEROMETER,
    GRAVITY,
    GYROSCOPE,
    ComplementaryFilter,
    GyroscopeRange,
    MemsSpec,
)
from r2p.sim.physics.motor import Drive, Gains, LeadBattery, Motor
from r2p.sim.physics.pendulum import Pendulum
from r2p.sim.physics.world import Triple
from r2p.sim.robots.base import BoardPlan, EmulatedRobot, RobotHardware, RobotOptions
from r2p.sim.robots.shared_nodes import BATTERY, Traffic, battery_monitor, forward_kinematics
from r2p.sim.robots.tiltone import nodes
from r2p.transports.link import Transport

STEP = 0.002
"""Seconds of the physics, and of the control of the motors."""
MOTORS = ("MOTOR1", "MOTOR2")
"""Left and right."""
MODULES = (*MOTORS, "IMU1", "PS", "GW")

_ELECTRONICS = 0.25  # A: the current of the modules
_IMU_HEIGHT = 0.1  # m above the axle
_FIELD = (220.0, -400.0)  # mgauss, to the north and up
_CALIBRATED = 0.05  # of the sensors' biases is left after a calibration
_FILTER = (0.2, 0.01)  # gains of the attitude, 1/s and 1/s^2: an acceleration of the robot must not look like a tilt
_POLL = 0.02  # s


class ControlInput(NamedTuple):
    """An effort that arrived at a motor: the control step ends here."""

    wheel: int
    """0 is the left one."""
    time: int
    """UTC, ns."""
    age: float
    """Since the measurement that it follows from, s."""
    effort: float
    """V or Nm."""


class InputAges:
    """The age of what the motors' efforts follow from, at each arrival."""

    def __init__(self) -> None:
        self.count = 0
        self.worst = self._sum = 0.0

    def add(self, age: float) -> None:
        """Count an age, s."""
        self.count += 1
        self._sum += age
        self.worst = max(self.worst, age)

    @property
    def mean(self) -> float:
        """Seconds; 0 without any."""
        return self._sum / self.count if self.count else 0.0


class TiltOneHardware(RobotHardware):
    """The body, its motors, its battery and its inertial sensors: everything that is not a module."""

    def __init__(self, seed: object = 0, spec: nodes.BalanceSpec = nodes.GEARED, payload: float = 0.0) -> None:
        """`seed`: of all random numbers. `payload` in kg."""
        super().__init__(seed)
        self.spec = spec
        self.motors = [Motor(spec.motor) for _ in MOTORS]
        self.body = Pendulum(msgspec.structs.replace(spec.body, payload=payload), *self.motors)
        self.body.held = True
        limit = Gains(0.0, limit=spec.motor.voltage)
        self.drives = [Drive(motor, limit, mode=spec.mode) for motor in self.motors]
        self.battery = LeadBattery(BATTERY)
        self.inertial = InertialUnit(
            self._motion,
            self.noise("IMU1"),
            accelerometer=msgspec.structs.replace(ACCELEROMETER, bias=ACCELEROMETER.bias * _CALIBRATED),
            gyroscope=_gyroscope(),
            attitude=ComplementaryFilter(gain=_FILTER[0], bias_gain=_FILTER[1]),
        )
        self.plant = Plant([*self.drives, self.body, self.inertial, self], dt=STEP)
        self._raising = 0.0  # rad/s

    def step(self, dt: float) -> None:
        """Draw the current of motors and modules from the battery for `dt` seconds, after drives and body."""
        self.battery.supply(self.motors, _ELECTRONICS, dt)
        if self._raising:
            self._raise(dt)

    def stand_up(self, seconds: float) -> None:
        """Hold the robot, and turn it upright."""
        self.body.held = True
        self._raising = -self.body.tilt / seconds

    def _raise(self, dt: float) -> None:
        left = -self.body.tilt
        turn = math.copysign(min(abs(left), abs(self._raising) * dt), left)
        self.body.raise_by(turn, dt)
        if not self.body.tilt:
            self._raising = 0.0

    def _motion(self) -> Motion:
        """Return what the inertial sensors measure."""
        body = self.body
        sin, cos, q, r = math.sin(body.tilt), math.cos(body.tilt), body.tilt_rate, body.turn_rate
        ahead = body.wheel_acceleration * self.spec.body.wheel_radius
        north, up = _FIELD
        forward = north * math.cos(body.w)
        return Motion(
            force=(
                ahead * cos - GRAVITY * sin + _IMU_HEIGHT * body.tilt_acceleration,
                body.velocity * r,
                ahead * sin + GRAVITY * cos - _IMU_HEIGHT * q * q,
            ),
            rates=(-r * sin, q, r * cos),
            field=(forward * cos - up * sin, -north * math.sin(body.w), forward * sin + up * cos),
        )


def _gyroscope() -> MemsSpec:
    """Return the data sheet of the calibrated gyroscope, in a range that a fall does not exceed."""
    full_scale, resolution = GyroscopeRange["500dps"].value
    bias = GYROSCOPE.bias * _CALIBRATED
    return msgspec.structs.replace(GYROSCOPE, full_scale=full_scale, resolution=resolution, bias=bias)


class TiltOne(EmulatedRobot):
    """The robot, on the network `via`, for the time of an `async with` block.

    `spec` is its body with motors and gains: `GEARED`, `TORQUE` or `LEGO` of `nodes`, or another one. `payload` in kg.
    `traffic` is the class of what the two controllers send. `on_input` is called with each effort that arrives at a
    motor. `RobotOptions` has the rest. Raises InvalidName for a module that the robot does not have, and
    TransportError for an invalid `via`.
    """

    title = "tiltOne"
    names = MODULES

    def __init__(
        self,
        via: str | Transport,
        *,
        seed: object = 0,
        spec: nodes.BalanceSpec = nodes.GEARED,
        payload: float = 0.0,
        traffic: Traffic = "hrt",
        on_input: Callable[[ControlInput], object] | None = None,
        **options: Unpack[RobotOptions],
    ) -> None:
        self.hardware = TiltOneHardware(seed, spec, payload)
        self.ages = InputAges()
        """How old the tilt was that the efforts follow from, when they arrived at the motors."""
        self._on_input = on_input
        self._clock: Clock | None = None
        chain: dict[str, Any] = {"spec": spec, "traffic": traffic}
        kinematics = functools.partial(
            forward_kinematics,
            body_velocity=spec.body.body_velocity,
            wheels=len(MOTORS),
            motor=spec.motor,
            encoder_period=nodes.PERIOD,
            rounds=10,
        )
        boards = {  # with the robot's nodes on each, as in the thesis (figure 8.7)
            "MOTOR1": BoardPlan(self._motor),
            "MOTOR2": BoardPlan(self._motor, {"fwdkin": kinematics}),
            "IMU1": BoardPlan(
                self._imu,
                {
                    "velocity": functools.partial(nodes.velocity_control, **chain),
                    "balance": functools.partial(nodes.balance_control, **chain),
                },
            ),
            "PS": BoardPlan(self._power_supply, {"battery": battery_monitor}),
            "GW": BoardPlan(self.make_gateway),
        }
        super().__init__(via, self.hardware.plant, boards, **options)

    @property
    def pose(self) -> Triple:
        """The true pose of the point between the wheels: x and y in m, heading in rad, since the start."""
        body = self.hardware.body
        return body.x, body.y, body.w

    def hold(self) -> None:
        """Hold the robot in its present pose, until `let_go`."""
        self.hardware.body.held = True

    def let_go(self) -> None:
        """Release the robot: from now on its controllers have to keep it upright."""
        self.hardware.body.held = False

    def shove(self, impulse: float, height: float = 1.0) -> None:
        """Hit it from behind, or from ahead (negative): an impulse in Ns, so many m above the axle."""
        self.hardware.body.shove(impulse, height)

    async def set_upright(self, seconds: float = 2.0) -> None:
        """Raise it from the floor within so many seconds, hold it until its motors work, and let go."""
        self.hardware.stand_up(seconds)
        await asyncio.sleep(seconds)
        await self.release()

    async def release(self) -> None:
        """Hold it until its motors work, then let go: the controllers first make sure that it is upright."""
        while not all(drive.setpoint for drive in self.hardware.drives):  # noqa: ASYNC110 - physics have no events
            await asyncio.sleep(_POLL)
        self.let_go()

    def _power_supply(self, name: str) -> PowerModule:
        return PowerModule(name, battery=self.hardware.battery, topic="power", via=self.via, parameters=self.parameters)

    def _imu(self, name: str) -> ImuModule:
        return ImuModule(
            name,
            unit=self.hardware.inertial,
            period=nodes.PERIOD,
            topics=["tilt"],
            via=self.via,
            parameters=self.parameters,
        )

    def _motor(self, name: str) -> MotorModule:
        wheel = MOTORS.index(name)
        config = MotorConfig(
            setpoint="effort",
            message=Effort2,
            ticks=functools.partial(self._received, wheel),
            timeout=nodes.TIMEOUT,
            encoder=f"encoder{wheel + 1}",
            period=nodes.PERIOD,
            current=f"current{wheel + 1}",
        )
        return MotorModule(
            name, drive=self.hardware.drives[wheel], config=config, via=self.via, parameters=self.parameters
        )

    def _received(self, wheel: int, message: Effort2) -> float:
        """Return the effort of a wheel, and note how old its input is."""
        clock = self._clock = self._clock or clock_of()
        now, effort = clock.now(), message.value[wheel] * self.hardware.spec.count
        age = nodes.age_of(message, now)
        self.ages.add(age)
        if self._on_input is not None:
            self._on_input(ControlInput(wheel, now, age, effort))
        return effort
