"""One zenoh session, and the way from zenoh's threads into the event loop.

What zenoh reports arrives in threads, one for each declaration, which only hand it to the loop: neither user code nor a
protocol runs outside of the loop. Blocking calls (opening, closing) run in a thread, so the loop never waits for a
network.
"""

import asyncio
import concurrent.futures
import contextlib
import contextvars
import functools
import json
import threading
from collections import deque
from collections.abc import Callable, Iterable
from typing import Any, TypeVar

import zenoh
from zenoh.handlers import FifoChannel, Handler, RingChannel

from r2p.codecs import liveliness
from r2p.errors import TransportError
from r2p.runtime.sample import PublisherClass
from r2p.transports.link import MESSAGES_PER_TURN
from r2p.transports.stats import LoggedCounter
from r2p.transports.zenoh import threads
from r2p.transports.zenoh.config import is_network_name, plain_text
from r2p.transports.zenoh.threads import OutboundThread, as_exception

T = TypeVar("T")

_CONTROL_BYTES_MAX = 4096
"""Bytes of a management message or its attachment; r2p sends far shorter ones, and longer ones are not copied."""

_CHANNEL_MAX = 65_536
"""Items that wait in zenoh until their thread runs: more than there can be. zenoh may add all of them during the call
that requests them, while it holds its locks, and would wait there for ever if they did not fit.
"""

_TOKENS_MAX = 262_144
"""Keys of tokens that wait likewise: twice those that a module keeps at most."""

_PRIORITIES: dict[PublisherClass, zenoh.Priority] = {
    PublisherClass.NON_REAL_TIME: zenoh.Priority.DATA,
    PublisherClass.SPORADIC: zenoh.Priority.INTERACTIVE_HIGH,
    PublisherClass.PERIODIC: zenoh.Priority.REAL_TIME,
}

_LARGE_PRIORITIES: dict[PublisherClass, zenoh.Priority] = {
    PublisherClass.NON_REAL_TIME: zenoh.Priority.DATA_LOW,
    PublisherClass.SPORADIC: zenoh.Priority.DATA_HIGH,
    PublisherClass.PERIODIC: zenoh.Priority.INTERACTIVE_LOW,
}
"""Of topics with large messages: apart from the others, for whom zenoh's queue is locked while one goes in."""


class Unreachable(Exception):
    """Raised while there is nothing to connect to."""


class LoopQueue:
    """A queue from zenoh's threads into the event loop, which calls `handle` with each item, in order."""

    def __init__(
        self,
        loop: asyncio.AbstractEventLoop,
        handle: Callable[[Any], None],
        lost: LoggedCounter,
        *,
        most: int,
        per_turn: int = MESSAGES_PER_TURN,
    ) -> None:
        """`most` items may wait; `per_turn` are handled before the loop runs once."""
        self._loop = loop
        self._per_turn = per_turn
        self._handle = handle
        self._lost = lost
        self._most = most
        self._items: deque[Any] = deque()
        self._scheduled = False
        self._context = contextvars.copy_context()  # that of the link: zenoh's threads have none
        self.overflowed = 0
        """Items that did not fit, as there were `most` already."""

    def put(self, item: Any) -> None:
        """Append an item; in any thread."""
        if len(self._items) >= self._most:
            self.overflowed += 1
            return
        self._items.append(item)
        if not self._scheduled:
            self._scheduled = True
            with contextlib.suppress(RuntimeError):  # the loop is closed
                self._loop.call_soon_threadsafe(self._drain, context=self._context)

    def count_error(self, error: Exception) -> None:
        """Count an error that kept an item out; in any thread."""
        with contextlib.suppress(RuntimeError):  # the loop is closed
            self._loop.call_soon_threadsafe(self._lost.internal_error, error)

    def _drain(self) -> None:
        # Cleared before the items are read: a later one schedules the next call.
        self._scheduled = False
        items = self._items
        self._lost.drain(items, self._handle, self._per_turn)
        if items and not self._scheduled:  # a flood; other callbacks of the loop have their turn in between
            self._scheduled = True
            self._loop.call_soon(self._drain)


