"""Timers by key, for protocols that are asked for their next deadline (`next`) and given the time (`pop`).

A heap with late deletion: setting a key to a later time, as each renewed lease does, leaves its old place in the heap.
That place is corrected when it comes up.
"""

import heapq
from collections.abc import Hashable, Iterator

from r2p.units import NEVER


class KeyedTimers:
    """Keys that expire. Setting a key later costs nothing: its place in the heap is corrected when it comes up."""

    def __init__(self) -> None:
        self.due = NEVER
        """Expiry of the next key (ns), or NEVER. Kept up to date: an RTCAN engine reads it after each frame."""
        self._due: dict[Hashable, int] = {}
        self._heap: list[tuple[int, int, Hashable]] = []
        self._pushed = 0

    def __contains__(self, key: Hashable) -> bool:
        return key in self._due

    def set(self, key: Hashable, due: int) -> None:
        """Let a key expire at `due` (ns), earlier or later than before; NEVER: it stays until it is cleared."""
        before = self._due.get(key)
        self._due[key] = due
        if before is None or due < before:
            self._push(key, due)
        elif before != self.due:  # as each renewed lease: another key is the first one, and stays it
            return
        self._update()

    def clear(self, key: Hashable) -> None:
        if self._due.pop(key, None) == self.due:
            self._update()

    def next(self) -> int | None:
        """Return when the next key expires (ns)."""
        return self.due if self.due < NEVER else None

    def put_off(self, until: int) -> None:
        """Let no key expire before `until` (ns)."""
        self._due = {key: max(due, until) for key, due in self._due.items()}
        self._update()

    def pop(self, now: int) -> Iterator[Hashable]:
        """Yield the expired keys, and clear each."""
        while self.due <= now:
            key = heapq.heappop(self._heap)[2]
            self.clear(key)
            yield key

    def _update(self) -> None:
        """Correct the places in the heap up to the first valid one."""
        while self._heap:
            self.due, _, key = self._heap[0]
            due = self._due.get(key)
            if due == self.due:
                return
            heapq.heappop(self._heap)
            if due is not None and due > self.due:
                self._push(key, due)
        self.due = NEVER

    def _push(self, key: Hashable, due: int) -> None:
        if due >= NEVER:
            return
        if len(self._heap) > 2 * len(self._due) + 64:  # keys that come and go: their old places would pile up
            self._heap = [(at, n, each) for n, (each, at) in enumerate(self._due.items()) if at < NEVER]
            heapq.heapify(self._heap)
            self._pushed = len(self._heap)
            return
        self._pushed += 1
        heapq.heappush(self._heap, (due, self._pushed, key))
