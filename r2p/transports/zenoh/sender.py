"""Send to subscribers in other modules as far as their credit goes, and track what they got.

    SubscriberJoined -> Reachability (do messages arrive there?) -> ZenohSubscriber -> TxStream
    credit           -> CreditReader -> ZenohSubscriber, whose waiting publishers go on
    SubscriberLeft   -> FinalCredits: did the subscriber get all its messages?

A topic goes out no further than its subscribers have room (r2p.protocols.flow_control).
"""

import asyncio
from collections import Counter
from collections.abc import Iterator

import msgspec
import zenoh

from r2p.codecs import UnknownType
from r2p.codecs.attachment import Credit, Origin, decode_credit, name_for
from r2p.codecs.management import ANY_TYPE
from r2p.errors import DecodeError
from r2p.protocols.discovery.events import TopicType
from r2p.protocols.flow_control import UNCOUNTED_BYTES, SendWindow
from r2p.runtime.backpressure import LINK_DOWN, WaitQueue
from r2p.runtime.sample import PublisherClass, Sample
from r2p.runtime.topic import Topic
from r2p.transports.link import Hub, Link, LinkSubscriber
from r2p.transports.zenoh.large import LARGE, LargeSender
from r2p.transports.zenoh.publish import BATCH_MAX, Batcher, PublisherCache, TxStream
from r2p.transports.zenoh.session import SubscriptionReader, ZenohSession

_NRT = PublisherClass.NON_REAL_TIME

_CREDIT_PAUSE_S = 0.02  # seconds after which credit is read that no publisher waits for
_CREDIT_RING = 1024  # credits that come in that time at most
_CREDIT_BYTES_MAX = 256  # longer messages are not copied, as they can't be credits

_RETRY_S = 0.002  # seconds until messages to a new subscriber are checked again; each time that much longer
_RETRY_FACTOR_MAX = 100  # so at most every 0.2 s
_RETRIES = 50  # checks, together 2.5 s, after which the user has to know
_CHECK_S = 0.25  # seconds between two checks whether what was sent is acknowledged
_RESENDS = 6  # checks at which latched values are sent once more, before the user has to know

FINAL_CREDIT_S = 1.0
"""Seconds after the end of a token in which a final credit may arrive: far more than threads and networks take."""


