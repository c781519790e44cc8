"""What happened in a recording, in the order of time: events, misses, changes of slots and parameters, and the log.

    for each in timeline(bag, start, end):
        print(each.time, each.kind, each.about, each.text)

Misses that a recording has one by one come one by one; `collapsed` joins those that repeat within a second.
"""

import heapq
import logging
import re
from bisect import bisect_left
from collections import defaultdict
from collections.abc import Iterable, Iterator
from operator import attrgetter, itemgetter
from typing import Final

import msgspec

from r2p.errors import DecodeError
from r2p.recording.bag import Bag
from r2p.recording.format import ChannelInfo
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
    SampleMeta,
    SlotOwner,
    SlotTable,
)
from r2p.ros.cdr import cdr
from r2p.units import SECOND

KINDS: Final = {
    "link": "links up, down, or waiting for their other end",
    "module": "modules that come, change their state, go, or are silent",
    "master": "elections of RTCAN masters, and buses without one",
    "slots": "slots that a topic gets or loses",
    "missed": "messages that did not reach every subscriber in time, by their publishers",
    "late": "messages that were published or sent after their time",
    "overdue": "messages that came to the recorder after their deadline",
    "lost": "messages that a subscriber, a link or a gateway dropped",
    "degraded": "links that no longer meet the class of a publisher",
    "log": "log records, WARNING and above",
    "parameter": "changes of parameters",
    "notice": "other notices: mismatches of types, conflicts of names, ...",
    "recorder": "messages that the recorder itself lost",
}
"""The kinds of events, and what they are."""

_KIND_OF_EVENT = {"no answer": "module", "answers": "module", "no master": "master", "events lost": "recorder"}
_BASELINE = 11 * SECOND  # tables of slots are repeated every ten seconds
ANSWER_WITHIN = 15 * SECOND
"""Nanoseconds until a module has reported its counters again: on slow links it is asked every ten seconds."""
_TOGETHER = SECOND  # ns in which the same events are joined
_LOGGED_MISS = re.compile(r"topic (\S+)(?: \(.*?\))?: (.+) \(missed (\d+), late \d+ so far\)")

_DELAY = re.compile(r" by [\d.]+ ms$")


class TimelineEvent(msgspec.Struct, frozen=True, kw_only=True):
    """Something that happened at `time` (UTC, ns), of one of KINDS.

    `about` names the link, module, topic or bus. `count` messages are concerned, the latest by `late` seconds.
    `sequence` is the number of the message (0: unknown). Several that were joined lasted until `until`.
    """

    time: int
    kind: str
    about: str
    text: str
    count: int = 1
    late: float = 0.0
    sequence: int = 0
    until: int = 0

    def joined(self, other: "TimelineEvent") -> "TimelineEvent":
        """Return this and a later one as one."""
        return msgspec.structs.replace(
            self, count=self.count + other.count, late=max(self.late, other.late), until=other.time
        )


def timeline(bag: Bag, start: int | None = None, end: int | None = None) -> Iterator[TimelineEvent]:
    """Yield what happened from `start` to `end` (UTC, ns; `end` not included; None: of the recording)."""
    first = bag.start if start is None else start
    parts = (_events(bag, first, end), _misses(bag, first, end), _slots(bag, first, end), _parameters(bag, first, end))
    others = (_overdue(bag, first, end), _recorder(bag, first, end))
    return heapq.merge(*parts, *others, key=attrgetter("time"))


def collapsed(events: Iterable[TimelineEvent]) -> Iterator[TimelineEvent]:
    """Join events that repeat within a second of the first one: they differ in time, number and delay only."""
    waiting: dict[tuple[str, str, str], TimelineEvent] = {}
    for each in events:
        key = each.kind, each.about, each.text
        while waiting and (oldest := next(iter(waiting.values()))).time < each.time - _TOGETHER:
            yield waiting.pop((oldest.kind, oldest.about, oldest.text))
        known = waiting.get(key)
        waiting[key] = each if known is None else known.joined(each)
    yield from waiting.values()


def slots_at(bag: Bag, time: int) -> list[SlotTable]:
    """Return the owners of the slots of each bus at an instant (UTC, ns), as they were recorded last."""
    tables: dict[str, SlotTable] = {}
    for each in bag.messages(SLOTS, SlotTable, start=time - _BASELINE, end=time + 1):
        tables[each.message.bus] = each.message
    return list(tables.values())


# Events


def _events(bag: Bag, start: int, end: int | None) -> Iterator[TimelineEvent]:
    for each in bag.messages(EVENTS, RecordedEvent, start=start, end=end):
        yield event_of(each.log_time, each.message)


def event_of(time: int, event: RecordedEvent) -> TimelineEvent:
    """Return a recorded event as one of the time line; `time` is its log time."""
    word = event.kind.partition(" ")[0]
    kind = _KIND_OF_EVENT.get(event.kind, word if word in KINDS else "notice")
    subject = event.module or event.topic if kind in ("module", "notice") else event.link
    return TimelineEvent(time=time, kind=kind, about=subject or event.link, text=_event_text(event))


