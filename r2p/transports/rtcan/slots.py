"""Periodic publishers on an RTCAN link: their slots are their clock, and without slots their own clock goes on.

A slot is requested as soon as a topic is advertised, subscribed or not: admission must not depend on subscribers. It is
used only while there are some. Until the master grants it, and when it is lost, the publisher's own ticker sends, as
for every other link, and the link makes soft real-time messages of that.
"""

import asyncio
from collections.abc import Callable

import msgspec

from r2p.clock import Clock
from r2p.codecs import rtcan
from r2p.protocols.rtcan.calendar import Calendar, Refusal
from r2p.protocols.rtcan.cycle import Timing
from r2p.protocols.rtcan.events import Done, Due, Fate, SlotsGranted, SlotsLost, SlotsRefused
from r2p.runtime.topic import SlotPublisher, Topic
from r2p.transports.link import Link
from r2p.transports.rtcan.driver import EngineDriver
from r2p.units import SECOND


class SlottedTopic(msgspec.Struct, eq=False):
    """A periodic topic and its slots. `period` and `phase` are in slots (0: none granted), `interval` in ns.

    `is_clock`: these slots are the publisher's clock; `clock_elsewhere`: those of another link are. `sent` and `missed`
    count messages since the grant; `earliest` and `latest` are when they ended, in ns from the start of their first
    slot on: the difference is the jitter.
    """

    topic: Topic
    publisher: SlotPublisher
    high: int
    period: int = 0
    phase: int = 0
    interval: int = 0
    refusal: str = ""
    is_clock: bool = False
    clock_elsewhere: bool = False
    due: int = 0
    sent: int = 0
    missed: int = 0
    earliest: int = 0
    latest: int = 0

    def measure(self, ended: int) -> None:
        """Count a message whose last frame ended at this instant."""
        after = ended - self.due
        self.earliest = min(self.earliest, after) if self.sent else after
        self.latest = max(self.latest, after) if self.sent else after
        self.sent += 1

    def describe(self) -> str:
        """Describe the slots and how well they are kept, for users."""
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
    """Why there can never be slots for messages of `size` bytes each `period` seconds. None: there may be."""
    wanted = round(period * SECOND) // timing.slot
    fragments = rtcan.fragment_count(size)
    any_message = rtcan.message_id(rtcan.FIRST_TOPIC, 0)
    answer = Calendar(timing.slots).admit(any_message, wanted, fragments, round_down=True)
    return answer.text if isinstance(answer, Refusal) else None


