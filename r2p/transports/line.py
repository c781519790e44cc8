"""The debug line: lines of ASCII (PROTOCOL.md 3) to and from one other end, over any carrier of bytes.

The first line written in a turn of the event loop is sent at once, the others of that turn in one piece; to one of many
clients of a server, all of them go in one piece. While the carrier (TCP connection, serial port) takes no more, lines
wait here, where management can overtake samples. Those of real-time publishers never wait: each is sent at once, before
all waiting ones, or its publisher keeps it and watches the time. A carrier is attached while it lives. The link
outlasts it, and so do its subscriptions and counters.

`UnconfirmedBytes` finds out how many messages a broken connection may have lost.
"""

import abc
import asyncio
import contextlib
from array import array
from bisect import bisect_right
from collections import deque
from collections.abc import Hashable
from typing import TYPE_CHECKING, Any, ClassVar

import msgspec

from r2p.codecs import debug, management, own_services
from r2p.codecs.management import FLAG_BOOT
from r2p.errors import MessageError
from r2p.keys import SharedKey
from r2p.names import LOADER_PREFIX, MANAGEMENT, module_alias
from r2p.protocols.discovery.negotiation import GRACE
from r2p.protocols.keys import LinkEnd
from r2p.runtime.backpressure import LINK_DOWN
from r2p.runtime.sample import PublisherClass, Sample
from r2p.runtime.topic import Topic
from r2p.transports.announcement import NOTHING
from r2p.transports.buffered_link import TOO_LONG, BufferedLink, SenderLookup
from r2p.transports.guard import LineGate
from r2p.transports.link import Hub
from r2p.units import SECOND

if TYPE_CHECKING:
    from collections.abc import Callable

BUFFER = 64 * 1024
"""Bytes that wait for a busy connection before its publishers have to wait or lose messages."""

_MANAGEMENT_BUFFER = 8 * 1024  # bytes more, for management only
_URGENT_MAX = 96  # urgent messages that wait, whatever else does: another 8 KiB
_CLOSING_S = 0.5  # seconds for the other end to read what is still buffered: a program that ends must not hang
_MANAGEMENT = MANAGEMENT.encode()
_NRT = PublisherClass.NON_REAL_TIME


class Carrier(abc.ABC):
    """A connection that carries the bytes of a line link.

    A carrier calls `carrier_full()` of its link when it holds bytes that could not be sent at once, and
    `carrier_ready()` when it has none left; in between it gets nothing but the last lines before `close()`.
    """

    flow_controlled: ClassVar[bool] = False
    """True if the other end waits while nothing is read, without losing anything."""

    unconfirmed = 0
    """Return the number of bytes sent that the other end has not confirmed, as far as known when the carrier breaks."""

    @abc.abstractmethod
    def send(self, data: bytes) -> None:
        """Send the bytes, and hold those that can't be sent at once."""

    @abc.abstractmethod
    def pause(self) -> None:
        """Stop reading for now."""

    @abc.abstractmethod
    def resume(self) -> None:
        """Go on reading."""

    @abc.abstractmethod
    def close(self) -> None:
        """Send held bytes, as far as the other end reads them, and close."""


class Connection(Carrier):
    """A carrier that can break. Its transport waits for its end, and closes it."""

    def __init__(self) -> None:
        self.ended = asyncio.Event()
        """An event that is set once the connection is gone for good, or was never made."""

    @abc.abstractmethod
    def abort(self) -> None:
        """Close at once; do nothing if it is closed."""

    async def aclose(self) -> None:
        """Close, and wait for the end; bytes that the other end does not read soon are not sent."""
        self.close()
        try:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(_CLOSING_S):
                    await self.ended.wait()
        finally:
            self.abort()
        await self.ended.wait()


class _NewStamp(msgspec.Struct, frozen=True, gc=False):
    """A mark among lines that wait for delivery: the lines behind it arrived at `received_at` (UTC, ns).

    Bytes hardly ever arrive while lines wait, so a mark is cheaper than a stamp on each line.
    """

    received_at: int
    topic: bytes = b""  # no line has an empty topic, so `BufferedLink` leaves the mark to `receive_other`
    data: bytes = b""


