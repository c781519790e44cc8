"""Fault confinement: a controller counts errors, and with more of them takes less and less part."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from r2p.sim.can.node import State

if TYPE_CHECKING:
    from collections.abc import Callable

_PASSIVE: Final = 127
_OFF: Final = 255
_RECEIVED_WELL: Final = 119  # what the receive error counter goes back to from above 127


class Confinement:
    """The two error counters of a controller, and the state that follows from them; `changed` is told of a new one."""

    def __init__(self, changed: Callable[[State], object]) -> None:
        self.state = State.ACTIVE
        self.live = True
        """Whether the controller takes part: neither down nor in bus-off."""
        self.passive = False
        self.transmit = 0
        self.receive = 0
        self._changed = changed

    def transmitted(self) -> None:
        """A frame got through."""
        self._count(self.transmit - 1, self.receive)

    def received(self) -> None:
        """A good frame came in."""
        self._count(self.transmit, self.receive - 1 if self.receive <= _PASSIVE else _RECEIVED_WELL)

    def failed(self, *, transmit: int = 0, receive: int = 0) -> None:
        """A frame was destroyed, while it was sent or received: add this to the counters."""
        self._count(self.transmit + transmit, self.receive + receive)

    def restart(self) -> None:
        """Begin anew, without errors."""
        self.transmit = self.receive = 0
        self.enter(State.ACTIVE)

    def enter(self, state: State) -> None:
        """Be in this state from now on."""
        if state is not self.state:
            self.state = state
            self.live = state is State.ACTIVE or state is State.PASSIVE
            self.passive = state is State.PASSIVE
            self._changed(state)

    def _count(self, transmit: int, receive: int) -> None:
        self.transmit = max(0, transmit)
        self.receive = max(0, receive)
        if self.transmit > _OFF:
            self.enter(State.BUS_OFF)
        else:
            self.enter(State.PASSIVE if max(self.transmit, self.receive) > _PASSIVE else State.ACTIVE)
