"""Topics that this tool subscribes to, only to measure them: rate, bytes, gaps and latency. Nothing is decoded."""

import math
from collections import deque

from r2p.modules.module import Module
from r2p.monitoring.counters import clamp
from r2p.monitoring.rates import CounterRate
from r2p.monitoring.snapshot import LatencyFigures
from r2p.runtime.immediate import ImmediateSubscriber
from r2p.runtime.node import Node
from r2p.runtime.sample import Sample
from r2p.units import SECOND

_DELAYS_MAX = 4096  # the newest of one period
_PUBLISHERS_MAX = 1024  # of a topic, whose messages are followed by number


class _Sequence:
    """The sequence numbers of one publisher."""

    __slots__ = ("next",)

    def __init__(self) -> None:
        self.next = 0
        """The number that follows; 0: any."""


class MeasuredTopic:
    """The measurement of one topic, from `open` to `close`; `users` are those that have asked for it."""

    def __init__(self, module: Module, node: Node, name: str) -> None:
        self.users = 0
        self.rate: float | None = None
        self.bandwidth: float | None = None
        """Bytes per second."""
        self.latency: LatencyFigures | None = None
        """That of the last period; None: no message, or without the time of its publishing."""
        self._name = name
        self._now = module.space.clock.now
        self._monotonic = module.space.clock.monotonic
        self._messages = self._bytes = self._gaps = 0
        self._numbered = False
        self._sequences: dict[object, _Sequence] = {}
        self._delays: deque[int] = deque(maxlen=_DELAYS_MAX)
        self._delayed = 0
        now = self._monotonic() / SECOND
        self._rate, self._byte_rate = CounterRate(now, 0), CounterRate(now, 0)
        self._subscriber = ImmediateSubscriber(module.space, node, self._handle, lossy=True)

    def open(self) -> None:
        """Subscribe."""
        self._subscriber.open(self._name, None)

    def close(self) -> None:
        """End the subscription."""
        self._subscriber.close()

    @property
    def lost_here(self) -> int:
        """Messages that reached this tool, and that the subscription could not accept."""
        return self._subscriber.lost + self._subscriber.too_long

    @property
    def lost_on_way(self) -> int | None:
        """Messages that did not reach this tool, by their publishers' numbers; None where links carry none."""
        return clamp(max(0, self._gaps - self.lost_here)) if self._numbered else None

    def report(self) -> None:
        """Compute the figures of the period that ends now."""
        now = self._monotonic() / SECOND
        self.rate = self._rate.add(now, self._messages)
        self.bandwidth = self._byte_rate.add(now, self._bytes)
        delays, count = sorted(self._delays), self._delayed
        self._delays.clear()
        self._delayed = 0
        self.latency = (
            LatencyFigures(percentile(delays, 0.5) / SECOND, percentile(delays, 0.99) / SECOND, count)
            if delays
            else None
        )

    def _handle(self, sample: Sample) -> None:
        """Count a message. `Topic.deliver` calls this with each one, so it is short."""
        self._messages += 1
        self._bytes += len(sample.data)
        if (sample.stamped or sample.hops) and sample.stamp:
            self._delayed += 1
            self._delays.append(self._now() - sample.stamp)
        if number := sample.sequence:
            self._numbered = True
            key = (sample.source, sample.publisher_class)
            sequence = self._sequences.get(key)
            if sequence is None:
                sequence = self._follow(key)
            if sequence.next and number > sequence.next:  # a lower one: its publisher has started again
                self._gaps += number - sequence.next
            sequence.next = number + 1

    def _follow(self, key: object) -> _Sequence:
        """Begin to follow the numbers of a publisher; of too many, the one that came first is forgotten."""
        if len(self._sequences) >= _PUBLISHERS_MAX:
            del self._sequences[next(iter(self._sequences))]
        sequence = self._sequences[key] = _Sequence()
        return sequence


def percentile(values: list[int], share: float) -> int:
    """Return the value that `share` (0 to 1) of the sorted values do not exceed."""
    return values[max(0, math.ceil(share * len(values)) - 1)]
