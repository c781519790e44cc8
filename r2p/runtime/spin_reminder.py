"""A reminder for the mistake that costs beginners the most time: callbacks without a `spin` that calls them."""

from collections.abc import Mapping
from typing import Any

from r2p.clock import Alarm
from r2p.log_lines import NodeLogger
from r2p.runtime.subscriber import Subscriber
from r2p.runtime.topic import TopicSpace
from r2p.units import SECOND


class SpinReminder:
    """Warns once when messages wait for callbacks of a node that does not call `spin`, or returns without it.

    It looks once a second at what waits, until `spin` is called: so messages on their way cost nothing more.
    """

    def __init__(
        self, node: str, log: NodeLogger, subscribers: Mapping[Subscriber[Any], None], space: TopicSpace
    ) -> None:
        self._node = node
        self._log = log
        self._subscribers = subscribers
        self._clock = space.clock
        self._alarm = Alarm(space.loop, self._look, background=True)
        self._waiting: set[str] = set()
        """The topics of which messages waited at the last look."""
        self._warned = False
        self._alarm.set(self._clock.monotonic() + SECOND)

    def close(self) -> None:
        """Stop looking."""
        self._alarm.close()

    def returned(self) -> None:
        """Warn of all callbacks: the node's function has returned."""
        topics = {each.topic for each in self._subscribers if each.callback is not None}
        if topics:
            self._warn("it has returned, so its callbacks for %s were never called", topics)

    def _look(self) -> None:
        waiting = {each.topic for each in self._subscribers if each.callback is not None and each.queue}
        late = waiting & self._waiting
        self._waiting = waiting
        if late:
            self._warn("messages on %s wait for its callbacks", late)
        else:
            self._alarm.set(self._clock.monotonic() + SECOND)

    def _warn(self, text: str, topics: set[str]) -> None:
        if not self._warned:
            self._warned = True
            advice = "node %s does not call spin(): " + text + "; write `while True: await node.spin()`"
            self._log.warning(advice, self._node, ", ".join(sorted(topics)))
