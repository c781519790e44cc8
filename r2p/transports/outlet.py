"""One topic on its way out by one link: what a link looks like to publishers."""

from typing import TYPE_CHECKING

from r2p.room import LINK_DOWN, Room
from r2p.sample import PublisherClass, Sample
from r2p.topic import Outlet, Topic

if TYPE_CHECKING:
    from r2p.transports.link import Link


class LinkOutlet(Outlet):
    """One topic on its way out by one link.

    Nobody waits for a link that is down. What it is given is lost, counted; real-time publishers are told of each
    sample, the others were told when it went down.
    """

    __slots__ = ("_link", "topic")

    def __init__(self, link: "Link", topic: Topic, lines: Room | None = None) -> None:
        """`lines`: its own, or else those of the link."""
        super().__init__(link.name, link, link.room if lines is None else lines)
        self._link = link
        self.topic = topic

    @property
    def reachable(self) -> bool:
        return self._link.up

    def offer(self, sample: Sample) -> bool:
        link = self._link
        if not link.up:
            if sample.publisher_class != PublisherClass.NON_REAL_TIME:
                return False
            self.force(sample)
            return True
        if not link.takes(sample):
            return False
        link.write(self.topic.name, sample)
        return True

    def force(self, sample: Sample) -> None:
        link = self._link
        if link.up and not link.full:
            link.write(self.topic.name, sample)
        else:
            self.lost += 1
            link.stats.lost["send buffer full" if link.up else LINK_DOWN] += 1

    def lose(self, reason: str) -> None:
        super().lose(reason)
        self._link.stats.lost[reason] += 1

    def refill(self) -> None:
        self._link.made_room()
