"""What goes out over an RTCAN bus: samples by their deadlines, management as the network of the others wants it."""

from collections.abc import Sequence

import msgspec

from r2p.clock import Clock
from r2p.codecs import management, rtcan
from r2p.protocols.rtcan.engine import Engine
from r2p.protocols.rtcan.events import NEVER, Action, Done, Fate, Profile
from r2p.runtime.sample import PublisherClass, Sample
from r2p.runtime.topic import PublisherHandle, Topic
from r2p.transports.can.port import CanPort
from r2p.transports.link import LinkSubscriber
from r2p.transports.rtcan.slots import SlottedTopics
from r2p.transports.stats import LinkStats

# The samples that an RTCAN engine has, and what becomes of them: one account for each class, so bulk refuses no event.


NRT_FRAMES = 128
"""Frames of non real-time messages that wait before their publishers do: some 20 ms of the bus."""
SRT_MESSAGES = 128
"""Soft real-time messages that wait before their publishers keep them."""

_SECOND = 1_000_000_000
_NRT = PublisherClass.NON_REAL_TIME


class Handed(msgspec.Struct, eq=False):
    """A sample with the engine. `deadline` is by the engine's clock (ns), NEVER if it does not expire."""

    publisher: PublisherHandle | None
    frames: int
    deadline: int


def publisher_of(topic: Topic, sample: Sample) -> PublisherHandle | None:
    """The publisher of this module whose sample it is; None: it came by another link."""
    if sample.source.link:
        return None
    for publisher in topic.publishers:
        if publisher.node.name == sample.source.node and publisher.publisher_class == sample.publisher_class:
            return publisher
    return None


class TxAccounting:
    """The accounts of one link."""

    def __init__(self, link: str, stats: LinkStats) -> None:
        self._link = link
        self._stats = stats
        self._frames = 0
        self._messages = 0

    @property
    def waiting(self) -> bool:
        """Whether the engine has samples of ours."""
        return bool(self._frames or self._messages)

    @property
    def full(self) -> bool:
        """Whether there is no room for messages that do not expire."""
        return self._frames >= NRT_FRAMES

    def takes(self, sample: Sample) -> bool:
        """Whether there is room for this one."""
        return self._frames < NRT_FRAMES if sample.publisher_class == _NRT else self._messages < SRT_MESSAGES

    def enter(self, publisher: PublisherHandle | None, sample: Sample, deadline: int) -> Handed:
        """The engine gets it."""
        frames = rtcan.fragment_count(len(sample.data))
        self._stats.sent += 1
        self._stats.bytes_sent += len(sample.data)
        if deadline == NEVER:
            self._frames += frames
        else:
            self._messages += 1
        return Handed(publisher, frames, deadline)

    def done(self, handed: Handed, done: Done) -> None:
        """The engine has it no more."""
        if handed.deadline == NEVER:
            self._frames -= handed.frames
        else:
            self._messages -= 1
        if done.missed or done.fate not in (Fate.SENT, Fate.UNKNOWN):
            self._missed(handed, done)

    def _missed(self, handed: Handed, done: Done) -> None:
        """It was late, or never sent. What newer data replaced was not promised: there were no slots yet."""
        publisher, late = handed.publisher, max(0, done.at - handed.deadline) / _SECOND
        if done.fate in (Fate.SENT, Fate.UNKNOWN):
            if publisher is not None:
                publisher.link_late(self._link, "sent after its deadline", late)
            return
        self._stats.sent -= 1
        if done.fate is Fate.DISCARDED:  # its publisher is told that the link is down
            self._stats.lost["link down"] += 1
            return
        self._stats.lost[done.fate.value] += 1
        if publisher is not None and done.fate is not Fate.REPLACED:
            publisher.link_missed(self._link, done.fate.value, late)


# tx


_DEADLINE = 50_000_000  # ns; of real-time messages that do not say: from other links, or latched


class Response(msgspec.Struct, eq=False):
    """A SUBSCRIBE_RESPONSE on its way."""

    sent: bool = False


class Transmitter:
    """Hands to the engine what a link sends; `periodics` are its periodic topics, `clock` is the module's."""

    def __init__(
        self, engine: Engine, port: CanPort, handover: TxAccounting, periodics: SlottedTopics, clock: Clock
    ) -> None:
        self._engine = engine
        self._now = port.now
        self._handover = handover
        self._periodics = periodics
        self._clock = clock
        self._response: Response | None = None
        self._coming: dict[str, Response] = {}  # topics that will have subscribers when it is there

    def send(self, outlet: LinkSubscriber | None, topic: str, high: int, sample: Sample) -> Sequence[Action]:
        """A sample of a topic, which has this high byte, and an outlet if this module has the topic."""
        now, drop = self._now(), sample.drop_late
        publisher = publisher_of(outlet.topic, sample) if outlet is not None else None
        deadline = NEVER if sample.publisher_class == _NRT else now + self._time_left(topic, sample, publisher)
        handed = self._handover.enter(publisher, sample, deadline)
        return self._engine.publish(now, high, sample.data, deadline=deadline, drop=drop, handle=handed)

    def manage(self, data: bytes, *, urgent: bool) -> Sequence[Action]:
        """A management message; its sender must be told where all have one id."""
        handle = None
        if management.type_of(data) == management.ManagementType.SUBSCRIBE_RESPONSE and self._engine.ready:
            handle = self._response = Response()
        if self._engine.profile is Profile.FIRMWARE:
            data = management.mark(data)
        return self._engine.manage(self._now(), data, urgent=urgent, handle=handle)

    def follows_response(self, topic: str) -> bool:
        """Whether a topic has to wait till the last response is on the bus: an urgent message would overtake it, and
        find nobody.
        """
        if self._response is None or self._response.sent:
            return False
        self._coming[topic] = self._response
        return True

    def answered(self, response: Response) -> list[str]:
        """It is on the bus: the topics that waited for it."""
        response.sent = True
        topics = [topic for topic, awaited in self._coming.items() if awaited is response]
        for topic in topics:
            del self._coming[topic]
        return topics

    def forget(self, topic: str) -> None:
        """Nobody wants the topic any more."""
        self._coming.pop(topic, None)

    def _time_left(self, topic: str, sample: Sample, publisher: PublisherHandle | None) -> int:
        """Ns until the deadline; a latched value that is sent once more has a new one."""
        left = (sample.expires or sample.deadline) - self._clock.now() if sample.deadline else 0
        if left > 0 or (sample.deadline and not (publisher is not None and publisher.latch)):
            return left
        slotted = self._periodics.by_topic.get(topic)
        return round(slotted.publisher.period * _SECOND) if slotted is not None else _DEADLINE
