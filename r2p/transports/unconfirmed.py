"""What a link has given to a connection, for the time when that breaks: how many messages its last bytes were."""

from array import array
from bisect import bisect_right
from collections import deque

_FINE = 64
"""Pieces given last, of which each is known."""

_STEP = 4096
"""Bytes between two marks before those, for the last 512 kB at least."""

_LONG_STEP = 16 * _STEP
"""Bytes between two marks before those: 8 MB at least, more than a socket takes."""

_MARKS = 128


class _Marks:
    """How many messages had been given before a byte, at every so many bytes: the last 128 to 256 of them."""

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


class UnconfirmedBytes:
    """The bytes and messages of one connection; the longer ago they were given, the fewer marks it keeps of them."""

    def __init__(self) -> None:
        self._bytes = 0
        self._fine: deque[tuple[int, int]] = deque(maxlen=_FINE)
        self._marks = _Marks()
        self._next = 0
        self._old = _Marks()
        self._next_old = 0

    def note(self, size: int, messages: int) -> None:
        """`size` bytes are given now; `messages` were given before them."""
        position = self._bytes
        self._fine.append((position, messages))
        if position >= self._next:
            self._mark(position, messages)
        self._bytes = position + size

    def _mark(self, position: int, messages: int) -> None:
        self._next = position + _STEP
        self._marks.add(position, messages)
        if position >= self._next_old:
            self._next_old = position + _LONG_STEP
            self._old.add(position, messages)

    def within(self, last: int, messages: int) -> int:
        """How many messages the last bytes were, at most; `messages` have been given by now."""
        if not last or not self._fine:
            return 0
        begin = self._bytes - last
        for position, before in reversed(self._fine):
            if position <= begin:
                return messages - before
        for marks in (self._marks, self._old):
            if (found := marks.before(begin)) is not None:
                return messages - found
        return messages - self._old.oldest
