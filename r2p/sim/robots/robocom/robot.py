"""Robocom in one piece: its hardware modules on one network, and the body that their motors drive.

    async with Robocom("sim:robocom", seed=1) as robot:
        ...
        print(robot.pose)

The robot has the modules of the thesis (8.2.2): two motor modules, IMU with a GPS receiver, power supply and gateway.
On a simulated bus each module has a crystal of its own, and takes a while to notice a frame, as microcontrollers do.
"""

import functools
import math
from typing import TYPE_CHECKING, ClassVar, NamedTuple, Unpack

import msgspec

import r2p
from r2p.clock import clock_of
from r2p.msg import IMURaw9, Speed2, StampedPose3, Timestamp
from r2p.sim.modules import stamped
from r2p.sim.modules.boards import MotorConfig, MotorModule, Plant, PowerModule
from r2p.sim.modules.sensors import ImuModule, InertialUnit, Motion
from r2p.sim.physics.differential import DifferentialBody
from r2p.sim.physics.gps import GpsReceiver, GpsSpec, GpsTruth
from r2p.sim.physics.inertial import GRAVITY
from r2p.sim.physics.motor import Drive, LeadBattery, Motor, rounded_gains, speed_gains
from r2p.sim.physics.world import Triple
from r2p.sim.robots.base import BoardPlan, EmulatedRobot, RobotHardware, RobotOptions
from r2p.sim.robots.robocom import nodes
from r2p.sim.robots.shared_nodes import TIMEOUT, battery_monitor
from r2p.transports.link import Transport
from r2p.units import SECOND

if TYPE_CHECKING:
    from r2p.modules.supervisor import NodeFunction

STEP = 0.002
"""Seconds of the physics, and of the control of the motors."""
FREQUENCY, DAMPING = 15.0, 0.8
"""Natural frequency (rad/s) and damping of the wheels' speed control, straight ahead."""
MOTORS = ("MOTOR1", "MOTOR2")
"""Left and right."""
MODULES = (*MOTORS, "IMU1", "PS", "GW")

_DRIFT = 20.0  # ppm, one sigma: crystals
_FIELD = (220.0, -400.0)  # mgauss, to the north and up
_TRUTH = 0.1  # s
_ELECTRONICS = 2.5  # A: modules and computer


class InterruptLatency(msgspec.Struct, frozen=True):
    """How long modules take to notice a frame: `latency` s, give or take `jitter` s. The default is an assumption."""

    latency: float = 5e-6
    jitter: float = 3e-6


class SampleTaken(NamedTuple):
    """One sample: the module that took it, and when, by the clock of the simulation (monotonic ns), which is exact."""

    module: str
    at: int


class RobocomHardware(RobotHardware):
    """The body, its motors, sensors and battery: everything that is not a module."""

    def __init__(self, seed: object = 0, gps: GpsSpec | None = None) -> None:
        """`seed`: of all random numbers. The clock of the GPS is that of the running loop."""
        super().__init__(seed)
        self.clock = clock_of()
        self.motors = [Motor(nodes.MOTOR) for _ in MOTORS]
        self.body = DifferentialBody(nodes.BODY, self.motors, self.noise("body"))
        exact = speed_gains(nodes.MOTOR, self.body.ahead, frequency=FREQUENCY, damping=DAMPING)
        gains = rounded_gains(exact, nodes.MOTOR)
        self.drives = [Drive(motor, gains) for motor in self.motors]
        self.unit = InertialUnit(self._motion, self.noise("imu"))
        self.receiver = GpsReceiver(gps or GpsSpec(), self._antenna, self.clock.now, self.noise("gps"))
        self.battery = LeadBattery(nodes.BATTERY)
        self.plant = Plant([*self.drives, self.body, self.unit, self.receiver, self], dt=STEP)
        self.samples: list[SampleTaken] | None = None
        """When samples were taken, if it is a list."""
        self._stepped = self.clock.monotonic()

    def step(self, dt: float) -> None:
        """Draw the current of motors and modules from the battery for `dt` seconds, after all others."""
        self.battery.supply(self.motors, _ELECTRONICS, dt)
        self._stepped = self.clock.monotonic()

    def ticks(self, wheel: int) -> int:
        """Read the encoder of a wheel, at this very instant: the physics may have been stepped a moment ago."""
        motor = self.motors[wheel]
        now = self.clock.monotonic()
        self._sampled(MOTORS[wheel], now)
        since = min(STEP, (now - self._stepped) / SECOND)
        return math.floor((motor.angle + motor.speed * since) * motor.spec.ticks_per_radian)

    def inertial(self) -> IMURaw9:
        """Read the inertial sensors."""
        self._sampled("IMU1", self.clock.monotonic())
        return self.unit.raw()

    def _sampled(self, module: str, at: int) -> None:
        if self.samples is not None:
            self.samples.append(SampleTaken(module, at))

    def _motion(self) -> Motion:
        """Return what the inertial sensors feel, in the middle of the axle."""
        body = self.body
        north, up = _FIELD
        field = north * math.cos(body.w), -north * math.sin(body.w), up
        return Motion((*body.acceleration, GRAVITY), (0.0, 0.0, body.velocity[1]), field)

    def _antenna(self) -> GpsTruth:
        body = self.body
        v = body.velocity[0]
        return GpsTruth(body.x, body.y, v * math.cos(body.w), v * math.sin(body.w))


