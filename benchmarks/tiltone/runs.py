"""One run of tiltOne that stands: over the exact bus beside other modules, or over a network that delays and loses.

Everything is virtual time and seeds. The robot, its controllers and their gains are those of `r2p sim tiltone`; the
plants are `GEARED`, `TORQUE` and `LEGO` of its nodes.
"""

import asyncio
import contextlib
import functools
import math
import random
from collections.abc import AsyncIterator, Callable
from typing import NamedTuple

import msgspec

import r2p
from benchmarks.tiltone import delays
from r2p import sim
from r2p.clock import clock_of
from r2p.codecs import rtcan
from r2p.msg import IMU, Encoder, Proximity, Velocity3
from r2p.protocols.rtcan.cycle import timing
from r2p.sim.robots.shared_nodes import Traffic
from r2p.sim.robots.tiltone import nodes
from r2p.sim.robots.tiltone.robot import ControlInput, TiltOne
from r2p.transports.memory import network

PLANTS = {"geared": nodes.GEARED, "torque": nodes.TORQUE, "NXTway": nodes.LEGO}
TIMING = timing()
"""Cycles of 60 slots of 166 us."""
RESERVED = 4
"""Slots in each cycle: sync, effort, two encoders. Tilt and setpoint stay on their module."""
OWN = 0.05
"""The share of the free slots that take what else the robot sends, and the management of the network."""
STANDS = 1.0
"""Seconds from when the robot is let go until the network gets worse."""
MODULES = 3
"""Others on the bus that send, beside one that listens."""

_BUS = "sim:robot,latency=4us,jitter=3us"
_MEMORY = "memory:robot"
_NS = 1_000_000_000


class Stream(NamedTuple):
    """What each of the other modules sends at random instants: `weight` is how often, compared with the others."""

    topic: str
    message: r2p.Message
    size: int
    deadline: float
    """Of soft real-time messages, s; 0: non real-time."""
    weight: float

    @property
    def slots(self) -> int:
        """Its frames, each of which takes a slot."""
        return rtcan.fragment_count(self.size)


STREAMS = (
    Stream("ranges", Proximity(ranges=(110, 250, 333, 800)), 8, 0.02, 5.0),
    Stream("command", Velocity3(x=0.3, y=-0.1, w=0.7), 12, 0.05, 2.0),
    Stream("attitude", IMU(roll=0.1, pitch=-0.2, yaw=1.3, roll_rate=0.4, pitch_rate=-0.5, yaw_rate=0.6), 24, 0.0, 2.0),
    Stream("steps", Encoder(delta=1234.5), 4, 0.0, 2.0),
)
"""Ranges and commands as those of Triskar2, soft real-time; an attitude and an encoder, non real-time."""


class Scenario(msgspec.Struct, frozen=True, kw_only=True):
    """What is run. `network` is "bus", "memory", or a recording: "zenoh quiet", "tcp busy" and so on."""

    plant: str = "geared"
    network: str = "bus"
    traffic: Traffic = "hrt"
    """Of the setpoint and the efforts; everything else is as always."""
    load: float = 0.0
    """Of the bus by all together, as a share of the slots that nobody reserved; other modules add it to the robot's."""
    delay: float = 0.0
    """Of a memory network, s."""
    seed: int = 1
    after: float = 5.0
    """Seconds from when the robot is let go until the measurement starts: the same for all, as it still settles."""
    duration: float = 2.0
    """Seconds that are measured."""

    @property
    def background(self) -> float:
        """Frames a second that the other modules want to send."""
        free = (TIMING.slots - RESERVED) * _NS / TIMING.cycle
        return free * max(0.0, self.load - OWN)


class Outcome(msgspec.Struct, frozen=True):
    """What came of it. The motors' control steps every 2 ms; `ages` has an entry for each of these, and motor."""

    tilt: float
    """Root mean square, degrees; NaN if the robot fell."""
    torque: float
    """Of a motor at its wheel, root mean square, Nm."""
    ages: list[int]
    """Of the measurement that the effort in force follows from, at each step of the motors' control, us."""
    load: float
    """The share of the unreserved slots that were used, as measured."""


