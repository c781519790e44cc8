"""Triskar2 in one piece: its hardware modules on one network, and the body that their motors drive.

    async with Triskar2("memory:robot", seed=1) as robot:
        ...
        print(robot.pose)

The robot has the modules of the thesis (8.1.2): three motor modules, two proximity modules, power supply and gateway.
Others of its kind (chapter 7) start only by name, as `await robot.switch_on("IMU1")` does: inertial sensors, inputs and
outputs, ultrasonic range finders.

Programs use it like a real one, on its network or through its gateway. An emulated robot also has its true pose.
"""

import asyncio
import enum
import functools
import math
from typing import TYPE_CHECKING, Any, Unpack

import msgspec

import r2p
from r2p.msg import Speed3
from r2p.sim.modules.boards import IoModule, MotorConfig, MotorModule, Part, Pins, Plant, PowerModule, leds, sample
from r2p.sim.modules.sensors import (
    ImuModule,
    InertialUnit,
    Motion,
    ProximityModule,
    RangeArray,
    SonarArray,
    SonarModule,
)
from r2p.sim.physics.inertial import ACCELEROMETER, GRAVITY, Vector
from r2p.sim.physics.motor import Drive, LeadBattery, Motor, rounded_gains, speed_gains
from r2p.sim.physics.ultrasonic import Beam, SonarSpec, echo
from r2p.sim.physics.world import OmniBody, Triple, World
from r2p.sim.robots import triskar2
from r2p.sim.robots.base import BoardPlan, EmulatedRobot, RobotHardware, RobotOptions
from r2p.sim.robots.shared_nodes import BATTERY, TIMEOUT, Traffic, battery_monitor
from r2p.transports.link import Transport

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

STEP = 0.002
"""Seconds of the physics, and of the control of the motors."""
FREQUENCY, DAMPING = 20.0, 0.8
"""Natural frequency (rad/s) and damping of the wheels' speed control, apart from the coupling of the wheels."""

MOTORS = ("MOTOR1", "MOTOR2", "MOTOR3")
PROXIMITY = {"PROX1": "prox_front", "PROX2": "prox_rear"}
"""The proximity modules and their topics."""
MODULES = (*MOTORS, *PROXIMITY, "PS", "GW")
EXTRAS = ("IMU1", "IO1", "PROX3")
"""Modules that start only by name."""
Side = enum.Enum(
    "Side",
    {
        "z": ((0, 1), (1, 1), (2, 1)),
        "-z": ((0, 1), (1, -1), (2, -1)),
        "x": ((2, 1), (1, 1), (0, -1)),
        "-x": ((2, -1), (1, 1), (0, 1)),
        "y": ((0, 1), (2, 1), (1, -1)),
        "-y": ((0, 1), (2, -1), (1, 1)),
    },
)
"""The side of the IMU that is up: for each of its axes, which axis of the robot it is along, and with which sign."""

_SENSORS_AT = 0.12  # m from the centre: an object that touches the robot is at the sensors' shortest range
_SONARS_AT = 0.20  # m from the centre
_SONARS = (0.0, 90.0, 180.0, -90.0)  # degrees from ahead
_IMU_AT = 0.08  # m ahead of the centre
_SCALE, _MISALIGNMENT = 0.01, 0.01  # of the accelerometer, one sigma from device to device
_THERMOMETER = 0.5, 0.01  # V at 0 degrees Celsius, and V per degree: TMP36
_BEAM = (-8.0, 0.0, 8.0)  # degrees: rays that model the width of a sensor's beam
_ELECTRONICS = 0.25  # A: the current of the modules


class Hardware(RobotHardware):
    """The body, its motors and its battery in the world: everything that is not a module."""

    def __init__(self, seed: object = 0, world: World | None = None) -> None:
        """`seed`: of all random numbers."""
        super().__init__(seed)
        self.world = world or World()
        self.motors = [Motor(triskar2.MOTOR) for _ in MOTORS]
        self.body = OmniBody(triskar2.BODY, self.motors, self.noise("body"))
        exact = speed_gains(triskar2.MOTOR, self.body.own, frequency=FREQUENCY, damping=DAMPING)
        gains = rounded_gains(exact, triskar2.MOTOR)
        self.drives = [Drive(motor, gains) for motor in self.motors]
        self.battery = LeadBattery(BATTERY)
        self.pins = Pins()
        """The connectors of the input/output module: LEDs at its digital outputs, a thermometer at input 0."""
        self.inertial = InertialUnit(
            self._motion,
            self.noise("IMU1"),
            accelerometer=msgspec.structs.replace(ACCELEROMETER, scale=_SCALE, misalignment=_MISALIGNMENT),
        )
        self.side = Side["z"]
        """The side of the inertial sensors that is up; others than z on the calibration cube."""
        self.plant = Plant([*self.drives, self.body, self], dt=STEP)

    def step(self, dt: float) -> None:
        """Drain the battery by motors and modules for `dt` seconds, after drives and body, and read the thermometer."""
        self.battery.supply(self.motors, _ELECTRONICS, dt)
        self.pins.inputs[0] = _THERMOMETER[0] + _THERMOMETER[1] * self.world.temperature

    def add(self, part: Part) -> None:
        """Let a part take part, from now on: sensors that no module reads cost nothing."""
        if part not in self.plant.parts:
            self.plant.parts.append(part)

    def distance_to_wall(self, angle: float) -> float:
        """Return the distance (mm) to the nearest wall in a range finder's beam; `angle` in degrees from ahead."""
        at = self.body.w + math.radians(angle)
        x = self.body.x + _SENSORS_AT * math.cos(at)
        y = self.body.y + _SENSORS_AT * math.sin(at)
        return 1000 * min(self.world.distance(x, y, at + math.radians(ray)) for ray in _BEAM)

    def echo(self, source: int, receiver: int) -> float:
        """Return the distance (m) from which an ultrasonic range finder hears itself or another one, or infinity."""
        return echo(self.world, self._beam(source), self._beam(receiver))

    def _beam(self, number: int) -> Beam:
        at = self.body.w + math.radians(_SONARS[number])
        x, y = self.body.x + _SONARS_AT * math.cos(at), self.body.y + _SONARS_AT * math.sin(at)
        return Beam(x, y, at, SonarSpec().half_angle)

    def _motion(self) -> Motion:
        """Return what the inertial sensors measure."""
        ahead, aside, turn = self.body.acceleration
        w = self.body.velocity[2]
        north, _, up = Motion().field
        return Motion(
            force=self._in_module((ahead - w * w * _IMU_AT, aside + turn * _IMU_AT, GRAVITY)),
            rates=self._in_module((0.0, 0.0, w)),
            field=self._in_module((north * math.cos(self.body.w), -north * math.sin(self.body.w), up)),
        )

    def _in_module(self, vector: Vector) -> Vector:
        """Return a vector of the robot along the axes of the inertial sensors."""
        (i, a), (j, b), (k, c) = self.side.value
        return a * vector[i], b * vector[j], c * vector[k]


