"""A link: one line, connection or bus as a module sees it, and the discovery that runs on it.

    topic space  ->  LinkOutlet.offer  ->  Link.write
    wire         ->  Link.take         ->  Intake  ->  Topic.deliver

A transport (what a URL names) makes links, keeps them up, and feeds them. The link's discovery decides what flows:
nothing is sent for which nobody asked, nothing is taken that nobody opened.
"""

import abc
import itertools
import random
from collections import Counter, deque
from collections.abc import Callable, Hashable, Iterable
from typing import Any, ClassVar, Protocol

import msgspec

from r2p.clock import Alarm
from r2p.codecs.attachment import ClockOffset
from r2p.codecs.management import CLASS_LATCHES, FLAG_BOOT, NO_PARAMS, QUEUE, ROLE_PUBLISHES, ROLE_SUBSCRIBES
from r2p.messages import Message
from r2p.names import MANAGEMENT, TOPIC_MAX
from r2p.protocols.discovery.announcer import Relayed
from r2p.protocols.discovery.base import DiscoveryProtocol
from r2p.protocols.discovery.events import (
    Command,
    Event,
    ModuleChanged,
    ModuleGone,
    PublisherFound,
    PublisherGone,
    Send,
    SubscriberJoined,
    SubscribersGone,
    TopicType,
)
from r2p.protocols.discovery.session import Discovery
from r2p.runtime.backpressure import LINK_DOWN, WaitQueue
from r2p.runtime.sample import PublisherClass, Sample, Source
from r2p.runtime.topic import RemoteSubscriber, Topic, TopicSpace
from r2p.transports.receiver import TRY_AGAIN, Arrival, Intake, LinkStats, LoggedCounter, Receiver

# What the other ends of a link are told of this module's topics, and the difference to what they should be told.


class Announcement(msgspec.Struct, frozen=True):
    """What the other ends have been told of a topic; `asked` is the type in which it is subscribed.

    `queue`: how many messages a publisher keeps, or has on the way, for this module; that has nothing to do with the
    queues of its own subscribers.
    """

    publishes: bool = False
    subscribes: bool = False
    size: int = 0
    fingerprint: bytes = bytes(8)
    asked: TopicType = TopicType()
    queue: int = QUEUE
    params: bytes = NO_PARAMS
    endpoints: dict[tuple[str, int], int] = {}  # node and role -> publisher class


NOTHING = Announcement()


def wish_of(topic: Topic) -> Announcement:
    """What the other ends should know of a topic."""
    publishers: dict[tuple[str, int], int] = {}
    for each in topic.publishers:
        key = each.node.name, ROLE_PUBLISHES
        publisher_class = int(each.publisher_class) | (CLASS_LATCHES if each.latch else 0)
        publishers[key] = max(publisher_class, publishers.get(key, 0))  # a node may have several, of several classes
    subscribers = {(each.owner, ROLE_SUBSCRIBES): 0 for each in topic.queues}
    shape = TopicType() if topic.layout is None else TopicType(topic.layout.size, topic.layout.fingerprint)
    return Announcement(
        publishes=bool(publishers),
        subscribes=bool(subscribers),
        size=shape.size,
        fingerprint=shape.fingerprint,
        asked=shape,
        endpoints=publishers | subscribers,
    )


def announce(discovery: DiscoveryProtocol, now: int, topic: str, told: Announcement, wish: Announcement) -> list[Event]:
    events: list[Event] = []
    retyped = (wish.size, wish.fingerprint) != (told.size, told.fingerprint)
    if wish.publishes and (retyped or not told.publishes or wish.params != told.params):
        events += discovery.advertise(now, topic, wish.size, wish.fingerprint, wish.params)
    elif told.publishes and not wish.publishes:
        events += discovery.withdraw(now, topic)
    if wish.subscribes and ((wish.asked, wish.queue) != (told.asked, told.queue) or not told.subscribes):
        events += discovery.subscribe(now, topic, wish.asked.size, wish.queue, wish.asked.fingerprint)
    elif told.subscribes and not wish.subscribes:
        events += discovery.unsubscribe(now, topic)
    for (node, role), publisher_class in wish.endpoints.items():
        if told.endpoints.get((node, role)) != publisher_class:
            events += discovery.endpoint(now, node, topic, role, publisher_class)
    for node, role in told.endpoints.keys() - wish.endpoints.keys():
        events += discovery.endpoint_gone(now, node, topic, role)
    return events