class ZenohSubscriber(LinkSubscriber):
    """One topic on its way out, to all its subscribers on the network.

    The publisher's class decides how to wait for subscribers without room.
    """

    __slots__ = ("_batcher", "_sender", "_streams", "resending", "silent_checks")

    def __init__(self, sender: "ZenohSender", topic: Topic) -> None:
        super().__init__(sender.link, topic, WaitQueue())
        self._sender = sender
        self._batcher = sender.batcher
        self._streams = {
            each: TxStream(sender.publishers.window(topic.name, each), urgent=each is not _NRT)
            for each in PublisherClass
        }
        self.set_type(sender.types.get(topic.name, TopicType()))
        self.resending = False
        """True if latched values are being sent to a new subscriber, even if others have no room."""
        self.silent_checks: Counter[int] = Counter()
        """Checks in a row in which a session had acknowledged nothing."""

    # As a sink

    def offer(self, sample: Sample) -> bool:
        stream = self._streams[sample.publisher_class]
        window = stream.window
        # One condition for the hot path: there is credit, from the same publisher as before, and the link is up.
        if window.serial >= window.limit or sample.source is not stream.source or not self.link.up:
            if not self.link.up:
                return self.offer_down(sample)
            if not self._has_credit(stream) and not self.resending:
                return False
            if sample.source is not stream.source:
                self._prepare(stream, sample)
        if stream.large is not None and stream.large.is_full(window) and not self.resending:
            return False
        window.serial += 1
        stream.samples.append(sample)
        if stream.large is not None:
            window.add_bytes(len(sample.data))
            if len(sample.data) > LARGE:
                self._batcher.send_now(stream)
                return True
        if stream.urgent or len(stream.samples) in (1, BATCH_MAX):
            self._batcher.add(stream)
        return True

    def _has_credit(self, stream: TxStream) -> bool:
        """Return whether the subscribers have room, by their credit, which is read now if need be."""
        window = stream.window
        if window.serial < window.limit:
            return True
        self._sender.credits.receive()
        if window.serial < window.limit:
            return True
        self._sender.credits.wait()
        return False

    def force(self, sample: Sample) -> None:
        if not self.link.up:
            self.count_lost(LINK_DOWN)
        elif not self.offer(sample):
            self.count_lost("no credit")

    def refill(self) -> None:
        while not self.link.stats.lost.guard(self.wait_queue.serve):
            pass  # the one that raised no longer waits
        self.wait_queue.recover()

    def become_lossy(self, reason: str) -> None:
        """Go on without the subscribers that have no room; the others are waited for as before."""
        self._streams[_NRT].window.skip_full()
        self._sender.credits.wait()
        self.wait_queue.reject(self, reason)

    # For the sender

    def set_type(self, topic_type: TopicType, *, restart: bool = False) -> None:
        """Adapt to the type of the topic; `restart`: its zenoh publishers have been replaced."""
        long = topic_type.varies or not 0 < topic_type.size <= UNCOUNTED_BYTES
        for stream in self._streams.values():
            if stream.samples and (restart or stream.varies != topic_type.varies):
                self._batcher.send(stream)
            if restart:
                stream.source = None
            stream.varies = topic_type.varies
            stream.large = self._sender.large if long else None

    @property
    def windows(self) -> list[SendWindow]:
        """The windows of all classes."""
        return [stream.window for stream in self._streams.values()]

    def has_session(self, session: int) -> bool:
        """Return whether a session subscribes."""
        return session in self._streams[_NRT].window.subscribers

    def add_session(self, session: int, window: int) -> None:
        """Add a subscribing session, or change its window."""
        # Events and periodic messages never wait; their windows only count what was acknowledged.
        for publisher_class, stream in self._streams.items():
            stream.window.add(session, window if publisher_class == _NRT else 0)
        self.refill()

    def remove_session(self, session: int) -> int:
        """Remove a session; return how many messages it did not acknowledge, unless it left in order."""
        self._sender.credits.receive()  # its final credit may have come before its token went
        self.silent_checks.pop(session, None)  # it may join again
        unacknowledged = sum([stream.window.remove(session) for stream in self._streams.values()])
        self.refill()
        return unacknowledged

    def acknowledge(self, credit: Credit) -> None:
        """Note a session's progress; a waiting publisher goes on with `refill`."""
        window = self._streams[credit.publisher_class].window
        acknowledged = window.acknowledge(credit.session, credit.serial)
        self._sender.large.confirm(window, acknowledged)
        self.set_leaving(credit.session, leaving=credit.leaving)

    def set_leaving(self, session: int, *, leaving: bool) -> None:
        """Note whether a session has ended its subscription, in all classes."""
        for stream in self._streams.values():
            stream.window.set_leaving(session, leaving=leaving)

    def resend_latched(self) -> None:
        """Send latched values, even without room."""
        self.resending = True
        try:
            self.topic.resend_latched(self)
        finally:  # its callers go on after an error: what is published later must wait for credit again
            self.resending = False

    @property
    def awaits_credit(self) -> bool:
        """Return whether a publisher waits, or went on without a session that may grant credit again."""
        return bool(self.wait_queue) or not all(
            each.waited_for for each in self._streams[_NRT].window.subscribers.values()
        )

    def unacknowledged(self) -> set[int]:
        """Return the sessions that got messages, and have acknowledged none in any class."""
        windows = self.windows
        answered = {number for window in windows for number, each in window.subscribers.items() if each.answered}
        return {number for window in windows for number in window.unacknowledged()} - answered

    def _prepare(self, stream: TxStream, sample: Sample) -> None:
        """Switch to another publisher."""
        self._batcher.send(stream)
        publishers, name, publisher_class = self._sender.publishers, self.topic.name, sample.publisher_class
        put, direct_put = publishers.put(name, publisher_class), publishers.direct_put(name, publisher_class)
        stream.prepare(sample.source, self._sender.origin(self.topic, sample), put, direct_put)