class Robocom(EmulatedRobot):
    """The robot, on the network `via`, for the time of an `async with` block.

    With `truth` the gateway publishes where the robot really is, on `truth`: a node that no real robot has.
    `interrupts` are those of its modules, on a simulated bus (`sim:NAME`). `RobotOptions` has the rest. Raises
    InvalidName for a module that the robot does not have, and TransportError for an invalid `via`.
    """

    title = "Robocom"
    names: ClassVar[tuple[str, ...]] = MODULES

    def __init__(
        self,
        via: str | Transport,
        *,
        seed: object = 0,
        gps: GpsSpec | None = None,
        truth: bool = False,
        interrupts: InterruptLatency = InterruptLatency(),  # noqa: B008 - a frozen value
        **options: Unpack[RobotOptions],
    ) -> None:
        self.hardware = hardware = RobocomHardware(seed, gps)
        self._interrupts = interrupts
        boards = {  # with the robot's nodes on each, as in the thesis (figure 8.5)
            "MOTOR1": BoardPlan(self._motor, {"encoder": self._encoder(0), "invkin": nodes.inverse_kinematics}),
            "MOTOR2": BoardPlan(self._motor, {"encoder": self._encoder(1), "fwdkin": nodes.forward_kinematics}),
            "IMU1": BoardPlan(
                self._imu,
                {
                    "imu_raw": functools.partial(
                        stamped.raw_imu, read=hardware.inertial, topic="imu_raw", period=nodes.IMU_PERIOD
                    ),
                    "gps": functools.partial(stamped.gps, receiver=hardware.receiver, topic="gps"),
                },
            ),
            "PS": BoardPlan(self._power_supply, {"battery": functools.partial(battery_monitor, spec=nodes.BATTERY)}),
            "GW": BoardPlan(self.make_gateway, {"truth": self._truth} if truth else {}),
        }
        super().__init__(via, hardware.plant, boards, **options)

    @property
    def pose(self) -> Triple:
        """The true pose: x and y in m, heading in rad, since the start."""
        body = self.hardware.body
        return body.x, body.y, body.w

    async def _truth(self, node: r2p.Node) -> None:
        """Publish the true pose, sampled with the encoders and the inertial sensors."""

        def stamp(time: Timestamp, pose: Triple) -> StampedPose3:
            return StampedPose3(time, *pose)

        await stamped.publish_together(node, "truth", StampedPose3, _TRUTH, lambda: self.pose, stamp)

    def _link(self, name: str) -> str | Transport:
        """Return the link of a module: on a simulated bus with its own clock and interrupts."""
        if not isinstance(self.via, str) or not self.via.startswith("sim:"):
            return self.via
        each = self._interrupts
        drift = self.hardware.noise(f"{name} crystal").gauss(0, _DRIFT)
        return f"{self.via},drift={drift:.3f},latency={each.latency * 1e6:g}us,jitter={each.jitter * 1e6:g}us"

    def _power_supply(self, name: str) -> PowerModule:
        return PowerModule(
            name, battery=self.hardware.battery, topic="power", via=self._link(name), parameters=self.parameters
        )

    def _motor(self, name: str) -> MotorModule:
        wheel = MOTORS.index(name)
        ticks = nodes.MOTOR.ticks_per_radian
        config = MotorConfig(
            setpoint="speed",
            message=Speed2,
            ticks=lambda speeds: speeds.value[wheel] * ticks,
            timeout=TIMEOUT,
            encoder="",
            current=f"current{wheel + 1}",
        )
        return MotorModule(
            name, drive=self.hardware.drives[wheel], config=config, via=self._link(name), parameters=self.parameters
        )

    def _encoder(self, wheel: int) -> "NodeFunction":
        read = functools.partial(self.hardware.ticks, wheel)
        return functools.partial(stamped.encoder, read=read, topic=nodes.ENCODERS[wheel], period=nodes.PERIOD)

    def _imu(self, name: str) -> ImuModule:
        return ImuModule(name, unit=self.hardware.unit, topics=(), via=self._link(name), parameters=self.parameters)
