"""A link: one line, connection or bus as a module sees it, with its discovery.

A transport, which a URL names, opens links and keeps them up. The link's discovery decides what flows: only topics with
subscribers at the other end are sent, and only those with subscribers here are received. `Link` has the common part:
discovery, announcements, state and counters. Its two kinds send and receive messages: `BufferedLink`, with one send
buffer for all topics, and zenoh's, with a stream for each topic.
"""

import abc
import itertools
import random
from collections import Counter, deque
from collections.abc import Callable, Hashable, Iterable
from typing import ClassVar, Protocol

import msgspec

from r2p.clock import Alarm
from r2p.codecs.management import NO_PARAMS, QUEUE
from r2p.keys import SharedKey
from r2p.messages import ClockOffset, Message
from r2p.names import CARRIED_MAX, TOPIC_FIELD
from r2p.protocols.discovery.announcer import Relayed
from r2p.protocols.discovery.events import (
    AliasConflict,
    AliasFreed,
    Command,
    Event,
    ModuleChanged,
    ModuleGone,
    PublisherFound,
    PublisherGone,
    Send,
    SendTo,
    SubscriberJoined,
    SubscribersGone,
    possible_senders,
)
from r2p.protocols.discovery.interface import DiscoveryProtocol
from r2p.protocols.discovery.session import Discovery
from r2p.protocols.keys import LinkEnd
from r2p.runtime.backpressure import LINK_DOWN, WaitQueue
from r2p.runtime.network_time import NetworkClock
from r2p.runtime.sample import PublisherClass, Sample, Source
from r2p.runtime.topic import RemoteSubscriber, Topic
from r2p.transports.announcement import (
    NOTHING,
    Announcement,
    GatewayHooks,
    announcement_of,
    refused_publishers,
)
from r2p.transports.call_channel import CallChannel, CallHub
from r2p.transports.guard import GuardedHub, LinkGuard, key_protocol
from r2p.transports.stats import RETRY_AFTER_ERROR, LinkStats, LoggedCounter
from r2p.units import SECOND

MESSAGES_PER_TURN = 64
"""Messages that a link delivers before it lets the event loop run once."""


class Hub(GuardedHub, CallHub, Protocol):
    """The module as a transport sees it."""

    @property
    def instance(self) -> int:
        """Random 32-bit number of this run of the module."""

    @property
    def observer(self) -> bool:
        """Return whether the module is a tool that only looks."""

    @property
    def random(self) -> random.Random:
        """Random numbers for jitter; seeded under virtual time."""

    def attach(self, link: "Link") -> None:
        """Add a link to the module."""

    def detach(self, link: "Link") -> None:
        """Remove a link from the module."""

    def link_waits(self, link: "Link", reason: str) -> None:
        """Report that the other end of a link can't be reached yet, and why."""

    def listening(self, url: str, address: str) -> None:
        """Report the address at which a transport accepts connections."""

    def connection_refused(self, url: str, reason: str) -> None:
        """Report that a transport that accepts connections has refused one, and why."""

    def link_changed(self, link: "Link", reason: str, outage: float, lost: int) -> None:
        """Report that a link went down (`reason`), or up (after `outage` seconds; `lost` messages were lost)."""

    def link_notice(self, link: "Link", kind: str, text: str, *, trouble: bool) -> None:
        """Report something to the user, who need not act on it unless it is `trouble`."""

    def discovered(self, link: "Link", event: Event) -> None:
        """Handle what the discovery of a link has found."""

    async def message_type(self, fingerprint: bytes, topic: str) -> type[Message] | None:
        """Ask other modules for a message class of this layout: that of the topic, where several have it."""


class Transport(abc.ABC):
    """The object behind a URL: opens links to a hub, and keeps them up until it is cancelled."""

    @abc.abstractmethod
    async def run(self, hub: Hub, opened: Callable[[], object]) -> None:
        """Attach links and keep them alive for ever; on cancellation close and detach them.

        Calls `opened()` as soon as the transport works, or will work without further action: the module's `async with`
        waits for that. Raises TransportError for permanent faults, such as an address in use; Broken if it has worked.
        """