async def cube(node: r2p.Node, hardware: Hardware) -> None:
    """Put the inertial sensors on a side of the calibration cube."""

    def turn(side: Side) -> None:
        hardware.side = side

    doc = "The side of the sensors that is up: z as they are mounted, others on a cube to calibrate them"
    turn(node.parameter("up", Side["z"], doc=doc, on_change=turn).value)
    await asyncio.Event().wait()


class Triskar2(EmulatedRobot):
    """The robot, on the network `via`, for the time of an `async with` block.

    `traffic` is the class of all messages of the command chain; None: the nodes' defaults. `RobotOptions` has the rest.
    Raises InvalidName for a module that the robot does not have, and TransportError for an invalid `via`.
    """

    title = "Triskar2"
    names = (*MODULES, *EXTRAS)
    extras = EXTRAS

    def __init__(
        self,
        via: str | Transport,
        *,
        seed: object = 0,
        world: World | None = None,
        traffic: Traffic | None = None,
        **options: Unpack[RobotOptions],
    ) -> None:
        self.hardware = Hardware(seed, world)
        chain: dict[str, Any] = {} if traffic is None else {"traffic": traffic}
        boards = {  # with the robot's nodes on each, as in the thesis (figure 8.3)
            "MOTOR1": BoardPlan(self._motor, {"invkin": functools.partial(triskar2.inverse_kinematics, **chain)}),
            "MOTOR2": BoardPlan(self._motor, {"fwdkin": triskar2.forward_kinematics}),
            "MOTOR3": BoardPlan(self._motor),
            "PROX1": BoardPlan(self._proximity, {"obstacle": functools.partial(triskar2.obstacle_avoidance, **chain)}),
            "PROX2": BoardPlan(self._proximity),
            "PS": BoardPlan(self._power_supply, {"battery": battery_monitor}),
            "GW": BoardPlan(self.make_gateway),
            "IMU1": BoardPlan(self._imu, {"cube": functools.partial(cube, hardware=self.hardware)}),
            "IO1": BoardPlan(self._inputs_outputs),
            "PROX3": BoardPlan(self._sonar),
        }
        super().__init__(via, self.hardware.plant, boards, **options)

    @property
    def pose(self) -> Triple:
        """The true pose: x and y in m, heading in rad, since the start."""
        body = self.hardware.body
        return body.x, body.y, body.w

    def _power_supply(self, name: str) -> PowerModule:
        return PowerModule(name, battery=self.hardware.battery, topic="power", via=self.via, parameters=self.parameters)

    def _motor(self, name: str) -> MotorModule:
        wheel = MOTORS.index(name)
        ticks = triskar2.MOTOR.ticks_per_radian
        config = MotorConfig(
            setpoint="speed",
            message=Speed3,
            ticks=lambda speeds: speeds.value[wheel] * ticks,
            timeout=TIMEOUT,
            encoder=f"encoder{wheel + 1}",
            period=triskar2.PERIOD,
            current=f"current{wheel + 1}",
        )
        return MotorModule(
            name, drive=self.hardware.drives[wheel], config=config, via=self.via, parameters=self.parameters
        )

    def _proximity(self, name: str) -> ProximityModule:
        topic = PROXIMITY[name]
        ahead = triskar2.SIDES[topic]

        def distance_to(number: int) -> float:
            return self.hardware.distance_to_wall(ahead + triskar2.BEARINGS[number])

        sensors = RangeArray(distance_to, self.hardware.noise(name))
        return ProximityModule(name, sensors=sensors, topic=topic, via=self.via, parameters=self.parameters)

    def _imu(self, name: str) -> ImuModule:
        self.hardware.add(self.hardware.inertial)
        unit, period = self.hardware.inertial, triskar2.PERIOD
        return ImuModule(name, unit=unit, period=period, via=self.via, parameters=self.parameters)

    def _inputs_outputs(self, name: str) -> IoModule:
        nodes: dict[str, Callable[..., Awaitable[object]]] = {
            "leds": leds,
            "thermometer": functools.partial(sample, topic="analog"),
        }
        return IoModule(name, pins=self.hardware.pins, nodes=nodes, via=self.via, parameters=self.parameters)

    def _sonar(self, name: str) -> SonarModule:
        sensors = SonarArray(
            self.hardware.echo, self.hardware.noise(name), temperature=lambda: self.hardware.world.temperature
        )
        return SonarModule(name, sensors=sensors, via=self.via, parameters=self.parameters)