class ZenohSender:
    """All topics that a link sends."""

    def __init__(self, link: Link, hub: Hub, subscribers: dict[str, LinkSubscriber], *, batching: bool) -> None:
        """`subscribers` are those of the link, by topic; `batching`: several messages may share a payload."""
        self.link = link
        self.loop = hub.space.loop
        self.publishers = PublisherCache()
        self.batcher = Batcher(self.loop, link.stats, batching=batching)
        self.large = LargeSender(self.loop, link.stats.lost)
        self.credits = CreditReader(self)
        self.reachability = Reachability(self)
        self.final_credits = FinalCredits(self)
        self.topics = hub.space.topics
        """Topics that this module publishes, subscribes to or forwards."""
        self.types: dict[str, TopicType] = {}
        """The types of the topics that this module publishes or forwards on the link."""
        self.large.on_wait = self.credits.wait
        self.large.on_room = self.credits.serve
        self._hub = hub
        self._subscribers = subscribers
        self._prefix = ""

    def connect(self, session: ZenohSession, prefix: str) -> None:
        """Use this session."""
        self._prefix = prefix
        self.publishers.connect(session, f"{prefix}/topic/")
        self.credits.connect(session, f"{prefix}/credit/{self._hub.instance:x}")
        self.large.connect(session.large, session.outbound)

    def declare(self, topic: Topic, topic_type: TopicType) -> None:
        """Declare the zenoh publishers of a topic, or adapt to another type of it."""
        self.types[topic.name] = topic_type
        subscriber = self.subscriber(topic.name)
        restart = self.publishers.declare(topic, topic_type.size)
        if subscriber is not None:
            subscriber.set_type(topic_type, restart=restart)

    def undeclare(self, topic: str) -> None:
        """Undeclare the zenoh publishers of a topic."""
        self.types.pop(topic, None)
        self.publishers.undeclare(topic)

    def flush(self, topic: str) -> None:
        """Send what waits, before the zenoh publishers of this topic are undeclared."""
        self.batcher.flush()
        subscriber = self.subscriber(topic)
        if subscriber is not None:
            self.large.flush(subscriber.windows)

    def discard(self) -> int:
        """Drop what waits, and return the number of these messages."""
        return self.batcher.discard() + self.large.discard()

    def close(self) -> None:
        self.large.close()
        self.reachability.close()
        self.final_credits.close()
        self.credits.close()
        self.publishers.close()

    def subscribers(self) -> Iterator[ZenohSubscriber]:
        """The link's subscribers: one for each topic that other modules subscribe to."""
        return (each for each in self._subscribers.values() if isinstance(each, ZenohSubscriber))

    def subscriber(self, topic: str) -> ZenohSubscriber | None:
        subscriber = self._subscribers.get(topic)
        return subscriber if isinstance(subscriber, ZenohSubscriber) else None

    # Subscribers that join and leave

    def add_subscriber(self, topic: str, session: int, window: int) -> None:
        """Add a subscriber whose token appeared, or change its window."""
        self.credits.wait()
        subscriber = self.subscriber(topic)
        current = subscriber is not None and subscriber.topic is self.topics.get(topic)
        if subscriber is not None and current and subscriber.has_session(session):  # messages reach it already
            subscriber.add_session(session, window)
        else:
            self.reachability.add(topic, session, window)

    def admit(self, topic: str, session: int, window: int, *, leaving: bool = False) -> None:
        """Send latched values and all messages from now on to a subscriber, which they reach."""
        here = self.topics[topic]
        subscriber = self.subscriber(topic)
        if subscriber is not None and subscriber.topic is here:
            subscriber.add_session(session, window)
            subscriber.resend_latched()
        else:
            self.batcher.flush()  # of an earlier subscriber, whose serials this one continues
            subscriber = self._subscribers[topic] = ZenohSubscriber(self, here)
            subscriber.add_session(session, window)
            here.join(subscriber)
        if leaving:
            subscriber.set_leaving(session, leaving=True)

    def remove_subscriber(self, topic: str, session: int, *, gone: bool) -> None:
        """Stop sending to a subscriber. `gone`: its token, too; otherwise it still accepts messages on the way."""
        self.reachability.remove(topic, session)
        subscriber = self.subscriber(topic)
        unacknowledged = 0 if subscriber is None else subscriber.remove_session(session)
        if unacknowledged and gone and self.link.up:
            self.final_credits.expect(topic, session, unacknowledged)
        elif unacknowledged and gone:  # no credit comes on a link that is down
            self.count_unknown(unacknowledged)

    def count_unknown(self, count: int) -> None:
        """Count messages that a subscriber may not have got."""
        self.link.stats.lost["unknown at disconnect"] += count

    def report_unreachable(self, topic: str, session: int) -> None:
        """Report to the user that messages do not reach a subscriber."""
        modules = self.link.discovery.modules.values()
        module = next((each.name for each in modules if each.instance == session), "?")
        key = f"{self._prefix}/topic/{topic}"
        text = f"topic {topic} does not reach module {module}: "
        text += f"does the access control of a router deny {key} to either?"
        self._hub.link_notice(self.link, "unreachable subscriber", text, trouble=True)

    # Publishers

    def origin(self, topic: Topic, sample: Sample) -> Origin:
        """Return the publisher of a message as in headers."""
        own, source, hooks = self._hub.instance, sample.source, self.link.gateway_hooks
        return Origin(
            sample.publisher_class,
            own,
            self._instance_of(source.module) if source.link else own,
            ANY_TYPE if topic.layout is None else topic.layout.fingerprint,
            name_for(source.module if hooks is None else hooks.source_name(source)),
            source.node,
        )

    def _instance_of(self, module: str) -> int:
        """Return the number of a module on any link; 0: firmware, or unknown."""
        links = (each for each in self._hub.space.links if isinstance(each, Link))
        found = (each.discovery.modules.get(module) for each in links)
        return next((info.instance for info in found if info is not None and info.instance is not None), 0)


