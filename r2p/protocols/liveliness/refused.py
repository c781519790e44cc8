"""Tokens that were refused as there were too many, and when to ask the network for them.

The network tells of each token once, so what was refused has to be asked for when there is room. Tokens that are
refused are not kept, only counted: memory stays bounded. To be asked for many tokens is work for a router, so it is
done when all of them have room, and at longer and longer intervals where that happens again and again.
"""

_FIRST = 5_000_000_000
"""Ns from when there is room until the tokens are asked for; twice as long each time."""

_LONGEST = 300_000_000_000
"""Ns that it may become, and without a look after which it is short again."""


class Refused:
    """How many of `most` tokens were refused. `spread` is a number that few modules share: they ask one by one."""

    def __init__(self, most: int, spread: int) -> None:
        self._enough = most // 4
        self._spread = spread % 256
        self._any = False
        self._count = 0
        self._look_at: int | None = None
        self._looking = False
        self._pause = _FIRST
        self._last: int | None = None

    def add(self, count: int = 1) -> None:
        """So many were refused."""
        self._any = True
        self._count += count

    def went(self) -> None:
        """A token is gone that was not kept."""
        self._count = max(0, self._count - 1)

    def clear(self) -> None:
        """All tokens are gone, and will be told of again."""
        self._any = False
        self._count = 0
        self._look_at = None

    def next_deadline(self) -> int | None:
        """When to call `due` (monotonic ns)."""
        return self._look_at

    def review(self, now: int, free: int) -> None:
        """There is room for so many tokens."""
        if self._looking or self._look_at is not None or not self._fits(free):
            return
        if self._last is not None and now - self._last >= _LONGEST:
            self._pause = _FIRST
        self._look_at = now + self._pause + self._pause * self._spread // 256

    def due(self, now: int, free: int) -> bool:
        """Whether to ask for the tokens now: then `answered` has to be called."""
        if self._look_at is None or now < self._look_at:
            return False
        self._look_at = None
        if not self._fits(free):
            return False
        self._any, self._count, self._looking = False, 0, True
        self._last, self._pause = now, min(2 * self._pause, _LONGEST)
        return True

    def answered(self, *, complete: bool) -> None:
        """All answers are there; if not `complete`, others may be missing."""
        self._looking = False
        self._count //= 2  # one that came meanwhile may also be among the answers; rather too few than too many
        self._any = self._any or not complete

    def _fits(self, free: int) -> bool:
        """The number of those refused is an estimate, so a lot of room is enough in any case."""
        return self._any and free >= min(max(self._count, 1), self._enough)
