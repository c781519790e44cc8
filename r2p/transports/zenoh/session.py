"""One zenoh session. Everything that comes from zenoh's threads enters the event loop here.

A thread waits at zenoh's channel of each subscriber. There nothing is done but to hand what came to the loop: no code
of the user, and none of the protocols, runs outside of it. What blocks (opening, closing) runs in a thread, so the loop
never waits for a network.
"""

import asyncio
import contextlib
import functools
import json
import re
import threading
from collections import deque
from collections.abc import Callable, Iterable
from typing import Any, TypeVar

import zenoh
from zenoh.handlers import FifoChannel, Handler, RingChannel

from r2p.codecs import liveliness
from r2p.errors import TransportError
from r2p.transports.link import MESSAGES_PER_TURN
from r2p.transports.stats import LoggedCounter
from r2p.transports.zenoh import threads
from r2p.transports.zenoh.config import is_network_name
from r2p.transports.zenoh.threads import OutboundThread

T = TypeVar("T")

ErrorOfZenoh = zenoh.ZError

_PRIORITIES = {
    1: zenoh.Priority.DATA,
    2: zenoh.Priority.INTERACTIVE_HIGH,
    3: zenoh.Priority.REAL_TIME,
}


class Unreachable(Exception):
    """Nobody to connect to, for now."""


class LoopQueue:
    """The way from zenoh's threads into the loop: what they put in comes out of `take`, in order."""

    def __init__(
        self, loop: asyncio.AbstractEventLoop, take: Callable[[Any], None], lost: LoggedCounter, *, most: int
    ) -> None:
        self._loop = loop
        self._take = take
        self._lost = lost
        self._most = most
        self._waiting: deque[Any] = deque()
        self._woken = False
        self.overflown = 0
        """What did not fit any more."""

    def put(self, item: Any) -> None:
        """In any thread."""
        if len(self._waiting) >= self._most:
            self.overflown += 1
            return
        self._waiting.append(item)
        if not self._woken:
            self._woken = True
            with contextlib.suppress(RuntimeError):  # the loop is closed
                self._loop.call_soon_threadsafe(self._empty)

    def failed(self, error: Exception) -> None:
        """In any thread: something raised before it could be put in."""
        with contextlib.suppress(RuntimeError):  # the loop is closed
            self._loop.call_soon_threadsafe(self._lost.internal_error, error)

    def _empty(self) -> None:
        self._woken = False
        waiting = self._waiting
        self._lost.drain(waiting, self._take, MESSAGES_PER_TURN)
        if waiting and not self._woken:  # a flood; others have their turn in between
            self._woken = True
            self._loop.call_soon(self._empty)


class SubscriptionReader:
    """A subscription. A thread waits for samples, and hands them to the loop; when that falls behind, the thread rests,
    and the loop takes what else there is by itself, without a switch of threads for each.
    """

    def __init__(
        self,
        subscriber: "zenoh.Subscriber[Handler[zenoh.Sample]]",
        loop: asyncio.AbstractEventLoop,
        arrived: Callable[[zenoh.Sample], None],
    ) -> None:
        self._subscriber = subscriber
        self._loop = loop
        self._arrived = arrived
        self._receive = subscriber.handler.try_recv
        self._handed: deque[zenoh.Sample] = deque()
        self._taken = 0
        self._idle = True
        self._thread_rests = False
        self._closed = False
        self._go_on = threading.Lock()
        self._go_on.acquire()
        threads.start(self._watch)

    def take(self) -> zenoh.Sample | None:
        """The next sample that waits, or None."""
        if self._handed:
            self._taken += 1
            return self._handed.popleft()
        return self._receive() if self._thread_rests else None

    def wait(self) -> None:
        """Call `arrived` with the next sample, or soon with one that was handed over meanwhile."""
        self._idle = True
        if self._handed:
            self._loop.call_soon(self._pass_on)
        elif self._thread_rests:
            self._thread_rests = False
            self._go_on.release()

    def close(self) -> None:
        self._closed = True
        self._thread_rests = False
        self._subscriber.undeclare()
        with contextlib.suppress(RuntimeError):  # the thread waits for a sample, not for us
            self._go_on.release()

    def _watch(self) -> None:
        receive = self._subscriber.handler.recv
        count = 0
        with contextlib.suppress(zenoh.ZError, RuntimeError):  # it is undeclared; the loop is closed
            while not self._closed:
                sample = receive()
                count += 1
                rests = count - self._taken > 1
                self._loop.call_soon_threadsafe(self._hand_over, sample, rests)
                if rests:
                    self._go_on.acquire()

    def _hand_over(self, sample: zenoh.Sample, rests: bool) -> None:
        """In the loop, one sample after the other; behind the last one the thread may rest."""
        self._thread_rests = rests
        if self._idle and not self._handed:
            self._idle = False
            self._taken += 1
            self._arrived(sample)
        else:
            self._handed.append(sample)

    def _pass_on(self) -> None:
        """What was handed over before `wait` comes before all that is handed over after it."""
        if not self._idle or self._closed:
            return
        if self._handed:
            self._idle = False
            self._taken += 1
            self._arrived(self._handed.popleft())
        else:  # it has been taken meanwhile
            self.wait()


