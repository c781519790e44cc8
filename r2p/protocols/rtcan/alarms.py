"""Timers of which the next one is known at no cost: it is asked for after every frame, and seldom changes."""

from collections.abc import Hashable, Iterator

from r2p.protocols.rtcan.events import NEVER
from r2p.protocols.schedule import Timers


class Alarms(Timers):
    """As `Timers`, and remembers when the next key runs out."""

    def __init__(self) -> None:
        super().__init__()
        self._next_due = NEVER
        self._stale = False

    @property
    def due(self) -> int:
        """When the next key runs out; NEVER if there is none."""
        if self._stale:
            due = super().next()
            self._next_due = NEVER if due is None else due
            self._stale = False
        return self._next_due

    def set(self, key: Hashable, due: int) -> None:
        self._stale = True
        super().set(key, due)

    def clear(self, key: Hashable) -> None:
        self._stale = True
        super().clear(key)

    def pop(self, now: int) -> Iterator[Hashable]:
        self._stale = True
        yield from super().pop(now)
        self._stale = True
