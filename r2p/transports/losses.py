"""What a link drops: counted by reason, and told at debug level, in one place for all who count."""

import logging
from collections import Counter

from r2p.clock import Clock
from r2p.printable import get_logger

logger = get_logger("r2p.link")

_APART = 1_000_000_000
"""Ns between two lines about one reason."""


class Losses(Counter[str]):
    """A counter that logs each reason when its number grows, at most once a second; free while nothing is dropped."""

    def __init__(self, link: str, clock: Clock) -> None:
        super().__init__()
        self._link = link
        self._clock = clock
        self._told: dict[str, int] = {}

    def __setitem__(self, reason: str, count: int) -> None:
        grown = count > self[reason]
        super().__setitem__(reason, count)
        if grown and logger.isEnabledFor(logging.DEBUG):
            now = self._clock.monotonic()
            if now - self._told.get(reason, -_APART) >= _APART:
                self._told[reason] = now
                logger.debug("link %s drops: %s (%d so far)", self._link, reason, count)
