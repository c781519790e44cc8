"""The link of a module on an RTCAN bus: one engine on its port, and its discovery.

Each publisher class has room of its own (see `tx`), so bulk data never keeps an event out. Nothing is announced before
the node has an id8, and everything is announced again when it gets another one. A remote publisher is known by its
16-bit message id, which its SUBSCRIBE_RESPONSE announces (see `message_ids`).
"""

import functools
from collections import Counter
from collections.abc import Callable, Hashable, Sequence
from typing import Any, ClassVar

import msgspec

from r2p.codecs import can_bits, management, rtcan
from r2p.codecs.management import NO_PARAMS
from r2p.messages import ClockOffset
from r2p.msg import BusSlots, BusTraffic
from r2p.names import MANAGEMENT
from r2p.protocols.can_orders import Mailbox
from r2p.protocols.discovery.events import Event, ModuleGone, PublisherFound, PublisherGone
from r2p.protocols.discovery.session import Discovery
from r2p.protocols.rtcan.engine import Engine
from r2p.protocols.rtcan.events import (
    Action,
    Done,
    Due,
    EngineSettings,
    ForeignSyncs,
    IdConflict,
    LostSync,
    NewMaster,
    ParameterMismatch,
    ParametersMatch,
    Profile,
    Ready,
    Received,
    SlotEvent,
    SyncSeen,
)
from r2p.protocols.rtcan.master import Role
from r2p.protocols.rtcan.topic_ids import TopicIdAllocator
from r2p.runtime.sample import PublisherClass, Sample
from r2p.runtime.topic import Topic
from r2p.transports.buffered_link import TOO_LONG, BufferedLink, SenderLookup
from r2p.transports.can.port import CanPort
from r2p.transports.link import Hub, unique_name
from r2p.transports.rtcan.driver import EngineDriver, UtcEstimator
from r2p.transports.rtcan.message_ids import FIRMWARE, R2P, MessageIdMap, address_of, publisher_in
from r2p.transports.rtcan.network_clock import RtcanClock
from r2p.transports.rtcan.tx import (
    ResponseHandle,
    SampleHandle,
    SlottedTopic,
    SlottedTopics,
    Transmitter,
    inadmissible,
)
from r2p.transports.stats import LoggedCounter
from r2p.units import LONG_AGO, MILLISECOND, SECOND

_MANAGEMENT = MANAGEMENT.encode()
_LOSSES = ("undecodable", "management dropped")  # what the engine counts as lost without a publisher of this module

# The rate of discovery. After a start all modules have much to announce at once.
_RATE = 100.0  # messages a second: a fifteenth of a bus of 1 Mbit/s, and the same share of slower ones
_BURST, _BURST_MIN = 8, 4  # messages at once, on a bus of 1 Mbit/s and on the slowest ones
_BIT = 1000  # ns at 1 Mbit/s
_RATE_MIN = 1.0  # leases are longer then, as long as three rounds
_FREE_SHARE = 0.5  # of the free slots, for the discovery of all modules together
_FRAMES = 3  # of a message of discovery; without its zeros one has 1 to 4, and fewer than three on average
_WAITING_MAX = 1  # messages of this node
_RATE_STEP = 1.2  # by which the rate must differ before it is set anew
_FIRMWARE_RATE, _FIRMWARE_QUIET = 12.0, 0.033  # a second, and s: all modules have one id, so none may send at once

_OFFSET_VALID = 10 * MILLISECOND  # for which UTC's offset is not read again: slewed by 500 ppm it moves 5 us meanwhile
_CLASSES = {
    Mailbox.HRT: PublisherClass.PERIODIC,
    Mailbox.SRT: PublisherClass.SPORADIC,
    Mailbox.NRT: PublisherClass.NON_REAL_TIME,
}


BusListener = Callable[[list[BusTraffic], list[BusSlots]], object]
"""Takes what `bus_load` and `bus_slots` have, complete. It must not raise."""


