"""A module's place on a zenoh network: its tokens, its topics, and whether the network can be reached.

Keys, all under `r2p/NETWORK/`:

    live/...                what each module has, as liveliness tokens (r2p.codecs.liveliness)
    topic/TOPIC             messages: one or several, packed; the rest is in the attachment (r2p.codecs.attachment)
    credit/SESSION          to a publisher's module: how far a subscriber has come
    control                 management messages, from a module to all; who sends them is in the attachment
    schema/SESSION/TYPE     asks a module for the fields of a type, by fingerprint
"""

import functools
from collections import Counter
from collections.abc import Callable, Hashable, Iterator
from typing import TYPE_CHECKING, Any, ClassVar, cast

from r2p.codecs import UnknownType, liveliness, schemas
from r2p.codecs.attachment import Credit, decode_sender, encode_credit, encode_sender, name_for
from r2p.errors import DecodeError, MessageError
from r2p.messages import SIZE_MAX, Message, message_type
from r2p.names import NAMESPACED_MAX
from r2p.protocols.discovery.events import Declare, Event, QueryTokens, SubscriberJoined, SubscriberLeft, Undeclare
from r2p.protocols.liveliness.session import TOKENS, LivelinessDiscovery
from r2p.runtime.sample import PublisherClass, Source
from r2p.runtime.topic import Topic
from r2p.transports.announcement import NOTHING
from r2p.transports.link import Hub, Link, unique_name
from r2p.transports.stats import LoggedCounter
from r2p.transports.zenoh.credit import Credits, FinalCredits, Reachability
from r2p.transports.zenoh.publish import Batcher, PublisherCache, ZenohSubscriber
from r2p.transports.zenoh.session import ErrorOfZenoh, LoopQueue, SubscriptionReader, ZenohSession
from r2p.transports.zenoh.subscribe import RING, RxStreams

if TYPE_CHECKING:
    import asyncio

    import zenoh

_EVENTS = 65_536
"""Tokens, messages of the protocol and the like that wait for the loop at most."""

_TOKENS_FOUND = 4 * _EVENTS
"""Tokens that were asked for and wait for the loop: more than zenoh is asked for at once, so the last word has room."""

_LOOK = 30.0
"""Seconds for the network to tell of all its tokens."""

_QUERIES = 1024
"""Queries for types that wait for the loop at most."""

_ANSWER = 1.0
"""Seconds for the modules to answer a query."""

_GUARANTEES = {
    PublisherClass.NON_REAL_TIME: "in order, waits for room in every subscriber; zenoh priority data",
    PublisherClass.SPORADIC: "best effort, in order, sent at once; zenoh priority interactive high",
    PublisherClass.PERIODIC: "best effort, sent at once; zenoh priority real time",
}


