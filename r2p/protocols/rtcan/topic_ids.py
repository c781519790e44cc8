"""High bytes for topics (PROTOCOL.md 6).

Firmware subscribers look at the high byte of a message id and nothing else, so no two topics on a bus may share one,
and all publishers of one topic have to: the one with the lowest id8 leads, or firmware, which can't use another. The
name decides which byte to try first: modules that don't know of each other then seldom choose the same one.

The high bytes of others are learnt from their ADVERTISE and SUBSCRIBE_RESPONSE. That is a lease: it ends when it is not
repeated, and at once when the module announces another id for the topic, or another topic for the id.
"""

import zlib
from collections.abc import Callable
from typing import TypeVar

import msgspec

from r2p.codecs import rtcan
from r2p.units import LONG_AGO, SECOND

_COUNT = rtcan.HIGH_MAX + 1 - rtcan.FIRST_TOPIC
_LEASE = 300 * SECOND  # at least: two turns of the slow ring in the largest crowd that a bus can have
_ROUNDS = 2  # that may be missed on a slow bus
_MESSAGES = 2  # of one topic in a round: its type and its ADVERTISE
K = TypeVar("K")
V = TypeVar("V")


class _AnnouncedId(msgspec.Struct, eq=False):
    """The topic of another module's message id. `until`: the end of the lease (monotonic ns)."""

    topic: str
    firmware: bool
    until: int = LONG_AGO


class TopicIdAllocator:
    """The high bytes in use on one bus: this module's by topic, others' with at most one topic for each message id."""

    def __init__(self, alias: Callable[[str], str] = str) -> None:
        """`alias` returns what travels for the name of a topic; from that, the first byte to try follows."""
        self.refused: set[str] = set()
        """Topics of this module without a high byte."""
        self._alias = alias
        self._lease = _LEASE
        self._ours: dict[str, int] = {}
        self._announced: dict[int, _AnnouncedId] = {}  # by message id; the lease that ends first comes first
        self._topics: dict[int, dict[int, str]] = {}  # by high byte and id8
        self._messages: dict[str, dict[int, int]] = {}  # message ids by topic and id8
        self._freed = False

    def set_rate(self, rate: float) -> None:
        """Set how many announcements a second modules on this bus make: a lease lasts for the longest round."""
        self._lease = max(_LEASE, round(_ROUNDS * _MESSAGES * _COUNT / rate * SECOND))

    def pick(self, topic: str) -> int | None:
        """Return the high byte of a topic of this module, the same at each call; None if all are in use."""
        high = self._ours.get(topic)
        if high is not None:
            return high
        leader = self._leader(topic)
        first = zlib.crc32(self._alias(topic).encode())
        tried = [rtcan.FIRST_TOPIC + (first + step) % _COUNT for step in range(_COUNT)]
        for high in tried if leader is None else [rtcan.high_byte(leader), *tried]:
            if self._free(high, topic):
                self._ours[topic] = high
                self.refused.discard(topic)
                return high
        self.refused.add(topic)
        return None

    def drop(self, topic: str) -> None:
        """Give back the high byte of a topic that this module no longer publishes."""
        self._ours.pop(topic, None)

    def on_announced(self, now: int, topic: str, message: int, own_id8: int, *, firmware: bool = False) -> list[str]:
        """Note the message id of another module's topic; return the own topics that need another high byte now.

        Of two modules that picked the same one for different topics, or different ones for the same topic, the one with
        the lower id8 keeps it; `firmware` always does.
        """
        self._forget_ended(now)
        self._note(now, topic, message, firmware=firmware)
        if not firmware and rtcan.id8_of(message) >= own_id8:
            return []
        high = rtcan.high_byte(message)
        moved = [ours for ours, byte in self._ours.items() if byte == high and ours != topic]
        for ours in moved:
            del self._ours[ours]
        mine = self._ours.get(topic)
        if mine not in (None, high) and self._leader(topic) == message and self._free(high, topic):
            del self._ours[topic]
            moved.append(topic)
        return moved

    def topics(self, own_id8: int) -> dict[int, str]:
        """Return all topics on the bus that are known, by message id; those of this module under its id8."""
        ours = {rtcan.message_id(high, own_id8): topic for topic, high in self._ours.items()}
        return {message: each.topic for message, each in self._announced.items()} | ours

    def on_module_gone(self, id8: int) -> None:
        """Forget the module with this id8, which left."""
        for message in [each for each in self._announced if rtcan.id8_of(each) == id8]:
            self._forget(message)

    def retry(self, now: int) -> list[str]:
        """Return own topics without a high byte that may get one now."""
        self._forget_ended(now)
        freed, self._freed = self._freed, False
        return list(self.refused) if freed else []

    def __len__(self) -> int:
        """Return the number of message ids of others that are known."""
        return len(self._announced)

    def _free(self, high: int, topic: str) -> bool:
        """Return whether no module uses the high byte for another topic."""
        if high < rtcan.FIRST_TOPIC or high in self._ours.values():
            return False
        return all(other == topic for other in self._topics.get(high, {}).values())

    def _leader(self, topic: str) -> int | None:
        """Return the message id of the other publisher of a topic whose high byte all of them use."""
        messages = self._messages.get(topic, {})
        return min(
            messages.values(),
            key=lambda message: (not self._announced[message].firmware, rtcan.id8_of(message)),
            default=None,
        )

    def _note(self, now: int, topic: str, message: int, *, firmware: bool) -> None:
        id8 = rtcan.id8_of(message)
        known = self._announced.pop(message, None)
        if known is not None and known.topic != topic:
            self._announced[message] = known
            self._forget(message)
            known = None
        before = self._messages.get(topic, {}).get(id8)
        if before is not None and before != message:
            self._forget(before)
        if known is None:
            known = _AnnouncedId(topic, firmware)
            self._topics.setdefault(rtcan.high_byte(message), {})[id8] = topic
            self._messages.setdefault(topic, {})[id8] = message
        known.until = now + self._lease
        self._announced[message] = known

    def _forget_ended(self, now: int) -> None:
        while self._announced:
            message, oldest = next(iter(self._announced.items()))
            if now < oldest.until:
                return
            self._forget(message)

    def _forget(self, message: int) -> None:
        high, id8 = rtcan.high_byte(message), rtcan.id8_of(message)
        topic = self._announced.pop(message).topic
        _remove(self._topics, high, id8)
        _remove(self._messages, topic, id8)
        self._freed = True


def _remove(table: dict[K, dict[int, V]], key: K, id8: int) -> None:
    inner = table[key]
    del inner[id8]
    if not inner:
        del table[key]