# link


_SECOND = 1_000_000_000
_MANAGEMENT = MANAGEMENT.encode()
_EARLY = _SECOND  # ns by which a message may come before the answer to its subscription
_MOST_EARLY = 256  # of those
_NOT_SUBSCRIBED = "not subscribed"


class Hub(Protocol):
    """What a transport gets from the module that opened it."""

    @property
    def space(self) -> TopicSpace: ...

    @property
    def instance(self) -> int:
        """Random 32-bit number of this run of the module."""

    @property
    def observer(self) -> bool:
        """Whether the module is a tool that only looks."""

    @property
    def random(self) -> random.Random:
        """For jitter; seeded under virtual time."""

    def attach(self, link: "Link") -> None:
        """A link exists from now on."""

    def detach(self, link: "Link") -> None:
        """It does not any more."""

    def link_waits(self, link: "Link", reason: str) -> None:
        """It can't be reached yet."""

    def listening(self, url: str, address: str) -> None:
        """A transport takes connections at an address."""

    def connection_refused(self, url: str, reason: str) -> None:
        """A transport that takes connections did not take one."""

    def link_changed(self, link: "Link", reason: str, outage: float, lost: int) -> None:
        """It went up or down; on the way up: s that it was down, messages lost by that."""

    def link_notice(self, link: "Link", kind: str, text: str, *, trouble: bool) -> None:
        """Something is worth telling the user, who need not do anything about it unless it is `trouble`."""

    def discovered(self, link: "Link", event: Event) -> None:
        """Its discovery found something that concerns the module."""


class GatewayHooks(Protocol):
    """What a gateway has to say about one of its links, and a module with several links about what gateways join."""

    def heard(self, data: bytes) -> bool:
        """A management message, before discovery gets it; True if it concerns gateways only."""

    def desired_state(self, topic: Topic, own: Announcement) -> Announcement:
        """What the other ends are to be told of a topic, with what is wanted for other links."""

    @property
    def may_announce(self) -> bool:
        """Whether discovery may say anything: where two links lead to one network, only one of them does."""

    @property
    def has_other_gateways(self) -> bool:
        """Whether there are other gateways on the link's network."""

    def source_name(self, source: Source) -> str:
        """What the module that published a message is called there."""

    def discovery_changed(self) -> None:
        """Discovery may have learnt something."""


class Transport(abc.ABC):
    """What a URL names: it opens links to a hub, and keeps them up until it is cancelled."""

    @abc.abstractmethod
    async def run(self, hub: Hub, opened: Callable[[], object]) -> None:
        """Attach links and keep them alive for ever; on cancellation close and detach them.

        Calls `opened()` once it works, or works on its way by itself: the module's `async with` waits for that. Raises
        TransportError for what waiting can't mend, such as an address in use; Broken if it had worked before.
        """


