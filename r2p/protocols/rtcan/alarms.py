"""Timers of which the next one is known at no cost: it is asked for after every frame, and seldom changes."""

from collections.abc import Hashable, Iterator

from r2p.protocols.rtcan.events import NEVER
from r2p.protocols.schedule import Timers


class Alarms(Timers):
    """As `Timers`, and remembers when the next key runs out."""

    def __init__(self) -> None:
        super().__init__()
        self.due = NEVER
        """When the next key runs out; NEVER if there is none."""

    def set(self, key: Hashable, due: int) -> None:
        super().set(key, due)
        self._look()

    def clear(self, key: Hashable) -> None:
        super().clear(key)
        self._look()

    def pop(self, now: int) -> Iterator[Hashable]:
        for key in super().pop(now):
            self._look()
            yield key

    def _look(self) -> None:
        due = self.next()
        self.due = NEVER if due is None else due