class LineLink(BufferedLink):
    """A link over the debug line.

    `buffer` bytes may wait for the carrier. With `piecemeal` the carrier gets one line at a time, so that at most one
    line can no longer be overtaken or discarded.
    """

    max_payload: ClassVar[int] = debug.PAYLOAD_MAX
    point_to_point: ClassVar[bool] = True

    def __init__(
        self, name: str, hub: Hub, *, management_rate: float = 250.0, buffer: int = BUFFER, piecemeal: bool = False
    ) -> None:
        super().__init__(name, hub, management_rate=management_rate)
        self._reader = debug.Reader(self.stats.lost)
        self._encoders: dict[str, Callable[[bytes, int], bytes]] = {}
        self._senders = SenderLookup(self.discovery, self.name)
        self._received_at = 0  # when the bytes of the line that is delivered next came in (UTC, ns)
        self._carrier: Carrier | None = None
        self._urgent: deque[bytes] = deque()
        self._management: deque[bytes] = deque()
        self._samples: deque[bytes] = deque()
        self._buffered_bytes = 0  # bytes in these three queues
        self._corked = False  # whether lines wait for the end of this turn of the loop
        self._answering = False  # whether an answer to a subscriber is among them
        self._blocked = False  # whether the carrier is full
        self._limit = self._buffer = buffer  # bytes that may wait; -1 while samples have to wait for the grace period
        self._grace: asyncio.TimerHandle | None = None
        self._piecemeal = piecemeal
        self._unconfirmed = UnconfirmedBytes()
        self._messages_given = 0  # samples that have been given to carriers, as `stats.sent` counts them
        self._unsent: tuple[str, Sample] | None = None
        """The sample of a real-time publisher that the carrier has not sent entirely, and its topic."""
        self._gate: LineGate | None = None
        self._loader_topics: set[str] = set()  # those that flow without a handshake now

    def use_key(self, key: SharedKey | None, end: LinkEnd = LinkEnd.SERIAL) -> None:
        super().use_key(key, end)
        if self.guard is not None:
            self._gate = LineGate(self._space, self.guard, self._open, self._deny_key)

    def _deny_key(self, reason: int, text: str) -> None:
        """Report that the other end has not proven the key, and let it know the reason (DENIED_..., 0: it does)."""
        if reason:
            name = module_alias(self._space.module)
            self.write_management(management.encode(management.Denied(name, name, 0, reason)), urgent=True)
        self.refuse_key(text)

    # For the carrier

    def connect(self, carrier: Carrier) -> None:
        """Use this carrier from now on: its connection is up."""
        if self._closed:
            carrier.close()
            return
        self._carrier = carrier
        self._blocked = False
        self._reader = debug.Reader(self.stats.lost)
        self._unconfirmed = UnconfirmedBytes()
        self._messages_given = self.stats.sent
        self._send(debug.OPENING)
        if self._carrier is not carrier:  # it broke at the first bytes
            return
        if self._gate is None:
            self._open()
        else:
            self._gate.connected(at_once=carrier.flow_controlled)

    def _open(self) -> None:
        """Begin to exchange messages: the connection is up, and its other end has proven the key, if there is one."""
        if self._gate is not None:
            self.denied, self.key_refused = False, ""
        if self.lossless:
            self._apply(self.discovery.set_lossless(self._clock.monotonic()))
        self._begin_grace()
        self.on_up()

    def _begin_session(self) -> None:
        """Do nothing: with a key, the session has begun with the connection."""

    def disconnect(self, reason: str) -> None:
        """Give up the carrier: its connection has ended."""
        self._count_unknown()
        self._carrier = None
        self._end_grace()
        if self._gate is not None:
            self._gate.close()
        self.on_down(reason)
        if self._gate is not None:
            self._clear_buffer()  # of what proves the key: it is of use for this connection only
        self._lose_unsent()  # after `on_down`, so that it counts as lost in this outage

    def feed(self, data: bytes | memoryview) -> None:
        """Deliver the messages in received bytes."""
        self.stats.bytes_received += len(data)
        received_at = self._clock.now()
        try:
            lines = self._reader.feed(bytes(data))
        except Exception as error:  # noqa: BLE001 - counted and logged; the other lines follow
            self.stats.lost.internal_error(error)
            lines = self._readable_lines(bytes(data))
        if self._gate is not None and not self._gate.is_open:  # else data would pass by subscriptions of before
            lines = [line for line in lines if line.topic == _MANAGEMENT]
        if self._arrivals:  # lines of an earlier connection, say: they keep their stamp
            self.receive([_NewStamp(received_at)])
        else:
            self._received_at = received_at
        self.receive(lines)

    def _readable_lines(self, data: bytes) -> list[debug.Line]:
        """Return all lines but the one whose reading raised, each read separately."""
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
        """Stop giving data to the carrier: it holds bytes that it could not send."""
        self._blocked = True

    def carrier_ready(self) -> None:
        """Go on with waiting lines: the carrier has sent all its bytes."""
        self._blocked = False
        self.stats.lost.guard(self._report_late)
        self.made_room()  # before the bytes that wait fill the carrier again
        if not self._corked:
            self._uncork()

    # For `BufferedLink`

    def key(self, topic: str) -> bytes:
        return self.discovery.alias(topic).encode()

    @property
    def full(self) -> bool:
        return self._buffered_bytes >= self._limit

    def has_room_for(self, sample: Sample) -> bool:
        if sample.publisher_class == _NRT:
            return self._buffered_bytes < self._limit
        return not self._blocked and self._limit >= 0

    def write(self, topic: str, sample: Sample) -> None:
        due = sample.due
        deadline = due // 1000 if due else sample.stamp // 1000 + debug.NO_DEADLINE
        try:
            encode = self._encoders[topic]
        except KeyError:
            encode = self._encoders[topic] = debug.encoder(self.key(topic), empty=topic in self.varying)
        try:
            line = encode(sample.data, deadline)
        except MessageError:  # a topic of another link, with messages of any size, or one whose length varies
            self.count_unsendable(topic, sample, TOO_LONG if sample.data else "impossible message")
            return
        self.stats.sent += 1
        real_time = sample.publisher_class != _NRT
        if self._blocked or (not real_time and (self._corked or self._is_corked())):
            self._samples.append(line)
            self._buffered_bytes += len(line)
            if self._buffered_bytes >= self._limit:
                self._flush()
            return
        if not real_time:
            self._send_at_once(line)
            return
        if self._answering:  # a latched value must not overtake the answer to its subscriber
            self._flush()
        self._unsent = topic, sample  # before it is sent: it is lost if the carrier breaks by it
        self._send_at_once(line)
        if not self.up:
            self._lose_unsent()
        elif not self._blocked:  # else it is on its way only when the carrier is ready again
            self._unsent = None

    def write_call(self, data: bytes, to: Hashable) -> None:
        self._write_first(own_services.topic_of(data), data)

    def write_management(self, data: bytes, *, urgent: bool = False) -> None:
        self._write_first(_MANAGEMENT, data, urgent=urgent)

    def _write_first(self, topic: bytes, data: bytes, *, urgent: bool = False) -> None:
        """Send a line before waiting samples, an `urgent` one before all."""
        if len(self._urgent) >= _URGENT_MAX if urgent else self._buffered_bytes >= self._limit + _MANAGEMENT_BUFFER:
            self.stats.lost["management, send buffer full"] += 1
            return
        deadline = self._clock.now() // 1000 + debug.NO_DEADLINE
        line = debug.encode(topic, data, deadline)
        if not (self._is_corked() or self._blocked):
            self._send_at_once(line)
            return
        self._buffered_bytes += len(line)
        (self._urgent if urgent else self._management).append(line)
        if topic == _MANAGEMENT and management.type_of(data) == management.ManagementType.SUBSCRIBE_RESPONSE:
            self._answering = True

    def manage(self, data: bytes, source: Hashable) -> None:
        if self._gate is None or self._gate.is_open:
            super().manage(data, source)
        else:
            self._gate.receive(data, source)

    def sample(self, topic: str, arrival: debug.Line) -> Sample:
        return Sample(arrival.data, self._senders.source(topic), self._received_at, stamped=False)

    def receive_other(self, arrival: Any) -> None:
        if isinstance(arrival, _NewStamp):
            self._received_at = arrival.received_at
        else:
            super().receive_other(arrival)

    def discard(self) -> int:
        discarded = len(self._samples)
        self.stats.sent -= discarded
        if self._urgent:  # other management is repeated
            self.stats.lost["orders not sent"] += len(self._urgent)
        self._clear_buffer()
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
        if self._gate is not None:
            self._gate.close()
        self._end_grace()
        self._flush(closing=True)  # the carrier gets all that waits, and after it the announcement of the end
        super().close()
        self._flush(closing=True)
        carrier, self._carrier = self._carrier, None
        if carrier is not None:
            carrier.close()

    def _remove_subscriber(self, name: str) -> None:
        super()._remove_subscriber(name)
        self._encoders.pop(name, None)

    # Firmware drops messages too soon after a new connection (PROTOCOL.md 4). Its subscriptions outlast the old one, so
    # samples wait for as long.

    def _begin_grace(self) -> None:
        if self._subscribers.keys() - self._lapsed:
            self._limit = -1
            self._grace = self._space.loop.call_later(GRACE / SECOND, self._end_grace)

    def _end_grace(self) -> None:
        if self._grace is not None:
            self._grace.cancel()
            self._grace = None
            self._limit = self._buffer
            if self.up and self._carrier is not None:  # else what waits for room is lost with the connection
                self.made_room()

    # The send buffer. The fewer pieces the better: each is a system call, which takes longer than all else here.

    @property
    def gathers(self) -> bool:
        """Return whether the first line of a turn goes in one piece with the others, too, instead of at once."""
        return False

    def _is_corked(self) -> bool:
        """Return whether lines wait for the end of this turn."""
        if not self._corked and self.gathers:
            self._cork()
        return self._corked

    def _cork(self) -> None:
        self._corked = True
        self._space.loop.call_soon(self._uncork)

    def _send_at_once(self, line: bytes) -> None:
        if not self._corked:
            self._cork()
        self._send(line)

    def _uncork(self) -> None:
        self._corked = self._answering = False
        try:
            self._flush()
        except Exception as error:  # noqa: BLE001 - counted and logged
            self.stats.lost.internal_error(error)
        if self.wait_queue:
            self.made_room()

    def _flush(self, *, closing: bool = False) -> None:
        while self._buffered_bytes and (closing or not self._blocked):
            self._send(self._next_piece())

    def _next_piece(self) -> bytes:
        if self._piecemeal:
            piece = (self._urgent or self._management or self._samples).popleft()
            self._buffered_bytes -= len(piece)
            return piece
        piece = b"".join([*self._urgent, *self._management, *self._samples])
        self._clear_buffer()
        return piece

    def _clear_buffer(self) -> None:
        self._urgent.clear()
        self._management.clear()
        self._samples.clear()
        self._buffered_bytes = 0

    def _send(self, data: bytes) -> None:
        if self._carrier is not None:
            self._unconfirmed.add(len(data), self._messages_given)
            self._messages_given = self.stats.sent - len(self._samples)
            self.stats.bytes_sent += len(data)
            self._carrier.send(data)

    def _count_unknown(self) -> None:
        """Count messages that the connection had accepted, and the other end may not have received."""
        if self._carrier is not None and not self._closed:
            lost = self._unsent is not None  # that one certainly is, and is counted as such
            unknown = self._unconfirmed.messages_in(self._carrier.unconfirmed, self._messages_given) - lost
            if unknown > 0:
                self.stats.lost["unknown at disconnect"] += unknown

    # A real-time sample that the carrier could not send at once: it is on its way only when all its bytes are sent.

    def _report_late(self) -> None:
        unsent, self._unsent = self._unsent, None
        if unsent is not None:
            topic, sample = unsent
            late = self._clock.now() - sample.deadline
            if sample.deadline and late > 0 and (publisher := self.publisher_of(topic, sample)) is not None:
                publisher.link_late(self.name, "sent late", late / SECOND)

    def _lose_unsent(self) -> None:
        unsent, self._unsent = self._unsent, None
        if unsent is not None:
            self.stats.sent -= 1
            self.stats.lost[LINK_DOWN] += 1
            publisher = self.publisher_of(*unsent)
            if publisher is not None:
                publisher.link_missed(self.name, LINK_DOWN, sequence=unsent[1].sequence)

    # The loader's topic flows without a handshake while its module is in boot mode (PROTOCOL.md 5): that of a module at
    # the other end, or this module itself.

    def module_changed(self, module: str) -> None:
        topic = self._space.topics.get(LOADER_PREFIX + module)
        if topic is not None:
            self._match_loader(topic)

    def set_flags(self, flags: int) -> None:
        super().set_flags(flags)
        self.module_changed(self._space.module)

    def topic_changed(self, topic: Topic) -> None:
        self._encoders.pop(topic.name, None)  # it may take empty messages from now on, or no longer
        super().topic_changed(topic)
        if topic.name.startswith(LOADER_PREFIX):
            self._match_loader(topic)

    def _match_loader(self, topic: Topic) -> None:
        name = topic.name
        module = name.removeprefix(LOADER_PREFIX)
        is_own = module == self._space.module
        in_boot_mode = bool(self.discovery.flags & FLAG_BOOT) if is_own else self.discovery.is_booting(module)
        if in_boot_mode:
            self._loader_topics.add(name)
            if not self._announced.get(name, NOTHING).publishes:
                self._remove_subscriber(name)
            elif name not in self._subscribers:
                self._add_subscriber(name)
            self._publisher_found(name, 0)
        elif name in self._loader_topics:
            self._loader_topics.remove(name)
            self._remove_subscriber(name)
            self.remove_publishers(name)


