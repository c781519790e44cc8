"""The topics of a recording: each with its subscription, and the types of its publishers.

A message is recorded in the type of its publisher: that which the user states; that of this module's own nodes; one of
r2p.msg with the fingerprint that the publisher announces; or one that other modules are asked for. While they are
asked, the publisher's messages wait, for at most HELD_MAX: then they are recorded as packed bytes, which can be given a
type later. What follows after an answer has the type.

A publisher that starts again may have another type. It counts its messages anew, so it is looked up again then, and
when something has changed in discovery.
"""

from collections.abc import Callable

import msgspec

from r2p.codecs.management import ANY_TYPE
from r2p.messages import Message
from r2p.monitoring.topic_types import UNANNOUNCED, TypeFinder
from r2p.recording.entries import BagEntry, SampleEntry
from r2p.runtime.immediate import ImmediateSubscriber
from r2p.runtime.node import Node
from r2p.runtime.sample import PublisherClass, Sample, Source
from r2p.units import SECOND

HELD_MAX = SECOND // 2
"""Nanoseconds that messages wait for their type at most."""
HELD_BYTES = 16 << 20
"""Bytes of the messages of one publisher that wait for their type, at most."""

PUBLISHERS_MAX = 1024
"""Publishers of one topic that are recorded under their names; those that come after them have none."""


class RecordedPublisher(msgspec.Struct, eq=False):
    """A publisher of a topic. Until its type is known as `cls`, its messages wait in `held`.

    `next` is the sequence number that follows (0: any); `missed` counts those that were left out. `held_since` is in
    monotonic ns.
    """

    source: Source
    publisher_class: PublisherClass
    fingerprint: bytes = ANY_TYPE
    cls: type[Message] | None = None
    next: int = 0
    missed: int = 0
    held: list[SampleEntry] | None = None
    held_since: int = 0
    held_bytes: int = 0


class RecordedTopic:
    """One topic: hands each message over to `put`, with its type and the time of its reception."""

    def __init__(self, node: Node, name: str, types: TypeFinder, put: Callable[[BagEntry], object]) -> None:
        self.name = name
        self.messages = 0
        """The messages that were received."""
        self._space = space = types.module.space
        self._now = space.clock.now
        self._types = types
        self._put = put
        self._publishers: dict[tuple[Source, PublisherClass], RecordedPublisher] = {}
        self._last: RecordedPublisher | None = None
        self._subscriber = ImmediateSubscriber(space, node, self._handle, lossy=True)
        self._topic = space.open(name, None)  # the same as in `open`, where its latched messages come

    def open(self) -> None:
        """Begin to receive."""
        self._subscriber.open(self.name, None)

    @property
    def missed(self) -> int:
        """Messages that were lost on their way to this module, by the numbers of their publishers."""
        return sum(each.missed for each in self._publishers.values())

    @property
    def rejected(self) -> int:
        """Messages that reached this module, and that the subscription could not accept."""
        return self._subscriber.lost + self._subscriber.too_long

    def _handle(self, sample: Sample) -> None:
        """Record a message. `Topic.deliver` calls this with each one, so it is short."""
        publisher = self._last
        if (
            publisher is None
            or sample.source is not publisher.source
            or sample.publisher_class is not publisher.publisher_class
        ):
            publisher = self._last = self._publisher(sample.source, sample.publisher_class)
            if publisher.source is not sample.source:
                sample = msgspec.structs.replace(sample, source=publisher.source)
        sequence = sample.sequence
        if sequence != publisher.next and sequence:
            self._jumped(publisher, sequence)
        publisher.next = sequence + 1
        self.messages += 1
        entry = SampleEntry(self.name, sample, publisher.cls, self._now())
        if publisher.held is None:
            self._put(entry)
        else:
            self._hold(publisher, publisher.held, entry)

    def _publisher(self, source: Source, publisher_class: PublisherClass) -> RecordedPublisher:
        key = source, publisher_class
        publisher = self._publishers.get(key)
        if publisher is None and len(self._publishers) >= PUBLISHERS_MAX and (source.module or source.node):
            return self._publisher(Source(link=source.link), publisher_class)
        if publisher is None:
            publisher = self._publishers[key] = RecordedPublisher(*key)
            self._find_type(publisher)
        else:
            publisher.source = source  # an equal one, which is the same object from now on: that is compared faster
        return publisher

    def _jumped(self, publisher: RecordedPublisher, sequence: int) -> None:
        """Count a gap; a lower number is that of a publisher that has started again, or of a latched message."""
        if sequence < publisher.next:
            self._review(publisher)
        elif publisher.next:
            publisher.missed += sequence - publisher.next

    # Types

    def _find_type(self, publisher: RecordedPublisher) -> None:
        """Set the type of a publisher, or ask for it."""
        source, own = publisher.source, self._topic.layout
        publisher.fingerprint = fingerprint = self._fingerprint(source)
        publisher.cls = self._types.stated(self.name)
        if publisher.cls is not None:
            return
        if own is not None and (not source.link or fingerprint in (own.fingerprint, ANY_TYPE)):
            publisher.cls = own.cls
        elif fingerprint == ANY_TYPE:
            publisher.cls = UNANNOUNCED.get(self.name)
        else:
            publisher.cls = self._types.by_fingerprint(fingerprint)
            if publisher.cls is None and self._types.ask(fingerprint, self.name, lambda: self._answered(publisher)):
                publisher.held = publisher.held or []
                publisher.held_since = self._space.clock.monotonic()

    def _fingerprint(self, source: Source) -> bytes:
        return self._space.fingerprint_of(self._topic, source) if source.link else ANY_TYPE

    def _answered(self, publisher: RecordedPublisher) -> None:
        if publisher.cls is None:
            publisher.cls = self._types.by_fingerprint(publisher.fingerprint)
        self._release(publisher)

    def review(self) -> None:
        """Look whether publishers have another type than before, as discovery has changed."""
        for publisher in self._publishers.values():
            self._review(publisher)

    def _review(self, publisher: RecordedPublisher) -> None:
        now = self._fingerprint(publisher.source)
        own = self._topic.layout
        changed = (
            now not in (publisher.fingerprint, ANY_TYPE)
            if publisher.source.link
            else (own is not None and publisher.cls is not own.cls)
        )
        if publisher.held is None and (changed or (publisher.cls is None and now != ANY_TYPE)):
            self._find_type(publisher)

    # Messages that wait for their type

    def _hold(self, publisher: RecordedPublisher, held: list[SampleEntry], entry: SampleEntry) -> None:
        held.append(entry)
        publisher.held_bytes += entry.nbytes
        if publisher.held_bytes > HELD_BYTES:
            self._release(publisher)

    def poll(self, now: int) -> None:
        """Record what has waited for its type long enough; `now` in monotonic ns."""
        for publisher in self._publishers.values():
            if publisher.held is not None and now - publisher.held_since >= HELD_MAX:
                self._release(publisher)

    def _release(self, publisher: RecordedPublisher) -> None:
        held, publisher.held, publisher.held_bytes = publisher.held or (), None, 0
        for entry in held:
            entry.cls = publisher.cls
            self._put(entry)

    def close(self) -> None:
        """End the subscription, and record what waits."""
        self._subscriber.close()
        for publisher in self._publishers.values():
            self._release(publisher)
