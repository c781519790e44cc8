"""The state of an emulated robot in figures, read from its counters, so that the display does not disturb it.

`FiguresReader` reads what all robots have, topics and the bus. What a robot has of its own is the `body` of the
figures; the parts that several have are here, too.
"""

import math
from collections import deque
from collections.abc import Callable, Iterable
from typing import Generic, NamedTuple, TypeVar

import msgspec

import r2p
from r2p.clock import clock_of
from r2p.codecs import rtcan
from r2p.msg import Odometry, Pose3
from r2p.runtime.publishers import AnyPublisher, PeriodicPublisher
from r2p.sim import SimCan
from r2p.sim.physics.motor import Drive
from r2p.sim.physics.world import Triple
from r2p.sim.robots.base import EmulatedRobot
from r2p.transports.rtcan.link import RtcanLink
from r2p.units import SECOND

_WINDOW = 1.0  # seconds to average rates over
_FRESH = 0.5  # seconds; odometry comes each 0.1 s
_LATE_MAX = 0.1  # of all periodic messages; even on a fast PC some are late
_LEFT_OUT = ("log", "current", "power")  # topics that are no part of the control chain
_HARD, _PERIODIC, _SOFT, _NOT = "hard: in slots", "by the clock", "soft: by deadline", "no"
_CLASSES = {
    r2p.PublisherClass.NON_REAL_TIME: _NOT,
    r2p.PublisherClass.SPORADIC: _SOFT,
    r2p.PublisherClass.PERIODIC: _PERIODIC,
}
_URGENCY = [_HARD, _PERIODIC, _SOFT, _NOT]

B = TypeVar("B")


class RobotTopicFigures(msgspec.Struct, frozen=True):
    """One publisher: its real-time class, messages per second, and messages since the start."""

    topic: str
    source: str
    real_time: str
    rate: float
    sent: int
    missed: int


class OdometryFigures(msgspec.Struct, frozen=True):
    """The last odometry: its pose, the true one when it arrived (m, m, rad), and how long ago that was (s)."""

    pose: Pose3
    truth: Triple
    age: float

    @property
    def fresh(self) -> bool:
        """Return whether the next message is in time."""
        return self.age <= _FRESH

    @property
    def off(self) -> float:
        """Distance of the two positions, m."""
        return math.hypot(self.pose.x - self.truth[0], self.pose.y - self.truth[1])


class OdometryCheck:
    """Compares odometry with the true pose."""

    def __init__(self, pose: Callable[[], Triple]) -> None:
        """`pose` returns the true one."""
        self.off_max = 0.0
        """The largest distance of an odometry from the true position so far, m."""
        self._pose = pose
        self._clock = clock_of()
        self._last: OdometryFigures | None = None
        self._received = 0

    def received(self, odometry: Odometry) -> None:
        """Compare a message with the true pose."""
        self._last = OdometryFigures(odometry.pose, self._pose(), 0.0)
        self._received = self._clock.monotonic()
        self.off_max = max(self.off_max, self._last.off)

    async def watch(self, node: r2p.Node) -> None:
        """Compare all messages of `odometry`: the function of a node."""
        node.subscribe("odometry", Odometry, self.received, queue=1, lossy=True)
        while True:
            await node.spin()

    @property
    def last(self) -> OdometryFigures | None:
        """The last one, with its age now."""
        last = self._last
        return last and OdometryFigures(last.pose, last.truth, (self._clock.monotonic() - self._received) / SECOND)


class WheelFigures(msgspec.Struct, frozen=True):
    """One wheel, in rad/s and A; without a setpoint its motor is stopped."""

    name: str
    on: bool
    setpoint: float | None
    speed: float
    current: float


def wheel_figures(robot: EmulatedRobot, name: str, drive: Drive) -> WheelFigures:
    """Return the figures of the wheel that the module `name` turns."""
    motor = drive.motor
    setpoint = None if drive.setpoint is None else drive.setpoint / motor.spec.ticks_per_radian
    return WheelFigures(name, name in robot.modules, setpoint, motor.speed, motor.current)


class RobotBusFigures(msgspec.Struct, frozen=True):
    """The bus: load (0 to 1) and frames per second, totals since the start, and reserved slots."""

    load: float
    rate: float
    frames: int
    errors: int
    slots: float
    """Reserved in each cycle, on average."""
    of: int
    mean: float = 0.0
    """Load since the start, 0 to 1."""


class RobotFigures(msgspec.Struct, Generic[B], frozen=True):
    """All figures at a time, in s since the start."""

    time: float
    body: B
    """What this robot has of its own."""
    topics: list[RobotTopicFigures]
    bus: RobotBusFigures | None
    late: float = 0.0
    """The share of periodic messages in the last second that began late, or were skipped: 0 to 1."""
    slow: float = 0.0
    """Seconds so far in which the computer was too slow."""

    @property
    def too_slow(self) -> bool:
        """Return whether the computer is too slow for the simulation: then figures of real time mean little."""
        return self.late > _LATE_MAX

    @property
    def missed(self) -> int:
        """Messages that missed their deadline."""
        return sum(topic.missed for topic in self.topics)


