"""What the demo counts for each topic: messages, their rate, their latency."""

from collections import deque
from statistics import median, quantiles

from r2p.messages import Message

_WINDOW = 2_000_000_000  # ns, of the rate
_LATENCIES = 10_000  # kept, the newest


class Tally:
    """The messages of one topic; its times are those of one way, or of a `round_trip`."""

    def __init__(self, topic: str, link: str, *, round_trip: bool = False) -> None:
        self.topic = topic
        self.link = link
        self.round_trip = round_trip
        self.sent = 0
        self.received = 0
        self.last: Message | None = None
        self.latencies: deque[int] = deque(maxlen=_LATENCIES)
        self._recent: deque[int] = deque()

    def take(self, now: int, message: Message, latency: int | None = None) -> None:
        """A message came in at `now` (ns), after `latency` ns."""
        self.received += 1
        self.last = message
        self._recent.append(now)
        if latency is not None:
            self.latencies.append(latency)

    def rate(self, now: int) -> float:
        """Messages a second, of the last two seconds."""
        recent = self._recent
        while recent and recent[0] <= now - _WINDOW:
            recent.popleft()
        return (len(recent) - 1) * 1e9 / (recent[-1] - recent[0]) if len(recent) > 1 else 0.0

    @property
    def median(self) -> float | None:
        """Of the latencies, in ms."""
        return median(self.latencies) / 1e6 if self.latencies else None

    @property
    def slowest(self) -> float | None:
        """The latency, in ms, that one in a hundred exceeds."""
        if len(self.latencies) < 2:
            return self.median
        return quantiles(self.latencies, n=100, method="inclusive")[98] / 1e6
