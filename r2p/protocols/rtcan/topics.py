"""High bytes for topics: which one a publisher takes (PROTOCOL.md 6).

Firmware subscribers look at the high byte of a message id and nothing else, so no two topics on a bus may share one.
The name decides which byte to try first: modules that know nothing of each other then seldom meet, and publishers of
one topic mostly take the same. What others use is learnt from their SUBSCRIBE_RESPONSE.
"""

import zlib

from r2p.codecs import rtcan

_COUNT = 0x100 - rtcan.FIRST_TOPIC


class HighBytes:
    """The high bytes in use on one bus: ours by topic, and those of others with their topics."""

    def __init__(self) -> None:
        self._ours: dict[str, int] = {}
        self._others: dict[int, dict[int, str]] = {}  # by high byte: topics by id8

    def pick(self, topic: str) -> int | None:
        """The high byte of our topic, always the same one. None: all are in use."""
        high = self._ours.get(topic)
        if high is not None:
            return high
        first = zlib.crc32(topic.encode())
        for step in range(_COUNT):
            high = rtcan.FIRST_TOPIC + (first + step) % _COUNT
            if high not in self._ours.values() and not self._taken(high, topic):
                self._ours[topic] = high
                return high
        return None

    def drop(self, topic: str) -> None:
        """We don't publish it any more."""
        self._ours.pop(topic, None)

    def heard(self, topic: str, message: int, own_id8: int) -> str | None:
        """A module publishes a topic with this message id. Comes back: our topic that has to take another high byte.

        Of two modules that picked the same one for different topics, the one with the lower id8 keeps it.
        """
        high, id8 = rtcan.high_byte(message), rtcan.id8_of(message)
        self._others.setdefault(high, {})[id8] = topic
        for ours, byte in self._ours.items():
            if byte == high and ours != topic and id8 < own_id8:
                del self._ours[ours]
                return ours
        return None

    def gone(self, id8: int) -> None:
        """A module left."""
        for topics in self._others.values():
            topics.pop(id8, None)

    def _taken(self, high: int, topic: str) -> bool:
        return any(other != topic for other in self._others.get(high, {}).values())