class Observer:
    """A part of the plant that notes tilt, torques and the age of what is in force, at each step."""

    def __init__(self, robot: TiltOne) -> None:
        self._body, self._drives = robot.hardware.body, robot.hardware.drives
        self._clock = clock_of()
        self._measured = [self._clock.now()] * 2
        self.reset()

    def reset(self) -> None:
        """Start to count anew."""
        self.ages: list[int] = []
        self._tilts = self._torques = 0.0

    def received(self, arrived: ControlInput) -> None:
        """Note when the tilt was measured that an effort follows from."""
        self._measured[arrived.wheel] = arrived.time - round(arrived.age * _NS)

    def step(self, _dt: float) -> None:
        """Note all of it."""
        now = self._clock.now()
        self._tilts += self._body.tilt**2
        for drive, measured in zip(self._drives, self._measured, strict=True):
            self.ages.append((now - measured) // 1000)
            self._torques += (drive.motor.current * drive.motor.spec.constant) ** 2

    def outcome(self, load: float) -> Outcome:
        """Return what was noted since `reset`."""
        count = len(self.ages)
        tilt = math.nan if self._body.fallen else math.degrees(math.sqrt(2 * self._tilts / count))
        return Outcome(tilt, math.sqrt(self._torques / count), [*self.ages], load)


def one(scenario: Scenario) -> Outcome:
    """Return what comes of a scenario."""
    return sim.run(functools.partial(_measured, scenario), seed=scenario.seed)


async def _measured(scenario: Scenario) -> Outcome:
    observers: list[Observer] = []
    bus = sim.can_bus("robot") if scenario.network == "bus" else None
    robot = TiltOne(
        _BUS if bus else _MEMORY,
        seed=scenario.seed,
        spec=PLANTS[scenario.plant],
        traffic=scenario.traffic,
        on_input=lambda arrived: observers[0].received(arrived),
    )
    observers.append(Observer(robot))
    robot.plant.parts.append(observers[0])
    async with robot:
        await robot.ready()
        await robot.release()
        loop = asyncio.get_running_loop()
        start = loop.time() + scenario.after
        await asyncio.sleep(STANDS)
        async with _disturbed(scenario):
            await asyncio.sleep(start - loop.time())
            observers[0].reset()
            if bus is not None:
                bus.bus.reset_statistics()
            await asyncio.sleep(scenario.duration)
            return observers[0].outcome(_load(bus, scenario.duration) if bus else 0.0)


def _load(bus: sim.SimCan, duration: float) -> float:
    """Return the share of the unreserved slots that were used since the last `reset_statistics`."""
    cycles = duration * _NS / TIMING.cycle
    return (bus.bus.statistics.total.frames / cycles - RESERVED) / (TIMING.slots - RESERVED)


@contextlib.asynccontextmanager
async def _disturbed(scenario: Scenario) -> AsyncIterator[None]:
    """What others do to the network, for the time of the block."""
    async with contextlib.AsyncExitStack() as stack:
        if scenario.network == "bus":
            if scenario.background:
                await _fill_bus(scenario, stack)
        elif scenario.network == "memory":
            network("robot").delay = scenario.delay
        else:
            transport, state = scenario.network.split()
            recordings = delays.load(transport)
            numbers = random.Random(f"{scenario.seed}/delays")
            replaying = delays.replay(recordings.of(state), recordings.period, network("robot"), numbers)
            stack.callback(asyncio.create_task(replaying).cancel)
        yield


async def _fill_bus(scenario: Scenario, stack: contextlib.AsyncExitStack) -> None:
    """Start the other modules."""
    rate = scenario.background / MODULES / sum(stream.weight * stream.slots for stream in STREAMS)
    modules = [
        await stack.enter_async_context(r2p.Module(f"OTHER{number}", via=_BUS, watchdog=False))
        for number in range(MODULES + 1)
    ]
    modules[0].start(_listen)
    ready = asyncio.Barrier(MODULES * len(STREAMS) + 1)
    for number, module in enumerate(modules[1:], 1):
        for stream in STREAMS:
            numbers = random.Random(f"{scenario.seed}/{number}/{stream.topic}")
            waits = functools.partial(numbers.expovariate, stream.weight * rate)
            each = functools.partial(_talk, stream=stream, number=number, waits=waits, ready=ready)
            module.start(each, name=stream.topic)
    await ready.wait()


async def _listen(node: r2p.Node) -> None:
    for number in range(1, MODULES + 1):
        for stream in STREAMS:
            node.subscribe(f"{stream.topic}{number}", type(stream.message), lambda _message: None, lossy=True)
    while True:
        await node.spin()


async def _talk(
    node: r2p.Node, stream: Stream, number: int, waits: Callable[[], float], ready: asyncio.Barrier
) -> None:
    topic, kind = f"{stream.topic}{number}", type(stream.message)
    publisher = (
        node.advertise(topic, kind, r2p.Sporadic(deadline=stream.deadline))
        if stream.deadline
        else node.advertise(topic, kind)
    )
    await publisher.wait_subscriber()
    await ready.wait()
    while True:
        await asyncio.sleep(waits())
        publisher.publish_nowait(stream.message)