class Link(abc.ABC):
    """What all links share: discovery, outlets and inlets, fair intake, state and counters."""

    max_payload: ClassVar[int] = 255
    """Bytes of the longest message."""
    max_name: ClassVar[int] = TOPIC_MAX
    """Characters of the longest topic's name."""
    passes_probes: ClassVar[bool] = True
    """Whether there may be gateways of firmware on it."""
    in_order: ClassVar[bool] = True
    """Whether what is sent first comes first; else a message may overtake the answer that announces it."""
    lone: ClassVar[bool] = False
    """Whether it has only one other end."""

    def __init__(
        self, name: str, hub: Hub, *, management_rate: float = 250.0, discovery: DiscoveryProtocol | None = None
    ) -> None:
        self.name = name = unique_name(name, hub)
        self.title = self.name.removesuffix(":")
        """The name as it stands in texts."""
        self.up = False
        self.admits_gateways = True
        """Whether a gateway at its other end takes part in the mesh of ours; else it is for clients."""
        self.gate: GatewayHooks | None = None
        """Set by the module: what gateways, and it beside gateways, do with the link."""
        self.denied = False
        """Set by the module: whether its other end has refused it, and no connection has been of use since."""
        self.passing = False
        """Whether it is closed for good when it goes down: that of a client."""
        self.stands_by = ""
        """Why another link is used in place of this one, where gateways join their networks; empty while it is used."""
        self.stats = LinkStats(lost=LoggedCounter(name, hub.space.clock))
        self.discovery: DiscoveryProtocol = discovery or _discovery(name, hub, management_rate)
        self._hub = hub
        self._space = hub.space
        self._clock = hub.space.clock
        self._alarm = Alarm(hub.space.loop, self._poll, background=True)
        self._outlets: dict[str, LinkSubscriber] = {}
        self._intake: Intake = Receiver(self, hub.space.loop, self.stats)
        self._told: dict[str, Announcement] = {}
        self._lapsed: set[str] = set()
        self._early: dict[tuple[bytes, Hashable], tuple[Arrival, int]] = {}  # the last message, and when it came (ns)
        self._events: deque[Event] = deque()
        self._acting = False
        self.wait_queue = WaitQueue()
        self._down_at = self._clock.monotonic()
        self._lost_at_down = 0
        self._unreachable = ""
        self._closed = False

    # For the transport that owns the link

    def on_up(self) -> None:
        """The other end can be reached: announce everything."""
        outage = (self._clock.monotonic() - self._down_at) / _SECOND
        lost = self.stats.lost["link down"] - self._lost_at_down
        self.up = True
        self._unreachable = ""
        self.stats.ups += 1
        self._hub.link_changed(self, "", outage, lost)
        for name in self._lapsed:
            self._detach(name)
        self._lapsed.clear()
        self._apply(self.discovery.link_up(self._clock.monotonic()))

    def unreachable(self, reason: str) -> None:
        """It can't be reached yet: tell the user once for each reason."""
        if reason != self._unreachable:
            self._unreachable = reason
            self._hub.link_waits(self, reason)

    def on_down(self, reason: str) -> None:
        """The other end is gone. What waits to be sent is discarded and counted: no stale command ever arrives late."""
        if not self.up:
            return
        self.up = False
        self._down_at = self._clock.monotonic()
        self._lost_at_down = self.stats.lost["link down"]
        self._early.clear()
        lost = self.discard()  # which counts, too, what waited for room
        self.stats.lost["link down"] += lost
        self._hub.link_changed(self, reason, 0.0, 0)
        carried = [publisher for outlet in self._outlets.values() for publisher in outlet.topic.publishers]
        self._apply(self.discovery.link_down(self._down_at))
        self.wait_queue.reject_all(LINK_DOWN)  # whoever waits for it waits for nothing
        for publisher in carried:
            publisher.link_degraded(self.name, reason)

    def close(self) -> None:
        """Say good-bye, and let go of all topics."""
        if self._closed:
            return
        self._apply(self.discovery.leave(self._clock.monotonic()))
        self._closed = True
        self.up = False
        self._alarm.close()
        self.wait_queue.reject_all("link closed")
        for name in list(self._outlets):
            self._detach(name)
        self._intake.close()

    def take(self, arrivals: Iterable[Arrival]) -> None:
        """Something came in."""
        self._intake.take(arrivals)

    def latched(self, topic: str) -> bool:
        """Whether a publisher at the other end latches the topic; only r2p modules tell."""
        return any(each.latches(topic) for each in self.discovery.endpoints.values())

    def take_other(self, arrival: Arrival) -> None:
        if arrival.topic == _MANAGEMENT:
            self.manage(arrival.data, self.sender(arrival))
        else:
            self.take_unexpected(arrival)

    def take_unexpected(self, arrival: Arrival) -> None:
        """Count it; what is wanted may be announced by what comes next: keep the last message for that."""
        self.stats.lost[_NOT_SUBSCRIBED] += 1
        topic = None if self.in_order else self._space.topics.get(arrival.topic.decode("ascii", "replace"))
        if topic is None or not topic.wanted:
            return
        key = arrival.topic, self.sender(arrival)
        self._early.pop(key, None)
        if len(self._early) >= _MOST_EARLY:
            del self._early[next(iter(self._early))]
        self._early[key] = arrival, self._clock.monotonic()

    def manage(self, data: bytes, source: Hashable) -> None:
        """A management message came in from this address."""
        if self.gate is None or not self.gate.heard(data):
            self._apply(self.discovery.receive(self._clock.monotonic(), data, source))

    # For subclasses

    @property
    @abc.abstractmethod
    def full(self) -> bool:
        """Whether the send buffer has no room."""

    @abc.abstractmethod
    def write(self, topic: str, sample: Sample) -> None:
        """Put a sample into the send buffer; there is room."""

    @abc.abstractmethod
    def write_management(self, data: bytes, *, urgent: bool = False) -> None:
        """Send a management message before the samples that wait, `urgent` ones before all; lost if nothing moves."""

    @abc.abstractmethod
    def sample(self, topic: str, arrival: Any) -> Sample:
        """The sample that came in."""

    def discard(self) -> int:
        """Empty the send buffer; says how many samples are lost by that."""
        return 0

    def sender(self, arrival: Any) -> Hashable:
        """The sender's address on a bus; None on a line with one other end."""
        return None

    @property
    def waits(self) -> bool:
        """Whether the other end waits while nothing is read, and nothing is lost by that."""
        return False

    @property
    def private(self) -> bool:
        """Whether its other end stays the same for as long as it is up."""
        return False

    def pause(self) -> None:
        """Stop reading, if possible: what came in is still being handed out."""

    def resume(self) -> None:
        """Go on reading."""

    def made_room(self) -> None:
        """To be called whenever `takes` may say something else: whoever waits gets the room, in order."""
        while not self.stats.lost.guard(self.wait_queue.serve):
            pass  # the one that raised waits no more
        if not self.full:
            self.wait_queue.recover()

    def module_changed(self, module: str) -> None:
        """A module at the other end came, went, or changed its state."""

    # For outlets, publishers and the module

    def takes(self, sample: Sample) -> bool:
        """Whether there is room for this very sample now; asked before each `write`."""
        return not self.full

    @property
    def losses(self) -> Counter[str]:
        """All that was dropped since the link was opened, in both directions, by reason."""
        return self.stats.lost + self.discovery.counts

    def guarantee(self, topic: str, publisher_class: PublisherClass) -> str:
        """What the class means here for this topic, in words."""
        return "best effort, in order" + (", waits for room" if publisher_class == PublisherClass.NON_REAL_TIME else "")

    def best_effort(self, publisher_class: PublisherClass) -> bool:
        return publisher_class != PublisherClass.NON_REAL_TIME

    def refusal(self, size: int) -> str | None:
        return (
            f"{size} bytes, and it carries at most {self.max_payload} in a message" if size > self.max_payload else None
        )

    def inadmissible(self, size: int, period: float) -> str | None:
        """Why there can never be slots for messages of `size` bytes each `period` seconds."""
        return None

    def network_time(self) -> int | None:
        """The time (ns) that all nodes of the network share. None: it has none, or it is not known."""
        return None

    def translation(self) -> ClockOffset | None:
        """How that time is translated to UTC here, and how well. None: there is none, or it is not known."""
        return None

    def params(self, topic: str) -> bytes | None:
        """What the others need to know to receive a topic from us. None: it can't be published here."""
        return NO_PARAMS

    def window(self, topic: Topic) -> int:
        """How many messages a publisher of the topic is to keep for this link."""
        return QUEUE

    async def admission(self, topic: str) -> None:
        """Best effort is admitted at once."""

    async def message_type(self, fingerprint: bytes) -> type[Message] | None:
        """A message class of this layout, from a module on the link that has it; where such things can be asked."""
        return None

    def command(self, command: Command, module: str) -> None:
        """Send STOP, REBOOT or BOOTLOAD to a module."""
        self._apply(self.discovery.command(self._clock.monotonic(), command, module))

    def tell_conflict(self, module: str, instance_a: int, instance_b: int) -> None:
        """Tell two modules that they carry one name."""
        self._apply(self.discovery.conflict(self._clock.monotonic(), module, instance_a, instance_b))

    def relay(self, message: Relayed) -> None:
        """Pass on what a module on another link has said."""
        self._apply(self.discovery.relay(self._clock.monotonic(), message))

    def query(self) -> None:
        """Ask everybody to repeat what they publish and subscribe."""
        self._apply(self.discovery.query(self._clock.monotonic()))

    def set_flags(self, flags: int) -> None:
        """Tell the module's state, as in ALIVE."""
        self._apply(self.discovery.set_flags(self._clock.monotonic(), flags))

    def topic_changed(self, topic: Topic) -> None:
        """A publisher or a subscriber of this module came or went: tell the others."""
        now = self._clock.monotonic()
        told = self._told.pop(topic.name, NOTHING)
        wish = wish_of(topic)
        if self.gate is not None:
            wish = self.gate.desired_state(topic, wish)
        if len(topic.name) > self.max_name:
            wish = NOTHING
        params = self.params(topic.name) if wish.publishes and not self.refusal(wish.size) else None
        queue = self.window(topic) if wish.subscribes else QUEUE
        wish = msgspec.structs.replace(wish, publishes=params is not None, params=params or NO_PARAMS, queue=queue)
        if wish != told:
            self._apply(announce(self.discovery, now, topic.name, told, wish))
        if not wish.publishes:
            self._detach(topic.name)
        if not wish.subscribes:
            self._intake.shut_all(topic.name)
        if wish.publishes or wish.subscribes or wish.endpoints:
            self._told[topic.name] = wish

    # Discovery

    def _poll(self) -> None:
        now = self._clock.monotonic()
        try:
            events = self.discovery.poll(now)
        except Exception as error:  # noqa: BLE001 - counted and logged
            self.stats.lost.internal_error(error)
            self._alarm.set(now + TRY_AGAIN)
        else:
            self._apply(events)

    def _apply(self, events: Iterable[Event]) -> None:
        self._events.extend(events)
        if self._acting:
            return  # what an event brings about comes after the events before it
        self._acting = True
        try:
            while self._events:
                self.stats.lost.guard(self._act, self._events.popleft())
        finally:
            self._acting = False
        if not self._closed:
            self._alarm.set(self.discovery.next_deadline())
            if self.gate is not None:
                self.stats.lost.guard(self.gate.discovery_changed)

    def _act(self, event: Event) -> None:
        match event:
            case Send(data, urgent):
                if self.up and (self.gate is None or self.gate.may_announce):
                    self.write_management(data, urgent=urgent)
            case SubscriberJoined(topic):
                self._attach(topic)
            case SubscribersGone(topic) if self.up or self._closed:
                self._detach(topic)
            case SubscribersGone(topic):  # until the other end is back, what it does not get is counted
                self._lapsed.add(topic)
            case PublisherFound(topic, source, _, size):
                self._open(topic, size, source)
            case PublisherGone(topic, source):
                self._intake.shut(topic, source)
            case _:
                if isinstance(event, ModuleChanged | ModuleGone):
                    self.module_changed(event.info.name)
                self._hub.discovered(self, event)

    def _attach(self, name: str) -> None:
        topic = self._space.topics.get(name)
        if topic is None:
            return
        outlet = self._outlets.get(name)
        if outlet is None or outlet.topic is not topic:
            outlet = self._outlets[name] = LinkSubscriber(self, topic)
            topic.join(outlet)
        else:
            topic.resend_latched(outlet)

    def _detach(self, name: str) -> None:
        outlet = self._outlets.pop(name, None)
        if outlet is not None:
            outlet.topic.leave(outlet)

    def _open(self, name: str, size: int, sender: Hashable = None) -> None:
        topic = self._space.topics.get(name)
        if topic is not None and topic.wanted:
            self._intake.open(topic, topic.layout.size if topic.layout is not None else size, sender)
            self._admit_early(name.encode(), sender)

    def _admit_early(self, name: bytes, sender: Hashable) -> None:
        """A message may overtake the answer that announces it; a latched one would not come again.

        Not where the module has other links, by which the same message may have come meanwhile.
        """
        arrival, at = self._early.pop((name, sender), (None, 0))
        alone = len(self._space.links) == 1
        if arrival is not None and alone and self._clock.monotonic() - at <= _EARLY:
            self.stats.lost[_NOT_SUBSCRIBED] -= 1
            self._intake.take_first(arrival)


