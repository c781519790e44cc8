"""The link of a module on an RTCAN bus: one engine on its port, and the discovery that runs over it.

    NonRealTime  non real-time: publishers wait for room
    Sporadic     soft real-time, least laxity first; what is late is dropped or sent, and signalled
    Periodic     hard real-time in slots of its own (`periodics`), without them soft real-time until the next period

Each class has room of its own, so bulk never refuses an event. Nothing is announced before the node has an id8. A
publisher is known by its 16-bit message id, which its SUBSCRIBE_RESPONSE tells: there is one inlet for each.
"""

from collections import Counter
from collections.abc import Callable, Hashable, Sequence
from typing import Any, ClassVar

from r2p.codecs import management, rtcan
from r2p.codecs.attachment import ClockOffset
from r2p.codecs.management import NO_PARAMS
from r2p.names import MANAGEMENT
from r2p.protocols.discovery.events import Event, ModuleGone, PublisherFound, PublisherGone
from r2p.protocols.rtcan.engine import Engine
from r2p.protocols.rtcan.events import (
    Action,
    Degraded,
    Done,
    Due,
    EngineSettings,
    Granted,
    IdConflict,
    ParameterMismatch,
    ParametersMatch,
    Ready,
    Received,
    Refused,
)
from r2p.protocols.rtcan.master import Role
from r2p.protocols.rtcan.topic_ids import TopicIdAllocator
from r2p.runtime.sample import PublisherClass, Sample
from r2p.runtime.topic import Topic
from r2p.transports.buffered_link import BufferedLink
from r2p.transports.can.port import CanPort
from r2p.transports.link import Hub, unique_name
from r2p.transports.rtcan import rx as origins
from r2p.transports.rtcan.driver import EngineDriver
from r2p.transports.rtcan.options import discovery_on, pace
from r2p.transports.rtcan.rx import MessageIdMap, ReceivedMessage, SampleBuilder
from r2p.transports.rtcan.slots import SlottedTopic, SlottedTopics, inadmissible
from r2p.transports.rtcan.status import LinkStatus, UtcEstimator
from r2p.transports.rtcan.tx import Handed, Response, Transmitter, TxAccounting

_MANAGEMENT = MANAGEMENT.encode()
_LOSSES = ("undecodable", "management dropped")  # of what the engine counts: messages lost that were nobody's