class CreditReader:
    """Reads the credit of subscribers when a publisher has used up its own.

    Under load the thread of the event loop seldom lets another one run, and credit through another thread would arrive
    after the publisher has stopped for it. So it stays in zenoh's ring until a publisher has no room, or for
    _CREDIT_PAUSE_S.
    """

    def __init__(self, sender: ZenohSender) -> None:
        self._sender = sender
        self._loop = sender.loop
        self._lost = sender.link.stats.lost
        self._reader: SubscriptionReader | None = None
        self._waits = False
        self._pause: asyncio.TimerHandle | None = None

    def connect(self, session: ZenohSession, key: str) -> None:
        """Subscribe to this module's credit. A thread waits for it from the first subscriber on: it wakes up often."""
        self._reader = session.subscribe(key, _CREDIT_RING, self._on_credit, waits=False)
        self._waits = False

    def receive(self) -> None:
        """Read the credit; waiting publishers go on after the present work."""
        if self._reader is not None:
            first = self._reader.receive()
            if first is not None:
                self._read(first)
                self._loop.call_soon(self.serve)

    def wait(self) -> None:
        """Read the next credit as soon as it arrives."""
        if self._reader is not None and not self._waits:
            self._waits = True
            self._reader.wait()

    def close(self) -> None:
        reader, self._reader = self._reader, None
        if reader is not None:
            reader.close()
        if self._pause is not None:
            self._pause.cancel()

    def _on_credit(self, first: zenoh.Sample | None) -> None:
        self._waits = False
        self._read(first)
        self.serve()

    def _read(self, sample: zenoh.Sample | None) -> None:
        while sample is not None and self._reader is not None:
            self._lost.guard(self._apply, sample.payload)
            sample = self._reader.receive()

    def _apply(self, payload: zenoh.ZBytes) -> None:
        try:
            credit = decode_credit(payload.to_bytes() if len(payload) <= _CREDIT_BYTES_MAX else b"")
        except UnknownType:
            self._lost["unknown type"] += 1
        except DecodeError:
            self._lost["undecodable"] += 1
        else:
            subscriber = self._sender.subscriber(credit.topic)
            if subscriber is not None:
                subscriber.acknowledge(credit)
            if credit.leaving:
                self._sender.final_credits.receive(credit.topic, credit.session)
                self._sender.reachability.set_leaving(credit.topic, credit.session)

    def serve(self) -> None:
        """Let waiting publishers go on."""
        if self._reader is None:
            return
        subscribers = list(self._sender.subscribers())
        for subscriber in subscribers:
            if subscriber.get_wait_queue():
                self._lost.guard(subscriber.refill)
        # Only for a waiting publisher, a thread is woken for the next credit; otherwise it is read after a pause.
        if any(subscriber.awaits_credit for subscriber in subscribers):
            self.wait()
        elif not self._waits and self._pause is None:
            self._pause = self._loop.call_later(_CREDIT_PAUSE_S, self._pause_over)

    def _pause_over(self) -> None:
        self._pause = None
        self.wait()


class _PendingSubscriber(msgspec.Struct, eq=False):
    """A subscriber with a token, as long as messages may not reach it."""

    window: int
    retries: int = 0
    leaving: bool = False


