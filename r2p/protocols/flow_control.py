"""Credit-based flow control from end to end: a publisher never runs further ahead of a subscriber than its window.

Each message of a session on a topic in one class has a serial number. A subscriber's session grants credit: it reports
the last serial that its queues accepted, and its window says how many more may be on the way. A publisher waits for a
subscriber that grants nothing, and skips it when it has waited long enough; the subscriber's next credit ends that.
Missing serials also show losses on the way.

Where messages may be long, bytes are limited as well, by the publisher, who knows the sizes of its messages: to
BYTES_MAX on the way, or four messages. So that it need not wait long, a subscriber grants credit also for each
CREDIT_BYTES of messages above UNCOUNTED_BYTES.
"""

from collections import deque

import msgspec

from r2p.codecs.attachment import SERIAL_WRAP

NO_LIMIT = 1 << 62
"""A serial that is never reached: no subscriber has a window."""

SHARE = 1024
"""Messages from one credit to the next without a window. When a link breaks, this many messages at most are
of unknown fate, beside those that were on the way.
"""

BYTES_MAX = 192 * 1024
"""Bytes on the way to the slowest subscriber from which on nothing more is sent: five topics at full speed fit into
zenoh's own queue of 1 MB. A message counts as a quarter of this at most, so four large ones may be on their way, or
wait for one another.
"""

CREDIT_BYTES = 16 * 1024
"""Bytes of accepted messages from one credit to the next. A longer message is granted credit at once."""

UNCOUNTED_BYTES = 1024
"""Bytes of the longest message that does not count: the window is enough to limit such messages."""

_HALF = SERIAL_WRAP // 2 + 1  # a distance of this or more is one backwards


class _SubscriberWindow(msgspec.Struct):
    """One remote subscriber. `joined_at` and `acknowledged` are serials; `answered`: it has granted credit."""

    window: int
    acknowledged: int
    joined_at: int
    answered: bool = False
    waited_for: bool = True
    leaving: bool = False


