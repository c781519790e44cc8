"""What a link has given to a connection, for the time when that breaks: how many messages its last bytes were."""

from collections import deque

_FINE = 64
"""Pieces given last, of which each is known."""

_COARSE = 4096
"""Bytes between two marks before those."""

_MARKS = 2048
"""Coarse marks: 8 MB, more than a socket takes."""


class HandedOver:
    """The bytes and messages of one connection; of what was given before it remembers every few kilobytes."""

    def __init__(self) -> None:
        self._bytes = 0
        self._fine: deque[tuple[int, int]] = deque(maxlen=_FINE)
        self._coarse: deque[tuple[int, int]] = deque(maxlen=_MARKS)
        self._next = 0

    def note(self, size: int, messages: int) -> None:
        """`size` bytes are given now; `messages` were given before them."""
        mark = self._bytes, messages
        self._fine.append(mark)
        if self._bytes >= self._next:
            self._coarse.append(mark)
            self._next = self._bytes + _COARSE
        self._bytes += size

    def within(self, last: int, messages: int) -> int:
        """How many messages the last bytes were, at most; `messages` have been given by now."""
        if not last or not self._fine:
            return 0
        begin = self._bytes - last
        for marks in (self._fine, self._coarse):
            for position, before in reversed(marks):
                if position <= begin:
                    return messages - before
        return messages - self._coarse[0][1]
