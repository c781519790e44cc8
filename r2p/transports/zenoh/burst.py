"""What goes out when: the first message at once, the others together when the turn of the event loop is over.

Each packet that zenoh is given wakes threads at both ends, which takes longer than a message. So a flood goes out every
few turns, and as soon as it ends.
"""

import asyncio

from r2p.transports.intake import LinkStats
from r2p.transports.zenoh.lane import MOST, Lane

TURNS = 12
"""Turns of the loop in which messages of a flood wait for more of them, at most."""

FLOOD = 8
"""Messages in one turn that make a flood; what comes more slowly goes out when its turn is over."""


class Burst:
    """The messages of all topics of one link."""

    def __init__(
        self, loop: asyncio.AbstractEventLoop, stats: LinkStats, error: type[Exception], *, batching: bool
    ) -> None:
        self._loop = loop
        self._batching = batching
        self._stats = stats
        self._error = error
        self._begun = False
        self._turns = 0
        self._count = 0
        self._lanes: dict[Lane, None] = {}

    def add(self, lane: Lane) -> None:
        """A message waits in a lane that was empty, or as many as may wait there: send them in good time."""
        if not self._begun:
            self._begun = True
            self._loop.call_soon(self._end)
        elif not lane.urgent and len(lane.waiting) < MOST:
            self._lanes[lane] = None
            return
        lane.send(self._stats, self._error, batching=self._batching)

    def send(self, lane: Lane) -> None:
        """Send what waits in this one."""
        if self._lanes.pop(lane, lane) is None:
            lane.send(self._stats, self._error, batching=self._batching)

    def flush(self) -> None:
        """Send what waits."""
        lanes, self._lanes = self._lanes, {}
        self._turns = self._count = 0
        for lane in lanes:
            lane.send(self._stats, self._error, batching=self._batching)

    def discard(self) -> int:
        """Forget what waits; says how much that was. Subscribers need not miss it, too, so its serials come again."""
        lanes, self._lanes = self._lanes, {}
        count = sum(len(lane.waiting) for lane in lanes)
        for lane in lanes:
            lane.flow.serial -= len(lane.waiting)
            lane.waiting.clear()
        return count

    def _end(self) -> None:
        """A turn is over: send what waits, unless it becomes more and more."""
        count = sum([len(lane.waiting) for lane in self._lanes])
        self._begun = count > 0
        if self._begun:
            self._loop.call_soon(self._end)
        self._turns += 1
        if self._batching and count >= self._count + FLOOD and self._turns < TURNS:
            self._count = count
        else:
            self.flush()
