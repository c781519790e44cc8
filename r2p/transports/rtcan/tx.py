"""The way out over an RTCAN bus: samples by their deadlines, slots, and management in this network's form.

NonRealTime  laxity 63: what the others leave of the bus
Sporadic     soft real-time, least laxity first
Periodic     hard real-time in slots, which are its publisher's clock (`SlottedTopics`); without slots soft
             real-time, with the period as deadline
"""

import asyncio
from collections.abc import Callable, Sequence

import msgspec

from r2p.codecs import management, rtcan
from r2p.codecs.management import ManagementType
from r2p.protocols.rtcan.calendar import Calendar, Refusal
from r2p.protocols.rtcan.cycle import Timing
from r2p.protocols.rtcan.events import Action, Done, Due, Fate, Profile, SlotEvent, SlotsGranted, SlotsRefused
from r2p.runtime.backpressure import LINK_DOWN
from r2p.runtime.sample import PublisherClass, Sample
from r2p.runtime.topic import PublisherHandle, SlotPublisher, Topic
from r2p.transports.buffered_link import TOO_LONG, BufferedLink
from r2p.transports.link import LinkSubscriber
from r2p.transports.rtcan.driver import EngineDriver
from r2p.units import NEVER, SECOND

NRT_FRAMES_MAX = 128
"""Frames of non real-time messages in the engine, before their publishers wait: some 20 ms of the bus."""

SRT_MESSAGES_MAX = 128
"""Soft real-time messages in the engine, before their publishers keep them. Counted apart from the frames above, so
that bulk data never keeps an event out.
"""

_DEFAULT_DEADLINE = 50_000_000  # ns, as of firmware; for real-time messages without one, from other links or latched
_NRT = PublisherClass.NON_REAL_TIME
_SENT = (Fate.SENT, Fate.UNKNOWN)


# Periodic messages in slots


class SlottedTopic(msgspec.Struct, eq=False):
    """A periodic topic and its slots. `period` and `phase` are in slots (0: none granted), `interval` in ns. `size`:
    bytes of its messages on the bus, at most. `requested`: the period and the lead of the request, in ns.

    `is_clock`: these slots are the publisher's clock; `clock_elsewhere`: those of another link are. `sent` and `missed`
    count messages since the grant; `earliest` and `latest` are when they ended, in ns from the start of their first
    slot on: the difference is the jitter.
    """

    topic: Topic
    publisher: SlotPublisher
    high: int
    size: int
    requested: tuple[int, int]
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
        if self.size > rtcan.FRAME_MAX:
            text = text.replace("a slot", f"{rtcan.fragment_count(self.size)} slots", 1)
        jitter = (self.latest - self.earliest) // 1000
        if jitter or self.missed:
            text += f"; jitter {jitter} us, {self.missed} of {self.sent + self.missed} missed their slot"
        return text


def inadmissible(timing: Timing, size: int, period: float) -> str | None:
    """The reason why messages of `size` bytes on the bus never get slots each `period` seconds; None if they may."""
    wanted = round(period * SECOND) // timing.slot
    fragments = rtcan.fragment_count(size)
    any_message = rtcan.message_id(rtcan.FIRST_TOPIC, 0)
    answer = Calendar(timing.slots).admit(any_message, wanted, fragments, round_down=True)
    return answer.text if isinstance(answer, Refusal) else None