class _Reading(NamedTuple):
    """The counters at a time (s): messages by publisher; periodic ones, late and all; frames, bit times and errors of
    the bus since it was made.
    """

    time: float
    sent: dict[tuple[str, str], int]
    periodic: tuple[int, int]
    bus: tuple[int, int, int]


class FiguresReader(Generic[B]):
    """Reads the figures; rates are over at least a second, or since the first reading."""

    def __init__(
        self,
        robot: EmulatedRobot,
        bus: SimCan | None,
        body: Callable[[], B],
        modules: Iterable[r2p.Module] = (),
    ) -> None:
        """`body` reads what the robot has of its own. `modules`: others whose topics count.

        Messages from before now do not count.
        """
        self._slow = self._last = 0.0
        self._body = body
        self._robot = robot
        self._bus = bus
        self._others = list(modules)
        self._started = {_key(*each): (each[1].sent, each[1].missed) for each in self._publishers()}
        self._began = self._count(0.0)
        self._readings = deque([self._began])

    def read(self, time: float) -> RobotFigures[B]:
        """Return the figures; `time` is now, in s since the start."""
        now = self._count(time)
        self._readings.append(now)
        while self._readings[1].time <= time - _WINDOW:
            self._readings.popleft()
        topics = (self._topic(*each, now) for each in self._publishers())
        late = self._late(now)
        if late > _LATE_MAX:
            self._slow += time - self._last
        self._last = time
        return RobotFigures(
            time,
            self._body(),
            sorted(topics, key=lambda topic: (_URGENCY.index(topic.real_time), topic.topic)),
            None if self._bus is None else self._bus_figures(self._bus, now),
            late,
            self._slow,
        )

    def _late(self, now: _Reading) -> float:
        """Return the share of late messages since the first reading that counts; 0 after a module was switched off."""
        late, count = (new - old for new, old in zip(now.periodic, self._readings[0].periodic, strict=True))
        return min(1.0, max(0, late) / count) if count > 0 else 0.0

    def _modules(self) -> list[r2p.Module]:
        return [*self._others, *self._robot.modules.values()]

    def _publishers(self) -> list[tuple[r2p.Module, AnyPublisher]]:
        return [
            (module, publisher)
            for module in self._modules()
            for supervisor in module.nodes.values()
            for publisher in supervisor.node.publishers
            if not publisher.topic.startswith(_LEFT_OUT)
        ]

    def _count(self, time: float) -> _Reading:
        publishers = self._publishers()
        sent = {_key(*each): each[1].sent for each in publishers}
        periodic = [each for _, each in publishers if isinstance(each, PeriodicPublisher)]
        late = sum(each.late + each.skipped for each in periodic)
        ticks = late, sum(each.sent + each.skipped for each in periodic)
        if self._bus is None:
            return _Reading(time, sent, ticks, (0, 0, 0))
        total = self._bus.bus.statistics.total
        return _Reading(time, sent, ticks, (total.frames, total.occupied, total.errors))

    def _topic(self, module: r2p.Module, publisher: AnyPublisher, now: _Reading) -> RobotTopicFigures:
        key = _key(module, publisher)
        sent, missed = self._started.get(key, (0, 0))
        if publisher.sent < sent:  # its module was switched off and on
            sent, missed = self._started[key] = (0, 0)
        before = self._readings[0]
        return RobotTopicFigures(
            publisher.topic,
            module.name,
            _real_time(module, publisher),
            max(0, now.sent[key] - before.sent.get(key, 0)) / _span(before, now),
            publisher.sent - sent,
            publisher.missed - missed,
        )

    def _bus_figures(self, bus: SimCan, now: _Reading) -> RobotBusFigures:
        before = self._readings[0]
        span, bit = _span(before, now), bus.bus.bit / SECOND
        frames, occupied, _ = (count - old for count, old in zip(now.bus, before.bus, strict=True))
        all_frames, all_occupied, errors = (count - old for count, old in zip(now.bus, self._began.bus, strict=True))
        mean = all_occupied * bit / _span(self._began, now)
        return RobotBusFigures(occupied * bit / span, frames / span, all_frames, errors, *self._slots(), mean)

    def _slots(self) -> tuple[float, int]:
        """Return the reserved slots per cycle, and the slots of a cycle."""
        links = [link for module in self._modules() for link in module.links if isinstance(link, RtcanLink)]
        used, of = 0.0, 0
        for link in links:
            of = link.engine.timing.slots
            for each in link.slots.values():
                if each.period:
                    used += of / each.period * rtcan.fragment_count(each.size)
        return used, of


def _key(module: r2p.Module, publisher: AnyPublisher) -> tuple[str, str]:
    return module.name, publisher.topic


def _span(before: _Reading, now: _Reading) -> float:
    """Return the seconds between two readings; more than 0 also for the first one."""
    return max(now.time - before.time, 1e-9)


def _real_time(module: r2p.Module, publisher: AnyPublisher) -> str:
    """Return how a topic is sent: in its own slots, by the local clock, by a deadline, or without real time."""
    for link in module.links:
        if isinstance(link, RtcanLink) and publisher.topic in link.slots and link.slots[publisher.topic].period:
            return _HARD
    return _CLASSES[publisher.publisher_class]