class SubscriptionReader:
    """Reads one subscription: a thread waits for the first sample, and the loop receives those behind it by itself.

    So while the loop falls behind, the thread pauses, and there is no switch of threads for each sample.
    """

    def __init__(
        self,
        subscriber: "zenoh.Subscriber[Handler[zenoh.Sample]]",
        loop: asyncio.AbstractEventLoop,
        on_sample: Callable[[zenoh.Sample], None],
        *,
        waits: bool = True,
    ) -> None:
        """`waits`: call `on_sample` with the first sample; otherwise `wait` starts that."""
        self._subscriber = subscriber
        self._loop = loop
        self._on_sample = on_sample
        self._try_receive = subscriber.handler.try_recv
        self._passed: deque[zenoh.Sample] = deque()  # samples that the thread has passed to the loop
        self._received = 0  # ... of which the loop has received so many; the thread compares that with what it passed
        self._waits = waits  # whether `on_sample` is to be called with the next sample
        self._thread_paused = not waits
        self._closed = False
        self._resume_thread = threading.Lock()
        self._resume_thread.acquire()
        threads.start_thread(functools.partial(self._run, waits), "reader")

    def receive(self) -> zenoh.Sample | None:
        """Return the next waiting sample, or None."""
        if self._passed:
            self._received += 1
            return self._passed.popleft()
        # Only while the thread is paused: otherwise it may hold the next sample, and the order would change.
        return self._try_receive() if self._thread_paused else None

    def wait(self) -> None:
        """Call `on_sample` with the next sample; soon with one passed meanwhile."""
        self._waits = True
        if self._passed:
            self._loop.call_soon(self._hand_out)
        elif self._thread_paused:
            self._thread_paused = False
            self._resume_thread.release()

    def close(self) -> None:
        self._closed = True
        self._thread_paused = False
        self._subscriber.undeclare()
        with contextlib.suppress(RuntimeError):  # the thread waits for a sample, and was not paused
            self._resume_thread.release()

    def _run(self, waits: bool) -> None:
        """Pass samples, in the thread; pause while the loop has not received the last but one."""
        receive = self._subscriber.handler.recv
        count = 0
        if not waits:
            self._resume_thread.acquire()
        with contextlib.suppress(zenoh.ZError, RuntimeError):  # it is undeclared; the loop is closed
            while not self._closed:
                sample = receive()
                count += 1
                pauses = count - self._received > 1
                self._loop.call_soon_threadsafe(self._pass, sample, pauses)
                if pauses:
                    self._resume_thread.acquire()

    def _pass(self, sample: zenoh.Sample, pauses: bool) -> None:
        """Handle each sample of the thread, in the loop; after the last one the thread may pause."""
        self._thread_paused = pauses
        if self._waits and not self._passed:
            self._waits = False
            self._received += 1
            self._on_sample(sample)
        else:
            self._passed.append(sample)

    def _hand_out(self) -> None:
        """Call `on_sample` with a sample passed before `wait`, ahead of all later ones."""
        if not self._waits or self._closed:
            return
        if self._passed:
            self._waits = False
            self._received += 1
            self._on_sample(self._passed.popleft())
        else:  # it has been received meanwhile
            self.wait()


async def open_session(config: zenoh.Config, on_error: Callable[[Exception], object]) -> "ZenohSession":
    """Open a session; `on_error` gets exceptions of its calls in a thread. Raises Unreachable if it may work later,
    TransportError if it can't.
    """
    try:
        return ZenohSession(await _in_thread(lambda: zenoh.open(config), zenoh.Session.close), on_error)
    except zenoh.ZError as error:
        text = plain_text(error)
        if text.startswith("Unable to connect"):
            raise Unreachable(text) from error
        raise TransportError(text) from error