_RECENT_MAX = 64  # pieces sent last; the position of each is known
_MARKS = 128  # marks that are known before those, at each step: as many at least, and up to twice as many
_STEP = 4096  # bytes between two marks: the last 512 kB
_LONG_STEP = 16 * _STEP  # bytes between two marks before those: 8 MB, more than a socket's buffers hold


class UnconfirmedBytes:
    """The number of messages in the last bytes of a connection, which may be lost when it breaks.

    The longer ago bytes were sent, the fewer of their positions are known, so memory stays small; for an unknown
    position the answer is the count as of the known one before it.
    """

    def __init__(self) -> None:
        self._bytes = 0
        self._recent: deque[tuple[int, int]] = deque(maxlen=_RECENT_MAX)
        self._marks = _Marks(_STEP)
        self._old_marks = _Marks(_LONG_STEP)

    def add(self, size: int, messages: int) -> None:
        """Note that `size` bytes are sent now, after `messages` messages."""
        position = self._bytes
        self._recent.append((position, messages))
        if position >= self._marks.next:  # seldom, and this is done for each piece
            self._marks.add(position, messages)
            if position >= self._old_marks.next:
                self._old_marks.add(position, messages)
        self._bytes = position + size

    def messages_in(self, last: int, messages: int) -> int:
        """Return how many messages are in the `last` bytes, at most; `messages` have been sent by now."""
        if not last or not self._recent:
            return 0
        begin = self._bytes - last
        for position, before in reversed(self._recent):
            if position <= begin:
                return messages - before
        for marks in (self._marks, self._old_marks):
            index = bisect_right(marks.positions, begin)
            if index:
                return messages - marks.messages[index - 1]
        return messages - self._old_marks.messages[0]


class _Marks:
    """The number of messages that had been sent before a byte, at every `step` bytes."""

    def __init__(self, step: int) -> None:
        self._step = step
        self.next = 0
        """The position of the next mark."""
        self.positions = array("Q")
        self.messages = array("Q")

    def add(self, position: int, messages: int) -> None:
        if len(self.positions) == 2 * _MARKS:
            del self.positions[:_MARKS], self.messages[:_MARKS]
        self.next = position + self._step
        self.positions.append(position)
        self.messages.append(messages)
