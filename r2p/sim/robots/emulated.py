"""Triskar2 in one piece: its hardware modules on one network, and the body that their motors drive.

    async with Triskar2("memory:robot", seed=1) as robot:
        ...
        print(robot.pose)

The robot has the modules of the thesis (8.1.2): three motor modules, two proximity modules, power supply and gateway.
Programs use it like a real one, on its network or through its gateway. An emulated robot also has its true pose, and a
power switch for each module.
"""

import asyncio
import contextlib
import functools
import math
import random
from collections.abc import Callable, Iterable
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from r2p.bridge import BridgeOptions
from r2p.clock import check_timeout
from r2p.errors import Error, InvalidName
from r2p.msg import Speed3
from r2p.runtime.publishers import AnyPublisher
from r2p.sim.modules.boards import (
    Board,
    GatewayModule,
    MotorConfig,
    MotorModule,
    ParameterOptions,
    Plant,
    PowerModule,
)
from r2p.sim.modules.sensors import ProximityModule, RangeArray
from r2p.sim.physics.motor import Drive, Gains, LeadBattery, Motor, speed_gains
from r2p.sim.physics.world import OmniBody, Triple, World
from r2p.sim.robots import triskar2
from r2p.transports.link import Transport

if TYPE_CHECKING:
    from r2p.modules.supervisor import NodeFunction
    from r2p.sim.modules.boot import BoardBoot

STEP = 0.002
"""Seconds of the physics, and of the control of the motors."""
FREQUENCY, DAMPING = 20.0, 0.8
"""Natural frequency (rad/s) and damping of the wheels' speed control, apart from the coupling of the wheels."""

MOTORS = ("MOTOR1", "MOTOR2", "MOTOR3")
PROXIMITY = {"PROX1": "prox_front", "PROX2": "prox_rear"}
"""The proximity modules and their topics."""
MODULES = (*MOTORS, *PROXIMITY, "PS", "GW")

_SENSORS_AT = 0.12  # m from the centre: an object that touches the robot is at the sensors' shortest range
_BEAM = (-8.0, 0.0, 8.0)  # degrees: rays that model the width of a sensor's beam
_POLL = 0.02  # s
_SETTLED = 0.5  # s for which everything has to stay ready
_ELECTRONICS = 0.25  # A: the current of the modules


class Hardware:
    """The body, its motors and its battery in the world: everything that is not a module."""

    def __init__(self, seed: object = 0, world: World | None = None) -> None:
        """`seed`: of all random numbers."""
        self.seed = seed
        self.world = world or World()
        self.motors = [Motor(triskar2.MOTOR) for _ in MOTORS]
        self.body = OmniBody(triskar2.BODY, self.motors, self.noise("body"))
        gains = _rounded(speed_gains(triskar2.MOTOR, self.body.own, frequency=FREQUENCY, damping=DAMPING))
        self.drives = [Drive(motor, gains) for motor in self.motors]
        self.battery = LeadBattery(triskar2.BATTERY)
        self.plant = Plant([*self.drives, self.body, self], dt=STEP)

    def step(self, dt: float) -> None:
        """Draw the current of motors and modules from the battery for `dt` seconds, after drives and body."""
        power = sum(motor.voltage * motor.current for motor in self.motors)
        self.battery.current = _ELECTRONICS + power / self.battery.voltage
        self.battery.step(dt)

    def noise(self, part: str) -> random.Random:
        """Return the random numbers for a part."""
        return random.Random(f"{self.seed}/{part}")

    def distance_to_wall(self, angle: float) -> float:
        """Return the distance (mm) to the nearest wall in a range finder's beam; `angle` in degrees from ahead."""
        at = self.body.w + math.radians(angle)
        x = self.body.x + _SENSORS_AT * math.cos(at)
        y = self.body.y + _SENSORS_AT * math.sin(at)
        return 1000 * min(self.world.distance(x, y, at + math.radians(ray)) for ray in _BEAM)


def _rounded(gains: Gains) -> Gains:
    """Return gains with two digits per radian of the wheel, as they are typed: 1.9 V/(rad/s) and 30 V/rad."""
    ticks = triskar2.MOTOR.ticks_per_radian
    kp, ki = (float(f"{each * ticks:.2g}") / ticks for each in (gains.kp, gains.ki))
    return Gains(kp, ki, limit=gains.limit)


