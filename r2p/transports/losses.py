"""What a link drops: counted by reason, and told at debug level, in one place for all who count.

Also what a link does about mistakes of r2p itself. Bytes from a wire never raise; should a message raise nevertheless,
it is lost, and those behind it must not be. So everything that handles one item after the other catches what an item
raises, passes it to `internal_error`, and goes on with the next one.
"""

import logging
from collections import Counter, deque
from collections.abc import Callable, Iterable
from typing import Any, ParamSpec, TypeVar

from r2p.clock import Clock, clock_of
from r2p.line_limit import LineLimit
from r2p.printable import get_logger

logger = get_logger("r2p.link")

TRY_AGAIN = 100_000_000
"""Ns after which a timer goes off again whose work raised; else a deadline that is over would be tried without end."""

_LINES = 1
"""Lines of the log in a second about one reason."""

_TRACEBACK = "traceback"

T = TypeVar("T")
P = ParamSpec("P")


class Losses(Counter[str]):
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
        """The handling of an item, or of `count` messages, raised: count them, log the traceback once a second."""
        self["internal error"] += count
        more = self._limit.suffix(_TRACEBACK, self._clock.monotonic())
        if more is not None:
            text = "link %s: internal error (%d so far), please report it%s"
            logger.error(text, self._link, self["internal error"], more, exc_info=error)

    def guard(self, call: Callable[P, object], *args: P.args, **kwargs: P.kwargs) -> bool:
        """Call it; False if it raised."""
        try:
            call(*args, **kwargs)
        except Exception as error:  # noqa: BLE001 - counted and logged
            self.internal_error(error)
            return False
        return True

    def drain(self, items: deque[T], handle: Callable[[T], Any], most: int) -> None:
        """Take items out and handle them, in order, `most` of them at most: those that are there now."""
        for _ in range(min(len(items), most)):
            item = items.popleft()
            try:
                handle(item)
            except Exception as error:  # noqa: BLE001 - counted and logged; the next one follows
                self.internal_error(error)


def internal_error_of(all_losses: Iterable[Losses], error: Exception) -> None:
    """Something raised that concerns several links: counted at each, as each may lack what was to be done."""
    for losses in all_losses:
        losses.internal_error(error)
