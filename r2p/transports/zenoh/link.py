"""A module's link to a zenoh network: its tokens, its topics, and its state.

Keys, all under `r2p/NETWORK/`:

    live/...                topics and nodes of each module, as liveliness tokens (r2p.codecs.liveliness)
    topic/TOPIC             messages: one or several, packed; the rest is in the attachment (r2p.codecs.attachment)
    credit/SESSION          a subscriber's progress, to the publisher's module
    call/SESSION            calls of r2p's own services, and answers, to a module; the attachment names the sender
    control                 management messages, from a module to all; the attachment names the sender
    schema/SESSION/TYPE     asks a module for the fields of a type, by fingerprint
"""

import asyncio
import functools
import itertools
from collections import Counter
from collections.abc import Callable, Hashable, Iterable
from typing import Any, ClassVar, cast

from r2p.codecs import UnknownType, liveliness, schemas
from r2p.codecs.attachment import decode_sender, encode_sender
from r2p.errors import DecodeError, MessageError
from r2p.messages import SIZE_MAX, Message, message_type
from r2p.protocols.discovery.events import (
    Declare,
    Event,
    QueryTokens,
    SubscriberJoined,
    SubscriberLeft,
    TopicType,
    Undeclare,
)
from r2p.protocols.liveliness.session import TOKENS_MAX, TOO_MANY, LivelinessDiscovery
from r2p.runtime.sample import PublisherClass, Source
from r2p.runtime.topic import Topic
from r2p.transports.announcement import NOTHING, Announcement
from r2p.transports.link import MESSAGES_PER_TURN, Hub, Link, unique_name
from r2p.transports.stats import LoggedCounter
from r2p.transports.zenoh.large import LARGE
from r2p.transports.zenoh.sender import ZenohSender
from r2p.transports.zenoh.session import LoopQueue, ZenohSession
from r2p.transports.zenoh.subscribe import ZenohReceiver

_EVENTS_MAX = 65_536  # tokens, messages of the protocol and the like that wait for the loop
_ANSWERS_MAX = 4 * _EVENTS_MAX  # queried tokens that wait for the loop: more than are queried at once, so all fit
_TYPE_QUERIES_MAX = 1024  # queries for types that wait for the loop
_TOKENS_TIMEOUT_S = 30.0  # seconds for the network to answer with all its tokens
_TYPE_TIMEOUT_S = 1.0  # seconds for the modules to answer a query for a type

_GUARANTEES = {
    PublisherClass.NON_REAL_TIME: "in order, waits for room in every subscriber; zenoh priority data",
    PublisherClass.SPORADIC: "best effort, in order, sent at once; zenoh priority interactive high",
    PublisherClass.PERIODIC: "best effort, sent at once; zenoh priority real time",
}

_LARGE_GUARANTEES = {
    PublisherClass.NON_REAL_TIME: "in order, waits for room in every subscriber; zenoh priority data low",
    PublisherClass.SPORADIC: "best effort, in order, large messages by a thread; zenoh priority data high",
    PublisherClass.PERIODIC: "best effort, large messages by a thread; zenoh priority interactive low",
}


def _type_of(announced: Announcement) -> TopicType:
    return TopicType(announced.size, announced.fingerprint, announced.varies)