class Triskar2:
    """The robot, on the network `via`, for the time of an `async with` block.

    `traffic` is the class of all messages of the command chain; None: the nodes' defaults. `modules`: the modules to
    run in this process; default: all. `outside`: the gateway's links for computers, with these `options`. `parameters`:
    what the modules' parameters are at first, and the file that all of them save to. Raises InvalidName for a module
    that the robot does not have, and TransportError for an invalid `via`.
    """

    def __init__(
        self,
        via: str | Transport,
        *,
        seed: object = 0,
        world: World | None = None,
        traffic: triskar2.Traffic | None = None,
        modules: Iterable[str] | None = None,
        outside: Iterable[str | Transport] = (),
        options: BridgeOptions | None = None,
        parameters: ParameterOptions | None = None,
    ) -> None:
        self.via = via
        self.outside = list(outside)
        self._options = options
        self._parameters = parameters
        self.hardware = Hardware(seed, world)
        self.modules: dict[str, Board] = {}
        """The modules that are switched on, by name."""
        self.boots: dict[str, BoardBoot] = {}
        """Loader and flash memory of each module that was ever switched on, by name."""
        chain: dict[str, Any] = {} if traffic is None else {"traffic": traffic}
        self._boards: dict[str, tuple[Callable[[str], Board], dict[str, NodeFunction]]] = {
            "MOTOR1": (self._motor, {"invkin": functools.partial(triskar2.inverse_kinematics, **chain)}),
            "MOTOR2": (self._motor, {"fwdkin": triskar2.forward_kinematics}),
            "MOTOR3": (self._motor, {}),
            "PROX1": (self._proximity, {"obstacle": functools.partial(triskar2.obstacle_avoidance, **chain)}),
            "PROX2": (self._proximity, {}),
            "PS": (self._power_supply, {"battery": triskar2.battery_monitor}),
            "GW": (self._gateway, {}),
        }
        """A factory for each module, and the robot's nodes on it, as in the thesis (figure 8.3)."""
        self._names = list(MODULES if modules is None else modules)
        for name in self._names:
            _check_name(name)

    @property
    def pose(self) -> Triple:
        """The true pose: x and y in m, heading in rad, since the start."""
        body = self.hardware.body
        return body.x, body.y, body.w

    async def __aenter__(self) -> Self:
        async with contextlib.AsyncExitStack() as opening:  # also when cancelled: without the block, nothing is closed
            opening.push_async_exit(self)
            await self.hardware.plant.__aenter__()
            for name in self._names:
                await self.switch_on(name)
            opening.pop_all()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Switch off all modules, the last first, and stop the physics, also if one of them raises (NodeCrashed)."""
        closing = contextlib.AsyncExitStack()
        closing.push_async_exit(self.hardware.plant)
        for name, board in self.modules.items():
            closing.push_async_exit(board)
            closing.callback(self.modules.pop, name)
        await closing.__aexit__(kind, error, trace)

    async def ready(self, timeout: float | None = None) -> None:
        """Wait until the network has admitted all publishers and has settled (with an elected master, on RTCAN).

        Raises TimeoutError after `timeout` seconds, and MessageError for a time-out that is not a number of seconds.
        """
        check_timeout("the time-out of ready", timeout)
        time = asyncio.get_running_loop().time
        async with asyncio.timeout(timeout):
            since = time()
            while time() < since + _SETTLED:
                await asyncio.sleep(_POLL)
                before = time()
                for publisher in self.publishers():
                    await publisher.ready()
                waited = time() > before + _POLL  # to ask those that are ready takes time, too, but less
                if waited or not all(link.up for board in self.modules.values() for link in board.links):
                    since = time()

    def publishers(self) -> list[AnyPublisher]:
        """Return the publishers of all nodes of its modules."""
        nodes = [each.node for board in self.modules.values() for each in board.nodes.values()]
        return [publisher for node in nodes for publisher in node.publishers]

    async def switch_on(self, name: str) -> Board:
        """Switch on the power of a module. Raises InvalidName, and Error if it is on."""
        _check_name(name)
        if name in self.modules:
            raise Error(f"module {name} is on: switch it off first")
        async with contextlib.AsyncExitStack() as opening:
            make, nodes = self._boards[name]
            board = self.modules[name] = make(name)
            board.boot = self.boots.setdefault(name, board.boot)
            opening.callback(self.modules.pop, name)
            await opening.enter_async_context(board)
            for node, function in nodes.items():
                board.start(function, name=node)
            opening.pop_all()
        return board

    async def switch_off(self, name: str) -> None:
        """Switch off the power of a module. Its nodes are cancelled in order, and it announces that it leaves.

        Raises InvalidName, Error if it is off, and NodeCrashed if nodes of it have crashed.
        """
        _check_name(name)
        board = self.modules.pop(name, None)
        if board is None:
            raise Error(f"module {name} is off: switch it on first")
        await board.__aexit__(None, None, None)

    def _gateway(self, name: str) -> GatewayModule:
        return GatewayModule(
            name, via=self.via, outside=self.outside, options=self._options, parameters=self._parameters
        )

    def _power_supply(self, name: str) -> PowerModule:
        return PowerModule(
            name, battery=self.hardware.battery, topic="power", via=self.via, parameters=self._parameters
        )

    def _motor(self, name: str) -> MotorModule:
        wheel = MOTORS.index(name)
        ticks = triskar2.MOTOR.ticks_per_radian
        config = MotorConfig(
            setpoint="speed",
            message=Speed3,
            ticks=lambda speeds: speeds.value[wheel] * ticks,
            timeout=triskar2.TIMEOUT,
            encoder=f"encoder{wheel + 1}",
            period=triskar2.PERIOD,
            current=f"current{wheel + 1}",
        )
        return MotorModule(
            name, drive=self.hardware.drives[wheel], config=config, via=self.via, parameters=self._parameters
        )

    def _proximity(self, name: str) -> ProximityModule:
        topic = PROXIMITY[name]
        ahead = triskar2.SIDES[topic]

        def distance_to(number: int) -> float:
            return self.hardware.distance_to_wall(ahead + triskar2.BEARINGS[number])

        sensors = RangeArray(distance_to, self.hardware.noise(name))
        return ProximityModule(name, sensors=sensors, topic=topic, via=self.via, parameters=self._parameters)


def _check_name(name: str) -> None:
    if name not in MODULES:
        raise InvalidName(f"Triskar2 has no module {name!r}: use {', '.join(MODULES)}")
