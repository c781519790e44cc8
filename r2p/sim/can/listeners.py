"""Who takes part in a bus, who hears whom, and whom a frame matters to: needed for each frame, and seldom changed."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from r2p.sim.can.controller import CanController

_REMEMBERED: Final = 4096  # identifiers of which it is known whom they concern


class Listeners:
    """The controllers with power that are not in bus-off, in the order in which they came.

    `audience[controller]`: its name, and all that hear what it sends alone. `concerned[identifier]`: to whom a good
    frame with this identifier matters.
    """

    def __init__(self) -> None:
        self.live: list[CanController] = []
        self.audience = _Audience(self.live)
        self.concerned = _Concerned(self.live)

    def join(self, controller: CanController) -> None:
        """It takes part from now on."""
        self.live.append(controller)
        self.audience.clear()
        self.concerned.clear()

    def leave(self, controller: CanController) -> None:
        """It takes no part any more, if it did."""
        if controller in self.live:
            self.live.remove(controller)
            self.audience.clear()
            self.concerned.clear()

    def reconsider(self) -> None:
        """Other frames than before may concern a controller."""
        self.concerned.clear()


class _Audience(dict["CanController", tuple[tuple[str, ...], list["CanController"]]]):
    """Worked out at the first question."""

    def __init__(self, live: list[CanController]) -> None:
        super().__init__()
        self._live = live

    def __missing__(self, owner: CanController) -> tuple[tuple[str, ...], list[CanController]]:
        audience = self[owner] = (owner.name,), [each for each in self._live if each is not owner]
        return audience


class _Concerned(dict[int, list["CanController"]]):
    """Worked out at the first question."""

    def __init__(self, live: list[CanController]) -> None:
        super().__init__()
        self._live = live

    def __missing__(self, identifier: int) -> list[CanController]:
        if len(self) >= _REMEMBERED:
            self.clear()
        concerned = self[identifier] = [each for each in self._live if each.concerned(identifier)]
        return concerned
