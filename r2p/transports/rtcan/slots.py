"""Periodic publishers on an RTCAN link: their slots are their clock, and without slots their own one goes on.

A slot is asked for as soon as a topic is advertised, whether somebody subscribes it or not: admission must not depend
on who listens. It is used only while somebody does. Until the master grants it, and when it is lost, the publisher's
own ticker sends, as for every other link, and the link makes soft real-time messages of that.
"""

import asyncio
from collections.abc import Callable, Sequence
from typing import Protocol

import msgspec

from r2p.clock import Clock
from r2p.codecs import rtcan
from r2p.protocols.rtcan.calendar import Calendar, Refusal
from r2p.protocols.rtcan.cycle import Timing
from r2p.protocols.rtcan.engine import Engine
from r2p.protocols.rtcan.events import Action, Degraded, Done, Due, Fate, Granted, Refused
from r2p.runtime.topic import SlotPublisher, Topic
from r2p.transports.stats import LinkStats

_SECOND = 1_000_000_000


class SlottedTopic(msgspec.Struct, eq=False):
    """A periodic topic and its slots. `period` and `phase` in slots (0: none granted), `interval` in ns.
    `driven`: they are the publisher's clock; `elsewhere`: those of another link are.

    `sent` and `missed` count messages since the grant; `earliest` and `latest` say when they ended, in ns from the
    start of their first slot on: how far apart these are is the jitter.
    """

    topic: Topic
    publisher: SlotPublisher
    high: int
    period: int = 0
    phase: int = 0
    interval: int = 0
    refusal: str = ""
    driven: bool = False
    elsewhere: bool = False
    due: int = 0
    sent: int = 0
    missed: int = 0
    earliest: int = 0
    latest: int = 0

    def measure(self, ended: int) -> None:
        after = ended - self.due
        self.earliest = min(self.earliest, after) if self.sent else after
        self.latest = max(self.latest, after) if self.sent else after
        self.sent += 1

    def words(self, timing: Timing) -> str:
        """What the slots are worth, for people."""
        if not self.period:
            return f"refused: {self.refusal}" if self.refusal else "waiting for admission"
        text = f"a slot every {self.period} slots ({self.interval / 1e6:g} ms), phase {self.phase}"
        if self.publisher.size > rtcan.FRAME_MAX:
            text = text.replace("a slot", f"{rtcan.fragment_count(self.publisher.size)} slots", 1)
        jitter = (self.latest - self.earliest) // 1000
        if jitter or self.missed:
            text += f"; jitter {jitter} us, {self.missed} of {self.sent + self.missed} missed their slot"
        return text


def inadmissible(timing: Timing, size: int, period: float) -> str | None:
    """Why there can never be slots for messages of `size` bytes each `period` seconds; None: there may be."""
    wanted = round(period * _SECOND) // timing.slot
    fragments = rtcan.fragment_count(size)
    answer = Calendar(timing.slots).admit(rtcan.FIRST_TOPIC << 8, wanted, fragments, round_down=True)
    return answer.text if isinstance(answer, Refusal) else None


class SlottedLink(Protocol):
    """What this needs of its link."""

    name: str
    up: bool
    stats: LinkStats
    engine: Engine

    def do(self, actions: Sequence[Action]) -> None:
        """Carry out what the engine wants."""

    def carries(self, topic: str) -> bool:
        """Whether somebody subscribes the topic, and is in reach."""


