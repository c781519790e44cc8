"""The link of a module on an RTCAN bus: one engine on its port, and the discovery that runs over it.

    NonRealTime  non real-time: publishers wait for room
    Sporadic     soft real-time, least laxity first; what is late is dropped or sent, and signalled
    Periodic     hard real-time in slots of its own (`periodics`), without them soft real-time until the next period

Each class has room of its own, so bulk never refuses an event. Nothing is announced before the node has an id8. A
publisher is known by its 16-bit message id, which its SUBSCRIBE_RESPONSE tells: there is one inlet for each.
"""

from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

import msgspec

from r2p.codecs import rtcan
from r2p.codecs.attachment import Clock
from r2p.codecs.management import NO_PARAMS
from r2p.codecs.rtcan import PAYLOAD_MAX
from r2p.names import MANAGEMENT
from r2p.protocols.discovery import Discovery
from r2p.protocols.events import Event, ModuleGone, Opened, Shut
from r2p.protocols.rtcan.calendar import Calendar, Refusal
from r2p.protocols.rtcan.election import Role
from r2p.protocols.rtcan.engine import Engine
from r2p.protocols.rtcan.events import (
    LONG_AGO,
    NEVER,
    Action,
    Degraded,
    Done,
    Due,
    Granted,
    IdConflict,
    Mailbox,
    Profile,
    Ready,
    Received,
    Refused,
    Silenced,
    Unsilenced,
)
from r2p.protocols.rtcan.settings import Settings
from r2p.protocols.rtcan.topics import HighBytes
from r2p.publishers import PeriodicPublisher
from r2p.sample import PublisherClass, Sample
from r2p.topic import Advertised, Topic
from r2p.transports.link import Hub, Link
from r2p.transports.losses import Losses
from r2p.transports.rtcan import origins
from r2p.transports.rtcan.handover import Handed, Handover, publisher_of
from r2p.transports.rtcan.inlets import RtcanInlets
from r2p.transports.rtcan.origins import Origins
from r2p.transports.rtcan.periodics import Periodics, Slotted
from r2p.transports.rtcan.port import CanPort
from r2p.transports.rtcan.shell import Shell
from r2p.transports.rtcan.translation import Translation
from r2p.transports.rtcan.words import NOTICES, Words

if TYPE_CHECKING:
    import asyncio

_SECOND = 1_000_000_000
_MILLISECOND = 1_000_000
_STEADY = 10_000_000  # ns; two clocks of one computer stay together that long
_DEADLINE = 50 * _MILLISECOND  # of real-time messages that do not say: from other links, or latched
_NRT = PublisherClass.NON_REAL_TIME
_CLASSES = {
    Mailbox.HRT: PublisherClass.PERIODIC,
    Mailbox.SRT: PublisherClass.SPORADIC,
    Mailbox.NRT: PublisherClass.NON_REAL_TIME,
}
_MANAGEMENT = MANAGEMENT.encode()
_ADVERTISE, _RESPONSE = 0x21, 0x23
_LOSSES = ("undecodable", "management dropped")  # of what the engine counts: messages lost that were nobody's
_RATE, _BURST = 100.0, 24  # management messages a second: a tenth of the bus
_FIRMWARE_RATE, _FIRMWARE_BURST, _QUIET = 12.0, 4, 0.033  # on one id for all, which must not collide


class Arrived(msgspec.Struct, frozen=True, gc=False):
    """A whole message that came in; `message` is its id."""

    topic: bytes
    data: bytes
    message: int
    received: Received


class Response(msgspec.Struct, eq=False):
    """A SUBSCRIBE_RESPONSE on its way, and the topics that will have subscribers when it is there."""

    sent: bool = False
    topics: list[str] = msgspec.field(default_factory=list)