class Reachability:
    """Check that messages reach the subscribers: before sending to them, and after.

    Tokens and routes for messages spread through the network at different times, and a router's access control may pass
    only one of them.
    """

    def __init__(self, sender: ZenohSender) -> None:
        self._sender = sender
        self._loop = sender.loop
        self._lost = sender.link.stats.lost
        self._pending: dict[tuple[str, int], _PendingSubscriber] = {}
        self._check_timer: asyncio.TimerHandle | None = None

    def add(self, topic: str, session: int, window: int) -> None:
        """Admit a new subscriber as soon as messages reach it."""
        pending = self._pending[topic, session] = _PendingSubscriber(window)
        self._try(topic, session, pending)

    def set_leaving(self, topic: str, session: int) -> None:
        """Note that a subscriber has sent its final credit while its token is still there."""
        pending = self._pending.get((topic, session))
        if pending is not None:
            pending.leaving = True

    def remove(self, topic: str, session: int) -> None:
        """Forget a subscriber whose token is gone."""
        self._pending.pop((topic, session), None)

    def close(self) -> None:
        self._pending.clear()
        if self._check_timer is not None:
            self._check_timer.cancel()

    def _try(self, topic: str, session: int, pending: _PendingSubscriber) -> None:
        if self._pending.get((topic, session)) is not pending or topic not in self._sender.topics:
            return  # it has left, or joined anew, or the topic is no longer used here
        if not self._reaches(topic):
            pending.retries += 1
            if pending.retries == _RETRIES:
                self._sender.report_unreachable(topic, session)
            delay = _RETRY_S * min(pending.retries, _RETRY_FACTOR_MAX)
            self._loop.call_later(delay, self._try, topic, session, pending)
            return
        del self._pending[topic, session]
        self._lost.guard(self._sender.admit, topic, session, pending.window, leaving=pending.leaving)
        if self._check_timer is None:
            self._check_timer = self._loop.call_later(_CHECK_S, self._check)

    def _reaches(self, topic: str) -> bool:
        try:
            return self._sender.publishers.reaches(topic)
        except Exception as error:  # noqa: BLE001 - counted and logged; the next check follows
            self._lost.internal_error(error)
            return False

    def _check(self) -> None:
        self._check_timer = None
        self._sender.credits.receive()
        subscribers = list(self._sender.subscribers())
        for subscriber in subscribers:
            self._lost.guard(self._check_subscriber, subscriber)
        if subscribers:
            self._check_timer = self._loop.call_later(_CHECK_S, self._check)

    def _check_subscriber(self, subscriber: ZenohSubscriber) -> None:
        for session in subscriber.unacknowledged():
            subscriber.silent_checks[session] += 1
            if subscriber.silent_checks[session] <= _RESENDS:  # a latched value that was lost would not come again
                subscriber.resend_latched()
            elif subscriber.silent_checks[session] == _RESENDS + 1:
                self._sender.report_unreachable(subscriber.topic.name, session)


class _DepartedSubscriber(msgspec.Struct, eq=False):
    """A subscriber whose token is gone; its unacknowledged messages are counted when the timer ends."""

    unacknowledged: int
    timer: asyncio.TimerHandle


class FinalCredits:
    """Waits for the final credit of subscribers whose token is gone.

    A subscriber that sends one has left in order. Unacknowledged messages of any other one count as unknown.
    """

    def __init__(self, sender: ZenohSender) -> None:
        self._sender = sender
        self._departed: dict[tuple[str, int], _DepartedSubscriber] = {}

    def expect(self, topic: str, session: int, unacknowledged: int) -> None:
        """Wait for the final credit of a subscriber that did not acknowledge this many messages."""
        key = topic, session
        before = self._departed.pop(key, None)
        if before is not None:  # it came back meanwhile, and is gone again
            before.timer.cancel()
            unacknowledged += before.unacknowledged
        timer = self._sender.loop.call_later(FINAL_CREDIT_S, self._expired, key)
        self._departed[key] = _DepartedSubscriber(unacknowledged, timer)

    def receive(self, topic: str, session: int) -> None:
        """Count nothing of a subscriber whose final credit arrived: it did not want the unacknowledged messages."""
        departed = self._departed.pop((topic, session), None)
        if departed is not None:
            departed.timer.cancel()

    def close(self) -> None:
        """Count open messages, as no further credit arrives."""
        self._sender.credits.receive()
        departed, self._departed = self._departed, {}
        for each in departed.values():
            each.timer.cancel()
            self._sender.count_unknown(each.unacknowledged)

    def _expired(self, key: tuple[str, int]) -> None:
        self._sender.credits.receive()  # which may be the very credit
        departed = self._departed.pop(key, None)
        if departed is not None:
            self._sender.count_unknown(departed.unacknowledged)
