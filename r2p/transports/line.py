"""The debug line: one other end that speaks in lines of ASCII (PROTOCOL.md 3), whatever carries the bytes.

Lines that are written in one turn of the event loop go out in one piece. A carrier (TCP connection, serial port) is
attached while it lives; the link stays over reconnects, so its subscriptions and counters do too.
"""

import abc
from collections.abc import Callable, Iterable
from typing import ClassVar

from r2p.codecs import debug
from r2p.codecs.management import FLAG_BOOT
from r2p.names import LOADER_PREFIX, MANAGEMENT
from r2p.protocols.events import Event, ModuleChanged
from r2p.sample import Sample
from r2p.transports.intake import Inlet
from r2p.transports.link import Hub, Link

BUFFER = 64 * 1024
"""Bytes that wait for a connection that takes no more, before its publishers have to wait or lose."""

OPENING = b"\r\n\r\n"
"""Ends whatever the reader at the other end has begun to read."""

_NO_DEADLINE = 0x7FFFFFFF
_WRAP = 0xFFFFFFFF


class Carrier(abc.ABC):
    """A connection that carries the bytes of a line link."""

    @abc.abstractmethod
    def send(self, data: bytes) -> None:
        """Send, or buffer what can't be sent at once; may call the link's `carrier_full` and `carrier_ready`."""

    @abc.abstractmethod
    def pause(self) -> None:
        """Read no more for now."""

    @abc.abstractmethod
    def resume(self) -> None:
        """Read on."""

    @abc.abstractmethod
    def close(self) -> None:
        """Send what is buffered, as far as it goes at once, and close."""


class LineLink(Link):
    """A link over the debug line."""

    longest: ClassVar[int] = 255

    def __init__(self, name: str, hub: Hub, *, management_rate: float = 250.0, buffer: int = BUFFER) -> None:
        super().__init__(name, hub, management_rate=management_rate)
        self._reader = debug.Reader(self.stats.lost)
        self._encoders: dict[str, Callable[[bytes, int], bytes]] = {}
        self._carrier: Carrier | None = None
        self._lines: list[bytes] = []
        self._waiting = 0
        self._limit = buffer
        self._blocked_carrier = False
        self._stamp = 0

    # Carrier

    def connected(self, carrier: Carrier) -> None:
        """Bytes flow from now on."""
        self._carrier = carrier
        self._blocked_carrier = False
        self._reader = debug.Reader(self.stats.lost)
        carrier.send(OPENING)
        if self._carrier is carrier:  # else it broke at the first bytes
            self.went_up()

    def disconnected(self, reason: str) -> None:
        """Bytes do not flow any more."""
        self._carrier = None
        self.went_down(reason)

    def fed(self, data: bytes | memoryview) -> None:
        """Bytes came in."""
        self.stats.bytes_received += len(data)
        self._stamp = self._clock.now()
        self.take(self._reader.feed(bytes(data)))

    def carrier_full(self) -> None:
        self._blocked_carrier = True

    def carrier_ready(self) -> None:
        self._blocked_carrier = False
        if not self.full:
            self._made_room()

    # Link

    @property
    def full(self) -> bool:
        return self._blocked_carrier or self._waiting >= self._limit

    def write(self, topic: str, sample: Sample) -> None:
        self.stats.sent += 1
        deadline = sample.deadline // 1000 if sample.deadline else sample.stamp // 1000 + _NO_DEADLINE
        try:
            encode = self._encoders[topic]
        except KeyError:
            encode = self._encoders[topic] = debug.encoder(topic.encode())
        self._put(encode(sample.data, deadline & _WRAP))

    def write_management(self, data: bytes) -> None:
        if self._blocked_carrier:
            self.stats.lost["management"] += 1
            return
        deadline = self._clock.now() // 1000 + _NO_DEADLINE
        self._put(debug.encode(MANAGEMENT.encode(), data, deadline & _WRAP))

    def sample(self, inlet: Inlet, arrival: debug.Line) -> Sample:
        return Sample(arrival.data, inlet.source, self._stamp, stamped=False)

    def discard(self) -> int:
        discarded = len(self._lines)
        self._lines.clear()
        self._waiting = 0
        return discarded

    def pause(self) -> None:
        if self._carrier is not None:
            self._carrier.pause()

    def resume(self) -> None:
        if self._carrier is not None:
            self._carrier.resume()

    def close(self) -> None:
        super().close()
        if self._carrier is not None:
            self._flush()
            self._carrier.close()

    def _put(self, line: bytes) -> None:
        if not self._lines:
            self._space.loop.call_soon(self._flush)
        self._lines.append(line)
        self._waiting += len(line)

    def _flush(self) -> None:
        if not self._lines:
            return
        data = b"".join(self._lines)
        self._lines.clear()
        self._waiting = 0
        if self._carrier is None:
            return
        self.stats.bytes_sent += len(data)
        self._carrier.send(data)
        if self._room and not self.full:
            self._made_room()

    # A module in boot mode takes and gives its loader topic without a handshake (PROTOCOL.md 5).

    def _apply(self, events: Iterable[Event]) -> None:
        events = list(events)
        super()._apply(events)
        for event in events:
            if isinstance(event, ModuleChanged) and event.info.flags & FLAG_BOOT:
                self._attach(LOADER_PREFIX + event.info.name)
                self._open(LOADER_PREFIX + event.info.name, 0)
