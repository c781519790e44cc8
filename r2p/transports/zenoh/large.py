"""Large messages on their way to zenoh: a thread hands them over, one at a time, at the network's pace.

zenoh cuts a message above 64 kB into fragments, and waits for room in its queue for them: too long for the event loop.
And it drops the whole message if the queue has no room for the first fragment within a millisecond, without a word.
So the next large message goes to zenoh only when a subscriber has confirmed the ones before it: then the queue is
empty. In shared memory there is room for more; unless a subscriber further away is slow, which is where a router would
drop them.
"""

import asyncio
import functools
from collections import Counter, deque
from collections.abc import Callable, Collection

import msgspec
import zenoh

from r2p.protocols.flow_control import SendWindow
from r2p.runtime.backpressure import LINK_DOWN
from r2p.runtime.sample import PublisherClass
from r2p.transports.stats import LoggedCounter
from r2p.transports.zenoh.threads import OutboundThread

LARGE = 16 * 1024
"""Bytes above which a packet is large. That is far below what zenoh sends as one piece, so the loop hands over only
what goes out in one piece.
"""

WAITING_MAX = 2
"""Packets of one topic and class that wait for the thread; more wait at their publisher."""

_UNCONFIRMED_MAX = 1 << 20  # bytes of large packets that no subscriber has confirmed: what zenoh's queue holds
_UNCONFIRMED_SHARED_MAX = 8 << 20  # ... through shared memory: half of zenoh's pool
_SLOWEST = 10e6  # bytes/s: packets not confirmed after the time that this takes may be lost, and the next one is sent
_QUICK = 64e6  # bytes/s: zenoh's queue gets room for the next fragment within the millisecond that it waits
_DIRECT_MAX = 1 << 20  # bytes that are copied into shared memory in 0.2 ms: a thread would take longer to wake up
_KEPT_BYTES = 31 << 20
_SUBMITTED_MAX = 2  # packets that the thread has, so that it need not wait for the loop


class LargePacket(msgspec.Struct, eq=False):
    """A packet that waits for the thread. `put` is zenoh's; `serial` is that of its last message; `sent_at` is in
    seconds of the loop's clock.
    """

    window: SendWindow
    publisher_class: PublisherClass
    serial: int
    count: int
    data: bytes
    header: bytes
    put: Callable[..., None]
    sent_at: float = 0.0


