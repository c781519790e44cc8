"""A subscription without a queue: its messages are handled at once, within `Topic.deliver`.

No task reads it, so no message wakes one, and it is never full: nothing waits for it, and nothing is dropped. Services
answer and recorders write this way.
"""

from collections import deque
from collections.abc import Callable
from typing import Any

from r2p.messages import Layout
from r2p.runtime.queues import EndpointOwner, SubscriberQueue
from r2p.runtime.sample import Sample
from r2p.runtime.topic import Topic, TopicSpace


class _HandledAtOnce(deque[Sample]):
    """The queue of an `ImmediateSubscriber`: always empty, as each message is handled when it comes."""

    def __init__(self, handle: Callable[[Sample], None]) -> None:
        super().__init__()
        self.append = handle  # type: ignore[method-assign]  # links append without a call of ours in between


class ImmediateSubscriber(SubscriberQueue):
    """Subscribes to one topic, and calls `handle` with each message. What it raises is an internal error of a link.

    `lossy`: publishers need not keep count of what arrives.
    """

    __slots__ = ("space", "topic")

    def __init__(
        self, space: TopicSpace, node: EndpointOwner, handle: Callable[[Sample], None], *, lossy: bool = False
    ) -> None:
        super().__init__(space.wake_scheduler, node, 1, lossy=lossy, keep_oldest=False)
        self.queue = _HandledAtOnce(handle)
        self.space = space
        self.topic: Topic | None = None

    def open(self, name: str, layout: Layout[Any] | None) -> Topic:
        """Join the topic; without a layout, with messages of any type. Raises TypeMismatch if it has another one."""
        self.typed = layout is not None
        self.topic = self.space.open(name, layout)
        self.topic.join(self)
        self.space.changed(self.topic)
        return self.topic

    def close(self) -> None:
        """Leave the topic."""
        if self.topic is not None:
            topic, self.topic = self.topic, None
            topic.leave(self)
            self.space.release(topic)
