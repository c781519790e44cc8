"""What takes part in the traffic of a bus: the controllers that listen, and those on their way out of bus-off."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, TypeVar

from r2p.codecs.can_bits import EXTENDED
from r2p.sim.can.controller import RECESSIVE_BITS

if TYPE_CHECKING:
    from collections.abc import Callable

    from r2p.sim.can.controller import CanController
    from r2p.sim.can.timeline import Timeline

_RECOVERY_SEQUENCES: Final = 128  # times 11 recessive bits, until a controller leaves bus-off
_CACHED_MAX: Final = 4096  # identifiers for which it is known which controllers they concern

K = TypeVar("K")
V = TypeVar("V")


class Listeners:
    """The live controllers in the order of their connection, and two caches: used for each frame, seldom changed."""

    def __init__(self) -> None:
        self.live: list[CanController] = []
        """Those that acknowledge frames."""
        self.silent: list[CanController] = []
        """Those that only listen."""
        self.audience = _Cache(self._find_audience)
        """By controller: its name, and the receivers and the silent listeners of frames that it sends alone."""
        self.concerned = _Cache(self._find_concerned)
        """The controllers that a good frame concerns; by the id of a `Frame`, by ~`wire_identifier` of others."""

    def join(self, controller: CanController) -> None:
        (self.silent if controller.node.listen_only else self.live).append(controller)
        self.audience.clear()
        self.concerned.clear()

    def leave(self, controller: CanController) -> None:
        for controllers in (self.live, self.silent):
            if controller in controllers:
                controllers.remove(controller)
                self.audience.clear()
                self.concerned.clear()

    def _find_audience(self, owner: CanController) -> tuple[tuple[str, ...], list[CanController], list[CanController]]:
        return (owner.name,), [each for each in self.live if each is not owner], self.silent.copy()

    def _find_concerned(self, key: int) -> list[CanController]:
        identifier = key | EXTENDED if key >= 0 else ~key
        return [each for each in (*self.live, *self.silent) if each.concerned(identifier)]


class _Cache(dict[K, V]):
    """Values that are found at the first look-up; a look-up costs no call after that, which counts for each frame."""

    def __init__(self, find: Callable[[K], V]) -> None:
        super().__init__()
        self._find = find

    def __missing__(self, key: K) -> V:
        if len(self) >= _CACHED_MAX:
            self.clear()
        value = self[key] = self._find(key)
        return value


class Recovery:
    """The controllers that are on their way out of bus-off: each counts 128 times 11 recessive bits in a row."""

    def __init__(self, timeline: Timeline, bit: int) -> None:
        self._timeline = timeline
        self._sequence = RECESSIVE_BITS * bit  # ns
        self.remaining: dict[CanController, int] = {}
        """Sequences that are left to count; while this is empty, `busy` and `free` need not be called."""
        self._since: dict[CanController, int] = {}  # from when on the bus was idle
        self._idle = 0  # counts changes between busy and idle: a timer from before a change does nothing

    def begin(self, controller: CanController, since: int) -> None:
        """Let this controller count from `since`, when the bus is idle."""
        if not self.remaining:
            self._idle += 1  # `busy` and `free` were not called, so older timers are void
        self.remaining[controller] = _RECOVERY_SEQUENCES
        self._since[controller] = since
        self._wait(controller)

    def forget(self, controller: CanController) -> bool:
        """Count no longer for this controller. False: it was not on its way out."""
        return self.remaining.pop(controller, None) is not None

    def busy(self, start: int) -> None:
        """Count the sequences up to the start of a frame."""
        self._idle += 1
        for controller in self.remaining:
            self.remaining[controller] -= max(0, start - self._since[controller]) // self._sequence

    def free(self, since: int) -> None:
        """Go on to count after a frame or an error frame, whose intermission ends at `since`."""
        self._idle += 1
        for controller in self.remaining:
            if self._since[controller] < since:  # the end of a frame and its intermission are one sequence
                self.remaining[controller] -= 1
            self._since[controller] = max(since, self._since[controller])
            self._wait(controller)

    def _wait(self, controller: CanController) -> None:
        when = self._since[controller] + max(0, self.remaining[controller]) * self._sequence
        self._timeline.at(when, self._check, controller, self._idle)

    def _check(self, controller: CanController, idle: int) -> None:
        if idle == self._idle and self.remaining.pop(controller, None) is not None:
            controller.rejoin()