def _event_text(event: RecordedEvent) -> str:
    match event.kind:
        case "link up":
            text = f"up after {event.outage:.3g} s, {event.count} messages lost" if event.outage else "up"
        case "link down" | "link waits":
            text = event.kind.removeprefix("link ")
        case "module found" | "module changed" | "module gone" | "module silent":
            text = event.kind.removeprefix("module ")
        case "master" | "no master" | "notice":
            return event.text
        case "events lost":
            return f"{event.count} events came too fast"
        case _:
            text = event.kind
    return f"{text}: {event.text}" if event.text else text


# Misses, with the reasons that logs have


MissReasons = dict[tuple[str, str], tuple[int, str]]
"""By module and topic: when it has logged a miss, and why."""


def _misses(bag: Bag, start: int, end: int | None) -> Iterator[TimelineEvent]:
    reasons: MissReasons = {}
    answers: dict[str, list[int]] | None = None
    signalled = set[str]()  # modules whose signals are there one by one
    logged = ((each.time, each) for each in _log(bag, start, end))
    signals = ((each.log_time, each.message) for each in bag.messages(SIGNALS, RecordedSignal, start=start, end=end))
    merged: Iterator[tuple[int, TimelineEvent | RecordedSignal]] = heapq.merge(logged, signals, key=itemgetter(0))
    for time, each in merged:
        if isinstance(each, RecordedSignal):
            if each.source == "publisher":
                signalled.add(each.module)
            yield signal_event(time, each, reasons)
            continue
        miss = logged_miss(each, reasons)
        if miss is not None:
            module = module_of(each)
            answers = _answers(bag, start, end) if answers is None else answers
            if module in signalled or _is_counted(time, answers.get(module, [])):
                continue
            each = miss
        yield each


def module_of(logged: TimelineEvent) -> str:
    """Return the module of an event of the log."""
    return logged.about.rpartition("/")[0]


def logged_miss(logged: TimelineEvent, reasons: MissReasons) -> TimelineEvent | None:
    """Return the miss that a module has logged, and note its reason; None if the record is about something else.

    Most of these are also in what the module counts: those are left that it logged before it was gone.
    """
    found = _LOGGED_MISS.search(logged.text)
    if found is None:
        return None
    topic, reason, missed = found[1], _DELAY.sub("", found[2]), int(found[3])
    reasons[module_of(logged), topic] = logged.time, reason
    about, text = f"{topic} of {logged.about}", f"{reason}, as it logged"
    return TimelineEvent(time=logged.time, kind="missed" if missed else "late", about=about, text=text)


def _answers(bag: Bag, start: int, end: int | None) -> dict[str, list[int]]:
    """Return when each module has said what it has counted (UTC, ns)."""
    prefix = f"{STATISTICS}/"
    until = None if end is None else end + ANSWER_WITHIN
    times: dict[str, list[int]] = defaultdict(list)
    for each in bag.raw(lambda channel: channel.name.startswith(prefix), start=start, end=until):
        times[each.channel.name.removeprefix(prefix)].append(each.log_time)
    return times


def _is_counted(time: int, answers: list[int]) -> bool:
    """Return whether a logged miss is also in what its module has counted: some are not, of modules that are gone."""
    following = bisect_left(answers, time)
    return following < len(answers) and answers[following] - time <= ANSWER_WITHIN


def signal_event(time: int, signal: RecordedSignal, reasons: MissReasons) -> TimelineEvent:
    """Return the event of a signal, with the reason that its module has logged."""
    owner = f"{signal.module}/{signal.node}" if signal.node else signal.module
    about = f"{signal.topic} of {owner}" if signal.topic else f"link {signal.where} of {owner}"
    text = signal.reason
    if signal.source == "statistics" and not text:
        logged_at, reason = reasons.get((signal.module, signal.topic), (0, ""))
        text = f"{reason}, as it logged" if reason and time - logged_at <= ANSWER_WITHIN else "as it counted"
    elif signal.where and signal.topic:
        text = f"{text} ({signal.where})"
    return TimelineEvent(
        time=time,
        kind=signal.kind if signal.kind in KINDS else "notice",
        about=about,
        text=text,
        count=signal.count,
        late=signal.late,
        sequence=signal.sequence,
    )


def _log(bag: Bag, start: int, end: int | None) -> Iterator[TimelineEvent]:
    for each in bag.messages(LOGS, LogRecord, start=start, end=end):
        if (event := log_event(each.log_time, each.message)) is not None:
            yield event


def log_event(time: int, record: LogRecord) -> TimelineEvent | None:
    """Return the event of a log record; None below WARNING."""
    if record.level < logging.WARNING:
        return None
    text = f"{logging.getLevelName(record.level)}: {record.msg}"
    return TimelineEvent(time=time, kind="log", about=record.name, text=text)


