"""Subscribers: one bounded queue each, and the ways to read it: `async for`, `fetch`, callbacks.

Nothing is awaited between popping a message and handing it out, so a cancelled reader loses none.
"""

import asyncio
import inspect
from collections.abc import AsyncIterator, Callable
from types import TracebackType
from typing import Any, Generic, Literal, Self, TypeVar, overload

import msgspec

from r2p.clock import LONGEST, SHORTEST, Alarm, check_seconds, check_timeout
from r2p.errors import Closed, DecodeError, MessageError, TooLong
from r2p.messages import SIZE_MAX, Layout, Message
from r2p.runtime.accepting import AcceptedTypes
from r2p.runtime.qos import check_count
from r2p.runtime.queues import QUEUE_BYTES, YIELD_EVERY, EndpointOwner, SampleQueue, SubscriberQueue, checkpoint
from r2p.runtime.sample import Sample
from r2p.runtime.topic import Topic, TopicSpace
from r2p.units import SECOND

T = TypeVar("T")
M = TypeVar("M", bound=Message)

Callback = Callable[[T], object]
Keep = Literal["newest", "oldest"]


class SubscriberOptions(msgspec.Struct, frozen=True):
    """The options of `Node.subscribe`, as described there, and in the same order."""

    callback: Callback[Any] | None
    queue: int
    lossy: bool
    keep: Keep
    max_age: float | None
    timeout: float | None
    on_timeout: Callable[[], object] | None
    queue_bytes: int = QUEUE_BYTES

    def check(self, topic: str) -> None:
        """Raise MessageError for invalid options."""
        check_count(topic, "queue", self.queue)
        check_count(topic, "queue_bytes", self.queue_bytes, "bytes")
        if self.keep not in ("newest", "oldest"):
            raise MessageError(f"topic {topic}: keep is 'newest' or 'oldest', not {self.keep!r}")
        if self.callback is not None and not callable(self.callback):
            raise MessageError(
                f"topic {topic}: a callback is a function, not {self.callback!r}: options are given by name"
            )
        if self.on_timeout is not None and (self.timeout is None or not callable(self.on_timeout)):
            raise MessageError(f"topic {topic}: on_timeout is a function, called after a timeout= without messages")
        for option, value in (("max_age", self.max_age), ("timeout", self.timeout)):
            if value is not None:
                check_seconds(f"topic {topic}: {option}", value, least=SHORTEST)


class _MonitoredQueue(SampleQueue):
    """A queue that notes the arrival of messages; only for subscribers with a time-out, as it costs time."""

    def __init__(self, sink: SubscriberQueue, most: int, note: Callable[[Sample], None]) -> None:
        super().__init__(sink, most)
        self._note = note

    def append(self, sample: Sample) -> None:
        super().append(sample)
        self._note(sample)