class SlottedTopics:
    """The periodic topics of one link.

    `clock` is the module's. `has_subscribers` says whether a topic has any on the bus that can be reached.
    """

    def __init__(self, link: Link, driver: EngineDriver, clock: Clock, has_subscribers: Callable[[str], bool]) -> None:
        self.by_topic: dict[str, SlottedTopic] = {}
        self._link = link
        self._driver = driver
        self._clock = clock
        self._has_subscribers = has_subscribers
        self._by_high: dict[int, SlottedTopic] = {}
        self._changed = asyncio.Event()

    def update(self, topic: Topic, high: int | None) -> None:
        """Request and release slots after a change of a topic's publishers, or of its high byte (None: it has none).

        Of the publishers that can use slots the first gets them.
        """
        publisher = next(iter(topic.slot_publishers), None)
        known = self.by_topic.get(topic.name)
        if known is not None and (known.publisher, known.high) != (publisher, high):
            self._release(known)  # slots belong to a message id, and are as long as the publisher's messages
            known = None
        if known is None and publisher is not None and high is not None:
            self._reserve(SlottedTopic(topic, publisher, high))

    async def wait_until(self, condition: Callable[[], bool]) -> None:
        """Wait for a condition that events about slots bring about."""
        while not condition():
            self._changed.clear()  # tasks that wait already were woken by `set`
            await self._changed.wait()

    def wake_waiters(self) -> None:
        """Let `wait_until` evaluate its conditions again."""
        self._changed.set()

    def close(self) -> None:
        """Release all slots."""
        for each in list(self.by_topic.values()):
            self._release(each)

    def undecided(self, topic: Topic) -> bool:
        """Whether a topic wants slots, and may still get some."""
        if not any(isinstance(each, SlotPublisher) for each in topic.publishers):
            return False
        slotted = self.by_topic.get(topic.name)
        return slotted is None or not (slotted.is_clock or slotted.clock_elsewhere)

    def slots_changed(self, event: SlotsGranted | SlotsRefused | SlotsLost) -> None:
        """Note that a topic got slots, was refused some, or lost them."""
        each = self._by_high.get(event.high)
        if each is None:
            return
        if isinstance(event, SlotsGranted):
            each.period, each.phase, each.interval = event.period, event.phase, event.interval
            each.refusal, each.due, each.sent, each.missed = "", 0, 0, 0
            return
        self._lose_slots(each)
        if isinstance(event, SlotsRefused):
            each.refusal = event.reason
        elif self._link.up:  # else the link tells the publisher that it is down
            each.publisher.link_degraded(self._link.name, f"slots lost: {event.reason}")

    def fill(self, due: Due) -> None:
        """Give the engine the data of a slot, or none where a tick is due and there is no slot."""
        each = self._by_high.get(due.high)
        payload = self._payload(each, due) if each is not None and due.slotted else None
        self._driver.carry_out(self._driver.engine.fill(self._driver.now(), due.high, payload))

    def completed(self, each: SlottedTopic, done: Done) -> None:
        """Count what became of the data of a slot."""
        if done.fate in (Fate.SENT, Fate.UNKNOWN):
            each.measure(done.at)
            return
        each.missed += 1
        self._link.stats.sent -= 1
        if done.fate is Fate.ABANDONED:
            self._link.stats.lost[done.fate.value] += 1
            if self.by_topic.get(each.topic.name) is each:  # else its publisher is closed
                each.publisher.link_missed(self._link.name, done.fate.value)

    def _payload(self, each: SlottedTopic, due: Due) -> bytes | None:
        """Have the publisher make the message of this slot."""
        if not each.is_clock:  # its first slot: until here its own clock went on
            each.is_clock = each.publisher.use_slot_clock(self._link, each.interval / SECOND)
            each.clock_elsewhere = not each.is_clock
            self.wake_waiters()
            if each.clock_elsewhere:
                return None  # the other link's clock makes the messages, which go from here as soft real-time ones
        since = round((due.at - each.due) / each.interval) if each.due else 1  # periods since the last slot
        each.due = due.at
        scheduled = self._driver.port.monotonic(due.at)
        late = max(0, self._clock.monotonic() - scheduled)
        sample = each.publisher.tick(scheduled, late, max(0, since - 1))
        if sample is None or not self._has_subscribers(each.topic.name):
            return None
        self._link.stats.sent += 1
        self._link.stats.bytes_sent += len(sample.data)
        return sample.data

    def _reserve(self, each: SlottedTopic) -> None:
        self.by_topic[each.topic.name] = self._by_high[each.high] = each
        interval, lead = round(each.publisher.period * SECOND), round(each.publisher.lead * SECOND)
        engine, now = self._driver.engine, self._driver.now()
        self._driver.carry_out(engine.reserve(now, each.high, each.publisher.size, interval, lead=lead, handle=each))

    def _release(self, each: SlottedTopic) -> None:
        self._lose_slots(each)
        del self.by_topic[each.topic.name]
        del self._by_high[each.high]
        self._driver.carry_out(self._driver.engine.release(self._driver.now(), each.high))

    def _lose_slots(self, each: SlottedTopic) -> None:
        each.period = 0
        if each.is_clock:
            each.is_clock = False
            each.publisher.use_own_clock(self._link)
