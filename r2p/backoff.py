"""How long to wait before the next try: longer each time, never the same for two who failed together."""

import random


class Backoff:
    """Delays from `first` to `longest` seconds, doubling, each shortened by up to a half at random."""

    def __init__(self, rng: random.Random, *, first: float = 0.1, longest: float = 2.0) -> None:
        self._rng = rng
        self._first = first
        self._longest = longest
        self._next = first

    def reset(self) -> None:
        self._next = self._first

    def slow_down(self) -> None:
        """Take the longest delay next."""
        self._next = self._longest

    def delay(self) -> float:
        """Seconds to wait now."""
        delay, self._next = self._next, min(self._next * 2, self._longest)
        return delay * self._rng.uniform(0.5, 1.0)
