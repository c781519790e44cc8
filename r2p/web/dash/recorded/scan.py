"""Goes through a recording once, chunk by chunk, and keeps what happened: what the time line shows, and what changes.

What is kept is bounded, whatever is in the file, and what did not fit is counted. All of it only grows, so a page that
knows the first part is sent the rest.
"""

import asyncio
import itertools
from bisect import bisect_right
from collections import Counter, defaultdict
from collections.abc import Callable, Hashable, Iterable, Iterator
from functools import partial
from typing import Any, Final, Generic, TypeVar

import msgspec

from r2p.errors import DecodeError
from r2p.messages import Message, layout
from r2p.monitoring.counters import clamp
from r2p.recording.bag import Bag
from r2p.recording.channels import BagChannel
from r2p.recording.mcap_reader import ChunkRef, MessageRecord
from r2p.recording.messages import (
    EVENTS,
    LOGS,
    LOSSES,
    PARAMETERS,
    SIGNALS,
    SLOTS,
    STATISTICS,
    LogRecord,
    ParameterValue,
    RecordedEvent,
    RecordedSignal,
    RecorderLosses,
    SlotTable,
)
from r2p.recording.timeline import (
    ANSWER_WITHIN,
    LossTotals,
    MissReasons,
    ParameterValues,
    SlotOwners,
    TimelineEvent,
    collapsed,
    event_of,
    log_event,
    logged_miss,
    module_of,
    overdue_event,
    parameter_change,
    recorder_losses,
    signal_event,
    slot_changes,
)
from r2p.ros.cdr import cdr
from r2p.units import SECOND
from r2p.web.dash.recorded.reader import ChunkTable, RecordingReader

K = TypeVar("K", bound=Hashable)
V = TypeVar("V")

EVENTS_MAX = 20_000
"""Events that are kept one by one."""
MISSES_MAX = 50_000
"""Counts of misses: each is of a topic, a kind and a step."""
GAPS_MAX = 10_000
STEPS = 1000
"""Steps of time in which misses are counted."""
MISS_KINDS = frozenset({"missed", "late", "overdue", "lost"})

_HISTORY_BYTES = 8 << 20  # of the changes of modules, of parameters, and of slots, as they are in the file
_SIZES_MAX = 1000  # channels whose size is found
_NAMES_MAX = 1 << 14  # modules and topics whose last value is kept, to see what changes
_GAP_MIN: Final = 2 * SECOND  # ns without a message after which a topic of a steady rate has a gap
_GAP_PERIODS = 20  # ... and at least as many of its usual periods
_GAP_PAUSES = 3  # ... and of its longest pause so far: messages may come in bursts
_STEADY = 10  # messages from which the rate of a topic is known
_BATCH_BYTES = 1 << 20  # of chunks that are read in one step
_OVERHEAD = 200  # bytes of a change, besides
_NEWS_EVERY = 0.25  # s between two looks of those that follow the scan


class History(Generic[K, V]):
    """What values were when, by key."""

    def __init__(self, limit: int = _HISTORY_BYTES) -> None:
        self.left_out = 0
        """Changes that did not fit."""
        self._left = limit
        self._times: dict[K, list[int]] = {}
        self._values: dict[K, list[V]] = {}

    def add(self, key: K, time: int, value: V, size: int) -> bool:
        """Enter a value of `size` bytes from `time` on; return False if it does not fit."""
        times, values = self._times.get(key, []), self._values.get(key, [])
        if values and values[-1] == value:
            return True
        if self._left < size:
            self.left_out += 1
            return False
        self._left -= size + _OVERHEAD
        at = bisect_right(times, time)
        times.insert(at, time)
        values.insert(at, value)
        self._times[key], self._values[key] = times, values
        return True

    def at(self, time: int) -> dict[K, V]:
        """Return the values at an instant; keys that have none by then are left out."""
        found = {}
        for key, times in self._times.items():
            if i := bisect_right(times, time):
                found[key] = self._values[key][i - 1]
        return found


