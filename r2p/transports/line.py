"""The debug line: one other end that speaks in lines of ASCII (PROTOCOL.md 3), whatever carries the bytes.

The first line that is written in a turn of the event loop goes out at once, the others of that turn in one piece. While
the carrier (TCP connection, serial port) takes no more, lines wait here, where management can overtake samples. Those
of real-time publishers never do: each goes out at once, before all that wait, or its publisher keeps it and watches the
time. A carrier is attached while it lives; the link stays over reconnects, so its subscriptions and counters do too.
"""

import abc
import asyncio
import contextlib
from array import array
from bisect import bisect_right
from collections import deque
from typing import TYPE_CHECKING, ClassVar

from r2p.codecs import debug
from r2p.codecs.management import FLAG_BOOT, ROLE_PUBLISHES
from r2p.errors import MessageError
from r2p.names import LOADER_PREFIX, MANAGEMENT
from r2p.protocols.discovery.base import DiscoveryProtocol
from r2p.protocols.discovery.negotiation import GRACE
from r2p.runtime.backpressure import LINK_DOWN
from r2p.runtime.sample import PublisherClass, Sample, Source
from r2p.runtime.topic import PublisherHandle, Topic
from r2p.transports.announcement import NOTHING
from r2p.transports.buffered_link import BufferedLink
from r2p.transports.link import Hub, is_booting

if TYPE_CHECKING:
    from collections.abc import Callable

BUFFER = 64 * 1024
"""Bytes that wait for a connection that takes no more, before its publishers have to wait or lose."""

OPENING = b"\r\n\r\n"
"""Ends whatever the reader at the other end has begun to read."""

_MANAGEMENT_BUFFER = 8 * 1024  # bytes more, for management only
_URGENT_MOST = 96  # urgent messages that wait, whatever else does: another 8 KiB
_CLOSING = 0.5  # seconds for the other end to take what is still buffered
_SECOND = 1_000_000_000
_NO_DEADLINE = 0x7FFFFFFF
_WRAP = 0xFFFFFFFF
_NRT = PublisherClass.NON_REAL_TIME


class Carrier(abc.ABC):
    """A connection that carries the bytes of a line link.

    It tells its link `carrier_full()` when it holds bytes that could not be sent at once, `carrier_ready()` when it
    has none left; in between nothing is given to it, except the last words before `close()`.
    """

    flow_controlled: ClassVar[bool] = False
    """Whether the other end waits while nothing is read, and nothing is lost by that."""

    @abc.abstractmethod
    def send(self, data: bytes) -> None:
        """Send, or hold what can't be sent at once."""

    @abc.abstractmethod
    def pause(self) -> None:
        """Read no more for now."""

    @abc.abstractmethod
    def resume(self) -> None:
        """Read on."""

    @abc.abstractmethod
    def close(self) -> None:
        """Send what is held, as far as the other end takes it, and close."""

    @property
    def unconfirmed(self) -> int:
        """Bytes that it was given and that the other end has not confirmed, as far as that is known."""
        return 0


class Connection(Carrier):
    """A carrier that can break. Whoever opened it waits for its end, and closes it in order."""

    def __init__(self) -> None:
        self.ended = asyncio.Event()
        """Set when it is gone for good, or was never there."""

    @abc.abstractmethod
    def abort(self) -> None:
        """Close at once; does nothing when it is closed."""

    async def aclose(self) -> None:
        """Close, and wait until it is over; what the other end does not take soon is not sent."""
        self.close()
        try:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(_CLOSING):
                    await self.ended.wait()
        finally:
            self.abort()
        await self.ended.wait()


