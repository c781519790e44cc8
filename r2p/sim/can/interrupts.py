"""How a node's software hears of things: a little late, in the order in which they happened, never after its death."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable

    from r2p.sim.can.node import LocalClock
    from r2p.sim.can.timeline import Timeline


class Interrupts:
    """Calls the software's handlers, each with the instant that the node's clock shows as its last argument.

    `delay()` gives ns from an instant to when its interrupt is served.
    """

    def __init__(self, timeline: Timeline, clock: LocalClock, delay: Callable[[], int]) -> None:
        self._timeline = timeline
        self._clock = clock
        self._delay = delay
        self._life = 0  # counts deaths: what it was about to hear is not heard any more
        self._heard = 0  # when its software hears the last thing so far

    def tell(self, when: int, handler: Callable[..., object], *args: Any) -> None:
        """Something happens at `when`, on the bus."""
        if handler is ignore:
            return
        heard = when + self._delay()
        if heard < self._heard:
            heard = self._heard
        self._heard = heard
        self._timeline.at(heard, self._serve, heard, self._life, handler, args)

    def look(self, when: int, handler: Callable[..., object], *args: Any) -> None:
        """Something may have to be done at `when`; it keeps nothing else waiting."""
        at = when + self._delay()
        self._timeline.at(at, self._serve, at, self._life, handler, args)

    def forget(self) -> None:
        """The node has died."""
        self._life += 1

    def _serve(self, at: int, life: int, handler: Callable[..., object], args: tuple[Any, ...]) -> None:
        if life == self._life:
            handler(*args, self._clock.local(at))


def ignore(*_args: object) -> None:
    """The handler of software that does not care."""