class RtcanLink(BufferedLink):
    """A module's place on an RTCAN bus. `utc_error` (ns): how well the module knows UTC; None: not at all."""

    max_payload: ClassVar[int] = rtcan.PAYLOAD_MAX
    has_slots: ClassVar[bool] = True

    def __init__(
        self, name: str, hub: Hub, port: CanPort, settings: EngineSettings, utc_error: int | None = None
    ) -> None:
        name = unique_name(name, hub)
        discovery = discovery_on(hub, name)
        super().__init__(name, hub, discovery=discovery)
        self._paced = discovery
        self.engine = Engine(settings)
        self.stats.faults = self.engine.counts
        self.shell = EngineDriver(self.engine, port, self)
        self.do: Callable[[Sequence[Action]], None] = self.shell.do
        self._now = port.now
        self._utc_error = utc_error
        self._translation = UtcEstimator(self.network_time, self._clock.now, lambda: self.engine.epoch)
        self._high_bytes = TopicIdAllocator()
        self._samples = SampleBuilder(name, self.engine, port, discovery, self._translation, self._clock)
        self._inlets = MessageIdMap(self.engine, self, self._space, self.stats.lost)
        self._periodics = SlottedTopics(self, self._clock, port.now, port.monotonic)
        self._words = LinkStatus(self.engine, port, settings)
        self._handover = TxAccounting(name, self.stats)
        self._departures = Transmitter(self.engine, port, self._handover, self._periodics, self._clock)
        self._on_bus = False

    # For the shell

    def act(self, action: Action) -> None:
        if isinstance(action, Received):
            topic = self._inlets.topics.get(action.message, _MANAGEMENT)
            if topic is _MANAGEMENT and action.message in self._inlets.shutting:
                self.stats.lost["not subscribed"] += 1
                return
            self.receive((ReceivedMessage(topic, action.payload, action.message, action),))
        elif isinstance(action, Done):
            self._done(action)
        elif isinstance(action, Due):
            self._periodics.due(action)
        else:
            self._learn(action)
            self._periodics.look()

    def bus_up(self) -> None:
        self._on_bus = True

    def bus_down(self, reason: str) -> None:
        self._on_bus = False
        down = self.on_down if self.up else self.unreachable
        down(reason)
        self._periodics.look()

    def bus_waits(self, reason: str) -> None:
        self.unreachable(reason)

    def bus_fault(self, kind: str) -> None:
        self.stats.faults[kind] += 1

    def internal_error(self, error: Exception) -> None:
        self.stats.lost.internal_error(error)

    def _learn(self, news: Action) -> None:
        match news:
            case Ready():
                self._ready(news)
            case ParametersMatch() if self.engine.ready:
                self._notice(news)
                self._announce()
            case Granted() | Refused() | Degraded():
                self._periodics.learn(news)
            case _ if not self._closed:
                text = self._notice(news)
                if isinstance(news, ParameterMismatch) or (isinstance(news, IdConflict) and news.yielded):
                    self.on_down(text)
                self._tell_utc()

    def _notice(self, news: Action) -> str:
        kind, text, trouble = self._words.notice(news)
        self._hub.link_notice(self, kind, text, trouble=trouble)
        return text

    def _ready(self, news: Ready) -> None:
        """The node has an id8, perhaps another one than before: announce everything under it."""
        self._high_bytes.pace(pace(self._paced, news.profile, self.engine.timing.bit))
        self.shell.refilter()
        self._announce()

    def _announce(self) -> None:
        for topic in list(self._space.topics.values()):
            self.stats.lost.guard(self.topic_changed, topic)
        self.on_up()

    # In

    def sample(self, topic: str, arrival: ReceivedMessage) -> Sample:
        self.stats.bytes_received += len(arrival.data)
        return self._samples.make(topic, arrival)

    def sender(self, arrival: ReceivedMessage) -> Hashable:
        return arrival.message

    def receive_other(self, arrival: Any) -> None:
        data, message = arrival.data, arrival.message
        source = rtcan.id8_of(message)
        if message == rtcan.FIRMWARE_MANAGEMENT:
            source = origins.address(data, self.discovery.modules)
            data = management.unmark(data)
        told = origins.publisher_in(data, source)
        if told is not None:
            firmware = source == origins.FIRMWARE and message == rtcan.FIRMWARE_MANAGEMENT
            now, id8 = self._clock.monotonic(), self.engine.id8 or 0
            self._renumber(self._high_bytes.heard(now, *told, id8, firmware=firmware))
        if self.up:  # before, we only listen
            self.manage(data, source)

    def _renumber(self, names: Sequence[str]) -> None:
        """These topics of ours have to take another high byte, or may find one now."""
        for name in names:
            topic = self._space.topics.get(name)
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
        if (
            high is None or not 1 <= len(sample.data) <= self.max_payload
        ):  # only from other links, with topics of any size
            self.stats.lost["impossible message"] += 1
            return
        self.do(self._departures.send(self._subscribers.get(topic), topic, high, sample))

    def write_management(self, data: bytes, *, urgent: bool = False) -> None:
        self.do(self._departures.manage(data, urgent=urgent))

    def _add_subscriber(self, name: str) -> None:
        if not self._departures.follows_response(name):
            super()._add_subscriber(name)

    def _remove_subscriber(self, name: str) -> None:
        self._departures.forget(name)
        super()._remove_subscriber(name)

    def _done(self, done: Done) -> None:
        handed = done.handle
        if isinstance(handed, SlottedTopic):
            self._periodics.done(handed, done)
        elif isinstance(handed, Handed):
            self._handover.done(handed, done)
            if self.wait_queue:
                self.made_room()
        elif isinstance(handed, Response):
            for name in self._departures.answered(handed):
                if self.up:
                    super()._add_subscriber(name)

    # Topics

    def params(self, topic: str) -> bytes | None:
        if not self.engine.ready:
            return NO_PARAMS
        high = self._high_bytes.pick(topic)
        if high is None:
            return None
        return management.rtcan_params(rtcan.message_id(high, self.engine.id8 or 0))

    def topic_changed(self, topic: Topic) -> None:
        refused = self._high_bytes.refused
        known = topic.name in refused
        refused.discard(topic.name)
        super().topic_changed(topic)
        if topic.name in refused and not known:
            text = f"topic {topic.name}: all message ids are taken; it is published as soon as one comes free"
            self._hub.link_notice(self, "no id", text, trouble=True)
        told = self._announced.get(topic.name)
        if told is None or not told.publishes:
            self._high_bytes.drop(topic.name)
            self._periodics.follow(topic, None)
        elif self.engine.ready:
            self._periodics.follow(topic, None if self._words.no_slots else self._high_bytes.pick(topic.name))

    def carries(self, topic: str) -> bool:
        return self.up and topic in self._subscribers

    def _act(self, event: Event) -> None:
        match event:
            case PublisherFound(topic, source, params, size):
                self._inlets.open(self._clock.monotonic(), topic, source, params, size)
                self.shell.refilter()
            case PublisherGone(topic, source):
                self._inlets.shut(self._clock.monotonic(), topic, source)
                self.shell.refilter()
            case _:
                if isinstance(event, ModuleGone) and isinstance(event.info.source, int):
                    self._high_bytes.gone(event.info.source)
                super()._act(event)

    # What it is worth

    @property
    def losses(self) -> Counter[str]:
        ours = Counter({kind: count for kind in _LOSSES if (count := self.engine.counts[kind])})
        return sum(self.engine.losses.values(), super().losses + ours)

    @property
    def slots(self) -> dict[str, SlottedTopic]:
        """The periodic topics of this module, and how well their slots are kept."""
        return self._periodics.by_topic

    def guarantee(self, topic: str, publisher_class: PublisherClass) -> str:
        return self._words.guarantee(publisher_class, self._periodics.by_topic.get(topic))

    def best_effort(self, publisher_class: PublisherClass) -> bool:
        return publisher_class == PublisherClass.PERIODIC and bool(self._words.no_slots)

    def inadmissible(self, size: int, period: float) -> str | None:
        return inadmissible(self.engine.timing, size, period)

    async def admission(self, topic: str) -> None:
        """Wait until a periodic topic sends in slots of its own, if it ever can."""
        await self._periodics.until(lambda: not self._undecided(topic))

    def _undecided(self, topic: str) -> bool:
        known = self._space.topics.get(topic)
        if known is None or not self._on_bus or self._words.no_slots or self._closed:
            return False
        return self._periodics.undecided(known)

    # Time

    def network_time(self) -> int | None:
        return self.engine.network_time(self._now())

    def translation(self) -> ClockOffset | None:
        return self._translation.clock(self._clock.monotonic())

    def utc(self) -> tuple[int, int] | None:
        """UTC by the RTCAN master, and how far off it may be (both ns). None: not known."""
        return self.engine.utc(self._now())

    def _tell_utc(self) -> None:
        if self._utc_error is not None and self.engine.role is Role.MASTER:
            self.engine.set_utc(self._now(), self._clock.now(), self._utc_error)

    def _poll(self) -> None:
        self._tell_utc()
        now = self._clock.monotonic()
        self._renumber(self._high_bytes.freed(now))
        if self._inlets.forget_shut(now):
            self.shell.refilter()
        super()._poll()

    # Life

    async def drained(self, longest: float) -> None:
        """Wait until the samples that the engine has are on the bus, at most `max_payload` seconds."""
        await self.shell.drained(longest, lambda: self._handover.waiting)

    def close(self) -> None:
        """Give the slots back and say good-bye; that takes a while on the bus: `shell.drained`."""
        if not self._closed:
            self._periodics.close()
            super().close()
            self._periodics.look()