class RecordingScan:
    """What happened in a recording, as far as it has been read: `share` of it."""

    def __init__(self, reader: RecordingReader) -> None:
        self.share = 0.0
        self.events: list[TimelineEvent] = []
        self.misses: list[tuple[str, str, int, int]] = []
        """Topic, kind, step, count."""
        self.gaps: list[tuple[str, int, int]] = []
        """Topic, last message before (ns), first one after."""
        self.left_out: Counter[str] = Counter()
        self.start = 0
        """When the recording begins (ns)."""
        self.step = SECOND
        """Nanoseconds of a step of misses."""
        self.sizes: dict[str, tuple[int, bool]] = {}
        """The bytes of a topic's messages, and whether that varies, by topic; where it is known."""
        self.module_events = History[str, RecordedEvent]()
        self.masters = History[str, str]()
        """The RTCAN master of each link; empty for none."""
        self.parameters = History[tuple[str, str, str], ParameterValue]()
        self.slots = History[str, SlotTable]()
        self._reader = reader
        self._changed = asyncio.Event()
        self._topics = _TopicTimes(self)
        self._observed = _Observed(self)

    async def run(self) -> None:
        """Read all of the recording, behind whatever else is read of it. Raises BagError if it can't be opened."""
        bag = await self._reader.bag()
        self.start, self.step = bag.start, max((bag.end - bag.start) // STEPS, 1)
        table = ChunkTable(bag, _is_scanned)
        for channel in itertools.islice((each for each in bag.channels if each.kind == "samples"), _SIZES_MAX):
            await self._reader.run_behind(partial(self._enter_size, channel))
        self._notify()
        done = 0
        for chunks in _batches(table.chunks):
            await self._reader.run_behind(partial(self._read_all, bag, chunks))
            done += len(chunks)
            self.share = min(done / len(table.chunks), 0.99)
            self._notify()
        self._observed.finish()
        self.share = 1.0
        self._notify()

    def _enter_size(self, channel: BagChannel) -> None:
        """Enter the size of a topic, for which its type is made: that takes a while, so it is behind the first page."""
        if channel.info is not None and channel.cls is not None:
            shape = layout(channel.cls)
            self.sizes[channel.info.topic] = shape.size, shape.varies

    async def changed(self) -> None:
        """Wait until more is known; at most four times a second."""
        changed = self._changed
        await asyncio.sleep(_NEWS_EVERY)
        await changed.wait()

    def _notify(self) -> None:
        changed, self._changed = self._changed, asyncio.Event()
        changed.set()

    def _read_all(self, bag: Bag, chunks: list[tuple[int, ChunkRef]]) -> None:
        """Enter chunks, in the thread of the reader."""
        for number, chunk in chunks:
            self._read(bag, number, chunk)

    def _read(self, bag: Bag, number: int, chunk: ChunkRef) -> None:
        channels = bag.files[number].channels
        self._topics.enter(channels, self._reader.times(bag, number, chunk))
        wanted = frozenset(key for key, each in channels.items() if each.kind == "meta" or _is_observation(each))
        found = self._observed.events(channels, self._reader.records(bag, number, chunk, wanted)) if wanted else []
        self.enter(found)

    def enter(self, found: list[TimelineEvent]) -> None:
        """Enter the events of a chunk."""
        counts: Counter[tuple[str, str, int]] = Counter()
        for each in found:
            if each.kind in MISS_KINDS:
                topic = each.about.partition(" of ")[0]
                counts[topic, each.kind, min(max((each.time - self.start) // self.step, 0), STEPS)] += each.count
        for (topic, kind, step), count in counts.items():
            self.keep(self.misses, (topic, kind, step, clamp(count)), MISSES_MAX, "misses")
        for each in collapsed(sorted(found, key=lambda each: each.time)):
            self.keep(self.events, msgspec.structs.replace(each, count=clamp(each.count)), EVENTS_MAX, "events")

    def keep(self, kept: list[V], item: V, limit: int, name: str) -> None:
        """Append to a list that has a limit."""
        if len(kept) < limit:
            kept.append(item)
        else:
            self.left_out[name] += 1


def _batches(chunks: Iterable[tuple[int, ChunkRef]]) -> Iterator[list[tuple[int, ChunkRef]]]:
    """Yield chunks, several small ones together: a plot that is read by turns with them takes as long for each turn."""
    batch: list[tuple[int, ChunkRef]] = []
    for each in chunks:
        batch.append(each)
        if sum(chunk.length for _, chunk in batch) >= _BATCH_BYTES:
            yield batch
            batch = []
    if batch:
        yield batch


def _is_observation(channel: BagChannel) -> bool:
    return channel.kind == "messages" and (channel.name in _READERS or channel.name.startswith(f"{STATISTICS}/"))


def _is_scanned(channel: BagChannel) -> bool:
    return channel.kind != "messages" or _is_observation(channel)


class _TopicTimes:
    """Finds the gaps of topics that have a steady rate."""

    def __init__(self, scan: RecordingScan) -> None:
        self._scan = scan
        self._last: dict[str, int] = {}
        self._first: dict[str, int] = {}
        self._counts: Counter[str] = Counter()
        self._pauses: dict[str, int] = {}  # the longest ones that are no gaps (ns)
        self._silent: Counter[str] = Counter()  # ns of gaps, which are not counted for the rate

    def enter(self, channels: dict[int, BagChannel], times: dict[int, list[int]]) -> None:
        """Enter the log times of a chunk by channel."""
        by_topic: dict[str, list[int]] = defaultdict(list)
        for number, each in times.items():
            channel = channels.get(number)
            if channel is not None and channel.kind == "samples" and channel.info is not None and each:
                by_topic[channel.info.topic] += each
        for topic, each in by_topic.items():
            each.sort()
            self._enter(topic, each)

    def _enter(self, topic: str, times: list[int]) -> None:
        first = self._first.setdefault(topic, times[0])
        last = self._last.get(topic, times[0])
        self._look(topic, last, times[0], first)
        if times[-1] - times[0] >= _GAP_MIN:  # chunks of r2p are shorter
            for before, after in itertools.pairwise(times):
                if after - before >= _GAP_MIN:
                    self._look(topic, before, after, first)
        self._counts[topic] += len(times)
        self._last[topic] = max(last, times[-1])

    def _look(self, topic: str, before: int, after: int, first: int) -> None:
        silence, count = after - before, self._counts[topic]
        period = (before - first - self._silent[topic]) / max(count, 1)
        least = max(_GAP_MIN, _GAP_PERIODS * period, _GAP_PAUSES * self._pauses.get(topic, 0))
        if silence < least or count < _STEADY:
            self._pauses[topic] = max(silence, self._pauses.get(topic, 0))
            return
        self._silent[topic] += silence
        self._scan.keep(self._scan.gaps, (topic, before, after), GAPS_MAX, "gaps")


class _Observed:
    """Makes events of what a recorder saw besides messages."""

    def __init__(self, scan: RecordingScan) -> None:
        self._scan = scan
        self._reasons: MissReasons = {}
        self._slots: SlotOwners = {}
        self._parameters: ParameterValues = {}
        self._losses: LossTotals = {}
        self._signalled: set[str] = set()  # modules whose misses are there one by one
        self._uncounted: dict[str, list[TimelineEvent]] = {}  # logged misses that may be counted yet, by module
        self._waiting = 0  # of these

    def events(self, channels: dict[int, BagChannel], records: list[MessageRecord]) -> list[TimelineEvent]:
        """Return the events of the messages of a chunk."""
        found: list[TimelineEvent] = []
        for log_time, number, sequence, _, data in records:
            channel = channels[number]
            if channel.kind == "meta":
                event = overdue_event(channel.info, log_time, sequence, data)
                found += [event] if event is not None else []
            elif channel.name.startswith(f"{STATISTICS}/"):
                self._answered(channel.name.removeprefix(f"{STATISTICS}/"), log_time, found)
            else:
                self._message(channel.name, log_time, data, found)
        return found

    def finish(self) -> None:
        """Enter the last misses of the log, for which no statistics of their modules follow."""
        for each in self._uncounted.values():
            self._scan.enter(each)

    def _message(self, name: str, time: int, data: bytes, found: list[TimelineEvent]) -> None:
        cls, read = _READERS[name]
        try:
            found += read(self, time, cdr(cls).decode(data), len(data))
        except DecodeError:
            self._scan.left_out[f"undecodable messages of {name}"] += 1
        for known in (self._reasons, self._losses, self._signalled):
            if len(known) > _NAMES_MAX:
                known.clear()

    def _answered(self, module: str, time: int, found: list[TimelineEvent]) -> None:
        """Leave out the logged misses of a module that its statistics have; those of long before are no part of it."""
        waiting = self._uncounted.pop(module, [])
        self._waiting -= len(waiting)
        found += [each for each in waiting if time - each.time > ANSWER_WITHIN]

    def event(self, time: int, event: RecordedEvent, size: int) -> list[TimelineEvent]:
        if event.kind.startswith("module ") and event.module:
            self._scan.module_events.add(event.module, time, event, size)
        elif event.kind in {"master", "no master"}:
            self._scan.masters.add(event.link, time, event.module if event.kind == "master" else "", size)
        return [event_of(time, event)]

    def signal(self, time: int, signal: RecordedSignal, _size: int) -> list[TimelineEvent]:
        if signal.source == "publisher":
            self._signalled.add(signal.module)
        return [signal_event(time, signal, self._reasons)]

    def log(self, time: int, record: LogRecord, _size: int) -> list[TimelineEvent]:
        event = log_event(time, record)
        if event is None:
            return []
        miss = logged_miss(event, self._reasons)
        if miss is None:
            return [event]
        if (module := module_of(event)) in self._signalled:
            return []
        if self._waiting >= _NAMES_MAX:
            return [miss]
        self._waiting += 1
        self._uncounted.setdefault(module, []).append(miss)
        return []

    def slot_table(self, time: int, table: SlotTable, size: int) -> list[TimelineEvent]:
        is_kept = self._scan.slots.add(table.bus, time, table, size)
        return slot_changes(self._slots, time, table) if is_kept else []

    def parameter(self, time: int, value: ParameterValue, size: int) -> list[TimelineEvent]:
        is_kept = self._scan.parameters.add((value.module, value.node, value.name), time, value, size)
        change = parameter_change(self._parameters, time, value) if is_kept else None
        return [] if change is None else [change]

    def recorder(self, time: int, losses: RecorderLosses, _size: int) -> list[TimelineEvent]:
        return recorder_losses(self._losses, time, losses)


_READERS: dict[str, tuple[type[Message], Callable[[_Observed, int, Any, int], list[TimelineEvent]]]] = {
    EVENTS: (RecordedEvent, _Observed.event),
    SIGNALS: (RecordedSignal, _Observed.signal),
    LOGS: (LogRecord, _Observed.log),
    SLOTS: (SlotTable, _Observed.slot_table),
    PARAMETERS: (ParameterValue, _Observed.parameter),
    LOSSES: (RecorderLosses, _Observed.recorder),
}
