"""An emulated robot: hardware modules on one network, around the physics that they measure and drive.

A robot of its own is a class with a plant, and with a plan for each board:

    class Robot(EmulatedRobot):
        title = "Robot"
        names = ("MOTOR1", "IO1")

        def __init__(self, via: str | Transport, **options: Unpack[RobotOptions]) -> None:
            ...
            super().__init__(via, plant, {"MOTOR1": BoardPlan(make_motor), "IO1": BoardPlan(make_io, nodes)}, **options)
"""

import asyncio
import contextlib
import random
from collections.abc import Callable, Iterable, Mapping
from types import TracebackType
from typing import TYPE_CHECKING, ClassVar, Self, TypedDict

import msgspec

from r2p.bridge import BridgeOptions
from r2p.clock import check_timeout
from r2p.errors import Error, InvalidName
from r2p.runtime.publishers import AnyPublisher
from r2p.sim.modules.boards import Board, GatewayModule, ParameterOptions, Plant
from r2p.transports.link import Transport

if TYPE_CHECKING:
    from r2p.modules.supervisor import NodeFunction
    from r2p.sim.modules.boot import BoardBoot

_POLL = 0.02  # s
_SETTLED = 0.5  # s for which everything has to stay ready


class RobotHardware:
    """What a robot is without its modules, as the base of its own: `seed` is that of all random numbers."""

    def __init__(self, seed: object) -> None:
        self.seed = seed

    def noise(self, part: str) -> random.Random:
        """Return the random numbers for a part: the same for each seed, whatever other parts there are."""
        return random.Random(f"{self.seed}/{part}")


class BoardPlan(msgspec.Struct, frozen=True):
    """How a module is made, each time it is switched on, and the robot's nodes on it by name."""

    make: Callable[[str], Board]
    nodes: Mapping[str, "NodeFunction"] = {}


class RobotOptions(TypedDict, total=False):
    """What every robot takes, beside what is its own.

    `modules`: the modules to run in this process; default: all. `outside`: the gateway's links for computers, with
    these `options`. `parameters`: what the modules' parameters are at first, and the file that all of them save to.
    """

    modules: Iterable[str] | None
    outside: Iterable[str | Transport]
    options: BridgeOptions | None
    parameters: ParameterOptions | None


class EmulatedRobot:
    """A robot, on the network `via`, for the time of an `async with` block.

    Programs use it like a real one, on its network or through its gateway. Beside that, each module has a power switch.
    """

    title: ClassVar[str]
    """What people call it."""
    names: ClassVar[tuple[str, ...]]
    """Its modules."""
    extras: ClassVar[tuple[str, ...]] = ()
    """Those of them that start only by name, in `modules` or with `switch_on`."""

    def __init__(
        self,
        via: str | Transport,
        plant: Plant,
        boards: Mapping[str, BoardPlan],
        *,
        modules: Iterable[str] | None = None,
        outside: Iterable[str | Transport] = (),
        options: BridgeOptions | None = None,
        parameters: ParameterOptions | None = None,
    ) -> None:
        """`boards`: a plan for each of `names`. Raises InvalidName for a module that the robot does not have."""
        self.via = via
        self.plant = plant
        """The clock of the physics."""
        self.outside = list(outside)
        self.parameters = parameters
        self.modules: dict[str, Board] = {}
        """The modules that are switched on, by name."""
        self.boots: dict[str, BoardBoot] = {}
        """Loader and flash memory of each module that was ever switched on, by name."""
        self._options = options
        self._boards = boards
        self._first = [name for name in self.names if name not in self.extras] if modules is None else list(modules)
        for name in self._first:
            self._check_name(name)

    async def __aenter__(self) -> Self:
        """Start the physics, and switch on the modules. Raises TransportError for an invalid `via`."""
        async with contextlib.AsyncExitStack() as opening:  # also when cancelled: without the block, nothing is closed
            opening.push_async_exit(self)
            await self.plant.__aenter__()
            for name in self._first:
                await self.switch_on(name)
            opening.pop_all()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Switch off all modules, the last first, and stop the physics, also if one of them raises (NodeCrashed)."""
        closing = contextlib.AsyncExitStack()
        closing.push_async_exit(self.plant)
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
        self._check_name(name)
        if name in self.modules:
            raise Error(f"module {name} is on: switch it off first")
        async with contextlib.AsyncExitStack() as opening:
            plan = self._boards[name]
            board = self.modules[name] = plan.make(name)
            board.boot = self.boots.setdefault(name, board.boot)
            opening.callback(self.modules.pop, name)
            await opening.enter_async_context(board)
            for node, function in plan.nodes.items():
                board.start(function, name=node)
            opening.pop_all()
        return board

    async def switch_off(self, name: str) -> None:
        """Switch off the power of a module. Its nodes are cancelled in order, and it announces that it leaves.

        Raises InvalidName, Error if it is off, and NodeCrashed if nodes of it have crashed.
        """
        self._check_name(name)
        board = self.modules.pop(name, None)
        if board is None:
            raise Error(f"module {name} is off: switch it on first")
        await board.__aexit__(None, None, None)

    def make_gateway(self, name: str) -> GatewayModule:
        """Make the gateway between the robot's network and the links outside."""
        return GatewayModule(
            name, via=self.via, outside=self.outside, options=self._options, parameters=self.parameters
        )

    def _check_name(self, name: str) -> None:
        if name not in self.names:
            raise InvalidName(f"{self.title} has no module {name!r}: use {', '.join(self.names)}")