class ZenohLink(Link):
    """One module on one zenoh network."""

    max_payload: ClassVar[int] = SIZE_MAX
    passes_probes: ClassVar[bool] = False
    lossless = True

    def __init__(self, name: str, hub: Hub, *, connects: bool, batching: bool, tokens_max: int | None = None) -> None:
        """`connects`: up while it is connected; otherwise it accepts connections, and is up even alone.

        `batching`: several messages may share a payload. `tokens_max`: tokens of other modules that are kept, if
        not TOKENS_MAX.
        """
        self._connects = connects
        self.instance = hub.instance
        name = unique_name(name, hub)
        counts = LoggedCounter(name, hub.space.clock)
        self._liveliness = LivelinessDiscovery(
            hub.space.module, hub.instance, observer=hub.observer, counts=counts, tokens_max=tokens_max
        )
        super().__init__(name, hub, discovery=self._liveliness)
        self.down = asyncio.Event()
        """Set while the link is not up."""
        self.down.set()
        self._session: ZenohSession | None = None
        self._prefix = ""
        self._queues: list[LoopQueue] = []
        self._transports: dict[str, bool] = {}  # the zenoh sessions that it is connected to, by id: by shared memory?
        most = self._liveliness.tokens_max
        self._tokens = TokenDebouncer(hub.space.loop, self._on_token_settled, self._on_token_refused, most)
        self._token_changes = self._queue(self._on_token, per_turn=KEYS_PER_TURN)
        self._token_answers = self._queue(self._on_token_answer, most=_ANSWERS_MAX, per_turn=KEYS_PER_TURN)
        self._overflowed = 0
        self._said_full = False
        self.sender = ZenohSender(self, hub, self._subscribers, batching=batching)
        self.receiver = ZenohReceiver(self, hub)

    # For the transport

    def use(self, session: ZenohSession, prefix: str) -> None:
        """Take part in the network; all its keys begin with the prefix."""
        self._session = session
        self._prefix = prefix
        self.sender.connect(session, prefix)
        self.receiver.connect(session, prefix)
        for name, announced in self._announced.items():
            if announced.publishes:
                self.sender.declare(self._space.topics[name], _type_of(announced))
        if not self._connects:  # before tokens come: they are believed only on a link that is up
            self.on_up()
        session.watch_transports(self._queue(self._on_transport))
        session.watch_tokens(f"{prefix}/{liveliness.KEY_PREFIX}", self._token_changes)
        session.listen(f"{prefix}/control", self._queue(self._on_control))
        session.listen(f"{prefix}/call/{self.instance:x}", self._queue(self._on_call))
        queue = functools.partial(self._queue, most=_TYPE_QUERIES_MAX)
        session.answer_queries(f"{prefix}/schema/{self.instance:x}/*", self._schema, queue)

    def _queue(
        self, handle: Callable[[Any], None], most: int = _EVENTS_MAX, per_turn: int = MESSAGES_PER_TURN
    ) -> LoopQueue:
        """Make a queue from zenoh's threads into the loop."""
        queue = LoopQueue(self._space.loop, handle, self.stats.lost, most=most, per_turn=per_turn)
        self._queues.append(queue)
        return queue

    # Link

    @property
    def losses(self) -> Counter[str]:
        overflowed = sum(each.overflowed for each in self._queues)
        return super().losses + Counter({"events overflown": overflowed})

    def write_management(self, data: bytes, *, urgent: bool = False) -> None:
        if self._session is not None and self._session.outbound.full and not urgent:
            self.stats.lost["management, send buffer full"] += 1
        elif self._session is not None:
            sender = encode_sender(self.instance)
            self._session.put(f"{self._prefix}/control", data, attachment=sender, urgent=urgent)

    def write_call(self, data: bytes, to: Hashable) -> None:
        if self._session is not None and self._session.outbound.full:
            self.stats.lost["calls, send buffer full"] += 1
        elif self._session is not None and isinstance(to, int):
            self._session.put(f"{self._prefix}/call/{to:x}", data, attachment=encode_sender(self.instance))

    def discard(self) -> int:
        for subscriber in self.sender.subscribers():
            subscriber.get_wait_queue().reject_all("link down")
        return self.sender.discard()

    def guarantee(self, topic: str, publisher_class: PublisherClass) -> str:
        known = self.sender.types.get(topic)
        return (_LARGE_GUARANTEES if known is not None and known.size > LARGE else _GUARANTEES)[publisher_class]

    def topic_changed(self, topic: Topic) -> None:
        super().topic_changed(topic)
        announced = self._announced.get(topic.name, NOTHING)
        if announced.publishes:
            self.sender.declare(topic, _type_of(announced))
        else:
            self.sender.undeclare(topic.name)
        if announced.subscribes:
            self.receiver.subscribe(topic)

    def window(self, topic: Topic) -> int:
        return self.receiver.window(topic)

    def on_up(self) -> None:
        self.down.clear()
        self.receiver.on_up()
        super().on_up()
        self._tokens.on_up()  # last: to a subscriber that appears something may be sent at once

    def on_down(self, reason: str) -> None:
        self.down.set()
        self._tokens.on_down()
        self.receiver.on_down()
        super().on_down(reason)

    def close(self) -> None:
        self.sender.batcher.flush()  # while the link is up: what was published before goes out
        self._tokens.on_down()
        super().close()
        self.sender.close()
        self._session = None

    def add_publisher(self, topic: Topic, size: int, source: Hashable) -> None:
        self.receiver.add_publisher(topic, source)

    def remove_publisher(self, name: str, source: Hashable) -> None:
        self.receiver.remove_publisher(name, source)

    def remove_publishers(self, name: str) -> None:
        self.receiver.unsubscribe(name)

    def _subscriber_joined(self, event: SubscriberJoined) -> None:
        self.sender.add_subscriber(event.topic, cast("int", event.source), event.queue)

    def _remove_subscriber(self, name: str) -> None:
        self.sender.flush(name)
        super()._remove_subscriber(name)

    def _release_topics(self) -> None:
        super()._release_topics()
        self.receiver.close()

    def _act(self, event: Event) -> None:
        match event:
            case Declare(key):
                if self._session is not None:
                    self._session.declare_token(f"{self._prefix}/{liveliness.token_key(key)}")
            case Undeclare(key):
                if self._session is not None:
                    self._session.undeclare_token(f"{self._prefix}/{liveliness.token_key(key)}")
            case QueryTokens():
                self._query_tokens()
            case SubscriberLeft(topic, int(session), gone):
                self.sender.remove_subscriber(topic, session, gone=gone)
            case _:
                super()._act(event)

    # Types

    def fingerprint_of(self, topic: str, source: Source) -> bytes:
        return self.receiver.fingerprint_of(topic, source)

    async def message_type(self, fingerprint: bytes) -> type[Message] | None:
        session = self._session
        if session is None:
            return None
        for answer in await session.query(f"{self._prefix}/schema/*/{fingerprint.hex()}", _TYPE_TIMEOUT_S):
            try:  # the first answer whose fields have this fingerprint: others may lie
                return message_type(*schemas.decode(answer, fingerprint))
            except (DecodeError, MessageError):
                self.stats.lost["wrong schema"] += 1
        return None

    def _schema(self, key: str) -> bytes | None:
        """Return the fields of the type in a query, if this module knows them."""
        wanted = key.rpartition("/")[2]
        for topic in self._space.topics.values():
            if topic.layout is not None and topic.layout.fingerprint.hex() == wanted:
                return schemas.encode(topic.layout.cls.__name__, topic.layout.schema)
        return None

    # Received; in the loop

    def _on_transport(self, change: tuple[str, bool, bool]) -> None:
        other, opened, shared = change
        if self._closed:
            return
        if opened:
            self._transports[other] = shared
        else:
            self._transports.pop(other, None)
        self.sender.large.shared = all(self._transports.values())
        if not self._connects:  # one that takes connections is up even alone
            return
        if opened and not self.up:
            self.on_up()
        elif not self._transports:
            self.on_down("the connection is lost")

    def _on_token(self, change: tuple[str, bool]) -> None:
        if self._closed:
            return
        if self._token_changes.overflowed != self._overflowed:  # tokens were lost, which zenoh does not report again
            overflowed = self._token_changes.overflowed
            missed, self._overflowed = overflowed - self._overflowed, overflowed
            self._apply(self._liveliness.missed(self._clock.monotonic(), missed))
        self._tokens.on_change(*change)

    def _on_token_refused(self) -> None:
        self._apply(self._liveliness.refused(self._clock.monotonic()))

    def _query_tokens(self) -> None:
        """Query all tokens, as zenoh reports each only once, and some were refused."""
        if self._session is not None:
            self._tokens.begin_query(self._liveliness.known_keys)
            prefix = f"{self._prefix}/{liveliness.KEY_PREFIX}"
            self._session.query_tokens(prefix, _TOKENS_TIMEOUT_S, self._token_answers)

    def _on_token_answer(self, answer: str | bool) -> None:
        """Handle a token, or finally whether these were all."""
        if self._closed:
            return
        if isinstance(answer, str):
            self._tokens.on_answer(answer)
        else:
            usable = self._tokens.end_query()
            self._apply(self._liveliness.query_ended(self._clock.monotonic(), complete=answer and usable))

    def _on_token_settled(self, key: str, there: bool) -> None:
        now = self._clock.monotonic()
        try:
            events = self._liveliness.appeared(now, key) if there else self._liveliness.disappeared(now, key)
        except Exception as error:  # noqa: BLE001 - counted and logged; the next token follows
            self.stats.lost.internal_error(error)
        else:
            self._apply(events)
            if not self._said_full and TOO_MANY in self._liveliness.counts:
                self._said_full, most = True, self._liveliness.tokens_max
                text = f"there are more modules and topics on the network than fit into {most} tokens, and "
                text += f"some stay unknown here: tokens={2 * most} in the URL makes room for more"
                self._hub.link_notice(self, TOO_MANY, text, trouble=True)

    def _on_control(self, message: tuple[bytes, bytes]) -> None:
        self._pass_on(message, self.manage)

    def _on_call(self, message: tuple[bytes, bytes]) -> None:
        self._pass_on(message, self.calls.receive)

    def _pass_on(self, message: tuple[bytes, bytes], handle: Callable[[bytes, Hashable], None]) -> None:
        """Call `handle` with a message and its sender, as its attachment names it."""
        header, data = message
        try:
            sender = decode_sender(header)
        except UnknownType:
            self.stats.lost["unknown type"] += 1
        except DecodeError:
            self.stats.lost["foreign"] += 1
        else:
            if sender != self.instance and self.up:
                handle(data, sender)


