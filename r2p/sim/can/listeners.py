"""Who takes part in a bus, who hears whom, and whom a frame matters to: needed for each frame, and seldom changed."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from r2p.sim.can.controller import CanController

_REMEMBERED: Final = 4096  # identifiers of which it is known whom they concern


class Listeners:
    """The controllers with power that are not in bus-off, in the order in which they came."""

    def __init__(self) -> None:
        self.live: list[CanController] = []
        self._audiences: dict[CanController, tuple[tuple[str, ...], list[CanController]]] = {}
        self._concerned: dict[int, list[CanController]] = {}

    def join(self, controller: CanController) -> None:
        """It takes part from now on."""
        self.live.append(controller)
        self._audiences.clear()
        self._concerned.clear()

    def leave(self, controller: CanController) -> None:
        """It takes no part any more, if it did."""
        if controller in self.live:
            self.live.remove(controller)
            self._audiences.clear()
            self._concerned.clear()

    def reconsider(self) -> None:
        """Other frames than before may concern a controller."""
        self._concerned.clear()

    def audience(self, owner: CanController) -> tuple[tuple[str, ...], list[CanController]]:
        """Its name, and all that hear what it sends alone."""
        audience = self._audiences.get(owner)
        if audience is None:
            others = [each for each in self.live if each is not owner]
            audience = self._audiences[owner] = (owner.name,), others
        return audience

    def concerned(self, identifier: int) -> list[CanController]:
        """To whom a good frame with this identifier matters."""
        concerned = self._concerned.get(identifier)
        if concerned is None:
            if len(self._concerned) >= _REMEMBERED:
                self._concerned.clear()
            concerned = self._concerned[identifier] = [each for each in self.live if each.concerned(identifier)]
        return concerned