class LineLink(BufferedLink):
    """A link over the debug line.

    `buffer` bytes may wait for the carrier. With `piecemeal` it is given one line at a time: so no more than that waits
    behind one that it has not taken entirely.
    """

    max_payload: ClassVar[int] = debug.PAYLOAD_MAX
    point_to_point: ClassVar[bool] = True

    def __init__(
        self, name: str, hub: Hub, *, management_rate: float = 250.0, buffer: int = BUFFER, piecemeal: bool = False
    ) -> None:
        super().__init__(name, hub, management_rate=management_rate)
        self._reader = debug.Reader(self.stats.lost)
        self._encoders: dict[str, Callable[[bytes, int], bytes]] = {}
        self._sources = PublisherLookup(self.discovery, self.name)
        self._carrier: Carrier | None = None
        self._urgent: deque[bytes] = deque()
        self._management: deque[bytes] = deque()
        self._samples: deque[bytes] = deque()
        self._waiting = 0
        self._corked = False
        self._blocked = False
        self._limit = self._buffer = buffer
        self._grace: asyncio.TimerHandle | None = None
        self._piecemeal = piecemeal
        self._stamp = 0
        self._unconfirmed = UnconfirmedBytes()
        self._given = 0
        self._held: tuple[str, Sample] | None = None
        self._unasked: set[str] = set()

    # Carrier

    def connected(self, carrier: Carrier) -> None:
        """Bytes flow from now on."""
        if self._closed:
            carrier.close()
            return
        self._carrier = carrier
        self._blocked = False
        self._reader = debug.Reader(self.stats.lost)
        self._unconfirmed = UnconfirmedBytes()
        self._given = self.stats.sent
        self._send(OPENING)
        if self._carrier is carrier:  # else it broke at the first bytes
            self._begin_grace()
            self.on_up()

    def disconnected(self, reason: str) -> None:
        """Bytes do not flow any more."""
        self._count_unknown()
        self._carrier = None
        self._end_grace()
        self.on_down(reason)
        self._lose_held()

    def fed(self, data: bytes | memoryview) -> None:
        """Bytes came in."""
        self.stats.bytes_received += len(data)
        self._stamp = self._clock.now()
        try:
            lines = self._reader.feed(bytes(data))
        except Exception as error:  # noqa: BLE001 - counted and logged; the other lines follow
            self.stats.lost.internal_error(error)
            lines = self._sound_lines(bytes(data))
        self.receive(lines)

    def _sound_lines(self, data: bytes) -> list[debug.Line]:
        """What there is but for the line whose reading raised: each is read for itself."""
        lines: list[debug.Line] = []
        self._reader.drops = {}  # up to what raised they are counted already
        for piece in data.splitlines(keepends=True):
            try:
                lines += self._reader.feed(piece)
            except Exception:  # noqa: BLE001 - counted before
                self._reader = debug.Reader(self.stats.lost)
        self._reader.drops = self.stats.lost
        return lines

    def carrier_full(self) -> None:
        self._blocked = True

    def carrier_ready(self) -> None:
        self._blocked = False
        self.stats.lost.guard(self._see_held_off)
        self.made_room()  # before the bytes that wait fill the carrier again
        if not self._corked:
            self._uncork()

    # Link

    def _remove_subscriber(self, name: str) -> None:
        super()._remove_subscriber(name)
        self._encoders.pop(name, None)

    @property
    def full(self) -> bool:
        return self._waiting >= self._limit

    def takes(self, sample: Sample) -> bool:
        if sample.publisher_class == _NRT:
            return self._waiting < self._limit
        return not self._blocked and self._limit >= 0

    def write(self, topic: str, sample: Sample) -> None:
        due = sample.expires or sample.deadline
        deadline = due // 1000 if due else sample.stamp // 1000 + _NO_DEADLINE
        try:
            encode = self._encoders[topic]
        except KeyError:
            encode = self._encoders[topic] = debug.encoder(topic.encode())
        try:
            line = encode(sample.data, deadline & _WRAP)
        except MessageError:  # only from another link, with a topic of any size
            self.stats.lost["impossible message"] += 1
            return
        self.stats.sent += 1
        real_time = sample.publisher_class != _NRT
        if self._blocked or (self._corked and not real_time):
            self._samples.append(line)
            self._waiting += len(line)
            if self._waiting >= self._limit:
                self._flush()
            return
        if real_time:
            self._held = topic, sample  # lost if the carrier breaks by it
        self._send_at_once(line)
        if real_time:
            self._see_sent()

    def write_management(self, data: bytes, *, urgent: bool = False) -> None:
        if len(self._urgent) >= _URGENT_MOST if urgent else self._waiting >= self._limit + _MANAGEMENT_BUFFER:
            self.stats.lost["management, send buffer full"] += 1
            return
        deadline = self._clock.now() // 1000 + _NO_DEADLINE
        line = debug.encode(MANAGEMENT.encode(), data, deadline & _WRAP)
        if not (self._corked or self._blocked):
            self._send_at_once(line)
            return
        self._waiting += len(line)
        (self._urgent if urgent else self._management).append(line)

    def sample(self, topic: str, arrival: debug.Line) -> Sample:
        return Sample(arrival.data, self._sources.source_of(topic), self._stamp, stamped=False)

    def discard(self) -> int:
        discarded = len(self._samples)
        self.stats.sent -= discarded
        if self._urgent:  # other management is repeated
            self.stats.lost["orders not sent"] += len(self._urgent)
        self._urgent.clear()
        self._management.clear()
        self._samples.clear()
        self._waiting = 0
        return discarded

    @property
    def flow_controlled(self) -> bool:
        if self._carrier is None or (self.gateway_hooks is not None and self.gateway_hooks.has_other_gateways):
            return False  # hellos of gateways that come late would part the tree
        return self._carrier.flow_controlled

    @property
    def fixed_peer(self) -> bool:
        return self._carrier is not None and self._carrier.flow_controlled

    def pause(self) -> None:
        if self._carrier is not None:
            self._carrier.pause()

    def resume(self) -> None:
        if self._carrier is not None:
            self._carrier.resume()

    def close(self) -> None:
        self._end_grace()
        self._flush(last_words=True)  # the carrier gets all that waits, and after it our good-bye
        super().close()
        self._flush(last_words=True)
        carrier, self._carrier = self._carrier, None
        if carrier is not None:
            carrier.close()

    # Firmware drops what comes too soon after a new connection (PROTOCOL.md 4): its subscriptions last, but data wait.

    def _begin_grace(self) -> None:
        if self._subscribers.keys() - self._lapsed:
            self._limit = -1
            self._grace = self._space.loop.call_later(GRACE / _SECOND, self._end_grace)

    def _end_grace(self) -> None:
        if self._grace is not None:
            self._grace.cancel()
            self._grace = None
            self._limit = self._buffer
            if self.up and self._carrier is not None:  # else what waits for room is lost with the connection
                self.made_room()

    def _send_at_once(self, line: bytes) -> None:
        if not self._corked:
            self._corked = True
            self._space.loop.call_soon(self._uncork)
        self._send(line)

    def _uncork(self) -> None:
        self._corked = False
        try:
            self._flush()
        except Exception as error:  # noqa: BLE001 - counted and logged
            self.stats.lost.internal_error(error)
        if self.wait_queue:
            self.made_room()

    def _flush(self, *, last_words: bool = False) -> None:
        while self._waiting and (last_words or not self._blocked):
            self._send(self._next_piece())

    def _next_piece(self) -> bytes:
        if self._piecemeal:
            piece = (self._urgent or self._management or self._samples).popleft()
            self._waiting -= len(piece)
            return piece
        piece = b"".join([*self._urgent, *self._management, *self._samples])
        self._urgent.clear()
        self._management.clear()
        self._samples.clear()
        self._waiting = 0
        return piece

    def _send(self, data: bytes) -> None:
        if self._carrier is not None:
            self._unconfirmed.add(len(data), self._given)
            self._given = self.stats.sent - len(self._samples)
            self.stats.bytes_sent += len(data)
            self._carrier.send(data)

    def _count_unknown(self) -> None:
        """What the connection had taken, and the other end may not have got."""
        if self._carrier is not None and not self._closed:
            held = self._held is not None  # that one is lost
            unknown = self._unconfirmed.messages_in(self._carrier.unconfirmed, self._given) - held
            if unknown > 0:
                self.stats.lost["unknown at disconnect"] += unknown

    # The sample of a real-time publisher that the carrier could not send at once: it is on its way when all is sent.

    def _see_sent(self) -> None:
        if not self.up:
            self._lose_held()
        elif not self._blocked:
            self._held = None

    def _see_held_off(self) -> None:
        held, self._held = self._held, None
        if held is not None:
            topic, sample = held
            late = self._clock.now() - sample.deadline
            if sample.deadline and late > 0 and (publisher := self._publisher(topic, sample)) is not None:
                publisher.link_late(self.name, "sent late", late / _SECOND)

    def _lose_held(self) -> None:
        held, self._held = self._held, None
        if held is not None:
            self.stats.sent -= 1
            self.stats.lost[LINK_DOWN] += 1
            publisher = self._publisher(*held)
            if publisher is not None:
                publisher.link_missed(self.name, LINK_DOWN, sequence=held[1].sequence)

    def _publisher(self, topic: str, sample: Sample) -> PublisherHandle | None:
        where = self._space.topics.get(topic)
        return None if where is None else where.publisher_of(sample)

    # The loader's topic flows without a handshake while its module is in boot mode (PROTOCOL.md 5): that of a module at
    # the other end, or our own.

    def module_changed(self, module: str) -> None:
        topic = self._space.topics.get(LOADER_PREFIX + module)
        if topic is not None:
            self._match_loader(topic)

    def set_flags(self, flags: int) -> None:
        super().set_flags(flags)
        self.module_changed(self._space.module)

    def topic_changed(self, topic: Topic) -> None:
        super().topic_changed(topic)
        if topic.name.startswith(LOADER_PREFIX):
            self._match_loader(topic)

    def _match_loader(self, topic: Topic) -> None:
        name = topic.name
        if self._in_boot_mode(name.removeprefix(LOADER_PREFIX)):
            self._unasked.add(name)
            if not self._announced.get(name, NOTHING).publishes:
                self._remove_subscriber(name)
            elif name not in self._subscribers:
                self._add_subscriber(name)
            self._publisher_found(name, 0)
        elif name in self._unasked:
            self._unasked.remove(name)
            self._remove_subscriber(name)
            self.remove_publishers(name)

    def _in_boot_mode(self, module: str) -> bool:
        if module == self._space.module:
            return bool(self.discovery.flags & FLAG_BOOT)
        return is_booting(self, module)


