"""A topic: joins the publishers and subscribers of one module, and the links that carry it.

`Topic.deliver` is one loop over the queues, highest priority first, and one over the links that send it on. It never
waits: full sinks worth waiting for are returned to the publisher, whose class decides what to do.
"""

import abc
import asyncio
from collections import deque
from collections.abc import Callable, Hashable, Mapping
from typing import TYPE_CHECKING, Any, Protocol
from weakref import WeakValueDictionary

from r2p.clock import Clock
from r2p.codecs.management import ANY_TYPE
from r2p.errors import TransportError, TypeMismatch
from r2p.log_lines import NodeLogger
from r2p.messages import Layout
from r2p.protocols.discovery.events import TopicType
from r2p.protocols.discovery.interface import DiscoveryProtocol
from r2p.runtime.accepting import AcceptedTypes
from r2p.runtime.backpressure import Sink, WaitQueue
from r2p.runtime.network_time import NetworkClock
from r2p.runtime.queues import EndpointOwner, SubscriberQueue, WakeScheduler
from r2p.runtime.sample import LastReceived, PublisherClass, Sample, Source

if TYPE_CHECKING:
    from r2p.runtime.qos import PublisherSignal


class RemoteSubscriber(Sink):
    """The subscribers of one topic at the other end of one link, as publishers see them."""

    __slots__ = ("link", "link_name", "wait_queue")

    def __init__(self, link_name: str, link: object, wait_queue: WaitQueue) -> None:
        super().__init__()
        self.link_name = link_name
        self.link = link
        """The link; topics only compare it."""
        self.wait_queue = wait_queue

    @property
    def owner(self) -> str:
        return self.link_name

    def get_wait_queue(self) -> WaitQueue:
        return self.wait_queue


class PublisherHandle(Protocol):
    """A publisher as its topic and its links see it."""

    node: EndpointOwner
    publisher_class: PublisherClass
    latch: bool

    def subscriber_joined(self, sink: Sink) -> None:
        """Send a latched value: a subscriber joined, or came back after a reboot."""

    def link_degraded(self, link: str, reason: str) -> None:
        """Report that a link no longer carries the topic."""

    def link_missed(self, link: str, reason: str, late: float = 0.0, sequence: int = 0) -> None:
        """Report that a link gave up a message that it had accepted; `late` is in seconds."""

    def link_late(self, link: str, reason: str, late: float = 0.0) -> None:
        """Report that a link sent a message after its deadline; `late` is in seconds."""


class SlotPublisher(abc.ABC):
    """Fills slots that a bus reserves for a topic: a periodic publisher of this module, or a gateway's relay."""

    period: float
    """Seconds."""
    lead: float
    """Seconds before its slot at which a message is made."""

    @property
    @abc.abstractmethod
    def size(self) -> int:
        """Bytes of one message; of the longest, if their length varies."""

    @property
    @abc.abstractmethod
    def varies(self) -> bool:
        """Return whether the length of the messages varies."""

    @abc.abstractmethod
    def use_slot_clock(self, slot_link: object, period: float) -> bool:
        """Let a link call `tick` at its slots, each `period` seconds, instead of the clock; again: other slots.

        Return False if the slots of another link are the clock, or the publisher is closed.
        """

    @abc.abstractmethod
    def use_own_clock(self, slot_link: object) -> None:
        """Go on with the publisher's own clock and period, if it used the slots of this link."""

    @abc.abstractmethod
    def tick(self, scheduled: int, late: int, skipped: int) -> Sample | None:
        """Return the message for the slot due at `scheduled` (monotonic ns), `late` by ns, after `skipped` periods."""

    @abc.abstractmethod
    def link_degraded(self, link: str, reason: str) -> None:
        """Report that a link has lost its slots."""

    @abc.abstractmethod
    def link_missed(self, link: str, reason: str, late: float = 0.0, sequence: int = 0) -> None:
        """Report that the link gave up a message that it had accepted; `late` is in seconds."""


class LatchedSource(Protocol):
    """A link that receives a topic, and keeps its last message."""

    def latched_value(self, topic: "Topic") -> Sample | None:
        """The last message, if its publisher latches it."""


