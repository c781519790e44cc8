"""What a gateway changes in messages on their way: rates, and publisher classes that the next link can't keep.

`Shaper` belongs to one route. A bus has no slots for messages that are not published there, so periodic ones become
sporadic; with `reserve` the gateway asks for slots as soon as it knows size and period, and `RelayedPeriodic` fills
them.
"""

from collections.abc import Callable

import msgspec

from r2p.bridge.options import ClassOf
from r2p.protocols.time_left import TimesLeft
from r2p.runtime.sample import PublisherClass, Sample
from r2p.runtime.topic import SlotPublisher
from r2p.units import SECOND

_UNKNOWN_PERIOD = SECOND // 20  # ns until a deadline while the period is not known
_LONGEST_PERIOD = 10 * SECOND  # a longer pause is none: the publisher starts again
_SURE = 8  # intervals after which a period counts as known


class RelayedPeriodic(SlotPublisher):
    """Fills the slots of a bus with what comes in by another link: messages of `size` bytes each `period` seconds."""

    lead = 0.0005

    def __init__(self, size: int, period: float) -> None:
        self.period = period
        self.missed = 0
        """Messages that were overtaken by the next one before their slot came, or that the bus lost."""
        self._size = size
        self._latest: Sample | None = None
        self._slot_link: object = None

    @property
    def size(self) -> int:
        return self._size

    def offer(self, sample: Sample) -> bool:
        """Keep a message for the next slot. False if the bus has no slots for it now, or not of this size: then it has
        to go without.
        """
        if self._slot_link is None or len(sample.data) != self._size:
            return False
        self.missed += self._latest is not None
        self._latest = sample
        return True

    def use_slot_clock(self, slot_link: object, period: float) -> bool:
        if self._slot_link not in (None, slot_link):
            return False
        self._slot_link = slot_link
        self.period = period
        return True

    def use_own_clock(self, slot_link: object) -> None:
        if self._slot_link is slot_link:
            self._slot_link = self._latest = None

    def tick(self, scheduled: int, late: int, skipped: int) -> Sample | None:
        latest, self._latest = self._latest, None
        return latest

    def link_degraded(self, link: str, reason: str) -> None:
        """The slots are lost: messages go as sporadic ones, which the link's notices report."""

    def link_missed(self, link: str, reason: str, late: float = 0.0, sequence: int = 0) -> None:
        self.missed += 1


class Shaper:
    """The changes on one route.

    `rate`: messages a second at most, with room for two at once. `klass`: what a debug line does not carry. `soften`:
    periodic messages become sporadic ones that are due within their period, as the next link has no slots for them.
    `reserve` is called with size (bytes) and period (s) when those of a publisher are known, and again when it comes
    back with another size; it gives back what takes the messages from then on.
    """

    def __init__(
        self,
        *,
        rate: float | None,
        klass: ClassOf | None,
        soften: bool,
        reserve: Callable[[int, float], RelayedPeriodic] | None = None,
    ) -> None:
        self.reserved: RelayedPeriodic | None = None
        self._reserve = reserve
        self._gap = None if rate is None else round(SECOND / rate)
        self._class = klass
        self._soften = soften
        self._free_at = 0
        self._periods: dict[tuple[str, str], _PublisherPeriod] = {}
        self._times_left = TimesLeft()

    @classmethod
    def of(
        cls,
        *,
        rate: float | None,
        klass: ClassOf | None,
        soften: bool,
        reserve: Callable[[int, float], RelayedPeriodic] | None = None,
    ) -> "Shaper | None":
        """None where there is nothing to change."""
        return cls(rate=rate, klass=klass, soften=soften, reserve=reserve) if rate or klass or soften else None

    def shape(self, sample: Sample, now: int, utc: int) -> Sample | None:
        """The message to forward at `now` (monotonic ns; the same in UTC); None: it exceeds the rate."""
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
        """The publisher's period (ns), as its stamps show it."""
        source = sample.source
        known = self._periods.get((source.module, source.node))
        if known is None:
            if len(self._periods) >= TimesLeft.MOST:
                self._periods.clear()
            self._periods[source.module, source.node] = _PublisherPeriod(sample.stamp, len(sample.data))
            return _UNKNOWN_PERIOD
        since = sample.stamp - known.stamp
        known.stamp = sample.stamp
        if since >= _LONGEST_PERIOD or len(sample.data) != known.size:
            known.size, known.period, known.count = len(sample.data), 0, 0
        elif since > 0:
            known.count += 1
            # The shortest interval counts, as messages may be lost; a publisher that slows down is followed by steps.
            known.period = since if not known.period else min(since, known.period + known.period // 8)
            if known.count == _SURE and self._reserve is not None:
                self.reserved = self._reserve(known.size, known.period / SECOND)
        return known.period or _UNKNOWN_PERIOD


class _PublisherPeriod(msgspec.Struct):
    """The last stamp of a publisher, the size of its messages, and its period as far as known (ns)."""

    stamp: int
    size: int
    period: int = 0
    count: int = 0


def _classed(sample: Sample, klass: ClassOf) -> Sample:
    deadline = sample.stamp + round(klass.time * SECOND) if klass.time else 0
    return msgspec.structs.replace(sample, publisher_class=klass.publisher_class, deadline=deadline, drop_late=False)