class ZenohLink(Link):
    """One module on one zenoh network."""

    max_payload: ClassVar[int] = SIZE_MAX
    send_error: ClassVar[type[Exception]] = ErrorOfZenoh
    """What sending raises when the session is closed."""
    max_name: ClassVar[int] = NAMESPACED_MAX
    passes_probes: ClassVar[bool] = False

    def __init__(self, name: str, hub: Hub, *, connects: bool, batching: bool) -> None:
        """`connects`: it is up while it is connected; else it takes those who come, and is up even alone.

        `batching`: several messages may share a payload.
        """
        self.prefix = ""
        """What all keys of the network begin with."""
        self._connects = connects
        self.instance = hub.instance
        name = unique_name(name, hub)
        presence = LivelinessDiscovery(
            hub.space.module, hub.instance, observer=hub.observer, counts=LoggedCounter(name, hub.space.clock)
        )
        super().__init__(name, hub, discovery=presence)
        self._presence = presence
        self._session: ZenohSession | None = None
        self._funnels: list[LoopQueue] = []
        self._transports: set[str] = set()
        self._tokens = TokenDebouncer(hub.space.loop, self._believed, self._refused)
        self._changes = self._funnel(self._token_changed)
        self._overflown = 0
        self._found = self._funnel(self._token_found, most=_TOKENS_FOUND)
        self.senders = PublisherCache()
        self.burst = Batcher(hub.space.loop, self.stats, self.send_error, batching=batching)
        self.credits = Credits(hub.space.loop, self.stats, self.zenoh_outlets, self._left)
        self._reach = Reachability(self, hub.space.loop)
        self._farewells = FinalCredits(hub.space.loop, self.credits.look, self._count_unknown)
        self._streams = RxStreams(
            name,
            hub.space.loop,
            self.stats,
            longest=self.max_payload,
            latched=self.latched,
            credit=self._credit,
            subscribe=self._subscribe,
        )

    # For the transport

    def use(self, session: ZenohSession, prefix: str) -> None:
        """There is a session: take part in the network."""
        self._session = session
        self.prefix = prefix
        session.outbound.failed = self.stats.lost.internal_error
        self.senders.connect(session, f"{prefix}/topic/")
        self._streams.connect()
        for name, told in self._announced.items():
            if told.publishes:
                self.senders.declare(self._space.topics[name])
        hexed = f"{self.instance:x}"
        if not self._connects:
            self.on_up()
        session.watch(self._funnel(self._transport_changed))
        session.watch_tokens(f"{self.prefix}/{liveliness.PLACE}", self._changes)
        session.listen(f"{self.prefix}/control", self._funnel(self._controlled))
        session.serve(f"{self.prefix}/schema/{hexed}/*", self._schema, functools.partial(self._funnel, most=_QUERIES))
        self.credits.connect(session, f"{self.prefix}/credit/{hexed}")

    def _funnel(self, take: Callable[[Any], None], most: int = _EVENTS) -> LoopQueue:
        funnel = LoopQueue(self._space.loop, take, self.stats.lost, most=most)
        self._funnels.append(funnel)
        return funnel

    # Link

    @property
    def losses(self) -> Counter[str]:
        overflown = sum(each.overflown for each in self._funnels)
        return super().losses + Counter({"events overflown": overflown})

    def write_management(self, data: bytes, *, urgent: bool = False) -> None:
        if self._session is not None and self._session.outbound.full and not urgent:
            self.stats.lost["management, send buffer full"] += 1
        elif self._session is not None:
            sender = encode_sender(self.instance)
            self._session.put(f"{self.prefix}/control", data, attachment=sender, urgent=urgent)

    def discard(self) -> int:
        for outlet in self._subscribers.values():
            outlet.wait_queue().reject_all("link down")
        return self.burst.discard()

    def guarantee(self, topic: str, publisher_class: PublisherClass) -> str:
        return _GUARANTEES[publisher_class]

    def topic_changed(self, topic: Topic) -> None:
        super().topic_changed(topic)
        told = self._announced.get(topic.name, NOTHING)
        if told.publishes:
            self.senders.declare(topic)
        else:
            self.senders.undeclare(topic.name)
        if told.subscribes:
            self._streams.begin(topic)

    def window(self, topic: Topic) -> int:
        return self._streams.window(topic)

    async def message_type(self, fingerprint: bytes) -> type[Message] | None:
        session = self._session
        if session is None:
            return None
        for answer in await session.ask(f"{self.prefix}/schema/*/{fingerprint.hex()}", _ANSWER):
            try:
                return message_type(*schemas.decode(answer, fingerprint))
            except (DecodeError, MessageError):
                self.stats.lost["wrong schema"] += 1
        return None

    def _schema(self, key: str) -> bytes | None:
        """What we know of the type that a query asks for."""
        wanted = key.rpartition("/")[2]
        for topic in self._space.topics.values():
            if topic.layout is not None and topic.layout.fingerprint.hex() == wanted:
                return schemas.encode(topic.layout.cls.__name__, topic.layout.schema)
        return None

    def add_publisher(self, topic: Topic, size: int, source: Hashable) -> None:
        self._streams.begin(topic)
        self._streams.open(topic, size, source)

    def remove_publisher(self, name: str, source: Hashable) -> None:
        self._streams.shut(name, source)

    def remove_publishers(self, name: str) -> None:
        self._streams.shut_all(name)

    def _release_topics(self) -> None:
        super()._release_topics()
        self._streams.close()

    def close(self) -> None:
        self.burst.flush()
        self._tokens.on_down()
        super().close()
        self._reach.close()
        self._farewells.close()
        self.credits.close()
        self.senders.close()
        self._session = None

    def _remove_subscriber(self, name: str) -> None:
        self.burst.flush()  # before what it is sent with is undeclared
        super()._remove_subscriber(name)

    def _act(self, event: Event) -> None:
        match event:
            case Declare(key):
                if self._session is not None:
                    self._session.declare(f"{self.prefix}/{liveliness.place(key)}")
            case Undeclare(key):
                if self._session is not None:
                    self._session.undeclare(f"{self.prefix}/{liveliness.place(key)}")
            case QueryTokens():
                self._look()
            case SubscriberLeft(topic, int(session), gone):
                self._part(topic, session, gone=gone)
            case _:
                super()._act(event)

    # Subscribers

    def _subscriber_joined(self, event: SubscriberJoined) -> None:
        """A subscriber is new, or has another window."""
        name, session, window = event.topic, cast("int", event.source), event.queue
        outlet = self._outlet(name)
        if outlet is not None and outlet.topic is self._space.topics.get(name) and outlet.knows(session):
            outlet.joined(session, window)
        else:
            self._reach.came(name, session, window)

    def _part(self, name: str, session: int, *, gone: bool) -> None:
        """Nothing is sent to a subscriber any more. One that is still there goes on taking what is on the way."""
        self._reach.left(name, session)
        outlet = self._outlet(name)
        unconfirmed = 0 if outlet is None else outlet.parted(session)
        if unconfirmed and gone and self.up:
            self._farewells.expect(name, session, unconfirmed)
        elif unconfirmed and gone:  # nothing comes on a link that is down
            self._count_unknown(unconfirmed)

    def _left(self, name: str, session: int) -> None:
        """A subscriber says that it leaves."""
        self._farewells.came(name, session)
        self._reach.leaves(name, session)

    def _count_unknown(self, count: int) -> None:
        self.stats.lost["unknown at disconnect"] += count

    def let_in(self, name: str, session: int, window: int, *, leaving: bool = False) -> None:
        """Messages reach it: send it what is latched, and all that comes."""
        topic = self._space.topics[name]
        outlet = self._outlet(name)
        if outlet is not None and outlet.topic is topic:
            outlet.joined(session, window)
            outlet.resend_latched()
        else:
            self.burst.flush()  # of an outlet before it, with whose numbers it goes on
            outlet = self._subscribers[name] = ZenohSubscriber(self, topic)
            outlet.joined(session, window)
            topic.join(outlet)
        if leaving:
            outlet.leaves(session, leaving=True)

    def tell_unheard(self, topic: str, session: int) -> None:
        """Messages do not reach a subscriber."""
        module = next((each.name for each in self._presence.modules.values() if each.instance == session), "?")
        key = f"{self.prefix}/topic/{topic}"
        text = (
            f"topic {topic} does not reach module {module}: does the access control of a router deny {key} to either?"
        )
        self._hub.link_notice(self, "unheard", text, trouble=True)

    def knows(self, topic: str) -> bool:
        """Whether this module has anything to do with a topic."""
        return topic in self._space.topics

    def zenoh_outlets(self) -> Iterator[ZenohSubscriber]:
        return (each for each in self._subscribers.values() if isinstance(each, ZenohSubscriber))

    def _outlet(self, name: str) -> ZenohSubscriber | None:
        outlet = self._subscribers.get(name)
        return outlet if isinstance(outlet, ZenohSubscriber) else None

    # For outlets and streams

    def source_name(self, source: Source) -> str:
        """What the module of a message is called on this network."""
        return name_for(source.module if self.gateway_hooks is None else self.gateway_hooks.source_name(source))

    def instance_of(self, module: str) -> int:
        """The number of a module on any link; 0: firmware, or not known."""
        links = (each for each in self._space.links if isinstance(each, Link))
        found = (each.discovery.modules.get(module) for each in links)
        return next((info.instance for info in found if info is not None and info.instance is not None), 0)

    def _subscribe(self, topic: str, arrived: Callable[["zenoh.Sample"], None]) -> "SubscriptionReader | None":
        if self._session is None:
            return None
        return self._session.subscribe(f"{self.prefix}/topic/{topic}", RING, arrived)

    def _credit(self, topic: str, sender: int, publisher_class: int, serial: int, *, leaving: bool = False) -> None:
        if self._session is not None:
            data = encode_credit(Credit(self.instance, publisher_class, serial, topic, leaving))
            self._session.put(f"{self.prefix}/credit/{sender:x}", data, final=leaving)

    # What comes in; in the loop

    def _transport_changed(self, change: tuple[str, bool]) -> None:
        other, opened = change
        if self._closed or not self._connects:
            return
        if opened:
            self._transports.add(other)
            if not self.up:
                self.on_up()
        else:
            self._transports.discard(other)
            if not self._transports:
                self.on_down("the connection is lost")

    def on_up(self) -> None:
        self._streams.resumed()
        super().on_up()
        self._tokens.on_up()

    def on_down(self, reason: str) -> None:
        self._tokens.on_down()
        self._streams.interrupted()
        super().on_down(reason)

    def _token_changed(self, change: tuple[str, bool]) -> None:
        if self._closed:
            return
        if self._changes.overflown != self._overflown:
            overflown = self._changes.overflown
            missed, self._overflown = overflown - self._overflown, overflown
            self._apply(self._presence.missed(self._clock.monotonic(), missed))
        self._tokens.changed(*change)

    def _refused(self) -> None:
        self._apply(self._presence.refused(self._clock.monotonic()))

    def _look(self) -> None:
        """Ask for all tokens: zenoh tells of each but once, and some were refused."""
        if self._session is not None:
            self._tokens.look()
            self._session.look_for_tokens(f"{self.prefix}/{liveliness.PLACE}", _LOOK, self._found)

    def _token_found(self, found: str | bool) -> None:
        """A token, or at last whether these were all."""
        if self._closed:
            return
        if isinstance(found, str):
            self._tokens.found(found)
        else:
            usable = self._tokens.looked()
            self._apply(self._presence.looked(self._clock.monotonic(), complete=found and usable))

    def _believed(self, key: str, there: bool) -> None:
        now = self._clock.monotonic()
        try:
            events = self._presence.appeared(now, key) if there else self._presence.disappeared(now, key)
        except Exception as error:  # noqa: BLE001 - counted and logged; the next token follows
            self.stats.lost.internal_error(error)
        else:
            self._apply(events)

    def _controlled(self, message: tuple[bytes, bytes]) -> None:
        header, data = message
        try:
            sender = decode_sender(header)
        except UnknownType:
            self.stats.lost["unknown type"] += 1
        except DecodeError:
            self.stats.lost["foreign"] += 1
        else:
            if sender != self.instance and self.up:
                self.manage(data, sender)