class PublisherLookup:
    """The source of what comes in by a line, by topic; looked up anew when discovery has learnt something.

    Lines do not carry it: r2p modules announce which of their nodes publish a topic. A topic that none has announced
    comes from the only module at the other end, if there is only one.
    """

    def __init__(self, discovery: DiscoveryProtocol, link: str) -> None:
        self._discovery = discovery
        self._link = link
        self._sources: dict[str, Source] = {}
        self._generation = -1

    def source_of(self, topic: str) -> Source:
        """Empty names for what is not known, and for what may be one or another."""
        if self._generation != self._discovery.generation:
            self._generation = self._discovery.generation
            self._sources.clear()
        source = self._sources.get(topic)
        if source is None:
            source = self._sources[topic] = self._find(topic)
        return source

    def _find(self, topic: str) -> Source:
        modules = self._discovery.modules.values()
        names = {info.instance: info.name for info in modules if info.r2p}
        publishers = {
            (names.get(each.instance, ""), each.node)
            for each in self._discovery.endpoints.values()
            if each.topic == topic and each.role == ROLE_PUBLISHES
        }
        candidates = {module for module, _ in publishers} or {info.name for info in modules if not info.observer}
        module = candidates.pop() if len(candidates) == 1 else ""
        node = publishers.pop()[1] if len(publishers) == 1 else ""
        return Source(module, node, self._link)