class ReceivedMessage(msgspec.Struct, frozen=True, gc=False):
    """A complete received message."""

    topic: bytes
    data: bytes
    message_id: int
    received: Received


class RtcanLink(BufferedLink):
    """A module's link to an RTCAN bus. `utc_error` (ns): the accuracy of the module's UTC, None if unknown."""

    max_payload: ClassVar[int] = rtcan.PAYLOAD_MAX
    max_variable: ClassVar[int] = rtcan.VARIABLE_MAX
    has_slots: ClassVar[bool] = True

    def __init__(
        self, name: str, hub: Hub, port: CanPort, settings: EngineSettings, utc_error: int | None = None
    ) -> None:
        name = unique_name(name, hub)  # before all parts, which log and count under it
        counts = LoggedCounter(name, hub.space.clock)
        discovery = Discovery(
            hub.space.module,
            hub.instance,
            rate=_RATE,
            burst=_BURST,
            observer=hub.observer,
            counts=counts,
            aliases=hub.space.aliases,
        )
        super().__init__(name, hub, discovery=discovery)
        self._set_pace, self._hold = discovery.set_pace, discovery.hold  # which other kinds of discovery lack
        self.engine = Engine(settings)
        self.stats.faults = self.engine.counts  # one counter for what goes wrong in the engine and on the bus
        self.driver = EngineDriver(self.engine, port, self)
        self.bus_listeners: list[BusListener] = []
        """Get what is on the bus, once a second. While there are any, the port receives all frames."""
        self._utc_error = utc_error
        self._utc = UtcEstimator(self.driver)
        self._network_clock: RtcanClock | None = None  # from its first use on
        self._utc_offset = 0  # of UTC from the monotonic clock (ns)
        self._utc_offset_until = LONG_AGO
        self._topic_ids = TopicIdAllocator(discovery.alias)
        self._senders = SenderLookup(discovery, name, shared=(FIRMWARE, R2P))
        self._message_ids = MessageIdMap(self, self.engine, self._space)
        self._slotted = SlottedTopics(self, self.driver, self._has_subscribers)
        self._transmitter = Transmitter(self, self.driver, self._slotted)
        self._on_bus = False
        self._rate = self._rate_max = _RATE  # of discovery now, and at most
        self._burst = _BURST

    # Called by the driver

    def act(self, action: Action) -> None:
        if isinstance(action, Received):  # the most frequent one first
            topic = self._message_ids.topics.get(action.message, _MANAGEMENT)
            if topic is _MANAGEMENT and action.message in self._message_ids.lingering:
                self.stats.lost["not subscribed"] += 1
                return
            self.receive((ReceivedMessage(topic, action.payload, action.message, action),))
        elif isinstance(action, Done):
            self._done(action)
        elif isinstance(action, Due):
            self._slotted.fill(action)
        elif isinstance(action, SyncSeen):
            if self._network_clock is not None:
                self._network_clock.on_sync(action)
        elif isinstance(action, SlotEvent):
            self._slotted.slots_changed(action)
            self._slotted.wake_waiters()
        else:
            self._network_event(action)
            self._slotted.wake_waiters()

    def bus_up(self) -> None:
        self._on_bus = True

    def bus_down(self, reason: str) -> None:
        self._on_bus = False
        if self.up:
            self.on_down(reason)
        else:
            self.unreachable(reason)
        self._slotted.wake_waiters()

    def bus_waits(self, reason: str) -> None:
        self.unreachable(reason)

    def bus_fault(self, kind: str) -> None:
        self.stats.faults[kind] += 1

    def internal_error(self, error: Exception) -> None:
        self.stats.lost.internal_error(error)

    def _network_event(self, event: Action) -> None:
        match event:
            case Ready():
                if event.profile is Profile.FIRMWARE and self._network_clock is not None:
                    self._network_clock.close()
                self._limit_discovery(event.profile)
                self.driver.update_filters()  # before it announces: answers come to the new id8
                self._announce()
            case ParametersMatch() if self.engine.ready:  # else `Ready` follows, and announces
                self._notice(event)
                self._announce()
            case _ if not self._closed:
                text = self._notice(event)
                if isinstance(event, ParameterMismatch) or (isinstance(event, IdConflict) and event.yielded):
                    self.on_down(text)
                self._set_utc()

    def _notice(self, event: Action) -> str:
        kind, text, trouble = describe_event(event, fixed_id=self.engine.settings.id8 is not None)
        self._hub.link_notice(self, kind, text, trouble=trouble)
        return text

    def _limit_discovery(self, profile: Profile) -> None:
        """Set the rate of discovery for this bus, now that the profile is known."""
        bit = self.engine.timing.bit
        rate, burst, quiet = _RATE * _BIT / bit, max(_BURST_MIN, _BURST * _BIT // bit), 0.0
        if profile is Profile.FIRMWARE:
            rate, burst, quiet = _FIRMWARE_RATE, _BURST_MIN, _FIRMWARE_QUIET
        self._rate_max, self._burst, self._rate = rate, burst, rate
        self._set_pace(rate, burst, quiet)
        self.calls.rate = rate / 2 if profile is Profile.FIRMWARE else rate  # half of the bus stays for discovery
        self._topic_ids.set_rate(rate)

    def _adapt_discovery(self) -> None:
        """Limit discovery to this module's part of the slots that are free now: they carry soft real-time, too."""
        if self.engine.profile is Profile.FIRMWARE or not self.engine.ready:
            return
        modules = 1 + sum(not info.hops for info in self.discovery.modules.values())
        part = _FREE_SHARE * self.engine.cycle.free_rate / _FRAMES / modules
        rate = min(self._rate_max, max(_RATE_MIN, part))
        if not self._rate / _RATE_STEP < rate < self._rate * _RATE_STEP:
            self._rate = rate
            self._set_pace(rate, round(self._burst * rate / self._rate_max), 0.0)
            self.engine.set_discovery_rate(rate)
        self._hold_discovery()

    def _hold_discovery(self) -> None:
        """Announce no more before what waits could be on the bus: it would only be older when it is sent."""
        waiting = self.engine.management_waiting
        if waiting > _WAITING_MAX:
            frames = waiting * _FRAMES
            self._hold(self._clock.monotonic() + round(frames * SECOND / max(self.engine.cycle.free_rate, frames)))

    def _announce(self) -> None:
        """Announce everything, under what may be another id8 than before."""
        for topic in list(self._space.topics.values()):
            self.stats.lost.guard(self.topic_changed, topic)
        self.on_up()

    # In

    def sample(self, topic: str, arrival: ReceivedMessage) -> Sample:
        """Make the sample of a message of this topic. Its stamp is the start of the message's first frame."""
        self.stats.bytes_received += len(arrival.data)
        received = arrival.received
        now = self.driver.now()
        if now >= self._utc_offset_until:  # two clocks of one computer: not worth two system calls per message
            self._utc_offset = self._clock.now() - self._clock.monotonic()
            self._utc_offset_until = now + _OFFSET_VALID
        stamp = self._utc_offset + self.driver.port.monotonic(self._started(received))
        source = self._senders.source(topic, rtcan.id8_of(arrival.message_id))
        # A laxity is the time to the deadline (ms), if there is one. SRT_MAX also stands for more, so it gives none.
        laxity = received.laxity
        deadline = stamp + laxity * MILLISECOND if rtcan.HRT < laxity < rtcan.SRT_MAX else 0
        sender = self.discovery.modules.get(source.module)
        return Sample(
            arrival.data,
            source,
            stamp,
            deadline,
            0,
            _CLASSES[received.mailbox],
            stamped=False,
            drop_late=sender is not None and sender.r2p,  # firmware gives 50 ms to everything, which means nothing
            clock=self._utc.offset(now),
        )

    def _started(self, received: Received) -> int:
        """Return the start of the first frame; roughly on a coarse port, whose stamps do not justify counting bits."""
        bit = self.engine.timing.bit
        if self.driver.port.coarse:
            first = min(len(received.header) + len(received.payload), rtcan.FRAME_MAX)
            return received.stamp - can_bits.frame_bits_max(first) * bit
        return received.started(bit)

    def sender(self, arrival: ReceivedMessage) -> Hashable:
        return arrival.message_id

    def receive_other(self, arrival: Any) -> None:
        """Handle management: all other messages are of subscribed topics."""
        data, message_id = arrival.data, arrival.message_id
        source = rtcan.id8_of(message_id)
        if message_id == rtcan.FIRMWARE_MANAGEMENT:
            source = address_of(data, self.discovery.modules, self.discovery.module_behind)
            data = management.unmark(data)
        publisher = publisher_in(data, source)
        if publisher is not None:
            firmware = source == FIRMWARE and message_id == rtcan.FIRMWARE_MANAGEMENT
            now, id8 = self._clock.monotonic(), self.engine.id8 or 0
            topic, offered = self.discovery.topic_behind(publisher[0]), publisher[1]
            self._renumber(self._topic_ids.on_announced(now, topic, offered, id8, firmware=firmware))
        if self.up:  # before, only the message ids of others matter
            self.manage(data, source)

    def sealer(self, source: Hashable) -> Hashable:
        return None if source in (FIRMWARE, R2P) else source  # nothing shows which of the two an order comes from

    def _renumber(self, names: Sequence[str]) -> None:
        """Announce topics of this module that need another high byte, or may find one now."""
        for name in names:
            topic = self._space.topics.get(name)
            if topic is not None:
                self.topic_changed(topic)

    def _act(self, event: Event) -> None:
        match event:
            case PublisherFound():
                self._message_ids.add(self._clock.monotonic(), event)
                self.driver.update_filters()
            case PublisherGone(topic, source):
                self._message_ids.remove(self._clock.monotonic(), topic, source)
                self.driver.update_filters()
            case _:
                if isinstance(event, ModuleGone) and isinstance(event.info.source, int):
                    self._topic_ids.on_module_gone(event.info.source)
                super()._act(event)

    # Out

    @property
    def full(self) -> bool:
        return self._transmitter.full

    def has_room_for(self, sample: Sample) -> bool:
        return self._transmitter.has_room_for(sample)

    def write(self, topic: str, sample: Sample) -> None:
        high, data = self._topic_ids.pick(topic), sample.data
        if topic in self.varying:
            if len(data) > self.max_variable:
                self.count_unsendable(topic, sample, TOO_LONG)
                return
            data = rtcan.encode_variable(data)
        # Only topics of other links, which a gateway forwards, may have no message id or messages of any size.
        if high is None or not 1 <= len(data) <= self.max_payload:
            self.count_unsendable(topic, sample, "impossible message" if high is None or not data else TOO_LONG)
            return
        self.driver.carry_out(self._transmitter.send(self._subscribers.get(topic), topic, high, sample, data))

    def write_management(self, data: bytes, *, urgent: bool = False) -> None:
        self.driver.carry_out(self._transmitter.send_management(data, urgent=urgent))
        if not urgent:
            self._hold_discovery()

    def _add_subscriber(self, name: str) -> None:
        if not self._transmitter.waits_for_response(name):
            super()._add_subscriber(name)

    def _remove_subscriber(self, name: str) -> None:
        self._transmitter.remove_topic(name)
        super()._remove_subscriber(name)

    def _has_subscribers(self, topic: str) -> bool:
        return self.up and topic in self._subscribers

    def _done(self, done: Done) -> None:
        match done.handle:
            case SlottedTopic() as slotted:
                self._slotted.completed(slotted, done)
            case SampleHandle() as handle:
                self._transmitter.completed(handle, done)
                if self.wait_queue:
                    self.made_room()
            case ResponseHandle() as response:
                for name in self._transmitter.response_sent(response):
                    if self.up:
                        super()._add_subscriber(name)

    # Topics

    def params(self, topic: str) -> bytes | None:
        if not self.engine.ready:
            return NO_PARAMS
        high = self._topic_ids.pick(topic)
        if high is None:
            return None
        return management.rtcan_params(rtcan.message_id(high, self.engine.id8 or 0))

    def topics_on_bus(self) -> dict[int, str]:
        """Return the topics of the bus by message id, this module's and those that others have announced."""
        return self._topic_ids.topics(self.engine.id8 or 0)

    def topic_changed(self, topic: Topic) -> None:
        refused = self._topic_ids.refused
        known = topic.name in refused
        refused.discard(topic.name)  # `params`, which this calls, puts it back if there is still no high byte
        super().topic_changed(topic)
        if topic.name in refused and not known:
            text = f"topic {topic.name}: all message ids are taken; publishing starts as soon as one is free"
            self._hub.link_notice(self, "no id", text, trouble=True)
        announced = self._announced.get(topic.name)
        if announced is None or not announced.publishes:
            self._topic_ids.drop(topic.name)
            self._slotted.update(topic, None)
        elif self.engine.ready:
            self._slotted.update(topic, None if no_slots(self.engine) else self._topic_ids.pick(topic.name))

    # What the link guarantees

    @property
    def losses(self) -> Counter[str]:
        own = Counter({kind: count for kind in _LOSSES if (count := self.engine.counts[kind])})
        return sum(self.engine.reassembly.losses.values(), super().losses + own)

    @property
    def slots(self) -> dict[str, SlottedTopic]:
        """The periodic topics of this module, and the state of their slots."""
        return self._slotted.by_topic

    def guarantee(self, topic: str, publisher_class: PublisherClass) -> str:
        return describe_guarantee(self.driver, publisher_class, self._slotted.by_topic.get(topic))

    def best_effort(self, publisher_class: PublisherClass) -> bool:
        return publisher_class == PublisherClass.PERIODIC and bool(no_slots(self.engine))

    def inadmissible(self, size: int, period: float, *, varies: bool = False) -> str | None:
        return inadmissible(self.engine.timing, rtcan.size_on_bus(size, varies=varies), period)

    async def admission(self, topic: str) -> None:
        """Wait until a periodic topic sends in slots of its own, if it ever can."""
        while self._undecided(topic):
            await self._slotted.wait_for_change()

    def _undecided(self, topic: str) -> bool:
        known = self._space.topics.get(topic)
        if known is None or not self._on_bus or no_slots(self.engine) or self._closed:
            return False
        return self._slotted.undecided(known)

    # Time

    def network_time(self) -> int | None:
        return self.engine.network_time(self.driver.now())

    def network_clock(self) -> RtcanClock | None:
        if self._closed or self.engine.profile is Profile.FIRMWARE:
            return None
        if self._network_clock is None or self._network_clock.closed:
            notice = functools.partial(self._hub.link_notice, self)
            self._network_clock = RtcanClock(self.name, self.driver, notice)
        return self._network_clock

    def translation(self) -> ClockOffset | None:
        return self._utc.offset(self.driver.now())

    def utc(self) -> tuple[int, int] | None:
        """Return UTC by the RTCAN master, and its possible error (both ns); None if unknown."""
        return self.engine.utc(self.driver.now())

    def _set_utc(self) -> None:
        """As the master, distribute this module's UTC."""
        if self._utc_error is not None and self.engine.election.role is Role.MASTER:
            self.engine.set_utc(self.driver.now(), self._clock.now(), self._utc_error)

    def _poll(self) -> None:
        self._set_utc()
        self._adapt_discovery()
        now = self._clock.monotonic()
        self._renumber(self._topic_ids.retry(now))
        if self._message_ids.end_lingering(now):
            self.driver.update_filters()
        super()._poll()

    @property
    def master(self) -> str:
        """The name of the master's module; empty without a master, or while its name is unknown."""
        id8 = self.engine.network.master
        if id8 is not None and id8 == self.engine.id8:
            return self._space.module
        known = (each.name for each in self.discovery.modules.values() if each.source == id8 and not each.hops)
        return next(known, "") if id8 else ""

    # Life

    async def drain(self, timeout: float) -> None:
        """Wait until the engine's samples are on the bus, at most `timeout` seconds."""
        await self.driver.drain(timeout, lambda: self._transmitter.pending)

    def close(self) -> None:
        """Release the slots and announce the end, which takes time on the bus: see `driver.drain`."""
        if not self._closed:
            self._slotted.close()  # while the engine can still send that
            super().close()
            if self._network_clock is not None:
                self._network_clock.close()
            self._slotted.wake_waiters()


# Texts for users


def no_slots(engine: Engine) -> str:
    """The reason why periodic messages never get slots on this bus; empty if they may."""
    if not engine.settings.reserves:
        slot = engine.timing.slot // 1000
        return f"slots of {slot} us are too short for a port that does not hit them; choose slots= and cycle="
    if engine.profile is Profile.FIRMWARE:
        return "firmware of 2014 keeps no cycle"
    return ""


def describe_guarantee(driver: EngineDriver, publisher_class: PublisherClass, slotted: SlottedTopic | None) -> str:
    """Describe what a publisher class means for a topic now; `slotted`: the topic is periodic and may have slots."""
    engine = driver.engine
    if engine.network.mismatch is not None:
        return f"nothing is sent: {engine.network.mismatch}"
    if not engine.ready:
        return "nothing yet: not on the bus"
    match publisher_class:
        case PublisherClass.PERIODIC:
            return _periodic_guarantee(engine, slotted)
        case PublisherClass.SPORADIC:
            laxity = "fresh at each try" if driver.port.one_shot else "fixed when a frame is handed to the controller"
            return f"soft real-time, least laxity first, {laxity}; late ones are signalled"
        case _:
            return "non real-time: uses what other classes leave of the bus; waits for room"


def _periodic_guarantee(engine: Engine, slotted: SlottedTopic | None) -> str:
    soft = "soft real-time with the period as deadline"
    if reason := no_slots(engine):
        return f"best effort: {reason}; {soft}"
    if slotted is None:
        return f"best effort: another publisher of the topic has the slots; {soft}"
    if slotted.period and slotted.is_clock:
        return slotted.describe()
    if slotted.clock_elsewhere:
        return f"best effort: the slots of another link are its clock; {soft}"
    master = "" if engine.network.master is not None else ": there is no master yet"
    return f"{slotted.describe()}{master}; meanwhile {soft}"


def describe_event(event: Action, *, fixed_id: bool) -> tuple[str, str, bool]:
    """Describe an event on the bus: its kind, a text, and whether it is trouble. `fixed_id`: this node has one id."""
    match event:
        case IdConflict(id8, yielded):
            then = "waits until it is free" if fixed_id else "takes another one"
            then = f"the other node keeps it, this module {then}" if yielded else "the other one should yield"
            return "id conflict", f"another node uses the id {id8} of this one: {then}", True
        case NewMaster(_, epoch, own=True):
            return "master", f"this module is the RTCAN master (epoch {epoch:08x})", False
        case NewMaster(id8):
            return "master", f"{'firmware' if id8 is None else f'node {id8}'} is the RTCAN master", False
        case ForeignSyncs(reason):
            text = f"a broken node sends sync frames, which costs slots: {reason}; unplug modules one by one to find it"
            return "foreign syncs", text, True
        case LostSync(reason):
            return "no master", f"no RTCAN master: {reason}", True
        case ParameterMismatch(reason):
            return "other parameters", f"nothing is sent: {reason}", True
        case ParametersMatch():
            return "own parameters", "the network's parameters are those of this module again", False
        case _:
            raise TypeError(f"not an event of the network: {event}")