# When the tokens of others are believed: not while the link is down, and not that they went for a moment.


_SETTLE = 0.02
"""Seconds after which a token that went is believed to: when the network goes, tokens go a moment before it."""


class TokenDebouncer:
    """The tokens of a link as zenoh tells of them; `believed(key, there)` gets what is to be taken for true, and
    `refused` is called for each that has no room before the link is up.
    """

    def __init__(
        self,
        loop: "asyncio.AbstractEventLoop",
        believed: Callable[[str, bool], None],
        refused: Callable[[], None],
    ) -> None:
        self._loop = loop
        self._believed = believed
        self._refused = refused
        self._up = False
        self._early: dict[str, None] = {}
        self._going: dict[str, asyncio.TimerHandle] = {}
        self._went: set[str] | None = None  # during a look: answers about these may be older than their end

    def changed(self, key: str, there: bool) -> None:
        """A token came or went."""
        if not self._up:
            self._changed_early(key, there)
        elif there:
            timer = self._going.pop(key, None)
            if timer is not None:  # it has not gone
                timer.cancel()
            else:
                self._believed(key, True)
        elif key not in self._going:
            self._going[key] = self._loop.call_later(_SETTLE, self._gone, key)
            self._note_end(key)

    def look(self) -> None:
        """All tokens are asked for: what goes from now on is newer than the answers."""
        self._went = set(self._going)

    def found(self, key: str) -> None:
        """A token is among the answers."""
        if self._went is not None and key not in self._went:
            self._believed(key, True)

    def looked(self) -> bool:
        """All answers have come. Says whether they could be used."""
        usable, self._went = self._went is not None, None
        return usable

    def on_up(self) -> None:
        """The link is up: what came before is there."""
        self._up = True
        early, self._early = self._early, {}
        for key in early:
            self._believed(key, True)

    def on_down(self) -> None:
        """It is down, or closed: nothing that goes now has gone by itself."""
        self._up = False
        self._went = None
        for timer in self._going.values():
            timer.cancel()
        self._going.clear()

    def _changed_early(self, key: str, there: bool) -> None:
        if not there:
            self._early.pop(key, None)
        elif key in self._early or len(self._early) < TOKENS:
            self._early[key] = None
        else:
            self._refused()

    def _note_end(self, key: str) -> None:
        if self._went is not None:
            self._went.add(key)
            if len(self._went) > TOKENS:  # too many to remember: the answers are of no use
                self._went = None

    def _gone(self, key: str) -> None:
        del self._going[key]
        self._believed(key, False)
