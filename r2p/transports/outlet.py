"""One topic on its way out by one link: what a link looks like to publishers."""

from collections.abc import Callable
from typing import TYPE_CHECKING

from r2p.sample import Sample
from r2p.topic import Outlet, Topic

if TYPE_CHECKING:
    from r2p.transports.link import Link


class LinkOutlet(Outlet):
    """One topic on its way out by one link. Nobody waits for a link that is down: what it is given is lost, counted."""

    __slots__ = ("_link", "topic")

    def __init__(self, link: "Link", topic: Topic) -> None:
        super().__init__(link.name)
        self._link = link
        self.topic = topic

    @property
    def reachable(self) -> bool:
        return self._link.up

    def offer(self, sample: Sample) -> bool:
        link = self._link
        if not link.up:
            self.lost += 1
            link.stats.lost["link down"] += 1
            return True
        if link.full:
            return False
        link.write(self.topic.name, sample)
        return True

    def force(self, sample: Sample) -> None:
        if not self.offer(sample):
            self.lost += 1
            self._link.stats.lost["send buffer full"] += 1

    def when_room(self, callback: Callable[[], None], *, soon: bool = False) -> None:
        self._link.when_room(callback)

    def wait_no_more(self, callback: Callable[[], None]) -> None:
        self._link.wait_no_more(callback)