class SlottedTopics:
    """The periodic topics of one link.

    A slot is requested as soon as a topic is advertised, subscribed or not: admission must not depend on subscribers.
    It is used only while there are some. Until the master grants it, and after its loss, the publisher's own ticker
    sends, as for every other link, and the link sends soft real-time messages.
    """

    def __init__(self, link: BufferedLink, driver: EngineDriver, has_subscribers: Callable[[str], bool]) -> None:
        """`has_subscribers` returns whether a topic has reachable subscribers on the bus."""
        self.by_topic: dict[str, SlottedTopic] = {}
        self._link = link
        self._driver = driver
        self._has_subscribers = has_subscribers
        self._by_high: dict[int, SlottedTopic] = {}
        self._changed = asyncio.Event()

    def update(self, topic: Topic, high: int | None) -> None:
        """Request and release slots after a change of a topic's publishers, or of its high byte, None without one.

        The first publisher that can use slots gets them.
        """
        publisher = next(iter(topic.slot_publishers), None)
        known = self.by_topic.get(topic.name)
        wanted = None if publisher is None or high is None else _request(topic, publisher, high)
        if known is not None and (known.publisher, known.high) != (publisher, high):
            if wanted is not None and _alike(known, wanted):
                self._pass_on(known, wanted.publisher)
            else:
                self._release(known)  # slots belong to a message id, and are as long as the publisher's messages
                known = None
        if known is None and wanted is not None:
            self._reserve(wanted)

    def _pass_on(self, known: SlottedTopic, publisher: SlotPublisher) -> None:
        """Let another publisher go on in the same slots."""
        known.publisher.use_own_clock(self._link)
        known.publisher = publisher
        if known.is_clock:
            known.is_clock = publisher.use_slot_clock(self._link, known.interval / SECOND)
            known.clock_elsewhere = not known.is_clock

    async def wait_for_change(self) -> None:
        self._changed.clear()  # tasks that wait already were woken by `set`
        await self._changed.wait()

    def wake_waiters(self) -> None:
        """Wake the tasks that wait for slots, after a change of slots or bus."""
        self._changed.set()

    def close(self) -> None:
        for each in list(self.by_topic.values()):
            self._release(each)

    def undecided(self, topic: Topic) -> bool:
        """Return whether a topic wants slots, and may still get some."""
        if not any(isinstance(each, SlotPublisher) for each in topic.publishers):
            return False
        slotted = self.by_topic.get(topic.name)
        return slotted is None or not (slotted.is_clock or slotted.clock_elsewhere)

    def slots_changed(self, event: SlotEvent) -> None:
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
        """Give the engine the data of a slot; do nothing for a tick without a slot."""
        each = self._by_high.get(due.high)
        payload = self._payload(each, due) if each is not None and due.slotted else None
        self._driver.carry_out(self._driver.engine.fill(self._driver.now(), due.high, payload))

    def completed(self, each: SlottedTopic, done: Done) -> None:
        """Count the outcome of a slot."""
        if done.fate in _SENT:
            each.measure(done.at)
            return
        each.missed += 1
        self._link.stats.sent -= 1
        if done.fate is Fate.ABANDONED:
            self._link.stats.lost[done.fate.value] += 1
            if self.by_topic.get(each.topic.name) is each:  # else its publisher is closed
                each.publisher.link_missed(self._link.name, done.fate.value)

    def _payload(self, each: SlottedTopic, due: Due) -> bytes | None:
        """Let the publisher make the message of this slot."""
        if not each.is_clock:  # its first slot: until here its own clock went on
            each.is_clock = each.publisher.use_slot_clock(self._link, each.interval / SECOND)
            each.clock_elsewhere = not each.is_clock
            self.wake_waiters()
            if each.clock_elsewhere:
                return None  # the other link's clock makes the messages, which go from here as soft real-time ones
        since = round((due.at - each.due) / each.interval) if each.due else 1  # periods since the last slot
        each.due = due.at
        scheduled = self._driver.port.monotonic(due.at)
        late = max(0, self._driver.clock.monotonic() - scheduled)
        sample = each.publisher.tick(scheduled, late, max(0, since - 1))
        if sample is None or not self._has_subscribers(each.topic.name):
            return None
        data = sample.data
        if each.publisher.varies:
            if len(data) + rtcan.HEADER_SIZE > each.size:
                self._link.count_unsendable(each.topic.name, sample, TOO_LONG)
                return None
            data = rtcan.encode_variable(data)
        self._link.stats.sent += 1
        self._link.stats.bytes_sent += len(sample.data)
        return data

    def _reserve(self, each: SlottedTopic) -> None:
        self.by_topic[each.topic.name] = self._by_high[each.high] = each
        engine, now, varies = self._driver.engine, self._driver.now(), each.publisher.varies
        interval, lead = each.requested
        self._driver.carry_out(
            engine.reserve(now, each.high, each.size, interval, lead=lead, varies=varies, handle=each)
        )

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


def _request(topic: Topic, publisher: SlotPublisher, high: int) -> SlottedTopic:
    size = rtcan.size_on_bus(publisher.size, varies=publisher.varies)
    requested = round(publisher.period * SECOND), round(publisher.lead * SECOND)
    return SlottedTopic(topic, publisher, high, size, requested)


def _alike(one: SlottedTopic, other: SlottedTopic) -> bool:
    """Return whether two publishers request the same slots for messages of the same kind."""
    same = (one.high, one.size, one.requested) == (other.high, other.size, other.requested)
    return same and one.publisher.varies == other.publisher.varies


# All other messages


class SampleHandle(msgspec.Struct, eq=False):
    """A sample in the engine. `deadline` is by the engine's clock (ns), NEVER if it does not expire."""

    topic: str
    publisher: PublisherHandle | None
    frames: int
    deadline: int


class ResponseHandle(msgspec.Struct, eq=False):
    """A SUBSCRIBE_RESPONSE in the engine, and its bytes."""

    data: bytes