class Link(abc.ABC):
    """The base of all links: discovery, announcements, state and counters."""

    max_payload: ClassVar[int] = 255
    """Bytes of the longest message."""
    max_variable: ClassVar[int | None] = None
    """Bytes of the longest message of those whose length varies; None: the same."""
    max_name: ClassVar[int] = CARRIED_MAX
    """Characters of the longest topic's name."""
    passes_probes: ClassVar[bool] = True
    """True if firmware gateways may be on the link."""
    foreign: ClassVar[str] = ""  # "ROS": the modules on the link are nodes of that
    point_to_point: ClassVar[bool] = False
    """True if the link has only one other end."""
    lossless: bool = False
    """True if what is sent also arrives at the other end, while the link is up."""
    has_slots: ClassVar[bool] = False
    """True if periodic messages have slots of their own, which a publisher has to ask for."""

    def __init__(
        self, name: str, hub: Hub, *, management_rate: float = 250.0, discovery: DiscoveryProtocol | None = None
    ) -> None:
        """`management_rate`: management messages a second at most, for a link without a discovery of its own."""
        self.name = name = unique_name(name, hub)
        self.title = self.name.removesuffix(":")
        """The name for texts."""
        self.up = False
        self.unreachable_reason = ""
        """The reported reason why the other end can't be reached; empty while the link is up."""
        self.admits_gateways = True
        """True if a gateway at the other end joins the mesh of this module's gateway; else the link is for clients."""
        self.gateway_hooks: GatewayHooks | None = None
        """Decisions of the module about this link, where gateways join networks."""
        self.guard: LinkGuard | None = None
        """The guard of a link with a key."""
        self.key_refused = ""
        """The reason if the two ends of the line do not have one key; empty if they have, or have not tried."""
        self.denied = False
        """True if the other end has refused the link, and no connection has been of use since; set by the module."""
        self.transient = False
        """True for the link of a client: it is closed for good when it goes down."""
        self.stands_by = ""
        """The reason to use another link instead, where gateways join both networks; empty while this one is used."""
        self.stats = LinkStats(lost=LoggedCounter(name, hub.space.clock))
        self.discovery: DiscoveryProtocol = discovery or _discovery(name, hub, management_rate)
        self._hub = hub
        self._space = hub.space
        self._clock = hub.space.clock
        self._alarm = Alarm(hub.space.loop, self._poll, background=True)  # announcements keep no program going
        self._subscribers: dict[str, LinkSubscriber] = {}
        """Subscribers at the other end as publishers here see them, by topic."""
        self.varying: set[str] = set()
        """Topics that are published on the link, by this module or a gateway, and whose messages vary in length."""
        self._announced: dict[str, Announcement] = {}
        self._lapsed: set[str] = set()  # topics that lost their subscribers while the link was down
        self._events: deque[Event] = deque()
        self._acting = False
        self._down_at = self._clock.monotonic()
        self._lost_at_down = 0
        self._closed = False
        self.calls = CallChannel(self, hub, management_rate)
        """The messages of r2p's own services."""

    # For the transport that owns the link

    def use_key(self, key: SharedKey | None, end: LinkEnd = LinkEnd.SHARED) -> None:
        """Guard the link with the key of its URL, if there is one; before the link comes up."""
        if key is not None:
            self.guard = LinkGuard(key_protocol(self._space, key, end), self._space, self._hub, self)

    def on_up(self) -> None:
        """Begin to send, and announce everything, as the other end can be reached."""
        outage = (self._clock.monotonic() - self._down_at) / SECOND
        lost = self.stats.lost[LINK_DOWN] - self._lost_at_down
        self.up = True
        self.unreachable_reason = ""
        self.stats.ups += 1
        self._begin_session()  # before anything is sealed
        self._hub.link_changed(self, "", outage, lost)
        for name in self._lapsed:  # before discovery finds the present subscribers
            self._remove_subscriber(name)
        self._lapsed.clear()
        self._apply(self.discovery.link_up(self._clock.monotonic()))

    def _begin_session(self) -> None:
        """Prove the key anew: what others have proven before may be recorded."""
        if self.guard is not None:
            self.guard.link_up()

    def unreachable(self, reason: str) -> None:
        """Report that the other end can't be reached yet, once for each reason."""
        if reason != self.unreachable_reason:
            self.unreachable_reason = reason
            self._hub.link_waits(self, reason)

    def refuse_key(self, reason: str) -> None:
        """Report that the two ends do not have one key, once for each reason."""
        self.denied, self.key_refused = True, reason
        if reason != self.unreachable_reason:
            self.unreachable_reason = reason
            self._hub.link_notice(self, "key refused", reason, trouble=True)

    def on_down(self, reason: str) -> None:
        """Stop sending, as the other end is gone; discard and count what waits: no stale command arrives late."""
        if not self.up:
            return
        self.up = False
        self._down_at = self._clock.monotonic()
        self._lost_at_down = self.stats.lost[LINK_DOWN]
        self.calls.clear()
        lost = self.discard()  # which may count some itself
        self.stats.lost[LINK_DOWN] += lost
        self._hub.link_changed(self, reason, 0.0, 0)
        # Before discovery forgets the subscribers, and so which topics the link carried.
        carried = [publisher for each in self._subscribers.values() for publisher in each.topic.publishers]
        self._apply(self.discovery.link_down(self._down_at))
        for publisher in carried:
            publisher.link_degraded(self.name, reason)

    def close(self) -> None:
        """Announce the end, and release all topics."""
        if self._closed:
            return
        self._apply(self.discovery.leave(self._clock.monotonic()))  # while the link can still send that
        self._closed = True
        self.up = False
        self._alarm.close()
        self.calls.clear()
        if self.guard is not None:
            self.guard.close()
        self._release_topics()

    def possible_senders(self) -> set[str]:
        """Return the modules that may have what none of them has announced, by name; empty: there may be others."""
        return possible_senders(self.discovery.modules.values())

    def manage(self, data: bytes, source: Hashable) -> None:
        """Handle a management message from this address."""
        if self.guard is None or self.guard.admits(data, self.sealer(source)):
            self.handle_management(data, source)

    def sealer(self, source: Hashable) -> Hashable:
        """Return what seals and what they seal have in common: the address they come from."""
        return source

    def handle_management(self, data: bytes, source: Hashable) -> None:
        """Handle a management message that counts, also on a link with a key."""
        if self.gateway_hooks is None or not self.gateway_hooks.handle_management(data):
            self._apply(self.discovery.receive(self._clock.monotonic(), data, source))

    def send_management(self, data: bytes, *, urgent: bool = False) -> None:
        """Send a management message, behind its seal on a link with a key: see `write_management`."""
        if self.guard is None:
            self.write_management(data, urgent=urgent)
        else:
            self.guard.send(data, urgent=urgent)

    # For the two kinds of links

    @abc.abstractmethod
    def write_management(self, data: bytes, *, urgent: bool = False) -> None:
        """Send a management message before waiting samples, `urgent` ones before all; lost if nothing moves."""

    def write_answer(self, messages: tuple[bytes, ...], to: Hashable) -> None:
        """Send management messages to one address. Only links that pass `addresses=True` to discovery need this."""
        raise NotImplementedError

    @abc.abstractmethod
    def write_call(self, data: bytes, to: Hashable) -> None:
        """Send a message of r2p's own services, to this address at least."""

    @abc.abstractmethod
    def discard(self) -> int:
        """Empty the send buffer; return how many samples are lost."""

    @abc.abstractmethod
    def add_publisher(self, topic: Topic, size: int, source: Hashable) -> None:
        """Receive messages of `size` bytes (0: any) from a remote publisher; called again when the size changes."""

    @abc.abstractmethod
    def remove_publisher(self, name: str, source: Hashable) -> None:
        """Stop receiving a topic from this publisher."""

    @abc.abstractmethod
    def remove_publishers(self, name: str) -> None:
        """Stop receiving a topic."""

    @abc.abstractmethod
    def _subscriber_joined(self, event: SubscriberJoined) -> None:
        """Send the topic from now on, and its latched values."""

    def _release_topics(self) -> None:
        for name in list(self._subscribers):
            self._remove_subscriber(name)

    @property
    def fixed_peer(self) -> bool:
        """Return whether the other end stays the same for as long as the link is up."""
        return False

    def module_changed(self, module: str) -> None:
        """Adapt to a module at the other end that joined, left, or changed its state."""

    # For publishers and the module

    @property
    def losses(self) -> Counter[str]:
        """All losses since the link was opened, in both directions, by reason."""
        return self.stats.lost + self.discovery.counts

    def fingerprint_of(self, topic: str, source: Source) -> bytes:
        """Return the fingerprint of the type in which this source publishes the topic; ANY_TYPE if it is unknown."""
        return self.discovery.publisher_type(topic, source.module).fingerprint

    def latched(self, topic: str) -> bool:
        """Return whether a publisher at the other end latches the topic; only r2p modules announce that."""
        return any(each.latches(topic) for each in self.discovery.endpoints.values())

    def guarantee(self, topic: str, publisher_class: PublisherClass) -> str:
        """Describe what the class means for this topic on this link."""
        return "best effort, in order" + (", waits for room" if publisher_class == PublisherClass.NON_REAL_TIME else "")

    def best_effort(self, publisher_class: PublisherClass) -> bool:
        """Return whether the link gives less than the class asks for."""
        return publisher_class != PublisherClass.NON_REAL_TIME

    def longest(self, *, varies: bool) -> int:
        """Return the bytes of the longest message that the link carries, of those whose length `varies` or is fixed."""
        return self.max_variable if varies and self.max_variable is not None else self.max_payload

    def refusal(self, size: int, *, varies: bool = False) -> str | None:
        """Return why messages of `size` bytes can't be sent on this link; None if they can.

        Of messages whose length `varies`, up to `size` bytes, those pass that fit; the others are counted.
        """
        most = self.longest(varies=varies)
        if size <= most:
            return None
        return f"{'up to ' if varies else ''}{size} bytes, and it carries at most {most} in a message"

    def inadmissible(self, size: int, period: float, *, varies: bool = False) -> str | None:
        """Return why there can never be slots for messages of `size` bytes each `period` seconds; None if there can."""
        return None

    def publishers_differ(self, topic: Topic) -> str | None:
        """Describe how the type of the publishers at the other end differs from this module's; None if it fits."""
        return refused_publishers(topic, self.discovery.topics.get(topic.name)) if self.up else None

    def network_time(self) -> int | None:
        """Return the time (ns) that all nodes of the network share; None without one, or if it is unknown."""
        return None

    def network_clock(self) -> NetworkClock | None:
        """Return the clock of that time, with which nodes tick; None without one."""
        return None

    def translation(self) -> ClockOffset | None:
        """Return the translation of network time to UTC and its accuracy, or None while these are unknown."""
        return None

    def params(self, topic: str) -> bytes | None:
        """Return what peers need to know to receive a topic from this module; None if it can't be published here."""
        return NO_PARAMS

    def window(self, topic: Topic) -> int:
        """Return how many messages a publisher of the topic is to keep for this link."""
        return QUEUE

    async def admission(self, topic: str) -> None:
        """Wait until the link has admitted the topic; best effort is admitted at once."""

    async def message_type(self, fingerprint: bytes) -> type[Message] | None:
        """Return a message class of this layout from a module on the link, where types can be requested."""
        return None

    def not_carried(self) -> dict[str, str]:
        """Return the topics of this side that the link does not carry, and why, where that is not their length."""
        return {}

    def known_types(self) -> Iterable[type[Message]]:
        """Return the classes of topics at the other end that are known here, for others that ask."""
        return ()

    @property
    def makes_types(self) -> bool:
        """Whether the types of announced topics are still being made, so that they will be known soon."""
        return False

    def command(self, command: Command, module: str) -> None:
        """Send STOP, REBOOT or BOOTLOAD to a module."""
        self._apply(self.discovery.command(self._clock.monotonic(), command, module))

    def report_conflict(self, module: str, instance_a: int, instance_b: int) -> None:
        """Inform two modules that they have the same name."""
        self._apply(self.discovery.report_conflict(self._clock.monotonic(), module, instance_a, instance_b))

    def relay(self, message: Relayed) -> None:
        """Pass on the announcement of a module on another link."""
        self._apply(self.discovery.relay(self._clock.monotonic(), message))

    def query(self) -> None:
        """Ask all modules to repeat what they publish and subscribe to."""
        self._apply(self.discovery.query(self._clock.monotonic()))

    def set_flags(self, flags: int) -> None:
        """Announce the module's state, as in ALIVE."""
        self._apply(self.discovery.set_flags(self._clock.monotonic(), flags))

    def topic_changed(self, topic: Topic) -> None:
        """Announce a topic that this module publishes or subscribes to, after a possible change."""
        desired = own = announcement_of(topic)
        if self.gateway_hooks is not None:
            desired = self.gateway_hooks.desired_state(topic, desired)
        is_used = bool(desired.publishes or desired.subscribes or desired.endpoints)
        is_used = is_used and len(topic.name) <= self.max_name
        # First, as it may change other topics: two can't have one alias. What a gateway only forwards under a short
        # name may be an alias whose name was not received yet, so that is no claim.
        claims = is_used and (own.publishes or own.subscribes or len(topic.name) > TOPIC_FIELD)
        self._apply(self.discovery.claim(topic.name) if claims else self.discovery.release(topic.name))
        if not is_used or self.discovery.rival(topic.name):
            desired = NOTHING
        known = self._announced.pop(topic.name, NOTHING)
        # Of messages of variable length those pass that the link can carry, and the others are counted.
        refused = not desired.varies and self.refusal(desired.size) is not None
        if desired.varies and desired.publishes:  # before subscribers are found, who may get a latched value at once
            self.varying.add(topic.name)
        else:
            self.varying.discard(topic.name)
        params = self.params(topic.name) if desired.publishes and not refused else None
        queue = self.window(topic) if desired.subscribes else QUEUE
        desired = msgspec.structs.replace(
            desired, publishes=params is not None, params=params or NO_PARAMS, queue=queue
        )
        if desired != known:
            self._apply(self._announce_changes(topic.name, known, desired))
        # Discovery reports nothing that this module has withdrawn itself.
        if not desired.publishes:
            self._remove_subscriber(topic.name)
        if not desired.subscribes:
            self.remove_publishers(topic.name)
        if desired.publishes or desired.subscribes or desired.endpoints:
            self._announced[topic.name] = desired

    def _announce_changes(self, topic: str, known: Announcement, desired: Announcement) -> list[Event]:
        """Announce the difference between what the other ends know of a topic and should know; return the events."""
        discovery, now = self.discovery, self._clock.monotonic()
        events: list[Event] = []
        retyped = (desired.size, desired.fingerprint, desired.varies) != (known.size, known.fingerprint, known.varies)
        if desired.publishes and (retyped or not known.publishes or desired.params != known.params):
            size, fingerprint, varies = desired.size, desired.fingerprint, desired.varies
            events += discovery.advertise(now, topic, size, fingerprint, desired.params, varies=varies)
        elif known.publishes and not desired.publishes:
            events += discovery.withdraw(now, topic)
        asks_anew = (desired.asked, desired.queue) != (known.asked, known.queue)
        if desired.subscribes and (asks_anew or not known.subscribes):
            asked, queue = desired.asked, desired.queue
            varies, accepted = asked.varies, asked.accepted
            events += discovery.subscribe(
                now, topic, asked.size, queue, asked.fingerprint, varies=varies, accepted=accepted
            )
        elif known.subscribes and not desired.subscribes:
            events += discovery.unsubscribe(now, topic)
        for (node, role), publisher_class in desired.endpoints.items():
            if known.endpoints.get((node, role)) != publisher_class:
                events += discovery.add_endpoint(now, node, topic, role, publisher_class)
        for node, role in known.endpoints.keys() - desired.endpoints.keys():
            events += discovery.remove_endpoint(now, node, topic, role)
        return events

    # Discovery

    def _poll(self) -> None:
        now = self._clock.monotonic()
        try:
            events = self.discovery.poll(now)
        except Exception as error:  # noqa: BLE001 - counted and logged
            self.stats.lost.internal_error(error)
            self._alarm.set(now + RETRY_AFTER_ERROR)
        else:
            self._apply(events)

    def _apply(self, events: Iterable[Event]) -> None:
        self._events.extend(events)
        if self._acting:
            return  # what an event causes comes after the events before it
        self._acting = True
        try:
            while self._events:
                self.stats.lost.guard(self._act, self._events.popleft())
        finally:
            self._acting = False
        if not self._closed:
            self._alarm.set(self.discovery.next_deadline())
            if self.gateway_hooks is not None:
                self.stats.lost.guard(self.gateway_hooks.discovery_changed)

    def _act(self, event: Event) -> None:
        match event:
            case Send(data, urgent):
                if self.up and (self.gateway_hooks is None or self.gateway_hooks.may_announce):
                    self.send_management(data, urgent=urgent)
            case SendTo(messages, to):
                if self.up and (self.gateway_hooks is None or self.gateway_hooks.may_announce):
                    self.write_answer(messages, to)
            case SubscriberJoined():
                self._subscriber_joined(event)
            case SubscribersGone(topic) if self.up or self._closed:
                self._remove_subscriber(topic)
            case SubscribersGone(topic):  # until the other end is back, what it does not get is counted
                self._lapsed.add(topic)
            case PublisherFound(topic, source, _, size):
                self._publisher_found(topic, size, source)
            case PublisherGone(topic, source):
                self.remove_publisher(topic, source)
            case _:
                self._report(event)

    def _report(self, event: Event) -> None:
        """Adapt to an event that concerns no topic of the other end, and pass it on to the module."""
        match event:
            case ModuleChanged(info) | ModuleGone(info):
                self.module_changed(info.name)
            case AliasFreed(name) | AliasConflict(refused=name) if (topic := self._space.topics.get(name)) is not None:
                self.topic_changed(topic)  # its alias is its own now, or not any more
        self._hub.discovered(self, event)

    def _publisher_found(self, name: str, size: int, source: Hashable = None) -> None:
        if (topic := self._space.topics.get(name)) is not None and topic.wanted:
            self.add_publisher(topic, topic.received_size(size), source)

    def _remove_subscriber(self, name: str) -> None:
        if (subscriber := self._subscribers.pop(name, None)) is not None:
            subscriber.topic.leave(subscriber)


