"""Networks of engines for tests, and what happened on their bus."""

from typing import Any

from r2p.codecs import rtcan
from r2p.codecs.rtcan import Frame
from r2p.protocols.can_orders import Outcome, Transmit
from r2p.protocols.rtcan.engine import Engine
from r2p.protocols.rtcan.events import Due, EngineSettings, Profile
from tests.protocols.rtcan.bus import SECOND, Bus, Node

CYCLE = 9_960_000
SLOT = 166_000
TOPIC = 5


def network(bus: Bus, *priorities: int, **settings: Any) -> list[Node]:
    """Nodes with id8 10, 11, ... that have found their master."""
    nodes = [bus.add(id8=10 + i, priority=priority, **settings) for i, priority in enumerate(priorities)]
    bus.start()
    bus.run(2 * SECOND)
    return nodes


def publish(node: Node, high: int, data: bytes, deadline: int | None = None, *, drop: bool = True) -> None:
    """Soft real-time within `deadline` ns; without, non real-time. The handle is the data."""
    if deadline is None:
        node.act(node.engine.publish(node.now, high, data, handle=data))
    else:
        node.act(node.engine.publish(node.now, high, data, deadline=node.now + deadline, drop=drop, handle=data))


def starts(bus: Bus, high: int, laxity: int | None = None) -> list[int]:
    """When the frames of a topic started."""
    return [
        at
        for at, frame, _ in bus.sent
        if rtcan.high_byte(rtcan.message_of(frame.id)) == high
        and (laxity is None or rtcan.laxity_of(frame.id) == laxity)
        and not is_sync(frame)
    ]


def is_sync(frame: Frame) -> bool:
    return rtcan.is_sync(frame.id)


def syncs(bus: Bus, since: int = 0) -> list[tuple[int, Node]]:
    return [(at, node) for at, frame, node in bus.sent if is_sync(frame) and at >= since]


def current_cycle(engine: Engine) -> int | None:
    """The counter of its cycle; None: it has none."""
    return engine.cycle.counter if engine.cycle.running else None


def counted(node: Node, size: int = 8) -> list[bytes]:
    """Its periodic message gets a running number."""
    filled: list[bytes] = []

    def fill(due: Due) -> bytes:
        filled.append(len(filled).to_bytes(size, "little"))
        return filled[-1]

    node.fill = fill
    return filled


def ready_engine(**settings: Any) -> tuple[Engine, int]:
    """An engine that is ready, without a bus, and has nothing to say for the next second."""
    engine = Engine(EngineSettings(number=1 << 40, id8=10, profile=Profile.RTCAN, **settings))
    actions = list(engine.start(0))
    while (at := engine.next_deadline()) is not None and at < 2 * SECOND:
        actions = list(engine.poll(at))
        for action in actions:
            if isinstance(action, Transmit):
                actions += engine.confirm(at, action.mailbox, Outcome.SENT, at)
    assert engine.ready
    return engine, 2 * SECOND


def next_transmit(node: Node) -> Transmit:
    """Poll, without the bus, until there is a frame to transmit."""
    while True:
        at = node.engine.next_deadline()
        assert at is not None
        for action in node.engine.poll(at):
            if isinstance(action, Transmit):
                return action


def firmware_management(bus: Bus, node: Node, text: bytes) -> None:
    """A firmware module says something."""
    for left, data in rtcan.fragments(text.ljust(31, b"\0") + b"\x11"):
        node.act(node.engine.receive(node.now, Frame(rtcan.encode_identifier(50, 0, left), data), node.now))
