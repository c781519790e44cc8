"""Messages that came in from zenoh on one topic and have no room: the one that is blocked, and those behind it.

A message waits in line at its sinks. After some turns of the event loop an event or a periodic message replaces an
older one. A message that does not expire waits for as long as it takes: its publisher learns that from the credit that
does not come.

Links whose topics share one line have `LinkBackpressure` instead (r2p.transports.receive_backpressure): there no
message may wait without a limit, and a reader that made no room once is not waited for again.
"""

import asyncio
from collections import deque
from collections.abc import Callable
from typing import Generic, TypeVar

from r2p.runtime.backpressure import Sink
from r2p.runtime.sample import PublisherClass, Sample
from r2p.transports.receive_backpressure import BlockedMessage, ReceiveBackpressure
from r2p.transports.stats import LoggedCounter

P = TypeVar("P")  # what is known of a message's publisher; it is only passed on

BACKLOG_MAX = 16_384
"""Messages that wait behind one that is blocked: what eight publishers may send meanwhile."""


class Backlog(ReceiveBackpressure, Generic[P]):
    """What waits for room on one topic.

    `deliver` gets each message when it has its turn, and None for the blocked one when that was placed; `resume` is
    called when reading may go on.
    """

    def __init__(
        self,
        loop: asyncio.AbstractEventLoop,
        lost: LoggedCounter,
        deliver: Callable[[P, int, Sample | None], None],
        resume: Callable[[], None],
    ) -> None:
        super().__init__(loop, lost)
        self.blocked: BlockedMessage | None = None
        self.holds = False
        """Whether the blocked message waits without a limit; reading goes on, and events overtake it."""
        self._deliver = deliver
        self._resume = resume
        self._blocked_serial: tuple[P, int]
        """Whose message is blocked, and its serial."""
        self._waiting: deque[tuple[P, int, Sample | None]] = deque()

    def block(self, publisher: P, serial: int, sample: Sample, sinks: list[Sink]) -> None:
        """Wait for room in these sinks."""
        self._blocked_serial = publisher, serial
        self.blocked = BlockedMessage(sample, sinks, self)

    def append(self, publisher: P, serial: int, sample: Sample | None) -> bool:
        """Put a message behind the others, or None in place of one that is only acknowledged. False if it is full."""
        if len(self._waiting) >= BACKLOG_MAX:
            return False
        self._waiting.append((publisher, serial, sample))
        return True

    def clear(self) -> int:
        """Drop everything; return how many messages waited behind the blocked one."""
        count = sum(sample is not None for _, _, sample in self._waiting)
        self._waiting.clear()
        blocked, self.blocked = self.blocked, None
        if blocked is not None:
            blocked.withdraw()
        return count

    def expired(self, message: BlockedMessage) -> None:
        if message.sample.publisher_class == PublisherClass.NON_REAL_TIME:
            message.hold()
            self.holds = True
            self._resume()
        else:
            for sink in message.withdraw():
                self.lost.guard(sink.force, message.sample)
            self.delivered()

    def delivered(self) -> None:
        if self.blocked is None:
            return  # all was dropped meanwhile
        self.blocked = None
        self._deliver(*self._blocked_serial, None)
        waiting = self._waiting
        while waiting and self.blocked is None:
            self._deliver(*waiting.popleft())
        if self.blocked is None:
            self.holds = False
            self._resume()
