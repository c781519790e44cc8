"""Recognise messages that come again: after a repetition, by another link, or by another gateway.

Both ways go by sequence number and stamp, as a publisher that has started again counts anew. `LastReceived` is for a
publisher whose start is known, so its messages never go back: whatever is not newer than the last one is dropped, and
order is kept. A gateway does not know the start, and the clock of a module without a battery may go back with it, so
`DuplicateFilter` drops only what it has seen: else all messages of such a module would be lost behind the gateway.
"""

import msgspec

from r2p.runtime.sample import Sample

_KEPT = 64  # messages of each publisher
_PUBLISHERS = 1024


class LastReceived(msgspec.Struct, eq=False, weakref=True):
    """The last message of a remote publisher, by whatever way it came."""

    sequence: int = 0
    stamp: int = 0

    def accept(self, sequence: int, stamp: int) -> bool:
        """Enter a message; False if it, or a later one, was here before. Messages without a number are all new."""
        if sequence and sequence <= self.sequence and stamp <= self.stamp:
            return False
        self.sequence = sequence
        self.stamp = stamp
        return True


class DuplicateFilter:
    """The last messages of all publishers of a topic, by number and stamp."""

    def __init__(self) -> None:
        self._stamps: dict[tuple[str, str], list[int]] = {}

    def accept(self, sample: Sample) -> bool:
        """Enter a message that has a number; False if it was here before."""
        source = sample.source
        key = (source.module, source.node)
        stamps = self._stamps.get(key)
        if stamps is None:
            if len(self._stamps) >= _PUBLISHERS:
                self._stamps.clear()
            stamps = self._stamps[key] = [0] * _KEPT
        place = sample.sequence % _KEPT
        if stamps[place] == sample.stamp:
            return False
        stamps[place] = sample.stamp
        return True
