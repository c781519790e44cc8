"""What goes out over an RTCAN bus: samples by their deadlines, and management as this network wants it.

NonRealTime  laxity 63: what the others leave of the bus
Sporadic     soft real-time, least laxity first
Periodic     hard real-time in slots (see `slots`); without slots soft real-time, with the period as deadline
"""

from collections.abc import Sequence

import msgspec

from r2p.clock import Clock
from r2p.codecs import management, rtcan
from r2p.codecs.management import ManagementType
from r2p.protocols.rtcan.events import Action, Done, Fate, Profile
from r2p.runtime.backpressure import LINK_DOWN
from r2p.runtime.sample import PublisherClass, Sample
from r2p.runtime.topic import PublisherHandle
from r2p.transports.link import LinkSubscriber
from r2p.transports.rtcan.driver import EngineDriver
from r2p.transports.rtcan.slots import SlottedTopics
from r2p.transports.stats import LinkStats
from r2p.units import NEVER, SECOND

NRT_FRAMES_MAX = 128
"""Frames of non real-time messages in the engine, before their publishers wait: some 20 ms of the bus."""

SRT_MESSAGES_MAX = 128
"""Soft real-time messages in the engine, before their publishers keep them. Counted apart from the frames above, so
that bulk data never keeps an event out.
"""

_DEFAULT_DEADLINE = 50_000_000  # ns; of real-time messages without one: those from other links, and latched ones
_NRT = PublisherClass.NON_REAL_TIME
_SENT = (Fate.SENT, Fate.UNKNOWN)


class SampleHandle(msgspec.Struct, eq=False):
    """A sample in the engine. `deadline` is by the engine's clock (ns), NEVER if it does not expire."""

    publisher: PublisherHandle | None
    frames: int
    deadline: int


class ResponseHandle(msgspec.Struct, eq=False):
    """A SUBSCRIBE_RESPONSE in the engine."""

    sent: bool = False


class TxAccounting:
    """Counts the samples of one link that are in the engine, and reports to publishers what was late or lost."""

    def __init__(self, link: str, stats: LinkStats) -> None:
        self._link = link
        self._stats = stats
        self._frames = 0
        self._messages = 0

    @property
    def waiting(self) -> bool:
        """Whether any sample is in the engine."""
        return bool(self._frames or self._messages)

    @property
    def full(self) -> bool:
        """Whether there is no room for messages that do not expire."""
        return self._frames >= NRT_FRAMES_MAX

    def has_room(self, sample: Sample) -> bool:
        """Whether there is room for this sample."""
        return self._frames < NRT_FRAMES_MAX if sample.publisher_class == _NRT else self._messages < SRT_MESSAGES_MAX

    def add(self, publisher: PublisherHandle | None, sample: Sample, deadline: int) -> SampleHandle:
        """Count a sample that the engine gets now."""
        frames = rtcan.fragment_count(len(sample.data))
        self._stats.sent += 1
        self._stats.bytes_sent += len(sample.data)
        if deadline == NEVER:
            self._frames += frames
        else:
            self._messages += 1
        return SampleHandle(publisher, frames, deadline)

    def remove(self, handle: SampleHandle, done: Done) -> None:
        """Count that the engine has sent a sample, or given it up."""
        if handle.deadline == NEVER:
            self._frames -= handle.frames
        else:
            self._messages -= 1
        if done.missed or done.fate not in _SENT:
            self._missed(handle, done)

    def _missed(self, handle: SampleHandle, done: Done) -> None:
        publisher, late = handle.publisher, max(0, done.at - handle.deadline) / SECOND
        if done.fate in _SENT:
            if publisher is not None:
                publisher.link_late(self._link, "sent after its deadline", late)
            return
        self._stats.sent -= 1
        if done.fate is Fate.DISCARDED:  # the link is down, which its publishers learn from the link
            self._stats.lost[LINK_DOWN] += 1
            return
        self._stats.lost[done.fate.value] += 1
        # REPLACED by newer data in a slot is no miss: until there were slots, nothing was promised.
        if publisher is not None and done.fate is not Fate.REPLACED:
            publisher.link_missed(self._link, done.fate.value, late)


class Transmitter:
    """Passes to the engine what a link sends. `clock` is the module's."""

    def __init__(self, driver: EngineDriver, accounting: TxAccounting, slotted: SlottedTopics, clock: Clock) -> None:
        self._engine = driver.engine
        self._now = driver.now
        self._accounting = accounting
        self._slotted = slotted
        self._clock = clock
        self._response: ResponseHandle | None = None  # the last one
        self._waiting: dict[str, ResponseHandle] = {}  # topics whose subscribers wait for a response

    def send(self, subscriber: LinkSubscriber | None, topic: str, high: int, sample: Sample) -> Sequence[Action]:
        """Send a sample of a topic, which has this high byte, and a `subscriber` if this module has the topic."""
        now, drop = self._now(), sample.drop_late
        publisher = subscriber.topic.publisher_of(sample) if subscriber is not None else None
        deadline = NEVER if sample.publisher_class == _NRT else now + self._time_left(topic, sample, publisher)
        handle = self._accounting.add(publisher, sample, deadline)
        return self._engine.publish(now, high, sample.data, deadline=deadline, drop=drop, handle=handle)

    def send_management(self, data: bytes, *, urgent: bool) -> Sequence[Action]:
        """Send a management message, marked as r2p's where all modules have one id."""
        handle = None  # only of a response its end is of interest
        if management.type_of(data) == ManagementType.SUBSCRIBE_RESPONSE and self._engine.ready:
            handle = self._response = ResponseHandle()
        if self._engine.profile is Profile.FIRMWARE:
            data = management.mark(data)
        return self._engine.manage(self._now(), data, urgent=urgent, handle=handle)

    def waits_for_response(self, topic: str) -> bool:
        """Whether a topic has to wait until the last response is on the bus.

        A message with little laxity would overtake the response, and its subscriber does not know the id before.
        """
        if self._response is None or self._response.sent:
            return False
        self._waiting[topic] = self._response
        return True

    def response_sent(self, response: ResponseHandle) -> list[str]:
        """Note that a response is on the bus. Returns the topics that waited for it."""
        response.sent = True
        topics = [topic for topic, awaited in self._waiting.items() if awaited is response]
        for topic in topics:
            del self._waiting[topic]
        return topics

    def remove_topic(self, topic: str) -> None:
        """Let a topic wait no longer: it has lost its subscribers."""
        self._waiting.pop(topic, None)

    def _time_left(self, topic: str, sample: Sample, publisher: PublisherHandle | None) -> int:
        """Ns until the deadline. A latched value that is sent once more gets a new one."""
        # A sample from another computer has `expires`, its deadline by the clock here.
        left = sample.due - self._clock.now() if sample.deadline else 0
        if left > 0 or (sample.deadline and not (publisher is not None and publisher.latch)):
            return left
        slotted = self._slotted.by_topic.get(topic)
        return round(slotted.publisher.period * SECOND) if slotted is not None else _DEFAULT_DEADLINE
