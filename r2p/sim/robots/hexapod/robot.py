"""The hexapod in one piece: 20 hardware modules on one network, and the legs that they move.

    async with Hexapod("sim:robot", seed=1) as robot:
        await robot.ready()
        ...
        await robot.unplug("LM2")
        await robot.switch_on("LM2")

The thesis wants up to 20 modules on a bus (3.3.1), and has no robot of so many. This one has 18 motor modules, one at
each joint, a power supply and a gateway.
"""

import functools
import random
from typing import Unpack

from r2p.sim.modules.boards import MotorConfig, MotorModule, Plant, PowerModule
from r2p.sim.physics.legs import JOINT_MOTOR, Joint, Legs, LegSpec
from r2p.sim.physics.motor import Drive, Gains, LeadBattery, Motor
from r2p.sim.physics.world import Triple
from r2p.sim.robots.base import BoardPlan, EmulatedRobot, RobotOptions
from r2p.sim.robots.hexapod import nodes
from r2p.sim.robots.shared_nodes import BATTERY, battery_monitor
from r2p.sim.transport import can_bus
from r2p.transports.link import Transport
from r2p.transports.url import parse

STEP = 0.005
"""Seconds of the physics, and of the control of the joints."""
MOTORS = tuple(f"{leg.upper()}{joint + 1}" for leg in nodes.LEGS for joint in range(nodes.JOINTS))
"""LF1 to RR3: leg by leg; 1 hip, 2 shoulder, 3 knee."""
MODULES = (*MOTORS, "PS", "GW")
GAINS = Gains(kp=200.0 / JOINT_MOTOR.ticks_per_radian, limit=JOINT_MOTOR.voltage)
"""Of the position of each joint: 200 V/rad."""

_ASSEMBLED = 0.0175  # rad by which joints differ at first
_ELECTRONICS = 1.0  # A: the current of the modules


class HexapodHardware:
    """The legs with their motors, and the battery: everything that is not a module."""

    def __init__(self, seed: object = 0, spec: LegSpec = nodes.BODY) -> None:
        """`seed`: of all random numbers."""
        self.seed = seed
        self.motors = [Motor(JOINT_MOTOR) for _ in MOTORS]
        self.drives = [Drive(motor, GAINS, mode="position") for motor in self.motors]
        numbers = random.Random(f"{seed}/assembly")
        for leg in range(len(nodes.LEGS)):  # it lies on its belly, and no joint is where another one is
            home = spec.angles(0.0, spec.reach, -spec.belly)
            for motor, angle in zip(self.motors[nodes.JOINTS * leg :], home, strict=False):
                motor.angle = angle + numbers.uniform(0.0, _ASSEMBLED)
        self.body = Legs(spec, [Joint(motor, spec.link_inertia) for motor in self.motors])
        self.battery = LeadBattery(BATTERY)
        self.plant = Plant([*self.drives, self.body, self], dt=STEP)

    def step(self, dt: float) -> None:
        """Draw the current of motors and modules from the battery for `dt` seconds, after drives and legs."""
        self.battery.supply(self.motors, _ELECTRONICS, dt)


class Hexapod(EmulatedRobot):
    """The robot, on the network `via`, for the time of an `async with` block.

    `RobotOptions` has the rest. Raises InvalidName for a module that the robot does not have, and TransportError for
    an invalid `via`.
    """

    title = "Hexapod"
    names = MODULES

    def __init__(self, via: str | Transport, *, seed: object = 0, **options: Unpack[RobotOptions]) -> None:
        self.hardware = HexapodHardware(seed)
        boards = {
            name: BoardPlan(
                self._motor,
                {"position": functools.partial(nodes.position, drive=drive, topic=f"joint_{name.lower()}")},
            )
            for name, drive in zip(MOTORS, self.hardware.drives, strict=True)
        }
        boards["LM1"] = BoardPlan(self._motor, {**boards["LM1"].nodes, "gait": nodes.gait})
        boards["RM1"] = BoardPlan(self._motor, {**boards["RM1"].nodes, "odometry": nodes.legged_odometry})
        boards["PS"] = BoardPlan(self._power_supply, {"battery": battery_monitor})
        boards["GW"] = BoardPlan(self.make_gateway)
        super().__init__(via, self.hardware.plant, boards, **options)

    @property
    def pose(self) -> Triple:
        """The true pose of the body's middle: x and y in m, heading in rad, since the start."""
        body = self.hardware.body
        return body.x, body.y, body.w

    async def unplug(self, name: str) -> None:
        """Unplug a module, on a simulated bus even in the middle of a frame: nothing is announced. `switch_on` plugs it
        in again. Raises as `switch_off` does.
        """
        via = self.via if isinstance(self.via, str) else ""
        if name in self.modules and via.startswith("sim:"):
            can_bus(parse(via).address).port(name).power_off()
        await self.switch_off(name)

    def _power_supply(self, name: str) -> PowerModule:
        return PowerModule(name, battery=self.hardware.battery, topic="power", via=self.via, parameters=self.parameters)

    def _motor(self, name: str) -> MotorModule:
        number = MOTORS.index(name)
        leg, joint = divmod(number, nodes.JOINTS)
        scale = nodes.COUNT * JOINT_MOTOR.ticks_per_radian
        config = MotorConfig(
            setpoint=f"leg_{nodes.LEGS[leg]}",
            message=nodes.LegAngles,
            ticks=lambda angles: angles.value[joint] * scale,
            timeout=nodes.TIMEOUT,
            encoder="",
            current=f"current_{name.lower()}",
            current_period=1.0,
        )
        return MotorModule(
            name, drive=self.hardware.drives[number], config=config, via=self.via, parameters=self.parameters
        )
