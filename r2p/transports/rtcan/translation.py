"""RTCAN's network time in UTC, as this computer sees both: the offset, and how far it was off lately."""

from collections import deque
from collections.abc import Callable

from r2p.codecs.attachment import Clock

_APART = 100_000_000  # ns between two measurements
_KEPT = 32


class Translation:
    """`network` and `utc` tell the two times (ns, None: not known), `epoch` which network time it is."""

    def __init__(
        self, network: Callable[[], int | None], utc: Callable[[], int], epoch: Callable[[], int | None]
    ) -> None:
        self._network = network
        self._utc = utc
        self._epoch = epoch
        self._measured: deque[int] = deque(maxlen=_KEPT)
        self._measured_at = -_APART
        self._clock: Clock | None = None

    def clock(self, now: int) -> Clock | None:
        """The translation at this instant (monotonic ns); None while there is no network time."""
        if now - self._measured_at >= _APART:
            self._measured_at = now
            self._measure()
        return self._clock

    def _measure(self) -> None:
        network, epoch = self._network(), self._epoch()
        if network is None or epoch is None:
            self._measured.clear()
            self._clock = None
            return
        if self._clock is not None and self._clock.epoch != epoch:
            self._measured.clear()
        self._measured.append(self._utc() - network)
        low, high = min(self._measured), max(self._measured)
        self._clock = Clock(epoch, (low + high) // 2, max((high - low + 1) // 2, 1_000))