# Tokens of other modules

KEYS_PER_TURN = 16
"""Keys that are handled before the event loop runs once: packs, of up to 64 tokens each."""

_SETTLE_S = 0.02
"""Seconds until the end of a token is believed: when a connection is lost, tokens end just before it."""


class TokenDebouncer:
    """Decides when to believe that a token has appeared or ended: not while the link is down.

    `settled(key, there)` gets the verdict; `refused` is called for each token without room before the link is up.
    """

    def __init__(
        self,
        loop: asyncio.AbstractEventLoop,
        settled: Callable[[str, bool], None],
        refused: Callable[[], None],
        most: int = TOKENS_MAX,
    ) -> None:
        """`most`: keys that are remembered, of each kind."""
        self._most = most
        self._loop = loop
        self._settled = settled
        self._refused = refused
        self._up = False
        self._early: dict[str, None] = {}
        self._going: dict[str, asyncio.TimerHandle] = {}
        self._went: set[str] | None = None
        """Tokens that ended since a query began: answers about them may be older than that. None without a query."""
        self._unconfirmed: set[str] = set()
        """Tokens that are there, but have not been among the answers."""
        self._answered = False

    def on_change(self, key: str, there: bool) -> None:
        """Note that a token appeared or ended."""
        if not self._up or key in self._early:
            self._changed_early(key, there)
        elif there:
            timer = self._going.pop(key, None)
            if timer is not None:  # it was back in time: nothing has changed
                timer.cancel()
            else:
                self._settled(key, True)
        elif key not in self._going:
            self._going[key] = self._loop.call_later(_SETTLE_S, self._gone, key)
            self._note_end(key)

    def begin_query(self, known: Iterable[str]) -> None:
        """Note that all tokens are queried: ends from now on are newer than the answers. The `known` ones must be
        among the answers: under load, zenoh 1.10 ends one in some thousand queries before its answers come.
        """
        self._went = set(self._going)
        self._unconfirmed = set(known) - self._went
        self._answered = False

    def on_answer(self, key: str) -> None:
        """Believe a token among the answers, unless it ended meanwhile."""
        self._answered = True
        self._unconfirmed.discard(key)
        if self._went is not None and key not in self._went:
            self._settled(key, True)

    def end_query(self) -> bool:
        """Return whether the answers are complete and could be used."""
        # There is always an answer: the session's own token.
        usable = self._went is not None and self._answered and not self._unconfirmed
        self._went, self._unconfirmed = None, set()
        return usable

    def on_up(self) -> None:
        """Believe tokens from before the link was up: the first ones now, the others as the loop has time."""
        self._up = True
        self._settle_early()

    def on_down(self) -> None:
        """Ignore ends of tokens: with the link down or closed, they say nothing about their modules."""
        self._up = False
        self._went = None
        for timer in self._going.values():
            timer.cancel()
        self._going.clear()

    def _settle_early(self) -> None:
        if self._up:
            for key in list(itertools.islice(self._early, KEYS_PER_TURN)):
                del self._early[key]
                self._settled(key, True)
            if self._early:
                self._loop.call_soon(self._settle_early)

    def _changed_early(self, key: str, there: bool) -> None:
        if not there:
            self._early.pop(key, None)
        elif key in self._early or len(self._early) < self._most:
            self._early[key] = None
        else:
            self._refused()

    def _note_end(self, key: str) -> None:
        if self._went is not None:
            self._unconfirmed.discard(key)
            self._went.add(key)
            if len(self._went) > self._most:  # too many to remember: the answers are of no use
                self._went = None

    def _gone(self, key: str) -> None:
        del self._going[key]
        self._settled(key, False)
