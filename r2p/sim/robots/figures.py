"""What an emulated robot does, in figures: read from its counters, so that looking changes nothing."""

import math
from collections.abc import Iterable

import msgspec

import r2p
from r2p.msg import Odometry
from r2p.publishers import AnyPublisher
from r2p.sim import SimCan
from r2p.sim.physics.omni import Triple
from r2p.sim.robots.emulated import MOTORS, Triskar2
from r2p.transports.rtcan.link import RtcanLink

_LEFT_OUT = ("log", "current", "power")
_CLASSES = {1: "", 2: "by deadline", 3: "by the clock"}


class TopicFigures(msgspec.Struct, frozen=True):
    """One publisher: how it sends, messages each second since the last look, and in all."""

    topic: str
    source: str
    how: str
    rate: float
    sent: int
    missed: int


class WheelFigures(msgspec.Struct, frozen=True):
    """One wheel: rad/s and A; no setpoint: its motor is stopped."""

    name: str
    on: bool
    setpoint: float | None
    speed: float
    current: float


class BusFigures(msgspec.Struct, frozen=True):
    """The bus: its load (0 to 1) and frames each second since the last look, and the slots that are reserved."""

    load: float
    rate: float
    frames: int
    errors: int
    slots: float
    """Of each cycle, in the mean."""
    of: int


class Figures(msgspec.Struct, frozen=True):
    """All of them; the clock in s since the start."""

    time: float
    pose: Triple
    path: float
    odometry: Odometry | None
    off: float | None
    """How far the last odometry was from the truth when it came, m."""
    wheels: list[WheelFigures]
    battery: tuple[float, float, float]
    """V, A, and 0 to 1."""
    topics: list[TopicFigures]
    bus: BusFigures | None

    @property
    def missed(self) -> int:
        """Messages that were not everywhere in time."""
        return sum(topic.missed for topic in self.topics)


class Gauge:
    """Reads the figures; rates are those since the reading before."""

    def __init__(self, robot: Triskar2, bus: SimCan | None, modules: Iterable[r2p.Module] = ()) -> None:
        """`modules`: other ones whose topics count. What was missed before now does not."""
        self._odometry: Odometry | None = None
        self._off: float | None = None
        self._robot = robot
        self._bus = bus
        self._others = list(modules)
        self._at = 0.0
        self._frames = self._occupied = 0
        self._missed: dict[tuple[str, str], int] = {}
        self._sent: dict[tuple[str, str], int] = {}
        self._missed = {(topic.source, topic.topic): topic.missed for topic in self._topics(1.0)}

    def told(self, odometry: Odometry) -> None:
        """Odometry came."""
        x, y, _ = self._robot.pose
        self._odometry = odometry
        self._off = math.hypot(odometry.pose.x - x, odometry.pose.y - y)

    def read(self, time: float) -> Figures:
        """At this moment, in s since the start."""
        hardware = self._robot.hardware
        span = max(time - self._at, 1e-9)
        self._at = time
        battery = hardware.battery
        return Figures(
            time,
            self._robot.pose,
            hardware.body.path,
            self._odometry,
            self._off,
            [self._wheel(wheel, name) for wheel, name in enumerate(MOTORS)],
            (battery.voltage, battery.current, battery.charge),
            self._topics(span),
            None if self._bus is None else self._bus_figures(self._bus, span),
        )

    def _wheel(self, wheel: int, name: str) -> WheelFigures:
        drive = self._robot.hardware.drives[wheel]
        motor = drive.motor
        setpoint = None if drive.setpoint is None else drive.setpoint / motor.spec.ticks_per_radian
        return WheelFigures(name, name in self._robot.modules, setpoint, motor.speed, motor.current)

    def _modules(self) -> list[r2p.Module]:
        return [*self._others, *self._robot.modules.values()]

    def _topics(self, span: float) -> list[TopicFigures]:
        return [
            self._topic(module, publisher, span)
            for module in self._modules()
            for supervisor in module.nodes.values()
            for publisher in supervisor.node.publishers
            if not publisher.topic.startswith(_LEFT_OUT)
        ]

    def _topic(self, module: r2p.Module, publisher: AnyPublisher, span: float) -> TopicFigures:
        key = (module.name, publisher.topic)
        before, self._sent[key] = self._sent.get(key, 0), publisher.sent
        rate = max(0, publisher.sent - before) / span
        missed = max(0, publisher.missed - self._missed.get(key, 0))
        return TopicFigures(publisher.topic, module.name, _how(module, publisher), rate, publisher.sent, missed)

    def _bus_figures(self, bus: SimCan, span: float) -> BusFigures:
        total = bus.bus.statistics.total
        frames, self._frames = total.frames - self._frames, total.frames
        occupied, self._occupied = total.occupied - self._occupied, total.occupied
        slots, of = self._slots()
        return BusFigures(occupied * bus.bus.bit / span / 1e9, frames / span, total.frames, total.errors, slots, of)

    def _slots(self) -> tuple[float, int]:
        """How many of a cycle are reserved, and how many there are."""
        links = [link for module in self._modules() for link in module.links if isinstance(link, RtcanLink)]
        used, of = 0.0, 0
        for link in links:
            of = link.engine.timing.slots
            for each in link.slots.values():
                if each.period:
                    used += of / each.period * max(1, math.ceil(each.publisher.size / 8))
        return used, of


def _how(module: r2p.Module, publisher: AnyPublisher) -> str:
    """How it is sent: in slots of its own, by a deadline, by the local clock."""
    for link in module.links:
        if isinstance(link, RtcanLink) and publisher.topic in link.slots and link.slots[publisher.topic].period:
            return "in slots"
    return _CLASSES[publisher.publisher_class]