class SlottedTopics:
    """The periodic topics of one link. `now` is the engine's clock, `monotonic` translates it to that of the module."""

    def __init__(
        self, link: SlottedLink, clock: Clock, now: Callable[[], int], monotonic: Callable[[int], int]
    ) -> None:
        self.by_topic: dict[str, SlottedTopic] = {}
        self._link = link
        self._clock = clock
        self._now = now
        self._monotonic = monotonic
        self._by_high: dict[int, SlottedTopic] = {}
        self._waiters: list[asyncio.Future[None]] = []

    def follow(self, topic: Topic, high: int | None) -> None:
        """The publishers of a topic changed, or its high byte: of those that are periodic the first gets slots."""
        publisher = next(iter(topic.slot_publishers), None)
        known = self.by_topic.get(topic.name)
        if known is not None and (known.publisher, known.high) != (publisher, high):
            self._drop(known)
            known = None
        if known is None and publisher is not None and high is not None:
            self._reserve(SlottedTopic(topic, publisher, high))

    async def until(self, condition: Callable[[], bool]) -> None:
        """Wait for something that news about slots bring about."""
        while not condition():
            waiter = asyncio.get_running_loop().create_future()
            self._waiters.append(waiter)
            await waiter

    def look(self) -> None:
        """There are news: who waits may look."""
        waiters, self._waiters = self._waiters, []
        for waiter in waiters:
            if not waiter.done():
                waiter.set_result(None)

    def close(self) -> None:
        """Give all slots back."""
        for each in list(self.by_topic.values()):
            self._drop(each)

    def undecided(self, topic: Topic) -> bool:
        """Whether it may still come to slots for a topic that wants some."""
        if not any(isinstance(each, SlotPublisher) for each in topic.publishers):
            return False
        slotted = self.by_topic.get(topic.name)
        return slotted is None or not (slotted.driven or slotted.elsewhere)

    def learn(self, news: Granted | Refused | Degraded) -> None:
        """A topic got slots, or not, or lost them."""
        each = self._by_high.get(news.high)
        if each is None:
            return
        if isinstance(news, Granted):
            each.period, each.phase, each.interval = news.period, news.phase, news.interval
            each.refusal, each.due, each.sent, each.missed = "", 0, 0, 0
            return
        self._end(each)
        if isinstance(news, Refused):
            each.refusal = news.reason
        elif self._link.up:  # else the publisher is told that the link is down
            each.publisher.link_degraded(self._link.name, f"slots lost: {news.reason}")

    def due(self, due: Due) -> None:
        """The engine wants data: for a slot, or because the time has come and there is no slot."""
        each = self._by_high.get(due.high)
        payload = self._tick(each, due) if each is not None and due.slotted else None
        self._link.do(self._link.engine.fill(self._now(), due.high, payload))

    def done(self, each: SlottedTopic, done: Done) -> None:
        """What became of the data."""
        if done.fate in (Fate.SENT, Fate.UNKNOWN):
            each.measure(done.at)
            return
        each.missed += 1
        self._link.stats.sent -= 1
        if done.fate is Fate.ABANDONED:
            self._link.stats.lost[done.fate.value] += 1
            if self.by_topic.get(each.topic.name) is each:  # else its publisher is closed
                each.publisher.link_missed(self._link.name, done.fate.value)

    def _tick(self, each: SlottedTopic, due: Due) -> bytes | None:
        """Let the publisher make the message of this slot."""
        if not each.driven:
            each.driven = each.publisher.use_slot_clock(self._link, each.interval / _SECOND)
            each.elsewhere = not each.driven
            self.look()
            if each.elsewhere:
                return None  # here it is soft real-time
        since = round((due.at - each.due) / each.interval) if each.due else 1
        each.due = due.at
        scheduled = self._monotonic(due.at)
        late = max(0, self._clock.monotonic() - scheduled)
        sample = each.publisher.tick(scheduled, late, max(0, since - 1))
        if sample is None or not self._link.carries(each.topic.name):
            return None
        self._link.stats.sent += 1
        self._link.stats.bytes_sent += len(sample.data)
        return sample.data

    def _reserve(self, each: SlottedTopic) -> None:
        self.by_topic[each.topic.name] = self._by_high[each.high] = each
        interval, lead = round(each.publisher.period * _SECOND), round(each.publisher.lead * _SECOND)
        engine = self._link.engine
        size = each.publisher.size
        self._link.do(engine.reserve(self._now(), each.high, size, interval, lead=lead, handle=each))

    def _drop(self, each: SlottedTopic) -> None:
        self._end(each)
        del self.by_topic[each.topic.name]
        del self._by_high[each.high]
        self._link.do(self._link.engine.release(self._now(), each.high))

    def _end(self, each: SlottedTopic) -> None:
        """Its slots are gone."""
        each.period = 0
        if each.driven:
            each.driven = False
            each.publisher.use_own_clock(self._link)