class ZenohSession:
    """An open session, as the loop uses it. Declarations last until they are undeclared, or the session is closed."""

    def __init__(self, session: zenoh.Session, on_error: Callable[[Exception], object]) -> None:
        self._session = session
        self.outbound = OutboundThread(asyncio.get_running_loop(), on_error)
        self.large = OutboundThread(asyncio.get_running_loop(), on_error)
        """The thread that hands large messages to zenoh."""
        self._declared: list[object] = []  # kept, as zenoh undeclares what Python collects
        self._publishers: set[zenoh.Publisher] = set()
        self._tokens: dict[str, zenoh.LivelinessToken] = {}
        self._token_count = 0

    @property
    def raw(self) -> zenoh.Session:
        """The session itself, for declarations that are not r2p's."""
        return self._session

    def watch_transports(self, queue: LoopQueue) -> None:
        """Report each transport to another session, open ones included: (its id, whether it opened, and whether it uses
        shared memory).
        """

        def changed(event: zenoh.TransportEvent) -> None:
            shared: object = getattr(event.transport, "is_shm", False)  # not in zenoh's stubs
            queue.put((str(event.transport.zid), event.kind == zenoh.SampleKind.PUT, bool(shared)))

        declare = self._session.info.declare_transport_events_listener
        self._call_back(functools.partial(declare, history=True), changed, queue)

    def watch_tokens(self, prefix: str, queue: LoopQueue) -> None:
        """Report each token under a prefix, present ones included: (rest of its key, whether it exists)."""
        start = len(prefix) + 1

        def changed(sample: zenoh.Sample) -> None:
            there = sample.kind == zenoh.SampleKind.PUT
            self._token_count += 1 if there else -1
            self.outbound.set_token_count(self._token_count)
            queue.put((liveliness.token_of(str(sample.key_expr)[start:]), there))

        declare = self._session.liveliness().declare_subscriber
        self._call_back(functools.partial(declare, f"{prefix}/**", history=True), changed, queue)

    def query_tokens(self, prefix: str, timeout: float, queue: LoopQueue) -> None:
        """Query the tokens under a watched prefix: the rest of each key, and finally whether these are all. A thread of
        its own waits for them, not that of `outbound`: many tokens take seconds.
        """
        start = len(prefix) + 1

        def query() -> bool:
            if self._token_count > _TOKENS_MAX // 2:  # they might not fit into the channel
                return False
            replies: FifoChannel[zenoh.Reply] = FifoChannel(_TOKENS_MAX)
            complete = True
            for reply in self._session.liveliness().get(f"{prefix}/**", replies, timeout=timeout):
                if reply.ok is None:  # the time is over
                    complete = False
                else:
                    queue.put(liveliness.token_of(str(reply.ok.key_expr)[start:]))
            return complete

        def run() -> None:
            complete = False
            try:
                complete = query()
            except zenoh.ZError:  # the session is closed
                pass
            except BaseException as error:  # noqa: BLE001 - a panic of zenoh, too: counted and logged in the loop
                queue.count_error(as_exception(error))
            finally:
                queue.put(complete)

        threads.start_thread(run, "token query")

    def listen(self, key: str, queue: LoopQueue) -> None:
        """Report each message of a key: (its attachment, payload), either of them empty if too long for r2p. The key
        has no wildcard: zenoh's router never frees 3 kB of each closed session that subscribed with a wildcard, if
        another session has subscribed by the same key expression.
        """

        def arrived(sample: zenoh.Sample) -> None:
            queue.put((_bytes_of(sample.attachment), _bytes_of(sample.payload)))

        declare = functools.partial(self._session.declare_subscriber, key, allowed_origin=zenoh.Locality.REMOTE)
        self._call_back(declare, arrived, queue)

    def answer_queries(
        self, key: str, answer: Callable[[str], bytes | None], make_queue: Callable[[Callable[[Any], None]], LoopQueue]
    ) -> None:
        """Answer queries: `answer` returns, in the loop, the payload for a key."""

        def reply(query: zenoh.Query) -> None:
            name = str(query.key_expr)
            payload = answer(name)
            with contextlib.suppress(zenoh.ZError):  # the session is closed
                if payload is not None:
                    query.reply(key.replace("*", name.rpartition("/")[2]), payload)
                query.drop()

        queue = make_queue(reply)
        self._call_back(functools.partial(self._session.declare_queryable, key), queue.put, queue)

    def _call_back(self, declare: Callable[..., object], put: Callable[[Any], object], queue: LoopQueue) -> None:
        """Declare something until the session is closed: a thread calls `put` with each item; `queue` counts errors."""

        def received(item: Any) -> None:
            try:
                put(item)
            except BaseException as error:  # noqa: BLE001 - a panic, too: counted in the loop; the next item follows
                queue.count_error(as_exception(error))

        self._declared.append(threads.declare(declare, received))

    def subscribe(
        self, key: str, most: int, on_sample: Callable[[zenoh.Sample], None], *, waits: bool = True
    ) -> SubscriptionReader:
        """Call `on_sample` in the loop with the first sample, if not only after the reader's `wait`; later ones are
        received from the reader. Of more than `most` waiting ones, the oldest are lost.
        """
        handler: RingChannel[zenoh.Sample] = RingChannel(most)
        subscriber = self._session.declare_subscriber(key, handler, allowed_origin=zenoh.Locality.REMOTE)
        return SubscriptionReader(subscriber, asyncio.get_running_loop(), on_sample, waits=waits)

    def declare_publisher(self, key: str, publisher_class: PublisherClass, *, large: bool = False) -> zenoh.Publisher:
        """Declare a publisher with the priority of the class, and whether its messages may be large.

        Never BLOCK: that would stop the loop. In the thread of large messages, too: where it does not get room for a
        whole message in 5 s, zenoh closes the connection, and so does each router on the way.
        """
        periodic = publisher_class == PublisherClass.PERIODIC
        publisher = self._session.declare_publisher(
            key,
            priority=(_LARGE_PRIORITIES if large else _PRIORITIES)[publisher_class],
            congestion_control=zenoh.CongestionControl.DROP,
            reliability=zenoh.Reliability.BEST_EFFORT if periodic else zenoh.Reliability.RELIABLE,
            # Without it, zenoh would wait for more to fill a batch.
            express=large or publisher_class != PublisherClass.NON_REAL_TIME,
            allowed_destination=zenoh.Locality.REMOTE,
        )
        self._publishers.add(publisher)
        return publisher

    def undeclare_publisher(self, publisher: zenoh.Publisher, *, large: bool = False) -> None:
        self._publishers.discard(publisher)
        (self.large if large else self.outbound).call(publisher.undeclare)

    def put(
        self, key: str, data: bytes, *, attachment: bytes | None = None, urgent: bool = False, final: bool = False
    ) -> None:
        """Send a message of the protocol. `final`: its loss can't be made up for, so if zenoh has no room, a thread
        waits, and later messages wait behind it.
        """
        call = self.outbound.submit if final else self.outbound.call
        call(
            functools.partial(
                self._session.put,
                key,
                data,
                attachment=attachment,
                priority=zenoh.Priority.REAL_TIME if urgent else zenoh.Priority.INTERACTIVE_HIGH,
                congestion_control=zenoh.CongestionControl.BLOCK if final else zenoh.CongestionControl.DROP,
                express=True,
                allowed_destination=zenoh.Locality.REMOTE,
            )
        )

    def declare_token(self, key: str) -> None:
        """Declare a liveliness token."""
        self.outbound.call(functools.partial(self._declare_token, key))

    def undeclare_token(self, key: str) -> None:
        self.outbound.call(functools.partial(self._undeclare_token, key))

    def _declare_token(self, key: str) -> None:
        self._tokens[key] = self._session.liveliness().declare_token(key)

    def _undeclare_token(self, key: str) -> None:
        token = self._tokens.pop(key, None)
        if token is not None:
            token.undeclare()

    async def query(self, key: str, timeout: float) -> list[bytes]:
        """Return all answers to a query, within `timeout` seconds."""

        def query() -> list[bytes]:
            channel: FifoChannel[zenoh.Reply] = FifoChannel(_CHANNEL_MAX)
            replies = self._session.get(key, channel, timeout=timeout, consolidation=zenoh.ConsolidationMode.NONE)
            return [reply.ok.payload.to_bytes() for reply in replies if reply.ok is not None]

        return await _in_thread(query)

    async def find_networks(self, *, tools: bool) -> set[str]:
        """Return the names of r2p networks with modules; failing that, with a publisher; failing that, with `tools`."""

        def keys(kind: str) -> list[tuple[str, str]]:
            replies: FifoChannel[zenoh.Reply] = FifoChannel(_TOKENS_MAX)
            found = self._session.liveliness().get(f"r2p/*/{liveliness.KEY_PREFIX}/**/{kind}/**", replies, timeout=1.0)
            keys = [str(reply.ok.key_expr).split("/", 3) for reply in found if reply.ok is not None]
            return [(network, liveliness.token_of(key)) for _, network, _, key in keys if is_network_name(network)]

        def find() -> set[str]:
            modules = [*keys("module"), *keys(liveliness.PACKED)]
            found = {network for network, key in modules if liveliness.is_module(key)}
            found = found or {network for network, key in [*modules, *keys("pub")] if liveliness.has_publisher(key)}
            if found or not tools:
                return found
            return {network for network, key in modules if liveliness.is_module(key, tools=True)}

        return await _in_thread(find)

    async def listening_endpoints(self) -> list[str]:
        """Return the endpoints where the session accepts connections, from its admin space."""

        def find() -> list[str]:
            answers = self._session.get(f"@/{self._session.zid()}/*", timeout=1.0)
            found = [json.loads(each.ok.payload.to_bytes()) for each in answers if each.ok is not None]
            return [str(locator) for each in found for locator in each.get("locators", [])]

        return await _in_thread(find)

    async def close(self) -> None:
        """Close the session; earlier messages are sent."""
        publishers, self._publishers = self._publishers, set()
        await _in_thread(functools.partial(self._close, publishers))

    def _close(self, publishers: Iterable[zenoh.Publisher]) -> None:
        self.outbound.finish()
        self.large.finish()
        with contextlib.suppress(zenoh.ZError):  # it is closed already
            for publisher in publishers:  # zenoh keeps 34 kB for ever of each session that is closed with one
                publisher.undeclare()
        self._session.close()


async def _in_thread(function: Callable[[], T], abandoned: Callable[[T], None] | None = None) -> T:
    """Call `function` in a thread; return its result, or raise its exception. If this is cancelled, the thread goes on,
    and its result goes to `abandoned`.
    """
    done: concurrent.futures.Future[T] = concurrent.futures.Future()
    done.set_running_or_notify_cancel()  # so that cancelling this leaves it alone

    def work() -> None:
        try:
            done.set_result(function())
        except BaseException as error:  # noqa: BLE001 - a panic of zenoh, too: raised again where it is awaited
            done.set_exception(as_exception(error))

    threads.start_thread(work, "request")
    try:
        return await asyncio.wrap_future(done)
    except asyncio.CancelledError:
        if abandoned is not None:
            threads.start_thread(functools.partial(_abandon, done, abandoned), "clean-up")
        raise


def _abandon(done: "concurrent.futures.Future[T]", abandoned: Callable[[T], None]) -> None:
    if done.exception() is None:  # which waits for it
        abandoned(done.result())


def _bytes_of(data: zenoh.ZBytes | None) -> bytes:
    return data.to_bytes() if data is not None and len(data) <= _CONTROL_BYTES_MAX else b""