class LinkSubscriber(RemoteSubscriber):
    """One topic on its way out by one link, for all modules at the other end that subscribe to it.

    Publishers do not wait for a link that is down: its messages are lost and counted.
    """

    __slots__ = ("topic",)

    link: Link  # which the base only compares

    def __init__(self, link: Link, topic: Topic, wait_queue: WaitQueue) -> None:
        super().__init__(link.name, link, wait_queue)
        self.topic = topic

    @property
    def reachable(self) -> bool:
        return self.link.up

    def count_lost(self, reason: str) -> None:
        super().count_lost(reason)
        self.link.stats.lost[reason] += 1

    def offer_down(self, sample: Sample) -> bool:
        """Accept a sample as lost while the link is down, if its publisher has signalled the outage, and does not
        signal each sample that is missed, as real-time ones do.
        """
        if sample.publisher_class != PublisherClass.NON_REAL_TIME:
            return False
        self.count_lost(LINK_DOWN)
        return True


def unique_name(name: str, hub: Hub) -> str:
    """Return a name that no other link has, even one to the same place; all parts of the link use this one."""
    used = {each.name for each in hub.space.links}
    names = itertools.chain((name,), (f"{name}#{n}" for n in itertools.count(2)))
    return next(each for each in names if each not in used)


def _discovery(link: str, hub: Hub, rate: float) -> Discovery:
    """Make the discovery of a line or a bus; `rate` is in messages per second."""
    counts = LoggedCounter(link, hub.space.clock)
    space, burst = hub.space, max(4, int(rate / 4))  # what a quarter of a second carries
    return Discovery(
        space.module, hub.instance, rate=rate, burst=burst, observer=hub.observer, counts=counts, aliases=space.aliases
    )