async def open_session(config: zenoh.Config) -> "ZenohSession":
    """Open it in a thread. Raises Unreachable where it may work later, TransportError where it can't."""
    try:
        return ZenohSession(await _in_thread(lambda: zenoh.open(config), _close))
    except zenoh.ZError as error:
        text = _plain(error)
        if text.startswith("Unable to connect"):
            raise Unreachable(text) from error
        raise TransportError(text) from error


class ZenohSession:
    """An open session, as the loop sees it. Declarations last until they are undeclared, or the session is closed."""

    def __init__(self, session: zenoh.Session) -> None:
        self._session = session
        self.outbound = OutboundThread(asyncio.get_running_loop())
        self._kept: list[Any] = []
        self._publishers: set[zenoh.Publisher] = set()
        self._tokens: dict[str, zenoh.LivelinessToken] = {}
        self._watched = 0

    def watch(self, funnel: LoopQueue) -> None:
        """Tell of each transport, those that are there included: (id, whether it opened)."""

        def changed(event: zenoh.TransportEvent) -> None:
            funnel.put((str(event.transport.zid), event.kind == zenoh.SampleKind.PUT))

        events: FifoChannel[zenoh.TransportEvent] = FifoChannel(_AT_ONCE)
        self._hear(self._session.info.declare_transport_events_listener(events, history=True), changed, funnel)

    def watch_tokens(self, prefix: str, funnel: LoopQueue) -> None:
        """Tell of each token under a prefix, also those that are there: (rest of its key, whether it is there)."""
        start = len(prefix) + 1

        def changed(sample: zenoh.Sample) -> None:
            there = sample.kind == zenoh.SampleKind.PUT
            self._watched += 1 if there else -1
            self.outbound.watch(self._watched)
            funnel.put((liveliness.token_at(str(sample.key_expr)[start:]), there))

        tokens: FifoChannel[zenoh.Sample] = FifoChannel(_AT_ONCE)
        declared = self._session.liveliness().declare_subscriber(f"{prefix}/**", tokens, history=True)
        self._hear(declared, changed, funnel)

    def look_for_tokens(self, prefix: str, timeout: float, funnel: LoopQueue) -> None:
        """Ask for the tokens under a prefix that is watched: the rest of each key, and at last whether these are all.

        A thread waits for them, not that of `outbound`: it may take seconds where there are many.
        """
        start = len(prefix) + 1

        def ask() -> bool:
            if self._watched > _AT_ONCE // 2:
                return False
            replies: FifoChannel[zenoh.Reply] = FifoChannel(_AT_ONCE)
            complete = True
            for reply in self._session.liveliness().get(f"{prefix}/**", replies, timeout=timeout):
                if reply.ok is None:  # the time is over
                    complete = False
                else:
                    funnel.put(liveliness.token_at(str(reply.ok.key_expr)[start:]))
            return complete

        def look() -> None:
            complete = False
            try:
                complete = ask()
            except zenoh.ZError:  # the session is closed
                pass
            except Exception as error:  # noqa: BLE001 - counted and logged in the loop
                funnel.failed(error)
            finally:
                funnel.put(complete)

        threads.start(look)

    def listen(self, key: str, funnel: LoopQueue) -> None:
        """Tell of each message: (its attachment, payload), either of them empty if it is longer than any of ours.

        A key without a wildcard: of each session that is closed, zenoh keeps 3 kB for ever in the router if it has
        subscribed with a wildcard, and another session has by the same key expression.
        """

        def arrived(sample: zenoh.Sample) -> None:
            funnel.put((_bytes_of(sample.attachment), _bytes_of(sample.payload)))

        messages: FifoChannel[zenoh.Sample] = FifoChannel(_AT_ONCE)
        declared = self._session.declare_subscriber(key, messages, allowed_origin=zenoh.Locality.REMOTE)
        self._hear(declared, arrived, funnel)

    def serve(
        self, key: str, answer: Callable[[str], bytes | None], funnel_to: Callable[[Callable[[Any], None]], LoopQueue]
    ) -> None:
        """Answer queries: `answer` gives, in the loop, the payload for a key. `funnel_to` makes a way into the loop."""

        def reply(query: zenoh.Query) -> None:
            name = str(query.key_expr)
            payload = answer(name)
            with contextlib.suppress(zenoh.ZError):  # the session is closed
                if payload is not None:
                    query.reply(key.replace("*", name.rpartition("/")[2]), payload)
                query.drop()

        funnel = funnel_to(reply)
        queries: FifoChannel[zenoh.Query] = FifoChannel(_AT_ONCE)
        self._hear(self._session.declare_queryable(key, queries), funnel.put, funnel)

    def _hear(self, declared: Any, heard: Callable[[Any], object], funnel: LoopQueue) -> None:
        """Call it, in a thread, with each item that comes; it puts that into the funnel."""

        def listen() -> None:
            receive = declared.handler.recv
            while True:
                try:
                    item = receive()
                except zenoh.ZError:  # it is undeclared
                    return
                try:
                    heard(item)
                except Exception as error:  # noqa: BLE001 - counted and logged in the loop; the next one follows
                    funnel.failed(error)

        self._kept.append(declared)
        threads.start(listen)

    def subscribe(self, key: str, most: int, arrived: Callable[[zenoh.Sample], None]) -> "SubscriptionReader":
        """Tell in the loop of the first sample that comes; the ones behind it are there to be taken out of the tap.

        Of more than `most` that wait, the oldest are lost.
        """
        loop = asyncio.get_running_loop()
        handler: RingChannel[zenoh.Sample] = RingChannel(most)
        return SubscriptionReader(
            self._session.declare_subscriber(key, handler, allowed_origin=zenoh.Locality.REMOTE), loop, arrived
        )

    def publisher(self, key: str, publisher_class: int) -> zenoh.Publisher:
        """What sends on a key as the class deserves. Never BLOCK: that would stop the loop, not the publisher."""
        periodic = publisher_class == 3
        publisher = self._session.declare_publisher(
            key,
            priority=_PRIORITIES[publisher_class],
            congestion_control=zenoh.CongestionControl.DROP,
            reliability=zenoh.Reliability.BEST_EFFORT if periodic else zenoh.Reliability.RELIABLE,
            express=publisher_class != 1,
            allowed_destination=zenoh.Locality.REMOTE,
        )
        self._publishers.add(publisher)
        return publisher

    def ends(self, publisher: zenoh.Publisher) -> None:
        """Send no more with it."""
        self._publishers.discard(publisher)
        self.outbound.call(publisher.undeclare)

    def put(
        self, key: str, data: bytes, *, attachment: bytes | None = None, urgent: bool = False, final: bool = False
    ) -> None:
        """Send something of the protocol's own. `final`: nothing makes up for it if it is lost, so a thread waits where
        zenoh has no room for it, and with it what is sent afterwards.
        """
        call = self.outbound.call_by_thread if final else self.outbound.call
        call(
            self._session.put,
            key,
            data,
            attachment=attachment,
            priority=zenoh.Priority.REAL_TIME if urgent else zenoh.Priority.INTERACTIVE_HIGH,
            congestion_control=zenoh.CongestionControl.BLOCK if final else zenoh.CongestionControl.DROP,
            express=True,
            allowed_destination=zenoh.Locality.REMOTE,
        )

    def declare(self, key: str) -> None:
        """Keep a liveliness token."""
        self.outbound.call(self._declare, key)

    def undeclare(self, key: str) -> None:
        self.outbound.call(self._undeclare, key)

    def _declare(self, key: str) -> None:
        self._tokens[key] = self._session.liveliness().declare_token(key)

    def _undeclare(self, key: str) -> None:
        token = self._tokens.pop(key, None)
        if token is not None:
            token.undeclare()

    async def ask(self, key: str, timeout: float) -> list[bytes]:
        """All answers to a query, within `timeout` seconds."""

        def ask() -> list[bytes]:
            channel: FifoChannel[zenoh.Reply] = FifoChannel(_AT_ONCE)
            replies = self._session.get(key, channel, timeout=timeout, consolidation=zenoh.ConsolidationMode.NONE)
            return [reply.ok.payload.to_bytes() for reply in replies if reply.ok is not None]

        return await _in_thread(ask)

    async def networks(self, *, tools: bool) -> set[str]:
        """The names of the r2p networks on which there are modules, or else a publisher, or else `tools` that look."""

        def tokens(kind: str) -> list[tuple[str, str]]:
            replies: FifoChannel[zenoh.Reply] = FifoChannel(_AT_ONCE)
            found = self._session.liveliness().get(f"r2p/*/{liveliness.PLACE}/**/{kind}/**", replies, timeout=1.0)
            keys = [str(reply.ok.key_expr).split("/", 3) for reply in found if reply.ok is not None]
            found_at = [(network, liveliness.token_at(key)) for _, network, _, key in keys if is_network_name(network)]
            return [(network, token) for network, token in found_at if token.split("/")[2:3] == [kind]]

        def ask() -> set[str]:
            everybody = tokens("module")
            found = {network for network, token in everybody if liveliness.is_module(token)}
            found = found or {network for network, _ in tokens("pub")}
            return found or {network for network, _ in everybody if tools}

        return await _in_thread(ask)

    async def listening(self) -> list[str]:
        """The endpoints where it takes connections."""

        def ask() -> list[str]:
            answers = self._session.get(f"@/{self._session.zid()}/*", timeout=1.0)
            found = [json.loads(each.ok.payload.to_bytes()) for each in answers if each.ok is not None]
            return [str(locator) for each in found for locator in each.get("locators", [])]

        return await _in_thread(ask)

    async def close(self) -> None:
        """Close it; what was put before is sent."""
        publishers, self._publishers = self._publishers, set()
        await _in_thread(functools.partial(self._close, publishers))

    def _close(self, publishers: Iterable[zenoh.Publisher]) -> None:
        """zenoh keeps 34 kB for ever of each session that is closed with a publisher in it."""
        self.outbound.finish()
        with contextlib.suppress(zenoh.ZError):  # it is closed already
            for publisher in publishers:
                publisher.undeclare()
        self._session.close()