class Topic:
    """One topic in one module."""

    def __init__(self, name: str, wake_scheduler: WakeScheduler) -> None:
        self.name = name
        self.layout: Layout[Any] | None = None
        self.unnamed_type = TopicType()
        """The size of the messages of a topic without a layout, such as one of a recording; links announce it."""
        self.publishers: list[PublisherHandle] = []
        # Both lists are replaced at a change, never changed in place: a sink may call the user's code, such as when a
        # write breaks a line, and that code may close entries while a sample is on its way through them.
        self.queues: list[SubscriberQueue] = []
        """Queues of this module's subscribers, by descending priority."""
        self.remote_subscribers: list[RemoteSubscriber] = []
        self.remote_publishers = 0
        """Publishers at the other ends of links."""
        self.latched_sources: list[LatchedSource] = []
        self.drop_filter: Callable[[str], bool] | None = None
        """Says for each message, by the name of its link, whether it is dropped (`r2p.bridge.multihoming`)."""
        self.accepted: list[AcceptedTypes] = []
        """The types of subscribers that accept several."""
        self._wake_scheduler = wake_scheduler
        self._last_received: WeakValueDictionary[Hashable, LastReceived] = WeakValueDictionary()

    @property
    def received_layout(self) -> Layout[Any] | None:
        """The layout of all messages that are received; None if it is unknown, or there may be several."""
        return None if self.accepted else self.layout

    def received_size(self, announced: int) -> int:
        """Return the bytes of each message of a publisher that has announced so many; 0: any."""
        layout = self.received_layout
        return announced if layout is None else layout.exact_size

    def last_received(self, publisher: Hashable) -> LastReceived:
        """Return the record that all links with a remote publisher share, to recognise duplicates.

        The record lasts as long as one of them keeps it.
        """
        last = self._last_received.get(publisher)
        if last is None:
            last = self._last_received[publisher] = LastReceived()
        return last

    def deliver(  # noqa: C901 - see below
        self, sample: Sample, own: object = None, slot_link: object = None
    ) -> list[Sink] | None:
        """Queue the sample wherever there is room; return the full sinks that are worth waiting for.

        For a sample of this module these include sinks that became lossy: its publisher counts their losses. `own` is
        the publishing node: its own queues never make it wait. `slot_link` sends in a slot, and is left out.
        """
        if self.drop_filter is not None and self.drop_filter(sample.source.link):
            return None
        wake_scheduler = self._wake_scheduler
        blocked: list[Sink] | None = None
        for sink in self.queues:
            queue = sink.queue
            if len(queue) >= sink.limit:
                # Never for a queue of the publishing node: it would wait for itself.
                if sink.node is not own and (sink.blocks_publishers or sink.waits_for(sample)):
                    blocked = [sink] if blocked is None else [*blocked, sink]
                    continue
                if sink.wait_queue is not None:  # what waits may have to go in first
                    sink.force(sample)
                    continue
                if not sink.drop_oldest():
                    continue
            # `SubscriberQueue._append`, inlined: every message passes here, and a call costs as much as the work.
            queue.append(sample)
            if (waiter := sink.waiter) is not None:
                sink.waiter = None
                if sink.priority < wake_scheduler.top:
                    wake_scheduler.wake_later(sink.priority, waiter)
                elif not waiter.done():
                    waiter.set_result(None)
        if self.remote_subscribers and not sample.source.link:  # only gateways pass messages from a link on
            blocked = self._send(self.remote_subscribers, sample, blocked, slot_link)
        return blocked if blocked is None else self._remaining(blocked)

    def deliver_run(self, samples: list[Sample], at: int) -> int:
        """Queue samples from a link in bulk, from `samples[at]` on, as far as there is room; return how many.

        None but for a single subscriber, whose queue does not count bytes: `deliver` takes each of the others.
        """
        if len(self.queues) != 1 or self.drop_filter is not None:
            return 0
        (sink,) = self.queues
        queue = sink.queue
        taken = min(sink.limit - len(queue), len(samples) - at)
        if taken <= 0 or queue.__class__ is not deque:
            return 0
        queue.extend(samples[at : at + taken])
        sink.wake_reader()
        return taken

    def deliver_by(self, link: str, sample: Sample) -> list[Sink] | None:
        """Offer the sample only to the subscribers behind one link; without any, to all subscribers. See `deliver`."""
        for remote in self.remote_subscribers:
            if remote.link_name == link:
                blocked = self._send([remote], sample, None, None)
                return blocked if blocked is None else self._remaining(blocked)
        return self.deliver(sample)

    def _remaining(self, sinks: list[Sink]) -> list[Sink] | None:
        """Leave out sinks that left meanwhile: they would never have room."""
        return [sink for sink in sinks if sink in self.queues or sink in self.remote_subscribers] or None

    def _send(
        self, subscribers: list[RemoteSubscriber], sample: Sample, blocked: list[Sink] | None, slot_link: object
    ) -> list[Sink] | None:
        """Offer the sample to links; return `blocked`, and those without room."""
        for remote in subscribers:
            # Behind others in the same line: nothing overtakes. Two look-ups, as lines are mostly empty.
            queue = remote.wait_queue
            in_line = (queue.real_time or queue.non_real_time) and queue.line_of(sample)
            if remote.link is slot_link or (not in_line and remote.offer(sample)):
                continue
            if blocked is None:
                blocked = [remote]
            else:
                blocked.append(remote)
        return blocked

    def join(self, sink: SubscriberQueue | RemoteSubscriber) -> None:
        """Add a subscriber or a link; latching publishers send it their last value."""
        if isinstance(sink, SubscriberQueue):
            self.queues = sorted([*self.queues, sink], key=lambda queue: -queue.priority)
            for value in self.latched_values():
                sink.offer_latched(value)
        elif sink not in self.remote_subscribers:
            self.remote_subscribers = [*self.remote_subscribers, sink]
        self.resend_latched(sink)

    def latched_values(self) -> list[Sample]:
        """Return the latched values of remote publishers."""
        return [value for source in self.latched_sources if (value := source.latched_value(self)) is not None]

    def is_latched(self, sample: Sample) -> bool:
        """Return whether a sample of another link may be a latched value, which is worth sending however old it is."""
        return False

    def resend_latched(self, sink: SubscriberQueue | RemoteSubscriber) -> None:
        """Let publishers resend latched values to a subscriber that joins behind a link, or is back after a reboot."""
        for publisher in list(self.publishers):  # one may be closed by what its message brings about
            publisher.subscriber_joined(sink)

    def leave(self, sink: SubscriberQueue | RemoteSubscriber) -> None:
        """Remove a subscriber or a link."""
        if isinstance(sink, SubscriberQueue):
            self.queues = [each for each in self.queues if each is not sink]
        else:
            self.remote_subscribers = [each for each in self.remote_subscribers if each is not sink]
        sink.get_wait_queue().drop_sink(sink)

    def publisher_of(self, sample: Sample) -> PublisherHandle | None:
        """Return this module's publisher, to which links report the sample's fate; None for a sample from a link."""
        if sample.source.link:
            return None
        for publisher in self.publishers:
            if publisher.node.name == sample.source.node and publisher.publisher_class == sample.publisher_class:
                return publisher
        return None

    def count_unsendable(self, sample: Sample, link: str, reason: str) -> None:
        """Note that a link can't carry a sample of another one; only a gateway, which passes those on, counts it."""

    @property
    def unused(self) -> bool:
        """Return whether no node of this module publishes or subscribes to the topic."""
        return not (self.publishers or self.queues)

    @property
    def typed(self) -> bool:
        """Return whether a node of this module uses the topic with a type: what only looks at it accepts any."""
        return bool(self.publishers) or any(queue.typed for queue in self.queues)

    @property
    def slot_publishers(self) -> list[SlotPublisher]:
        """The publishers for which a bus may reserve slots."""
        return [each for each in self.publishers if isinstance(each, SlotPublisher)]

    @property
    def wanted(self) -> bool:
        """Return whether links are to receive the topic."""
        return bool(self.queues)

    @property
    def in_use(self) -> bool:
        """Return whether links carry the topic."""
        return bool(self.remote_subscribers or self.remote_publishers)