class Transmitter:
    """Passes a link's messages to the engine, counts them there, and reports late and lost ones."""

    def __init__(self, link: BufferedLink, driver: EngineDriver, slotted: SlottedTopics) -> None:
        self._name = link.name
        self._stats = link.stats
        self._driver = driver
        self._engine = driver.engine
        self._slotted = slotted
        self._frames = 0  # of non real-time messages in the engine
        self._messages = 0  # soft real-time ones in the engine
        self._responses: dict[bytes, ResponseHandle] = {}  # in the engine
        self._response: ResponseHandle | None = None  # the last one, until it is on the bus
        self._awaited: dict[str, ResponseHandle] = {}  # by topic: the response that its subscribers need first

    @property
    def pending(self) -> bool:
        """Return whether any sample is in the engine."""
        return bool(self._frames or self._messages)

    @property
    def full(self) -> bool:
        """Return whether messages without a deadline have to wait for room."""
        return self._frames >= NRT_FRAMES_MAX

    def has_room_for(self, sample: Sample) -> bool:
        """Return whether there is room for this sample."""
        return self._frames < NRT_FRAMES_MAX if sample.publisher_class == _NRT else self._messages < SRT_MESSAGES_MAX

    def send(
        self, subscriber: LinkSubscriber | None, topic: str, high: int, sample: Sample, data: bytes
    ) -> Sequence[Action]:
        """Send a sample of a topic with this high byte, and a `subscriber` if this module has the topic.

        `data` are its bytes on the bus.
        """
        now = self._driver.now()
        publisher = subscriber.topic.publisher_of(sample) if subscriber is not None else None
        frames = rtcan.fragment_count(len(data))
        if sample.publisher_class == _NRT:
            deadline = NEVER
            self._frames += frames
        else:
            latched = subscriber is not None and subscriber.topic.is_latched(sample)
            deadline = now + self._time_left(topic, sample, latched=latched if publisher is None else publisher.latch)
            self._messages += 1
        self._stats.sent += 1
        self._stats.bytes_sent += len(sample.data)
        handle = SampleHandle(topic, publisher, frames, deadline)
        return self._engine.publish(now, high, data, deadline=deadline, drop=sample.drop_late, handle=handle)

    def completed(self, handle: SampleHandle, done: Done) -> None:
        """Count a sample that the engine has sent or given up."""
        if handle.deadline == NEVER:
            self._frames -= handle.frames
        else:
            self._messages -= 1
            if done.fate in _SENT:
                least, left = self._stats.least_laxity, handle.deadline - done.at
                least[handle.topic] = min(left, least.get(handle.topic, left))
        if done.missed or done.fate not in _SENT:
            self._report_missed(handle, done)

    def send_management(self, data: bytes, *, urgent: bool) -> Sequence[Action]:
        """Send a management message, marked as r2p's if all modules have one id.

        A response that waits already is not sent twice.
        """
        handle = None  # only of a response its end is of interest
        if management.type_of(data) == ManagementType.SUBSCRIBE_RESPONSE and self._engine.ready:
            waiting = self._responses.get(data)
            handle = self._response = waiting or ResponseHandle(data)
            if waiting is not None:
                return ()
            self._responses[data] = handle
        if self._engine.profile is Profile.FIRMWARE:
            data = management.mark(data)
        return self._engine.manage(self._driver.now(), data, urgent=urgent, handle=handle)

    def waits_for_response(self, topic: str) -> bool:
        """Return whether a topic has to wait until the last response is on the bus.

        A message with little laxity would overtake the response, and its subscriber does not know the id before.
        """
        if self._response is None:
            return False
        self._awaited[topic] = self._response
        return True

    def response_sent(self, response: ResponseHandle) -> list[str]:
        """Note that a response is on the bus, or lost. Return the topics that waited for it."""
        self._responses.pop(response.data, None)
        if response is self._response:
            self._response = None
        topics = [topic for topic, awaited in self._awaited.items() if awaited is response]
        for topic in topics:
            del self._awaited[topic]
        return topics

    def remove_topic(self, topic: str) -> None:
        """Stop a topic's wait, as it has lost its subscribers."""
        self._awaited.pop(topic, None)

    def _report_missed(self, handle: SampleHandle, done: Done) -> None:
        publisher, late = handle.publisher, max(0, done.at - handle.deadline) / SECOND
        if done.fate in _SENT:
            if publisher is not None:
                publisher.link_late(self._name, "sent after its deadline", late)
            return
        self._stats.sent -= 1
        if done.fate is Fate.DISCARDED:  # the link is down, which its publishers learn from the link
            self._stats.lost[LINK_DOWN] += 1
            return
        self._stats.lost[done.fate.value] += 1
        # REPLACED by newer data in a slot is not a miss: before there were slots, nothing was promised.
        if publisher is not None and done.fate is not Fate.REPLACED:
            publisher.link_missed(self._name, done.fate.value, late)

    def _time_left(self, topic: str, sample: Sample, *, latched: bool) -> int:
        """Return the ns until the deadline. A latched value that is sent again gets a new one."""
        # A sample from another computer has `expires`, its deadline by the clock here.
        left = sample.due - self._driver.clock.now() if sample.deadline else 0
        if left > 0 or (sample.deadline and not latched):
            return left
        slotted = self._slotted.by_topic.get(topic)
        return round(slotted.publisher.period * SECOND) if slotted is not None else _DEFAULT_DEADLINE