class Subscriber(Generic[T]):
    """One subscription of a node. Made by `Node.subscribe`.

    Iterate it (`async for message in sub`), `fetch()` single messages, or give a callback that `node.spin()` calls.
    Leaving an `async for` keeps the subscription; `close()` or `async with` ends it.
    """

    def __init__(
        self,
        space: TopicSpace,
        node: EndpointOwner,
        topic: Topic,
        layout: Layout[Any] | None,
        options: SubscriberOptions,
        accepted: AcceptedTypes | None = None,
    ) -> None:
        self.topic = topic.name
        """The topic's name, after remapping."""
        self.callback: Callback[T] | None = options.callback
        """The function that `Node.spin` calls with each message; None for iteration or `fetch`."""
        self.undecodable = 0
        """Messages whose bytes don't decode as the type; skipped."""
        self.stale = 0
        """Messages older than `max_age` when their turn came; skipped."""
        self.timeouts = 0
        """Times that no fresh message arrived for `timeout` seconds."""
        self._sink = SubscriberQueue(
            space.wake_scheduler, node, options.queue, lossy=options.lossy, keep_oldest=options.keep == "oldest"
        )
        self._sink.typed = layout is not None
        if layout is not None:
            self._sink.size_max = layout.size
        self._node = node
        self._space = space
        self._topic = topic
        self._layout = layout
        self._accepted = accepted
        self._type = None if layout is None else layout.cls
        self._max_age = None if options.max_age is None else round(options.max_age * SECOND)
        self._on_timeout = options.on_timeout
        self._closed = False
        self._silent = False
        self._since_yield = 0
        self._timeout = 0 if options.timeout is None else round(options.timeout * SECOND)
        self._last_message = space.clock.monotonic()
        self._alarm = Alarm(space.loop, self._check_silence, background=self._is_idle)
        if options.timeout is not None:
            self._sink.queue = _MonitoredQueue(self._sink, options.queue_bytes, self._note)
            self._alarm.set(self._last_message + self._timeout)
        elif (SIZE_MAX if layout is None else layout.size) * options.queue >= options.queue_bytes:
            self._sink.queue = SampleQueue(self._sink, options.queue_bytes)
        self.queue = self._sink.queue
        """Unread messages, oldest first."""

    @property
    def lost(self) -> int:
        """Messages that a full queue dropped."""
        return self._sink.lost

    @property
    def too_long(self) -> int:
        """Messages with more elements than the `r2p.Max` of the type here; skipped."""
        return self._sink.too_long

    @property
    def publishers(self) -> int:
        """The number of publishers of the topic that this module knows: its own, and remote ones that answered."""
        return len(self._topic.publishers) + self._topic.remote_publishers

    async def wait_publisher(self) -> None:
        """Wait until the topic has a publisher. Raises Closed if the subscription is closed, before or meanwhile."""
        if not (self.publishers or self._closed):
            await self._sink.publisher_came.wait()
        if self._closed:
            raise self._is_closed()

    def __aiter__(self) -> AsyncIterator[T]:
        return self._iterate(whole=False)

    @overload
    def samples(self: "Subscriber[M]") -> AsyncIterator[Sample[M]]: ...

    @overload
    def samples(self: "Subscriber[bytes]") -> AsyncIterator[Sample]: ...

    def samples(self) -> AsyncIterator[Sample[Any]]:
        """Iterate samples: messages with their source, stamp, deadline and packed bytes.

        `sample.message` is of the type that was subscribed to; without a type, it may be None.
        """
        return self._iterate(whole=True)

    async def _iterate(self, *, whole: bool) -> AsyncIterator[Any]:  # noqa: C901 - see below
        # One long function with everything in local variables, because every message passes here: calls would take as
        # long as the work. `_next` and `_yield_sometimes` are the same for less frequent paths.
        sink, kind, create_future = self._sink, self._type, self._space.loop.create_future
        queue, wake_scheduler, ages = sink.queue, self._space.wake_scheduler, self._max_age is not None
        decode = None if self._layout is None or ages else self._layout.decode
        while not self._closed:
            if not queue:
                if sink.waiter is not None:
                    raise self._two_readers()
                waiter = sink.waiter = create_future()
                try:
                    await waiter
                finally:
                    if sink.waiter is waiter:
                        sink.waiter = None
            # A node of low priority yields after each message, so that a more important one runs in between.
            credit = YIELD_EVERY if sink.priority >= wake_scheduler.top else 1
            while queue:
                sample = queue.popleft()
                if sink.wait_queue is not None:
                    sink.refill()
                message = sample.message
                if message is None and decode is not None and not self._topic.accepted:
                    try:  # as `_examine` does, which counts what does not decode
                        message = sample.message = decode(sample.data)
                    except DecodeError:
                        message = None
                if ages or message.__class__ is not kind:
                    message = self._examine(sample)
                    if message is None:
                        continue
                    if whole and kind is not None and sample.message is not message:
                        sample = msgspec.structs.replace(sample, message=message)  # decoded from another class
                yield sample if whole else message
                credit -= 1
                if not credit:
                    if queue:
                        await self._yield()
                    break

    async def fetch(self, timeout: float | None = None) -> T:
        """Wait for one message. Raises TimeoutError after `timeout` seconds, Closed if the subscription is closed.

        Raises MessageError for a time-out that is not a number of seconds.
        """
        if timeout is not None and (timeout.__class__ is not float or not timeout <= LONGEST):  # no call for a good one
            check_timeout(f"topic {self.topic}: the time-out of fetch", timeout)
        if self.queue:  # else the wait lets other tasks run
            await self._yield_sometimes()
        message = self._next()
        if message is not None:
            return message
        if timeout is None:  # apart, as a time-out costs more than a message
            return await self._fetch_next()
        limit = asyncio.timeout(timeout)
        try:
            async with limit:
                return await self._fetch_next()
        except TimeoutError:
            if not limit.expired():  # the subscription has a time-out of its own
                raise
            raise TimeoutError(self._nothing_within(timeout)) from None

    async def _fetch_next(self) -> T:
        while not self._closed:
            await self._arrival()
            message = self._next()
            if message is not None:
                return message
        raise self._is_closed()

    def close(self) -> None:
        """End the subscription. A reader that waits for its next message is woken."""
        if not self._closed:
            self._closed = True
            self._alarm.close()
            self._topic.leave(self._sink)
            if self._accepted is not None:
                self._topic.accepted.remove(self._accepted)
            self._space.release(self._topic)
            self._node.forget(self)
            self.queue.clear()
            self._sink.refill()
            if (reader := self._sink.waiter) is not None and not reader.done():
                reader.set_result(None)
            self._sink.publisher_joined()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    # Called by the node

    def open(self) -> None:
        """Join the topic. A latched value is available at once."""
        if self._accepted is not None:
            self._topic.accepted.append(self._accepted)
        self._topic.join(self._sink)
        self._space.changed(self._topic)

    async def serve(self) -> bool:
        """Call the callback with each waiting message; return whether there was any. For `Node.spin`."""
        served = False
        for _ in range(len(self.queue)):
            message = self._next()
            if message is None:
                break
            served = True
            if self.callback is not None:
                pending = self.callback(message)
                if pending is not None and inspect.isawaitable(pending):
                    await pending
            await self._yield_sometimes()
        return served

    def wait_by(self, waiter: asyncio.Future[None]) -> None:
        """Let the next message wake this future. Raises RuntimeError if another reader waits."""
        if self._sink.waiter is not None:
            raise self._two_readers()
        self._sink.waiter = waiter

    def wait_no_more(self, waiter: asyncio.Future[None]) -> None:
        """Stop waiting by this future."""
        if self._sink.waiter is waiter:
            self._sink.waiter = None

    def _next(self) -> T | None:
        """Pop messages up to the next one that is fresh and decodes; return None if the queue has no such message."""
        sink, queue = self._sink, self.queue
        while queue:
            sample = queue.popleft()
            if sink.wait_queue is not None:
                sink.refill()
            message: T | None = self._examine(sample)
            if message is not None:
                return message
        return None

    def _examine(self, sample: Sample) -> Any:
        """Return the sample's message as this subscriber's type; None, counted, if it is too old or does not decode."""
        if self._max_age is not None and self._space.clock.now() - sample.stamp > self._max_age:
            self.stale += 1
            return None
        if self._layout is None:
            return sample.data
        message: Any = sample.message
        if message.__class__ is self._type:
            return message
        try:
            message = self._decode_any(sample) if self._topic.accepted else self._layout.decode(sample.data)
        except DecodeError as error:
            if isinstance(error, TooLong):
                self._sink.too_long += 1
            else:
                self.undecodable += 1
            return None
        if sample.message is None:
            sample.message = message  # for the other subscribers
        return message

    def _decode_any(self, sample: Sample) -> Any:
        """Decode a message of a topic that may have several types, and convert it if it is of another one."""
        accepted = self._accepted
        if accepted is None:
            assert self._layout is not None
            accepted = AcceptedTypes(self.topic, self._layout, {})
        if sample.message is None:
            fingerprint = self._space.fingerprint_of(self._topic, sample.source)
            sample.message = accepted.decode(sample.data, fingerprint)  # for the other subscribers, too
        return accepted.convert(sample.message)

    async def _arrival(self) -> None:
        """Wait until something is in the queue, or the subscription is closed."""
        self._since_yield = 0
        waiter = self._space.loop.create_future()
        self.wait_by(waiter)
        try:
            await waiter
        finally:
            self.wait_no_more(waiter)

    def _nothing_within(self, seconds: float) -> str:
        """The text of a TimeoutError: what was waited for, and why nothing came, as far as that is known."""
        text = f"no message on {self.topic!r} within {seconds:g} s"
        count = self.publishers
        known = "its publisher is silent" if count == 1 else f"its {count} publishers are silent"
        stale = f", and {self.stale} messages so far were older than max_age" if self.stale else ""
        return f"{text}; {known if count else self._without_publisher()}{stale}"

    def _without_publisher(self) -> str:
        differ = (link.publishers_differ(self._topic) for link in self._space.links)
        return next(filter(None, differ), "it has no publisher yet")

    def _two_readers(self) -> RuntimeError:
        return RuntimeError(f"two tasks read one subscription of {self.topic}: subscribe once for each task")

    def _is_closed(self) -> Closed:
        return Closed(f"the subscription of {self.topic} is closed: subscribe again")

    async def _yield_sometimes(self) -> None:
        """Let other tasks run after YIELD_EVERY messages in a row; a node of low priority after each."""
        self._since_yield += 1
        if self._since_yield >= YIELD_EVERY or self._sink.priority < self._space.wake_scheduler.top:
            self._since_yield = 0
            await self._yield()

    async def _yield(self) -> None:
        wake_scheduler, priority = self._space.wake_scheduler, self._sink.priority
        if priority >= wake_scheduler.top:
            await checkpoint()
        else:
            turn = self._space.loop.create_future()
            wake_scheduler.wake_later(priority, turn)
            await turn

    def _note(self, sample: Sample) -> None:
        if self._max_age is None or self._space.clock.now() - sample.stamp <= self._max_age:
            self._last_message = self._space.clock.monotonic()
            if self._silent:
                self._silent = False
                self._alarm.set(self._last_message + self._timeout)

    def _is_idle(self) -> bool:
        """Return whether a time-out has no effect now: no reader waits, and no function is to be called."""
        return self._sink.waiter is None and self._on_timeout is None

    def _check_silence(self) -> None:
        now = self._space.clock.monotonic()
        if now < self._last_message + self._timeout:
            self._alarm.set(self._last_message + self._timeout)
            return
        self.timeouts += 1
        if self._on_timeout is not None:
            self._silent = True  # called once: the next message starts the alarm again
            if self._node.ending:
                return
            try:
                self._on_timeout()
            except Exception as error:  # noqa: BLE001 - the user's code: whatever it raises crashes its node
                self._node.crash(error)
            return
        self._last_message = now
        self._alarm.set(now + self._timeout)
        if (reader := self._sink.waiter) is not None and not reader.done():
            reader.set_exception(TimeoutError(self._nothing_within(self._timeout / SECOND)))
