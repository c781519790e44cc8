"""Two discoveries and a bad line between them, under a clock of their own."""

import heapq
import random
from collections.abc import Iterable

import msgspec

from r2p.codecs import management as m
from r2p.protocols.discovery.events import (
    Event,
    Mismatched,
    ModuleGone,
    PublisherFound,
    PublisherGone,
    Send,
    SubscriberJoined,
    SubscribersGone,
)
from r2p.protocols.discovery.negotiation import GRACE
from r2p.protocols.discovery.session import Discovery
from r2p.version import __version__

MS = 1_000_000
S = 1_000_000_000


def sent(events: Iterable[Event]) -> list[m.Management]:
    """The messages among the events."""
    return [m.decode(event.data) for event in events if isinstance(event, Send)]


def changes_in(events: Iterable[Event]) -> list[Event]:
    """The events that are not messages."""
    return [event for event in events if not isinstance(event, Send)]


def hear(discovery: Discovery, now: int, *messages: m.Management, source: object = None) -> list[Event]:
    """The events of receiving these messages."""
    return [event for message in messages for event in discovery.receive(now, m.encode(message), source)]


def run(discovery: Discovery, start: int, end: int) -> list[tuple[int, Event]]:
    """Poll it at its deadlines, from `start` until before `end`."""
    events: list[tuple[int, Event]] = []
    now = start
    while (due := discovery.next_deadline()) is not None and due < end:
        now = max(now, due)
        events += [(now, event) for event in discovery.poll(now)]
    return events


class Line(msgspec.Struct):
    """What the line does to a message: loses, repeats, delays it."""

    loss: float = 0.0
    repeat: float = 0.0
    delay: int = 0  # ns, at most


class Side:
    """Drives one discovery: attaches and opens topics as its events say, and keeps account."""

    def __init__(self, discovery: Discovery) -> None:
        self.discovery = discovery
        self.alive = True
        self.attached: set[str] = set()
        self.opened: set[str] = set()
        self.mismatched: set[tuple[str, int]] = set()
        self.unsolicited: list[int] = []
        self.rejoined: list[str] = []
        self.believed_dead = False

    def act(self, event: Event) -> None:
        match event:
            case SubscriberJoined(topic):
                if topic in self.attached:
                    self.rejoined.append(topic)
                self.attached.add(topic)
            case SubscribersGone(topic):
                self.attached.remove(topic)
            case PublisherFound(topic):
                self.opened.add(topic)
            case PublisherGone(topic):
                self.opened.remove(topic)
            case Mismatched(topic=topic, role=role):
                self.mismatched.add((topic, role))
            case ModuleGone():
                self.believed_dead = True


class World:
    """Two sides, `now`, and what is on its way."""

    def __init__(self, a: Discovery, b: Discovery, seed: int = 0) -> None:
        self.now = 0
        self.line = Line()
        self.a, self.b = Side(a), Side(b)
        self._on_the_way: list[tuple[int, int, Side, bytes]] = []
        self._random = random.Random(seed)
        self._sent = 0

    def do(self, side: Side, events: list[Event], *, solicited: bool = False) -> None:
        """Carry out the events of one side's discovery."""
        for event in events:
            if isinstance(event, Send):
                if not solicited:
                    side.unsolicited.append(self.now)
                self._send(self.b if side is self.a else self.a, event.data)
            else:
                side.act(event)

    def run(self, seconds: float) -> None:
        """Let that much time pass."""
        end = self.now + round(seconds * S)
        while (at := self._next()) <= end:
            self.now = max(self.now, at)
            self._step()
        self.now = end

    def _next(self) -> int:
        times = [side.discovery.next_deadline() for side in (self.a, self.b) if side.alive]
        times.append(self._on_the_way[0][0] if self._on_the_way else None)
        return min((time for time in times if time is not None), default=1 << 62)

    def _step(self) -> None:
        while self._on_the_way and self._on_the_way[0][0] <= self.now:
            _, _, side, data = heapq.heappop(self._on_the_way)
            if side.alive:
                self.do(side, side.discovery.receive(self.now, data), solicited=True)
        for side in (self.a, self.b):
            due = side.discovery.next_deadline()
            if side.alive and due is not None and due <= self.now:
                self.do(side, side.discovery.poll(self.now))

    def _send(self, side: Side, data: bytes) -> None:
        while self._random.random() >= self.line.loss:
            self._sent += 1
            at = self.now + self._random.randint(0, self.line.delay)
            heapq.heappush(self._on_the_way, (at, self._sent, side, data))
            if self._random.random() >= self.line.repeat:
                return


ONE = b"\x01" * 8
TWO = b"\x02" * 8
ME, PEER = 0x1111, 0x2222
SOON = 200 * MS
"""Before the next step of what is repeated."""
PC2 = m.Hello("PC2", PEER)


def own_hello(flags: int = 0, module: str = "PC1") -> m.Hello:
    """The HELLO of the module under test."""
    return m.Hello(module, ME, flags, wire=m.WIRE_VERSION, release=__version__)


REQUEST = m.SubscribeRequest("leds", 5, 8)
RESPONSE = m.SubscribeResponse("cmd", 12)


def started(*, observer: bool = False, quiet: float = 0.0) -> Discovery:
    """A module that publishes `leds` and subscribes `cmd`, 100 ms after its link went up."""
    discovery = Discovery("PC1", ME, observer=observer)
    discovery.set_pace(250.0, 32, quiet)
    discovery.advertise(0, "leds", 5, ONE)
    discovery.subscribe(0, "cmd", 12, 5, TWO)
    discovery.link_up(0)
    run(discovery, 0, 100 * MS)
    return discovery


def joined(discovery: Discovery, now: int, source: object = None) -> bool:
    """Whether a request for `leds` makes a subscriber that is new, or as good as new; of firmware: after its grace."""
    events = hear(discovery, now, REQUEST, source=source) + discovery.poll(now + GRACE)
    return any(isinstance(event, SubscriberJoined) for event in events)