class SendWindow:
    """The messages sent on one topic in one class, and how far each subscriber has come."""

    def __init__(self) -> None:
        self.serial = 0
        """The last serial sent. It has more than 32 bits, so that comparing needs no wrap."""
        self.limit = NO_LIMIT
        """The last serial for which all subscribers have room, except skipped ones."""
        self.subscribers: dict[int, _SubscriberWindow] = {}
        """Windows by session."""
        self._bytes: deque[tuple[int, int]] = deque()  # serials whose bytes are on the way, and what they count as
        self._bytes_sum = 0

    def add_bytes(self, size: int) -> None:
        """Count the bytes of the last message, on a topic whose messages may be long."""
        if size > UNCOUNTED_BYTES:
            size = min(size, BYTES_MAX // 4)
            self._bytes.append((self.serial, size))
            self._bytes_sum += size
            if self._bytes_sum >= BYTES_MAX:
                self._update()

    def rewind(self, count: int) -> None:
        """Take back the last serials, whose messages are not sent."""
        self.serial -= count
        if self._bytes:
            self._update()

    def add(self, session: int, window: int) -> None:
        """Add a subscriber, or change its window; 0: never wait for it."""
        known = self.subscribers.get(session)
        if known is None:
            # Earlier messages were not for this subscriber, so they count as acknowledged.
            self.subscribers[session] = _SubscriberWindow(window, self.serial, self.serial)
        elif known.window != window:  # it need not have granted anything for what went out before
            known.window = window
            known.acknowledged = self.serial
        self._update()

    def remove(self, session: int) -> int:
        """Remove a subscriber; return how many messages it did not acknowledge. One that left in order wants none."""
        known = self.subscribers.pop(session, None)
        self._update()
        return 0 if known is None or known.leaving else max(0, self.serial - known.acknowledged)

    def set_leaving(self, session: int, *, leaving: bool) -> None:
        """Note whether a subscriber has ended its subscription; one that grants credit again is back."""
        known = self.subscribers.get(session)
        if known is not None:
            known.leaving = leaving

    def acknowledge(self, session: int, serial: int) -> int:
        """Note that a subscriber has accepted everything up to this serial (its low 32 bits); return that of all it
        has accepted so far, or 0 if it does not subscribe.
        """
        known = self.subscribers.get(session)
        if known is None:
            return 0
        behind = (self.serial - serial) & SERIAL_WRAP
        if behind < _HALF:  # else it was never sent: a credit of an earlier run, or a forged one
            known.acknowledged = max(known.acknowledged, self.serial - behind)  # one credit may overtake another
            known.answered = known.waited_for = True
        self._update()
        return known.acknowledged

    def skip_full(self) -> list[int]:
        """Stop waiting for subscribers without room, until their next credit; return their sessions."""
        skipped = []
        for session, each in self.subscribers.items():
            if each.window and each.waited_for and self._is_full(each):
                each.waited_for = False
                skipped.append(session)
        self._update()
        return skipped

    def _is_full(self, subscriber: _SubscriberWindow) -> bool:
        if self._bytes_sum >= BYTES_MAX and subscriber.acknowledged < self._bytes[0][0]:
            return True
        return self.serial >= subscriber.acknowledged + subscriber.window

    def unacknowledged(self) -> list[int]:
        """Return the sessions that got messages, and have not answered since they joined."""
        return [
            session for session, each in self.subscribers.items() if not each.answered and self.serial > each.joined_at
        ]

    @property
    def accepted(self) -> int:
        """The last serial that all subscribers have accepted, except skipped ones, and those without a window."""
        waited_for = [each.acknowledged for each in self.subscribers.values() if each.window and each.waited_for]
        return min(waited_for, default=self.serial)

    def _update(self) -> None:
        self.limit = NO_LIMIT
        acknowledged = self.serial
        for each in self.subscribers.values():
            if each.window and each.waited_for:
                self.limit = min(self.limit, each.acknowledged + each.window)
                acknowledged = min(acknowledged, each.acknowledged)
        if self._bytes:
            self._limit_bytes(acknowledged)

    def _limit_bytes(self, acknowledged: int) -> None:
        counted = self._bytes
        while counted and counted[0][0] <= acknowledged:
            self._bytes_sum -= counted.popleft()[1]
        while counted and counted[-1][0] > self.serial:
            self._bytes_sum -= counted.pop()[1]
        if self._bytes_sum >= BYTES_MAX:
            self.limit = min(self.limit, self.serial)


class ReceiveWindow:
    """The messages received from one session on one topic in one class."""

    def __init__(self, size: int) -> None:
        self.size = size
        """Messages on the way, at most; 0: any number."""
        self.next_serial = -1
        """The expected serial; -1: any."""
        self.until_credit = 1
        """Messages that the queues accept before credit is granted; the first message is answered at once."""
        self._apart = 1
        """Messages from the next credit to the one after it, but for `_share`: one of the first may be lost."""
        self._bytes_until_credit = CREDIT_BYTES

    def advance(self, serial: int) -> int:
        """Expect the next serial; return how many are missing before this one, or -1 if it arrived before."""
        ahead = (serial - self.next_serial) & SERIAL_WRAP if self.next_serial >= 0 else 0
        if ahead >= _HALF:
            return -1
        self.next_serial = (serial + 1) & SERIAL_WRAP
        return ahead

    def resize(self, size: int) -> None:
        """Change the window. Sender and receiver count anew from there."""
        self.size = size
        self.until_credit = min(self.until_credit, self._share)

    def restart(self) -> None:
        """Answer the next message at once: a sender that is gone will have forgotten this receiver if it returns."""
        self.until_credit = self._apart = 1

    def skip(self, count: int) -> None:
        """Count lost messages towards the next credit, so that it is in time."""
        self.until_credit = max(1, self.until_credit - count)

    def accept(self, size: int, count: int = 1) -> bool:
        """Count messages of this size that the queues accepted; return whether credit is to be granted for them."""
        self.until_credit -= count
        if size > UNCOUNTED_BYTES:
            self._bytes_until_credit -= size * count
        return self.until_credit <= 0 or self._bytes_until_credit <= 0

    def credit_sent(self) -> None:
        """Start to count towards the next credit."""
        self.until_credit = min(self._apart, self._share)
        self._apart = min(2 * self._apart, SHARE)
        self._bytes_until_credit = CREDIT_BYTES

    @property
    def _share(self) -> int:
        """Messages from one credit to the next: a quarter of the window, so that the sender need not stop for it."""
        return max(1, self.size // 4) if self.size else SHARE