def _overdue(bag: Bag, start: int, end: int | None) -> Iterator[TimelineEvent]:
    """Yield the messages that came after their deadline; by the clock of the recorder, where that is known."""
    for each in bag.raw(lambda channel: channel.kind == "meta", start=start, end=end):
        if (event := overdue_event(each.channel.info, each.log_time, each.sequence, each.data)) is not None:
            yield event


def overdue_event(info: ChannelInfo | None, time: int, sequence: int, data: bytes) -> TimelineEvent | None:
    """Return the event of a message that came after its deadline, by its companion; None if it was in time."""
    try:
        meta = cdr(SampleMeta).decode(data)
    except DecodeError:
        return None
    due = meta.expires or meta.deadline
    if info is None or not 0 < due < time:
        return None
    owner = "/".join(filter(None, (info.module, info.node)))
    return TimelineEvent(
        time=time,
        kind="overdue",
        about=f"{info.topic} of {owner}" if owner else info.topic,
        text="received after its deadline",
        late=(time - due) / SECOND,
        sequence=meta.number or (sequence if info.numbered else 0),
    )


# Changes


SlotOwners = dict[str, dict[tuple[str, str], SlotOwner]]
"""The owners of slots by bus, then by topic and module."""

ParameterValues = dict[tuple[str, str, str], ParameterValue]
"""Parameters by module, node and name."""


def _slots(bag: Bag, start: int, end: int | None) -> Iterator[TimelineEvent]:
    before: SlotOwners = {}
    for each in bag.messages(SLOTS, SlotTable, start=start - _BASELINE, end=end):
        changes = slot_changes(before, each.log_time, each.message)
        if each.log_time >= start:
            yield from changes


def slot_changes(before: SlotOwners, time: int, table: SlotTable) -> list[TimelineEvent]:
    """Return the changes of owners by a table, and enter it; the first one of a bus has none."""
    owners = {(owner.topic, owner.module): owner for owner in table.owners if owner.topic != "sync"}
    known = before.get(table.bus)
    before[table.bus] = owners
    found = []
    for key in sorted(known.keys() | owners.keys()) if known is not None else ():
        text = _slots_text(known.get(key) if known else None, owners.get(key))
        if text:
            about = f"{key[0]} of {key[1]}" if key[0] else "unused slots"
            found.append(TimelineEvent(time=time, kind="slots", about=about, text=f"{text} on {table.bus}"))
    return found


def _slots_text(before: SlotOwner | None, after: SlotOwner | None) -> str:
    if after is None:
        return "" if before is None else f"has lost {_numbers(before)}"
    if before is None:
        return f"has {_numbers(after)}"
    return f"has {_numbers(after)} instead of {_numbers(before)}" if before.slots != after.slots else ""


def _numbers(owner: SlotOwner) -> str:
    return f"slot{'' if len(owner.slots) == 1 else 's'} {', '.join(map(str, owner.slots))}"


def _parameters(bag: Bag, start: int, end: int | None) -> Iterator[TimelineEvent]:
    values: ParameterValues = {}
    for each in bag.messages(PARAMETERS, ParameterValue, end=end):
        change = parameter_change(values, each.log_time, each.message)
        if change is not None and each.log_time >= start:
            yield change


def parameter_change(values: ParameterValues, time: int, new: ParameterValue) -> TimelineEvent | None:
    """Enter the value of a parameter and return its change; None for the first value."""
    key = new.module, new.node, new.name
    before, values[key] = values.get(key), new
    if before is None or (before.value, before.gone) == (new.value, new.gone):
        return None
    text = "gone" if new.gone else f"{f'{new.value} {new.unit}'.rstrip()}, was {before.value} ({new.origin})"
    about = f"{new.module}/{new.node}.{new.name}"
    return TimelineEvent(time=time, kind="parameter", about=about, text=text)


def _recorder(bag: Bag, start: int, end: int | None) -> Iterator[TimelineEvent]:
    """Yield what the recorder lost."""
    before: LossTotals = {}
    for each in bag.messages(LOSSES, RecorderLosses, end=end):
        grown = recorder_losses(before, each.log_time, each.message)
        if each.log_time >= start:
            yield from grown


LossTotals = dict[str, tuple[int, int]]
"""By topic: messages that the recorder has dropped, and missed."""


def recorder_losses(before: LossTotals, time: int, losses: RecorderLosses) -> list[TimelineEvent]:
    """Return what the recorder has lost since the totals of before, and enter the new ones."""
    found = []
    for topic in losses.topics:
        dropped, missed = before.get(topic.topic, (0, 0))
        before[topic.topic] = topic.dropped, topic.missed
        grown = {
            "dropped, as the disk was too slow or full": topic.dropped - dropped,
            "lost on their way to the recorder": topic.missed - missed,
        }
        found += [
            TimelineEvent(time=time, kind="recorder", about=topic.topic, text=text, count=count)
            for text, count in grown.items()
            if count > 0
        ]
    return found
