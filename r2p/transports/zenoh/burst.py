"""What goes out in one turn of the event loop: the first message at once, the others together when the turn is over.

Each message that zenoh is given wakes a thread of its own, which sends what is there by then. Given one after the other
without a pause they go out in a few large packets; each for itself, waking costs both ends as much as all the rest.
"""

import asyncio
from collections.abc import Callable

from r2p.room import LINK_DOWN
from r2p.transports.intake import LinkStats

Put = Callable[..., None]
"""zenoh's `Publisher.put(data, *, attachment)`."""

MOST = 64
"""Messages that wait for the end of a turn."""


def nowhere(data: bytes, *, attachment: bytes) -> None:
    """There is no session."""


class Burst:
    """The messages of all topics of one link."""

    def __init__(self, loop: asyncio.AbstractEventLoop, stats: LinkStats, error: type[Exception]) -> None:
        self._loop = loop
        self._stats = stats
        self._error = error
        self.begun = False
        """Whether something was sent in this turn of the loop; what comes now may be put into `waiting`."""
        self.waiting: list[tuple[Put, bytes, bytes]] = []

    def add(self, put: Put, data: bytes, header: bytes, *, urgent: bool) -> None:
        """Send it, with the others of this turn unless it is `urgent`; zenoh drops it where the network is too slow."""
        if self.begun and not urgent:
            self.waiting.append((put, data, header))
            if len(self.waiting) >= MOST:
                self.flush()
            return
        if not self.begun:
            self.begun = True
            self._loop.call_soon(self._end)
        self._send([(put, data, header)])

    def flush(self) -> None:
        """Send what waits."""
        waiting, self.waiting = self.waiting, []
        self._send(waiting)

    def discard(self) -> int:
        """Forget what waits; says how much that was."""
        waiting, self.waiting = self.waiting, []
        return len(waiting)

    def _end(self) -> None:
        self.begun = False
        if self.waiting:
            self.flush()

    def _send(self, messages: list[tuple[Put, bytes, bytes]]) -> None:
        lost = size = 0
        for put, data, header in messages:
            try:
                put(data, attachment=header)
                size += len(data)
            except self._error:
                lost += 1
        stats = self._stats
        stats.sent += len(messages) - lost
        stats.bytes_sent += size
        if lost:
            stats.lost[LINK_DOWN] += lost