class LinkView(Protocol):
    """A link as nodes see it."""

    title: str
    """The name for texts."""
    discovery: DiscoveryProtocol
    """What is known of the modules and nodes behind the link."""

    @property
    def name(self) -> str: ...

    @property
    def up(self) -> bool:
        """Return whether the other end can be reached."""

    @property
    def lossless(self) -> bool:
        """Return whether what is sent also arrives at the other end of the link, while it is up."""

    def guarantee(self, topic: str, publisher_class: PublisherClass) -> str:
        """Describe, for people, how well this link serves the topic in this class."""

    def best_effort(self, publisher_class: PublisherClass) -> bool:
        """Return whether the link gives less than the class asks for."""

    def refusal(self, size: int, *, varies: bool = False) -> str | None:
        """Return the reason why messages of `size` bytes, or of up to so many, don't all pass, if there is one."""

    def inadmissible(self, size: int, period: float, *, varies: bool = False) -> str | None:
        """Return the reason why slots for `size` bytes each `period` seconds are impossible, if there is one."""

    def publishers_differ(self, topic: Topic) -> str | None:
        """Describe how the type of the publishers behind the link differs, if it does, so that nothing is received."""

    def network_time(self) -> int | None:
        """Return the time (ns) that all nodes of the link's network share; None without one, or if it is unknown."""

    def network_clock(self) -> NetworkClock | None:
        """Return the clock of that time, with which nodes tick; None without one."""

    def fingerprint_of(self, topic: str, source: Source) -> bytes:
        """Return the fingerprint of the type in which this source publishes the topic; ANY_TYPE if it is unknown."""

    async def admission(self, topic: str) -> None:
        """Wait until the link has admitted the topic."""


class CallNumbers:
    """The numbers of a module's calls of one service."""

    def __init__(self) -> None:
        self.last = 0
        self.open: set[int] = set()
        """The numbers of calls without an answer."""


