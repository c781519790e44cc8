"""The samples that an RTCAN engine has, and what becomes of them: one account for each class, so bulk refuses no event.

"Delivered" means that its own frames were seen on the bus. What is late or given up is told to the publisher.
"""

import msgspec

from r2p.codecs import rtcan
from r2p.protocols.rtcan.events import NEVER, Done, Fate
from r2p.sample import PublisherClass, Sample
from r2p.topic import Advertised, Topic
from r2p.transports.intake import LinkStats

NRT_FRAMES = 128
"""Frames of non real-time messages that wait before their publishers do: some 20 ms of the bus."""
SRT_MESSAGES = 128
"""Soft real-time messages that wait before their publishers keep them."""

_SECOND = 1_000_000_000
_NRT = PublisherClass.NON_REAL_TIME


class Handed(msgspec.Struct, eq=False):
    """A sample with the engine. `deadline` is by the engine's clock (ns), NEVER if it does not expire."""

    publisher: Advertised | None
    frames: int
    deadline: int


def publisher_of(topic: Topic, sample: Sample) -> Advertised | None:
    """The publisher of this module whose sample it is; None: it came by another link."""
    if sample.source.link:
        return None
    for publisher in topic.publishers:
        if publisher.node.name == sample.source.node and publisher.publisher_class == sample.publisher_class:
            return publisher
    return None


class Handover:
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

    def enter(self, publisher: Advertised | None, sample: Sample, deadline: int) -> Handed:
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