class LargeSender:
    """The large packets of one link, and those behind them on the same topic."""

    def __init__(self, loop: asyncio.AbstractEventLoop, lost: LoggedCounter) -> None:
        self.on_wait: Callable[[], object] = lambda: None
        """Called when a packet waits for credit of the packets before it."""
        self.on_room: Callable[[], object] = lambda: None
        """Called when a packet has been handed to zenoh."""
        self._loop = loop
        self._lost = lost
        self._thread: OutboundThread | None = None
        self._calls: OutboundThread | None = None
        self._queues: dict[PublisherClass, deque[LargePacket]] = {each: deque() for each in reversed(PublisherClass)}
        self._waiting: Counter[SendWindow] = Counter()  # packets, with the one in the thread
        self._submitted: deque[LargePacket] = deque()
        self._unconfirmed: list[LargePacket] = []
        self._last: dict[SendWindow, LargePacket] = {}  # until all subscribers have it
        self._quick: set[SendWindow] = set()  # whose last packet all subscribers had at this rate
        self.shared = False
        """True if all of the session's connections use shared memory."""
        self._timer: asyncio.TimerHandle | None = None

    def connect(self, thread: OutboundThread, calls: OutboundThread) -> None:
        """Use this thread. `calls` may have a thread that makes the other calls of the session."""
        self._thread = thread
        self._calls = calls

    def accepts(self, window: SendWindow, size: int) -> bool:
        """Return whether a packet is to be sent from here: it is large, or others are in front of it."""
        return (
            size > LARGE
            or window in self._waiting
            or (self._calls is not None and self._calls.uses_thread)  # two threads would not keep the order
        )

    def is_full(self, window: SendWindow) -> bool:
        """Return whether the next packet has to wait at its publisher."""
        return self._waiting[window] >= WAITING_MAX

    def send(self, packet: LargePacket) -> None:
        """Send a packet when those before it are out."""
        self._queues[packet.publisher_class].append(packet)
        self._waiting[packet.window] += 1
        self._send_next()

    def confirm(self, window: SendWindow, serial: int) -> None:
        """Note that a subscriber has everything up to this serial."""
        last = self._last.get(window)
        if last is not None and window.accepted >= last.serial:
            del self._last[window]
            quick = len(last.data) >= _QUICK * (self._loop.time() - last.sent_at)
            (self._quick.add if quick else self._quick.discard)(window)
        if self._unconfirmed:
            self._unconfirmed = [
                each for each in self._unconfirmed if each.window is not window or each.serial > serial
            ]
            self._send_next()

    def discard(self) -> int:
        """Drop the packets that wait, and return the number of their messages. Later ones get their serials."""
        count = 0
        for queue in self._queues.values():
            while queue:
                packet = queue.pop()
                packet.window.rewind(packet.count)
                self._release(packet)
                count += packet.count
        self._unconfirmed.clear()
        self._last.clear()
        self._quick.clear()
        self._stop_timer()
        return count

    def flush(self, windows: Collection[SendWindow]) -> None:
        """Hand the packets of these windows to the thread, before their publishers are undeclared in it."""
        if self._thread is None:
            return
        for queue in self._queues.values():
            for packet in [packet for packet in queue if packet.window in windows]:
                queue.remove(packet)
                self._release(packet)
                self._thread.submit(functools.partial(_put, packet))

    def close(self) -> None:
        """Hand all packets to the thread: the session ends when it is done."""
        self.flush(list(self._waiting))
        self._stop_timer()
        self._thread = None

    def _send_next(self) -> None:
        """Send packets, the most urgent first, as long as the thread is idle, and the network has room."""
        while self._thread is not None and len(self._submitted) < _SUBMITTED_MAX:
            packet = next((queue[0] for queue in self._queues.values() if queue), None)
            if packet is None:
                return
            if not self._has_room(packet):
                self._wait()
                return
            self._stop_timer()
            self._queues[packet.publisher_class].popleft()
            self._submit(packet, self._thread)

    def _submit(self, packet: LargePacket, thread: OutboundThread) -> None:
        """Hand a packet to the thread; or to zenoh itself, if that takes no longer than to pack it took."""
        if len(packet.data) > LARGE:
            self._unconfirmed.append(packet)  # first, as credit may be here before the thread's answer
            packet.sent_at = self._loop.time()
            keep_freed_memory()
            self._last.setdefault(packet.window, packet)
        if self.shared and len(packet.data) <= _DIRECT_MAX and not self._submitted:
            self._release(packet)
            self._count(packet, _put(packet))
        else:
            self._submitted.append(packet)
            thread.submit(functools.partial(_put, packet), then=self._sent)

    def _has_room(self, packet: LargePacket) -> bool:
        if not self._unconfirmed:
            return True
        most = _UNCONFIRMED_SHARED_MAX if self.shared and packet.window in self._quick else _UNCONFIRMED_MAX
        return sum([len(each.data) for each in self._unconfirmed]) + len(packet.data) <= most

    def _wait(self) -> None:
        """Wait for credit, or until the packets on their way would be there if they were not lost."""
        if self._timer is None:
            seconds = sum([len(each.data) for each in self._unconfirmed]) / _SLOWEST
            self._timer = self._loop.call_later(seconds, self._give_up)
            self.on_wait()

    def _give_up(self) -> None:
        self._timer = None
        self._unconfirmed.clear()
        self._send_next()

    def _stop_timer(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _sent(self, done: bool | None) -> None:
        packet = self._submitted.popleft()
        self._release(packet)
        self._count(packet, done)
        self._send_next()
        self.on_room()

    def _count(self, packet: LargePacket, done: bool | None) -> None:
        if not done:  # the session is closed; another error is counted by the thread as well
            self._lost[LINK_DOWN] += packet.count

    def _release(self, packet: LargePacket) -> None:
        self._waiting[packet.window] -= 1
        if not self._waiting[packet.window]:
            del self._waiting[packet.window]


@functools.cache
def keep_freed_memory() -> None:
    """Let glibc keep up to 64 MB of freed memory for the next large messages, from the first one on.

    By default it returns each such block to Linux, and gets it back page by page: 250 page faults for 1 MB, which take
    longer than all else. Freeing one block of nearly 32 MB raises its threshold; elsewhere this does nothing.
    """
    bytes(_KEPT_BYTES)


def _put(packet: LargePacket) -> bool:
    """Hand a packet to zenoh, in the thread; return False if the session is closed."""
    try:
        packet.put(packet.data, attachment=packet.header)
    except zenoh.ZError:
        return False
    return True
