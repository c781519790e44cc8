"""A publisher that replaces another one in a swap of nodes: held back until that one is closed, then it goes on there.

    Node.advertise           ->  hold      publish() waits, publish_nowait() keeps its newest message, no fill is called
    the other one is closed  ->  take_over ->  BasePublisher.follow: next number, latched value, phase, what waits
    and off the topic        ->  release   what was held back goes out

Both are publishers of the topic meanwhile, so it stays announced. While a publisher is held back, attributes shadow its
methods: publishers that replace nothing pay nothing for it.
"""

from collections.abc import Callable
from typing import Any

import msgspec

from r2p.runtime.publishers.non_real_time import Publisher
from r2p.runtime.publishers.periodic import PeriodicPublisher
from r2p.runtime.publishers.sporadic import SporadicPublisher
from r2p.runtime.queues import Pulse

HELD_BACK = "held back until the node before has ended, and replaced by a newer one"
"""The reason for which a message of `publish_nowait` is missed."""


class ReplacedNode(msgspec.Struct, eq=False):
    """What a node, in a swap, replaces of another one: services by name, and publishers that have no successor yet.

    `followed` has those that have one, with it, and `drop_kept` what drops the messages that these keep.
    """

    publishers: list[Any] = []
    services: list[str] = []
    followed: list[tuple[Any, Any]] = []
    drop_kept: list[Callable[[str], None]] = []


def hold(publisher: Publisher[Any] | SporadicPublisher[Any] | PeriodicPublisher[Any], replaced: ReplacedNode) -> None:
    """Hold a new publisher back until the one with its topic in the node that it replaces is closed.

    If it is closed already, the new one only goes on with its number and phase.
    """
    same = [each for each in replaced.publishers if each.topic == publisher.topic]
    if not same:
        return
    other = next((each for each in same if each.publisher_class == publisher.publisher_class), same[0])
    replaced.publishers.remove(other)
    replaced.followed.append((other, publisher))
    if not other.is_open:
        publisher.follow(other)
    elif isinstance(publisher, PeriodicPublisher):
        publisher.silence()
        other.hand_over = lambda: _follow(publisher, other)
        publisher.abandon = lambda: _forget(other)
    else:
        replaced.drop_kept.append(_HeldBack(publisher, other).drop_kept)


def _follow(publisher: PeriodicPublisher[Any], other: Any) -> None:
    publisher.abandon = None
    publisher.follow(other)


def _forget(other: Any) -> None:
    other.hand_over = None


class _HeldBack:
    """The messages of a publisher that is held back until the `other` one is closed."""

    def __init__(self, publisher: Publisher[Any] | SporadicPublisher[Any], other: Any) -> None:
        self._publisher = publisher
        self._other = other
        self._released = Pulse()
        self._holds = True
        self._kept: Any = None
        vars(publisher).update(publish=self._publish, publish_nowait=self._publish_nowait, abandon=self._abandon)
        other.hand_over = self._take_over

    def drop_kept(self, reason: str) -> None:
        """Drop the message that is kept, and report it as missed for this reason."""
        if self._kept is not None:
            self._kept = None
            self._publisher.link_missed("", reason)

    def _take_over(self) -> Callable[[], None]:
        self._end()
        self._publisher.follow(self._other)
        return self._release

    def _abandon(self) -> None:
        """Stop holding a publisher that is closed first; the other one goes on."""
        self._end()
        self._kept = None
        self._released.emit()

    def _end(self) -> None:
        self._holds = False
        self._other.hand_over = self._publisher.abandon = None
        for name in ("publish", "publish_nowait"):
            del vars(self._publisher)[name]

    def _release(self) -> None:
        """Publish what was kept, and let the calls that wait go on."""
        message, self._kept = self._kept, None
        if message is not None:
            try:
                self._publisher.publish_nowait(message)
            except Exception as error:  # noqa: BLE001 - the message was changed meanwhile: its node crashes
                self._publisher.node.crash(error)
        self._released.emit()

    async def _publish(self, message: Any) -> None:
        if self._holds:
            self._publisher.check(message)
            self._publisher.held_back += 1
            try:
                await self._released.wait()
            finally:
                self._publisher.held_back -= 1
        await self._publisher.publish(message)

    def _publish_nowait(self, message: Any) -> bool:
        if not self._holds:  # the program has kept the method
            return self._publisher.publish_nowait(message)
        self._publisher.check(message)
        self.drop_kept(HELD_BACK)
        self._kept = message
        return False
