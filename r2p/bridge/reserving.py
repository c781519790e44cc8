"""A periodic topic of another link that is sent in slots of its own on an RTCAN bus.

The bus asks for the message of a slot; what it gets is the last one that came, once. So a message waits for at most one
period, and keeps the bus's beat instead of that of the network it came by.
"""

from typing import Any

from r2p.publishers import PeriodicPublisher
from r2p.sample import PublisherClass, Sample


class RelayedPeriodic(PeriodicPublisher[Any]):
    """Stands for the publisher, which is elsewhere: messages of `size` bytes each `period` seconds."""

    publisher_class = PublisherClass.PERIODIC
    lead = 0.0005

    def __init__(self, topic: str, size: int, period: float) -> None:
        # Not its base's: there is no node behind it, no clock, and nobody to signal to.
        self.topic = topic
        self.period = period
        self.latch = False
        self.missed = 0
        self._size = size
        self._latest: Sample | None = None
        self._by: object = None

    @property
    def size(self) -> int:
        return self._size

    def take(self, sample: Sample) -> bool:
        """A message came; False if the bus does not send it in slots now, and it has to go another way.

        So it has to if it has another size: the slots are for messages of one size.
        """
        if self._by is None or len(sample.data) != self._size:
            return False
        self.missed += self._latest is not None
        self._latest = sample
        return True

    def drive(self, driver: object, period: float) -> bool:
        if self._by not in (None, driver):
            return False
        self._by = driver
        self.period = period
        return True

    def undrive(self, driver: object) -> None:
        if self._by is driver:
            self._by = self._latest = None

    def tick(self, scheduled: int, late: int, skipped: int) -> Sample | None:
        """What came since the last slot."""
        latest, self._latest = self._latest, None
        return latest

    def degraded(self, link: str, reason: str) -> None:
        """The slots are lost: messages go as events, which the link's notices tell."""

    def link_missed(self, link: str, reason: str, late: float = 0.0, sequence: int = 0) -> None:
        self.missed += 1

    def link_late(self, link: str, reason: str, late: float = 0.0) -> None:
        """It was sent in its slot, or not at all."""