class RtcanLink(Link):
    """A module's place on an RTCAN bus. `utc_error` (ns): how well the module knows UTC; None: not at all."""

    longest: ClassVar[int] = PAYLOAD_MAX

    def __init__(self, name: str, hub: Hub, port: CanPort, settings: Settings, utc_error: int | None = None) -> None:
        discovery = Discovery(
            hub.space.module,
            hub.instance,
            rate=_RATE,
            burst=_BURST,
            observer=hub.observer,
            counts=Losses(name, hub.space.clock),
        )
        super().__init__(name, hub, discovery=discovery)
        self._paced = discovery
        self.engine = Engine(settings)
        self.stats.faults = self.engine.counts
        self.shell = Shell(self.engine, port, self)
        self.do: Callable[[Sequence[Action]], None] = self.shell.do
        self._now = port.now
        self._port = port
        self._utc_error = utc_error
        self._translation = Translation(self.network_time, self._clock.now, lambda: self.engine.epoch)
        self._high_bytes = HighBytes()
        self._origins = Origins(discovery, name)
        self._inlets = RtcanInlets(self.engine, self._intake, self._space, self.stats.lost)
        self._periodics = Periodics(self, self._clock, port.now, port.monotonic)
        self._words = Words(self.engine, port, settings)
        self._handover = Handover(name, self.stats)
        self._response: Response | None = None
        self._offset = 0  # of UTC from the monotonic clock (ns)
        self._offset_until = LONG_AGO
        self._on_bus = False
        self._waiters: list[asyncio.Future[None]] = []

    # For the shell

    def act(self, action: Action) -> None:
        if isinstance(action, Received):
            topic = self._inlets.topics.get(action.message, _MANAGEMENT)
            self._intake.take((Arrived(topic, action.payload, action.message, action),))
        elif isinstance(action, Done):
            self._done(action)
        elif isinstance(action, Due):
            self._periodics.due(action)
        else:
            self._learn(action)
            self.admitted()

    def bus_up(self) -> None:
        self._on_bus = True

    def bus_down(self, reason: str) -> None:
        self._on_bus = False
        if self.up:
            self.went_down(reason)
        else:
            self.unreachable(reason)
        self.admitted()

    def bus_waits(self, reason: str) -> None:
        self.unreachable(reason)

    def bus_fault(self, kind: str) -> None:
        self.stats.faults[kind] += 1

    def _learn(self, news: Action) -> None:
        match news:
            case Ready():
                self._ready(news)
            case Unsilenced() if self.engine.ready:
                self._notice(news)
                self._announce()
            case Granted():
                self._periodics.granted(news)
            case Refused():
                self._periodics.refused(news)
            case Degraded():
                self._periodics.degraded(news)
            case _ if not self._closed:
                text = self._notice(news)
                if isinstance(news, Silenced) or (isinstance(news, IdConflict) and news.yielded):
                    self.went_down(text)
                self._tell_utc()

    def _notice(self, news: Action) -> str:
        kind, text, trouble = NOTICES[type(news)](news)
        self._hub.link_notice(self, kind, text, trouble=trouble)
        return text

    def _ready(self, news: Ready) -> None:
        """The node has an id8, perhaps another one than before: announce everything under it."""
        if news.profile is Profile.FIRMWARE:
            self._paced.pace(_FIRMWARE_RATE, _FIRMWARE_BURST, _QUIET)
        else:
            self._paced.pace(_RATE, _BURST, 0.0)
        self.shell.refilter()
        if self.engine.silenced is None:
            self._announce()

    def _announce(self) -> None:
        for topic in list(self._space.topics.values()):
            self.topic_changed(topic)
        self.went_up()

    # In

    def sample(self, topic: str, arrival: Arrived) -> Sample:
        received = arrival.received
        self.stats.bytes_received += len(arrival.data)
        started = self._port.monotonic(self._started(received))
        now = self._now()
        if now >= self._offset_until:
            self._offset = self._clock.now() - self._clock.monotonic()
            self._offset_until = now + _STEADY
        stamp = self._offset + started
        source = self._origins.of(topic, arrival.message)
        laxity = received.laxity
        deadline = stamp + laxity * _MILLISECOND if rtcan.HRT < laxity < rtcan.SRT_MAX else 0
        sender = self.discovery.modules.get(source.module)
        return Sample(
            arrival.data,
            source,
            stamp,
            deadline,
            0,
            _CLASSES[received.mailbox],
            stamped=False,
            drop_late=sender is not None and sender.r2p,  # firmware says 50 ms of everything
            clock=self._translation.clock(now),
        )

    def _started(self, received: Received) -> int:
        """When it began. A coarse port does not know that to the bit, and counting them would take its time."""
        bit = self.engine.timing.bit
        if self._port.coarse:
            return received.stamp - rtcan.frame_bits_max(min(len(received.payload), rtcan.FRAME_MAX)) * bit
        return received.started(bit)

    def sender(self, arrival: Arrived) -> Hashable:
        return arrival.message

    def take_other(self, arrival: Any) -> None:
        data, message = arrival.data, arrival.message
        source = rtcan.id8_of(message)
        if message == rtcan.FIRMWARE_MANAGEMENT:
            source = origins.address(data, self.discovery.modules)
            data = origins.unmark(data)
        self._learn_high_byte(data, source)
        if self.up:  # before, we only listen
            self.manage(data, source)

    def _learn_high_byte(self, data: bytes, source: int) -> None:
        """Two topics must not share one: a publisher tells its own in what it offers; firmware only when asked."""
        kind, message = data[-1], origins.message_of(data[20:22])
        if kind != _RESPONSE and (kind != _ADVERTISE or source == origins.FIRMWARE):
            return
        shared = source in (origins.FIRMWARE, origins.R2P)
        if rtcan.high_byte(message) < rtcan.FIRST_TOPIC or not (shared or rtcan.id8_of(message) == source):
            return
        name = data[:16].partition(b"\0")[0].decode("ascii", "replace")
        ours = self._high_bytes.heard(name, message, self.engine.id8 or 0)
        topic = None if ours is None else self._space.topics.get(ours)
        if topic is not None:
            self.topic_changed(topic)

    # Out

    @property
    def full(self) -> bool:
        return self._handover.full

    def takes(self, sample: Sample) -> bool:
        return self._handover.takes(sample)

    def write(self, topic: str, sample: Sample) -> None:
        high = self._high_bytes.pick(topic)
        if high is None or not 1 <= len(sample.data) <= PAYLOAD_MAX:  # only from other links, with topics of any size
            self.stats.lost["impossible message"] += 1
            return
        now, outlet, drop = self._now(), self._outlets.get(topic), sample.drop_late
        publisher = publisher_of(outlet.topic, sample) if outlet else None
        deadline = NEVER if sample.publisher_class == _NRT else now + self._time_left(topic, sample, publisher)
        handed = self._handover.enter(publisher, sample, deadline)
        self.do(self.engine.publish(now, high, sample.data, deadline=deadline, drop=drop, handle=handed))

    def write_management(self, data: bytes, *, urgent: bool = False) -> None:
        handle = None
        if data[-1] == _RESPONSE and self.engine.ready:
            handle = self._response = Response()
        if self.engine.profile is Profile.FIRMWARE:
            data = origins.mark(data)
        self.do(self.engine.manage(self._now(), data, urgent=urgent, handle=handle))

    def _attach(self, name: str) -> None:
        """Once the last response is on the bus: an urgent message would overtake it, and find nobody."""
        if self._response is None or self._response.sent:
            super()._attach(name)
        else:
            self._response.topics.append(name)

    def _time_left(self, topic: str, sample: Sample, publisher: Advertised | None) -> int:
        """Ns until the deadline; a latched value that is sent once more has a new one."""
        left = sample.deadline - self._clock.now() if sample.deadline else 0
        if left > 0 or (sample.deadline and not (publisher is not None and publisher.latch)):
            return left
        slotted = self._periodics.by_topic.get(topic)
        return round(slotted.publisher.period * _SECOND) if slotted is not None else _DEADLINE

    def _done(self, done: Done) -> None:
        handed = done.handle
        if isinstance(handed, Slotted):
            self._periodics.done(handed, done)
        elif isinstance(handed, Handed):
            self._handover.done(handed, done)
            if self.room:
                self.made_room()
        elif isinstance(handed, Response):
            handed.sent = True
            for name in handed.topics:
                if self.up and name in self._space.topics:
                    super()._attach(name)

    # Topics

    def params(self, topic: str) -> bytes | None:
        if not self.engine.ready:
            return NO_PARAMS
        high = self._high_bytes.pick(topic)
        if high is None:
            self._hub.link_notice(self, "no id", f"topic {topic}: all message ids are taken", trouble=True)
            return None
        return origins.params_of(rtcan.message_id(high, self.engine.id8 or 0))

    def topic_changed(self, topic: Topic) -> None:
        super().topic_changed(topic)
        told = self._told.get(topic.name)
        if told is None or not told.publishes:
            self._high_bytes.drop(topic.name)
            self._periodics.follow(topic, None)
        elif self.engine.ready:
            high = None if self._words.no_slots else self._high_bytes.pick(topic.name)
            self._periodics.follow(topic, high)

    def carries(self, topic: str) -> bool:
        """Whether somebody subscribes the topic, and is in reach."""
        return self.up and topic in self._outlets

    def _act(self, event: Event) -> None:
        match event:
            case Opened(topic, source, params, size):
                self._inlets.open(topic, source, params, size)
                self.shell.refilter()
            case Shut(topic, source):
                self._inlets.shut(topic, source)
                self.shell.refilter()
            case _:
                if isinstance(event, ModuleGone) and isinstance(event.info.source, int):
                    self._high_bytes.gone(event.info.source)
                super()._act(event)

    # What it is worth

    @property
    def losses(self) -> Counter[str]:
        on_the_way: Iterable[Counter[str]] = self.engine.losses.values()
        ours = Counter({kind: count for kind in _LOSSES if (count := self.engine.counts[kind])})
        return sum(on_the_way, super().losses + ours)

    @property
    def slots(self) -> dict[str, Slotted]:
        """The periodic topics of this module, and how well their slots are kept."""
        return self._periodics.by_topic

    def guarantee(self, topic: str, publisher_class: PublisherClass) -> str:
        return self._words.guarantee(publisher_class, self._periodics.by_topic.get(topic))

    def best_effort(self, publisher_class: PublisherClass) -> bool:
        return publisher_class == PublisherClass.PERIODIC and bool(self._words.no_slots)

    def inadmissible(self, size: int, period: float) -> str | None:
        timing = self.engine.timing
        wanted = round(period * _SECOND) // timing.slot
        fragments = rtcan.fragment_count(size)
        answer = Calendar(timing.slots).admit(rtcan.FIRST_TOPIC << 8, wanted, fragments, round_down=True)
        return answer.text if isinstance(answer, Refusal) else None

    async def admission(self, topic: str) -> None:
        """Wait until a periodic topic sends in slots of its own, if it ever can."""
        while self._undecided(topic):
            waiter = self._space.loop.create_future()
            self._waiters.append(waiter)
            await waiter

    def _undecided(self, topic: str) -> bool:
        known = self._space.topics.get(topic)
        if known is None or not self._on_bus or self._words.no_slots or self._closed:
            return False
        if not any(isinstance(each, PeriodicPublisher) for each in known.publishers):
            return False
        slotted = self._periodics.by_topic.get(topic)
        return slotted is None or not (slotted.driven or slotted.elsewhere)

    def admitted(self) -> None:
        """A topic sends in its slots from now on, or never will."""
        waiters, self._waiters = self._waiters, []
        for waiter in waiters:
            if not waiter.done():
                waiter.set_result(None)

    # Time

    def network_time(self) -> int | None:
        return self.engine.network_time(self._now())

    def translation(self) -> Clock | None:
        return self._translation.clock(self._clock.monotonic())

    def utc(self) -> tuple[int, int] | None:
        """UTC by the RTCAN master, and how far off it may be (both ns). None: not known."""
        return self.engine.utc(self._now())

    def _tell_utc(self) -> None:
        if self._utc_error is not None and self.engine.role is Role.MASTER:
            self.engine.set_utc(self._now(), self._clock.now(), self._utc_error)

    def _poll(self) -> None:
        self._tell_utc()
        super()._poll()

    # Life

    def close(self) -> None:
        """Give the slots back and say good-bye; that takes a while on the bus: `shell.drained`."""
        if not self._closed:
            self._periodics.close()
            super().close()
            self.admitted()
