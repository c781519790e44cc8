"""The counters of a link: messages, bytes and connections, and by reason what it dropped.

All losses are counted in the link's `LoggedCounter`, which also logs them within limits: so code that drops messages
needs no logger, and a flood of bad messages can't fill the log.
"""

import logging
from collections import Counter, deque
from collections.abc import Callable, Iterable
from typing import Any, ParamSpec, TypeVar

import msgspec

from r2p.clock import Clock, clock_of
from r2p.log_lines import LineLimit, get_logger
from r2p.runtime.backpressure import INTERNAL_ERROR

logger = get_logger("r2p.link")

RETRY_AFTER_ERROR = 100_000_000
"""Ns until a timer whose work raised goes off again: otherwise a past deadline would be tried without end."""

_LINES = 1  # lines of the log in a second about one reason

_TRACEBACK = "traceback"

T = TypeVar("T")
P = ParamSpec("P")


class LoggedCounter(Counter[str]):
    """A counter that logs each reason when its number grows, at most once a second; free while nothing is dropped."""

    def __init__(self, link: str = "", clock: Clock | None = None) -> None:
        """`link` is its name, for the log; `clock` by default that of the running event loop."""
        super().__init__()
        self._link = link
        self._clock = clock or clock_of()
        self._limit = LineLimit(_LINES)

    def __setitem__(self, reason: str, count: int) -> None:
        grown = count > self[reason]
        super().__setitem__(reason, count)
        if grown and logger.isEnabledFor(logging.DEBUG):
            more = self._limit.suffix(reason, self._clock.monotonic())
            if more is not None:
                logger.debug("link %s drops: %s (%d so far)%s", self._link, reason, count, more)

    def internal_error(self, error: Exception, count: int = 1) -> None:
        """Count an item, or `count` messages, whose handling raised; log the traceback once a second."""
        self[INTERNAL_ERROR] += count
        more = self._limit.suffix(_TRACEBACK, self._clock.monotonic())
        if more is not None:
            text = "link %s: internal error (%d so far), please report it%s"
            logger.error(text, self._link, self[INTERNAL_ERROR], more, exc_info=error)

    def guard(self, call: Callable[P, object], *args: P.args, **kwargs: P.kwargs) -> bool:
        """Call the function; return False if it raised."""
        try:
            call(*args, **kwargs)
        except Exception as error:  # noqa: BLE001 - counted and logged
            self.internal_error(error)
            return False
        return True

    def drain(self, items: deque[T], handle: Callable[[T], Any], most: int) -> None:
        """Pop and handle at most `most` of the present items, in order, but none that `handle` adds."""
        for _ in range(min(len(items), most)):
            item = items.popleft()
            try:
                handle(item)
            except Exception as error:  # noqa: BLE001 - counted and logged; the next one follows
                self.internal_error(error)


def count_internal_error(all_losses: Iterable[LoggedCounter], error: Exception) -> None:
    """Count an error that concerns several links at each of them."""
    for losses in all_losses:
        losses.internal_error(error)


class LinkStats(msgspec.Struct):
    """Counters of one link since it was opened. `lost` counts losses in both directions, by reason; `faults` counts
    what went wrong on the line or the bus, by kind, even if nothing was lost.

    `sent` are samples accepted by the line, the bus or its buffer, and not discarded there since.
    """

    sent: int = 0
    received: int = 0
    bytes_sent: int = 0
    bytes_received: int = 0
    ups: int = 0
    lost: LoggedCounter = msgspec.field(default_factory=LoggedCounter)
    faults: Counter[str] = msgspec.field(default_factory=Counter)
    least_laxity: dict[str, int] = {}
    """The least time to the deadline with which a message was on the bus, below 0 after it: ns by topic."""

    def add(self, other: "LinkStats", losses: Counter[str]) -> None:
        """Add the counts of another link; its `losses` include those of its discovery."""
        for name in ("sent", "received", "bytes_sent", "bytes_received", "ups"):
            setattr(self, name, getattr(self, name) + getattr(other, name))
        for reason, count in losses.items():
            dict.__setitem__(self.lost, reason, self.lost[reason] + count)  # without logging: that link has done it
        self.faults.update(other.faults)
