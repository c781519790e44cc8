"""What a gateway keeps while it listens anew because its event loop stood still.

It can't know at once whether another gateway has begun to forward meanwhile. If none has, nothing is lost: what came in
is forwarded then, in order. Events and periods are not kept: they would be stale.
"""

from collections import deque
from collections.abc import Callable

from r2p.room import Sink
from r2p.sample import PublisherClass, Sample

MOST = 4096
"""Messages that are kept at most."""


class Held:
    """Messages, and how to go on with each."""

    def __init__(self) -> None:
        self._waiting: deque[tuple[Sample, Callable[[], list[Sink] | None]]] = deque()

    def __bool__(self) -> bool:
        return bool(self._waiting)

    def keep(self, sample: Sample, go_on: Callable[[], list[Sink] | None]) -> bool:
        """Keep a message; False if it can't be kept. `go_on` gives back the sinks that have no room for it."""
        if sample.publisher_class != PublisherClass.NON_REAL_TIME or len(self._waiting) >= MOST:
            return False
        self._waiting.append((sample, go_on))
        return True

    def release(self, failed: Callable[[Exception], object]) -> None:
        """Go on with all of them; `failed` is called with what one of them raises."""
        waiting, self._waiting = self._waiting, deque()
        for sample, go_on in waiting:
            try:
                for sink in go_on() or ():
                    sink.force(sample)
            except Exception as error:  # noqa: BLE001 - counted and logged; the next one follows
                failed(error)
