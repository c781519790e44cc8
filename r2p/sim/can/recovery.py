"""Out of bus-off: a controller comes back once it has seen 128 times 11 recessive bits in a row.

Every frame and every error frame ends with 11 of them, the intermission included; an idle bus has as many as fit.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from r2p.sim.can.controller import CanController
    from r2p.sim.can.timeline import Timeline

RECESSIVE: Final = 11
_TIMES: Final = 128


class Recovery:
    """The controllers that wait for it."""

    def __init__(self, timeline: Timeline, bit: int) -> None:
        self._timeline = timeline
        self._sequence = RECESSIVE * bit  # ns
        self.left: dict[CanController, int] = {}  # how many times more; without any, `busy` and `free` need no call
        self._since: dict[CanController, int] = {}  # from when on the bus was idle
        self._idle = 0  # counts the times that the bus became free or busy: a timer of another time does nothing

    def begin(self, controller: CanController, since: int) -> None:
        """This one counts from now, or from `since`, when the bus becomes idle."""
        if not self.left:
            self._idle += 1  # `busy` and `free` were not called: timers from before mean nothing
        self.left[controller] = _TIMES
        self._since[controller] = since
        self._wait(controller)

    def forget(self, controller: CanController) -> None:
        """This one has died."""
        self.left.pop(controller, None)

    def busy(self, start: int) -> None:
        """A frame starts on the idle bus."""
        self._idle += 1
        for controller in self.left:
            self.left[controller] -= max(0, start - self._since[controller]) // self._sequence

    def free(self, since: int) -> None:
        """A frame or an error frame is over, and so will its intermission be at `since`."""
        self._idle += 1
        for controller in self.left:
            if self._since[controller] < since:
                self.left[controller] -= 1
            self._since[controller] = max(since, self._since[controller])
            self._wait(controller)

    def _wait(self, controller: CanController) -> None:
        when = self._since[controller] + max(0, self.left[controller]) * self._sequence
        self._timeline.at(when, self._check, controller, self._idle)

    def _check(self, controller: CanController, idle: int) -> None:
        if idle == self._idle and self.left.pop(controller, None) is not None:
            controller.restarted()