_MESSAGE_MAX = 4096
_AT_ONCE = 65_536
"""What waits in zenoh until its thread runs, at most: more than there is, as zenoh may hand out all in the very call
that asks for it, holding its locks, and would wait there for ever.
"""


async def _in_thread(function: Callable[[], T], abandoned: Callable[[T], None] | None = None) -> T:
    """What `function` returns or raises, in a thread that nobody waits for when this is cancelled.

    What it returns then goes to `abandoned`.
    """
    loop = asyncio.get_running_loop()
    future: asyncio.Future[T] = loop.create_future()

    def succeed(result: T) -> None:
        if not future.cancelled():
            future.set_result(result)
        elif abandoned is not None:
            threads.start(functools.partial(abandoned, result))

    def fail(error: Exception) -> None:
        if not future.cancelled():
            future.set_exception(error)

    def work() -> None:
        try:
            result = function()
        except Exception as error:  # noqa: BLE001 - raised again where it is awaited
            with contextlib.suppress(RuntimeError):  # the loop is closed
                loop.call_soon_threadsafe(fail, error)
            return
        try:
            loop.call_soon_threadsafe(succeed, result)
        except RuntimeError:  # the loop is closed
            if abandoned is not None:
                abandoned(result)

    threads.start(work)
    return await future


def _close(session: zenoh.Session) -> None:
    session.close()


def _plain(error: Exception) -> str:
    """zenoh's text without the places in its source."""
    return re.sub(r" at /\S+?\.rs:\d+\.?", "", str(error)).strip()


def _bytes_of(data: zenoh.ZBytes | None) -> bytes:
    return data.to_bytes() if data is not None and len(data) <= _MESSAGE_MAX else b""