def is_booting(link: Link, module: str) -> bool:
    """Whether a module that is heard on the link is in boot mode, where a STOP does lasting harm."""
    info = link.discovery.modules.get(module)
    return info is not None and bool(info.flags & FLAG_BOOT)


def unique_name(name: str, hub: Hub) -> str:
    """A name that tells links apart that lead to the same place. All that a link makes calls it by this one."""
    taken = {each.name for each in hub.space.links}
    names = itertools.chain((name,), (f"{name}#{n}" for n in itertools.count(2)))
    return next(each for each in names if each not in taken)


def _discovery(link: str, hub: Hub, rate: float) -> Discovery:
    """That of a line or a bus; `rate` is in messages/s."""
    counts = LoggedCounter(link, hub.space.clock)
    return Discovery(
        hub.space.module, hub.instance, rate=rate, burst=max(4, int(rate / 4)), observer=hub.observer, counts=counts
    )


# One topic on its way out by one link: what a link looks like to publishers.


class LinkSubscriber(RemoteSubscriber):
    """One topic on its way out by one link.

    Nobody waits for a link that is down. What it is given is lost, counted; real-time publishers are told of each
    sample, the others were told when it went down.
    """

    __slots__ = ("_link", "topic")

    def __init__(self, link: "Link", topic: Topic, lines: WaitQueue | None = None) -> None:
        """`lines`: its own, or else those of the link."""
        super().__init__(link.name, link, link.wait_queue if lines is None else lines)
        self._link = link
        self.topic = topic

    @property
    def reachable(self) -> bool:
        return self._link.up

    def offer(self, sample: Sample) -> bool:
        link = self._link
        if not link.up:
            if sample.publisher_class != PublisherClass.NON_REAL_TIME:
                return False
            self.force(sample)
            return True
        if not link.takes(sample):
            return False
        link.write(self.topic.name, sample)
        return True

    def force(self, sample: Sample) -> None:
        link = self._link
        if link.up and not link.full:
            link.write(self.topic.name, sample)
        else:
            self.lost += 1
            link.stats.lost["send buffer full" if link.up else LINK_DOWN] += 1

    def count_lost(self, reason: str) -> None:
        super().count_lost(reason)
        self._link.stats.lost[reason] += 1

    def refill(self) -> None:
        self._link.made_room()