_RECENT = 64
"""Pieces sent last of which each is known."""

_STEP = 4096
"""Bytes between two marks before those, for the last 512 kB at least."""

_LONG_STEP = 16 * _STEP
"""Bytes between two marks before those: 8 MB at least, more than a socket's buffers hold."""

_MARKS = 128


class UnconfirmedBytes:
    """How many messages the last bytes of a connection were: what may be lost when it breaks.

    The longer ago bytes were sent, the fewer of their positions are known, so memory stays small; where the position
    that is asked for is not known the answer is the count as of the known one before it.
    """

    def __init__(self) -> None:
        self._bytes = 0
        self._recent: deque[tuple[int, int]] = deque(maxlen=_RECENT)
        self._marks = _Marks()
        self._next = 0
        self._old = _Marks()
        self._next_old = 0

    def add(self, size: int, messages: int) -> None:
        """Note that `size` bytes are sent now, after `messages` messages."""
        position = self._bytes
        self._recent.append((position, messages))
        if position >= self._next:
            self._mark(position, messages)
        self._bytes = position + size

    def _mark(self, position: int, messages: int) -> None:
        self._next = position + _STEP
        self._marks.add(position, messages)
        if position >= self._next_old:
            self._next_old = position + _LONG_STEP
            self._old.add(position, messages)

    def messages_in(self, last: int, messages: int) -> int:
        """How many messages the `last` bytes were, at most; `messages` have been sent by now."""
        if not last or not self._recent:
            return 0
        begin = self._bytes - last
        for position, before in reversed(self._recent):
            if position <= begin:
                return messages - before
        for marks in (self._marks, self._old):
            if (found := marks.before(begin)) is not None:
                return messages - found
        return messages - self._old.oldest


class _Marks:
    """How many messages had been sent before a byte, at every so many bytes: the last 128 to 256 of them."""

    def __init__(self) -> None:
        self.positions = array("Q")
        self._before = array("Q")

    def add(self, position: int, messages: int) -> None:
        if len(self.positions) == 2 * _MARKS:
            del self.positions[:_MARKS], self._before[:_MARKS]
        self.positions.append(position)
        self._before.append(messages)

    def before(self, position: int) -> int | None:
        """As of the mark there or just before it; None: that is forgotten."""
        index = bisect_right(self.positions, position)
        return self._before[index - 1] if index else None

    @property
    def oldest(self) -> int:
        return self._before[0]
