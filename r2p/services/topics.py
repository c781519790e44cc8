"""The two topics of a service as one end uses them: it publishes on one, and handles each message of the other.

A received message does not wait in a queue for a task to read it: it is handled at once, within `Topic.deliver`. So an
answer wakes its caller directly, a call costs no task, and a call from a handler or a subscriber's callback never waits
for the task that it runs in.
"""

from collections import deque
from collections.abc import Callable
from typing import Any

from r2p.messages import Layout
from r2p.runtime.backpressure import Sink
from r2p.runtime.immediate import ImmediateSubscriber
from r2p.runtime.publishers import SporadicPublisher
from r2p.runtime.qos import Sporadic
from r2p.runtime.queues import EndpointOwner
from r2p.runtime.sample import DirectedSample, PublisherClass, Sample
from r2p.runtime.topic import Topic, TopicSpace

PENDING_MAX = 64
"""Messages of one end that wait for room in a link; one more drops the oldest of them."""


class Inlet(ImmediateSubscriber):
    """Subscribes to one topic of a service, and calls `handle` with each message."""

    __slots__ = ("changed", "end")

    def __init__(self, space: TopicSpace, node: EndpointOwner, end: object, handle: Callable[[Sample], None]) -> None:
        super().__init__(space, node, handle)
        self.end = end
        """The server or the client."""
        self.changed: Callable[[], None] = lambda: None
        """Callback when the topic gets a publisher."""

    def publisher_joined(self) -> None:
        super().publisher_joined()
        self.changed()


class Outlet(SporadicPublisher[Any]):
    """Publishes packed messages on one topic of a service, each with a lifetime of its own."""

    def __init__(self, space: TopicSpace, node: EndpointOwner, name: str, layout: Layout[Any]) -> None:
        """Open the topic. Raises TypeMismatch if it has another type."""
        topic = space.open(name, layout)
        super().__init__(space, node, topic, layout, Sporadic(1.0, pending=PENDING_MAX), latch=False)
        self.changed: Callable[[], None] = lambda: None
        """Callback when the topic gets a subscriber."""
        self._early: deque[tuple[str, Sample]] = deque(maxlen=PENDING_MAX)
        """Answers to callers whose links are yet to see their subscription, and the links."""
        topic.publishers.append(self)
        for queue in topic.queues:
            queue.publisher_joined()
        space.changed(topic)

    @property
    def where(self) -> Topic:
        """The topic."""
        return self._topic

    def send(self, data: bytes, lifetime: int) -> None:
        """Publish a packed message that expires after `lifetime` (ns)."""
        self.sent = sequence = self.sent + 1
        stamp = self._now()
        sample = Sample(data, self._source, stamp, stamp + lifetime, sequence, PublisherClass.SPORADIC)
        blocked = self._topic.deliver(sample)
        if blocked is not None:
            self._deliver_later(sample, blocked, lifetime)

    def answer(self, data: bytes, lifetime: int, link: str, caller: int) -> None:
        """Publish an answer by the link that its request came from, for the module `caller` (its instance)."""
        self.sent = sequence = self.sent + 1
        stamp = self._now()
        sample = DirectedSample(
            data, self._source, stamp, stamp + lifetime, sequence, PublisherClass.SPORADIC, to=caller
        )
        others = self._topic.remote_subscribers
        if link and all(each.link_name != link for each in others):
            self._early.append((link, sample))
            if not others:
                return
        self._deliver_by(link, sample, lifetime)

    def _deliver_by(self, link: str, sample: Sample, lifetime: int) -> None:
        blocked = self._topic.deliver_by(link, sample)
        if blocked is not None:
            self._deliver_later(sample, blocked, lifetime)

    def subscriber_joined(self, sink: Sink) -> None:
        super().subscriber_joined(sink)
        now = self._now()
        while self._early:
            link, sample = self._early.popleft()
            if sample.deadline > now:
                self._deliver_by(link, sample, sample.deadline - now)
        self.changed()

    def link_degraded(self, link: str, reason: str) -> None:
        """Report nothing: the link says in the log that it is down, and calls say what they lack."""
