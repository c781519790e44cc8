"""What a gateway changes in messages on their way, or holds back: rates, and classes that the next link can't keep."""

from collections.abc import Callable
from typing import TYPE_CHECKING

import msgspec

from r2p.bridge.options import ClassOf
from r2p.protocols.time_left import TimesLeft
from r2p.sample import PublisherClass, Sample

if TYPE_CHECKING:
    from r2p.bridge.reserving import RelayedPeriodic

_SECOND = 1_000_000_000
_UNKNOWN_PERIOD = _SECOND // 20
_LONGEST_PERIOD = 10 * _SECOND
_SURE = 8  # intervals
Learnt = Callable[[int, float], None]


class Shaper:
    """The changes on one way.

    `rate`: messages a second at most, in bursts of two. `klass`: what a debug line can't say. `soften`: periodic
    messages become sporadic ones that are due within their period, as the next link has no slots for them. `learnt` is
    called with size (bytes) and period (s) when those of a publisher are known, and again when it comes back with
    another size; it may set `reserved`, which takes the messages then.
    """

    def __init__(
        self, *, rate: float | None, klass: ClassOf | None, soften: bool, learnt: "Learnt | None" = None
    ) -> None:
        self.reserved: RelayedPeriodic | None = None
        self._learnt = learnt
        self._gap = None if rate is None else round(_SECOND / rate)
        self._class = klass
        self._soften = soften
        self._free_at = 0
        self._periods: dict[tuple[str, str], _Period] = {}
        self._times_left = TimesLeft()

    @classmethod
    def of(
        cls, *, rate: float | None, klass: ClassOf | None, soften: bool, learnt: "Learnt | None" = None
    ) -> "Shaper | None":
        """None where there is nothing to change."""
        return cls(rate=rate, klass=klass, soften=soften, learnt=learnt) if rate or klass or soften else None

    def shape(self, sample: Sample, now: int, utc: int) -> Sample | None:
        """The message to forward at `now` (monotonic ns; the same in UTC); None: it is one too many."""
        if self._gap is not None:
            if now < self._free_at:
                return None
            self._free_at = max(self._free_at, now - self._gap) + self._gap
        if self._class is not None and not sample.deadline:
            sample = _classed(sample, self._class)
        if self._soften and sample.publisher_class is PublisherClass.PERIODIC:
            return self._softened(sample, now, utc)
        return sample

    def _softened(self, sample: Sample, now: int, utc: int) -> Sample:
        period, deadline, expires = self._period(sample), sample.deadline, sample.expires
        if not deadline:
            deadline = sample.stamp + period
            source = sample.source
            expires = utc + self._times_left.of((source.module, source.node)).left(now, sample.stamp, deadline)
        sporadic = PublisherClass.SPORADIC
        return msgspec.structs.replace(
            sample, publisher_class=sporadic, deadline=deadline, expires=expires, drop_late=False
        )

    def _period(self, sample: Sample) -> int:
        """The publisher's period, as its stamps show it."""
        source = sample.source
        known = self._periods.get((source.module, source.node))
        if known is None:
            if len(self._periods) >= TimesLeft.MOST:
                self._periods.clear()
            self._periods[source.module, source.node] = _Period(sample.stamp, len(sample.data))
            return _UNKNOWN_PERIOD
        since = sample.stamp - known.stamp
        known.stamp = sample.stamp
        if since >= _LONGEST_PERIOD or len(sample.data) != known.size:
            known.size, known.period, known.count = len(sample.data), 0, 0
        elif since > 0:
            known.count += 1
            known.period = since if not known.period else min(since, known.period + known.period // 8)
            if known.count == _SURE and self._learnt is not None:
                self._learnt(known.size, known.period / _SECOND)
        return known.period or _UNKNOWN_PERIOD


class _Period(msgspec.Struct):
    """The last stamp of a publisher, the size of its messages, and its period as far as known (ns)."""

    stamp: int
    size: int
    period: int = 0
    count: int = 0


def _classed(sample: Sample, klass: ClassOf) -> Sample:
    deadline = sample.stamp + round(klass.time * _SECOND) if klass.time else 0
    return msgspec.structs.replace(sample, publisher_class=klass.publisher_class, deadline=deadline, drop_late=False)
