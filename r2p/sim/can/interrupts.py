"""The way from an event on the bus to the software of a node: a latency, its jitter, and one event of the timeline."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import random
    from collections.abc import Callable

    from r2p.codecs.can_bits import AnyFrame
    from r2p.sim.can.records import Latency
    from r2p.sim.can.timeline import LocalClock, Timeline


class Interrupts:
    """Calls the callbacks of the node's software, each with the time of the node's clock as its last argument.

    They come a little late, in the order of the events, and never after the node has lost power. `latency` is from an
    event to the moment when its interrupt is served.
    """

    def __init__(self, timeline: Timeline, clock: LocalClock, latency: Latency, numbers: random.Random) -> None:
        self._timeline = timeline
        self.clock = clock
        self._nominal = latency.nominal
        self._delay = latency.sampler(numbers)
        self.life = 0
        """Counts power cuts: interrupts from before one are not served."""
        self._latest = 0  # when the last interrupt so far is served: none overtakes another, whatever their delays

    def deliver(self, when: int, handler: Callable[..., object], *args: Any) -> None:
        """Call the handler for an event on the bus at `when`."""
        if handler is not ignore:
            at = self.next(when)
            self._timeline.at(at, self._serve, at, self.life, handler, args)

    def next(self, when: int) -> int:
        """Return the instant at which the interrupt for an event at `when` is served: no earlier than those before."""
        at = when + (self._delay() if self._delay else self._nominal)
        if at < self._latest:
            at = self._latest
        self._latest = at
        return at

    def check_at(self, when: int, handler: Callable[..., object], *args: Any) -> None:
        """Call the handler for a time-out at `when`, which does not hold up the events after it."""
        at = when + (self._delay() if self._delay else self._nominal)
        self._timeline.at(at, self._serve, at, self.life, handler, args)

    def discard(self) -> None:
        """Drop all interrupts that were not served: the node has lost power."""
        self.life += 1

    def _serve(self, at: int, life: int, handler: Callable[..., object], args: tuple[Any, ...]) -> None:
        if life == self.life:
            handler(*args, self.clock.local(at))


class Reception:
    """A good frame on its way to the software of the nodes that it concerns.

    Those whose interrupts are served at one instant, one after the other, are one event: most are, unless their latency
    varies.
    """

    __slots__ = ("_at", "_end", "_nodes", "_timeline", "frame")

    def __init__(self, timeline: Timeline, frame: AnyFrame, end: int) -> None:
        self.frame = frame
        self._timeline = timeline
        self._end = end
        self._at = -1  # the instant of the event that may take more nodes
        self._nodes: list[tuple[Interrupts, int, Callable[..., object]]] = []

    def add(self, interrupts: Interrupts, handler: Callable[..., object]) -> None:
        """Call the handler for the frame when the node's interrupt is served."""
        at = interrupts.next(self._end)
        if at != self._at:
            self._at, self._nodes = at, []
            self._timeline.at(at, self._serve, at, self._nodes)
        self._nodes.append((interrupts, interrupts.life, handler))

    def part(self) -> None:
        """Take no more nodes into the same event, as another event may come between."""
        self._at = -1

    def _serve(self, at: int, nodes: list[tuple[Interrupts, int, Callable[..., object]]]) -> None:
        frame, waiting = self.frame, iter(nodes)
        try:
            for interrupts, life, handler in waiting:
                if life == interrupts.life:
                    handler(frame, interrupts.clock.local(at))
        except BaseException:
            self._timeline.at(at, self._serve, at, [*waiting])  # the exception of one node's software is not of others
            raise


def ignore(*_args: object) -> None:
    """Do nothing: the callback of software that has set none."""