class TopicSpace:
    """The topics of one module, by name; its links are informed of changes by `changed`."""

    def __init__(
        self, module: str, loop: asyncio.AbstractEventLoop, clock: Clock, aliases: Mapping[str, str] | None = None
    ) -> None:
        self.module = module
        self.instance = 0
        """The random 32-bit number of this run of the module."""
        self.call_numbers: dict[str, CallNumbers] = {}
        """Those of each service: kept here, as all clients share them, and no restart of a node may begin anew."""
        self.loop = loop
        self.clock = clock
        self.aliases = aliases or {}
        """Aliases chosen for topics whose names are too long for some links."""
        self.wake_scheduler = WakeScheduler(loop)
        self.topics: dict[str, Topic] = {}
        self.links: list[LinkView] = []
        self.on_link_added: list[Callable[[], object]] = []
        """Callbacks after a link was added."""
        self.make_topic: Callable[[str, WakeScheduler], Topic] = Topic
        """The class of the topics; a gateway has its own."""
        self.signal_listeners: list[Callable[[PublisherSignal], object]] = []
        """Get each signal of each publisher of this module, also those that the log leaves out; they must not raise."""
        self.changed: Callable[[Topic], None] = lambda _topic: None
        """Callback after a publisher or a subscriber of this module was added or removed."""
        self.listeners: list[Callable[[Topic], None]] = []
        """More callbacks of that kind."""

    def open(self, name: str, layout: Layout[Any] | None) -> Topic:
        """Return the topic for a new user. Raises TypeMismatch if it has another layout (`None` fits any)."""
        topic = self.topics.get(name)
        if topic is None:
            topic = self.topics[name] = self.make_topic(name, self.wake_scheduler)
        if layout is not None:
            for each in topic.accepted:
                self._check_accepted(name, each, layout)
            if topic.layout is None:
                topic.layout = layout
            elif topic.layout.fingerprint != layout.fingerprint:
                raise TypeMismatch(
                    f"topic {name} is {topic.layout.cls.__name__} ({topic.layout.schema}) in module {self.module}, "
                    f"not {layout.cls.__name__} ({layout.schema}): a changed layout needs a topic of its own"
                )
        return topic

    def open_accepting(self, name: str, accepted: AcceptedTypes) -> Topic:
        """Return the topic for a subscriber that accepts several types. Raises TypeMismatch if it has yet another."""
        topic = self.open(name, None)
        if topic.layout is not None:
            self._check_accepted(name, accepted, topic.layout)
        return topic

    def _check_accepted(self, name: str, accepted: AcceptedTypes, layout: Layout[Any]) -> None:
        if not accepted.accepts(layout):
            raise TypeMismatch(
                f"topic {name} is {layout.cls.__name__} ({layout.schema}) in module {self.module}, which a subscriber "
                f"of {accepted.names} does not accept: add it to its accept="
            )

    def network_clock(self) -> NetworkClock | None:
        """Return the clock of the first link that has one: the time of the module's RTCAN network."""
        return next((clock for link in self.links if (clock := link.network_clock()) is not None), None)

    def check_links(
        self, topic: str, shape: Layout[Any], publisher_class: PublisherClass, period: float | None
    ) -> None:
        """Raise TransportError for a link that gives less than the class of a publisher asks for."""
        size, varies = shape.size, shape.varies
        for link in self.links:
            reason = link.refusal(size, varies=varies)
            if not reason and link.best_effort(publisher_class):
                reason = link.guarantee(topic, publisher_class)
            elif not reason and period is not None:
                reason = link.inadmissible(size, period, varies=varies)
            if reason:
                raise TransportError(f"topic {topic} on link {link.name}: {reason} (advertised with strict=True)")

    def warn_of_links(self, log: NodeLogger, topic: str, shape: Layout[Any], what: str) -> None:
        """Warn of links that can't carry the topic, or not all of its messages. `what` is the predicate."""
        for link in self.links:
            if (reason := link.refusal(shape.size, varies=shape.varies)) is None:
                continue
            if shape.varies:
                text = "topic %s: link %s can't carry its longest messages (%s); they are counted as too long"
                log.warning(text, topic, link.name, reason)
            else:
                log.warning("topic %s %s link %s: %s", topic, what, link.name, reason)

    def fingerprint_of(self, topic: Topic, source: Source) -> bytes:
        """Return the fingerprint of the type in which another module publishes a topic; ANY_TYPE if it is unknown."""
        link = next((each for each in self.links if each.name == source.link), None)
        return ANY_TYPE if link is None else link.fingerprint_of(topic.name, source)

    def release(self, topic: Topic) -> None:
        """Inform the links of a change; forget the topic's type with the last one that has it, and the topic itself if
        neither this module nor a link uses it.
        """
        if not topic.typed:
            topic.layout, topic.unnamed_type = None, TopicType()
        self.changed(topic)
        if topic.unused and not topic.in_use:
            self.topics.pop(topic.name, None)
