"""Plots of a recording: the least and the greatest values of each step of time, so that a peak of one message shows.

Where there is much to read, a preview comes first: a few messages of some chunks, in an order that spreads over the
whole time. What is sent of it is coarse, then all messages are read, and a page can ask for another time meanwhile.
Points are at the log times of messages, which is the time of the recorder's computer: that of the time line.
"""

import asyncio
import itertools
import math
from bisect import bisect_left
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from operator import itemgetter
from typing import Any, TypeVar

import msgspec

from r2p.errors import BagError, DecodeError, WebError
from r2p.monitoring.fields import FieldExtractor
from r2p.recording.bag import Bag
from r2p.recording.channels import BagChannel
from r2p.recording.format import CDR
from r2p.recording.mcap_reader import ChunkRef, MessageRecord
from r2p.recording.message_index import indexed
from r2p.units import SECOND
from r2p.web.dash.recorded.reader import ChunkTable, RecordingReader

T = TypeVar("T")

POINTS_MAX = 20_000
"""Points of each column at most, whatever a page asks for."""

_FEW = 50  # chunks that need no preview
_PREVIEW = 4  # messages of each channel in a chunk, of as many chunks as there are steps
_FIRST_AFTER, _FURTHER_AFTER = 0.1, 0.5  # s until the first coarse points, and between further ones
_TIME = itemgetter(0)

Columns = Sequence[Sequence[float]]
Send = Callable[[list[float], Columns, "PlotProgress"], object]


class PlotProgress(msgspec.Struct):
    """How much of a plot has been read: its `share`, and the messages so far."""

    share: float = 0.0
    messages: int = 0
    undecodable: int = 0


def wanted_channels(bag: Bag, topic: str) -> list[BagChannel]:
    """Return the channels with the messages of a topic. Raises WebError if the recording does not have it."""
    found = [each for each in bag.channels if each.info and each.kind == "samples" and each.info.topic == topic]
    if not found:
        raise WebError(f"the recording has no topic {topic[:100]!r}")
    return found


class RecordedPlot:
    """Some fields of a topic between two instants (ns, both included), with at most `points` for each."""

    def __init__(
        self,
        reader: RecordingReader,
        topic: str,
        paths: Sequence[str],
        span: tuple[int | None, int | None],
        points: int,
    ) -> None:
        self._reader = reader
        self._topic = topic
        self._paths = paths
        self._span = span
        self._points = min(max(points, 2), POINTS_MAX)
        self._progress = PlotProgress()
        self._extractors: dict[type, FieldExtractor] = {}

    async def prepare(self) -> None:
        """Find the topic and the fields. Raises WebError and MessageError for those that are not there."""
        bag = await self._reader.bag()
        self._table = await self._reader.run(lambda: self._find(bag))

    async def run(self, send: Send) -> None:
        """Read all chunks, and send what is known of them after a while, further on, and at the end."""
        bag, table = await self._reader.bag(), self._table
        start = bag.start if self._span[0] is None else self._span[0]
        end = bag.end if self._span[1] is None else self._span[1]
        chunks = table.between(start, end)
        steps = MinMaxSteps(len(self._paths), (start, end), self._points)
        self._due = asyncio.get_running_loop().time() + _FIRST_AFTER
        if len(chunks) > _FEW:
            with self._reader.ahead():
                for number, chunk in itertools.islice(spread(chunks), self._points // 2):
                    await self._reader.run(partial(self._read, bag, table.ids[number], steps, number, chunk, _PREVIEW))
                    await self._send(steps, send)
            if steps.has_all:
                steps = MinMaxSteps(len(self._paths), (start, end), self._points)
        for i, (number, chunk) in enumerate(chunks):
            await self._reader.run_behind(partial(self._read, bag, table.ids[number], steps, number, chunk, None))
            self._progress.share = i / len(chunks)
            await self._send(steps, send)
        self._progress.share = 1.0
        await self._send(steps, send)

    async def _send(self, steps: "MinMaxSteps", send: Send) -> None:
        """Send what there is, if the last time is long enough ago, or this is the end."""
        clock = asyncio.get_running_loop().time
        if clock() >= self._due or self._progress.share == 1:
            send(*await self._reader.run(steps.points), self._progress)
            self._due = clock() + _FURTHER_AFTER

    def _find(self, bag: Bag) -> ChunkTable:
        """Return the chunks of the topic, and check that one of its channels has the fields."""
        channels = wanted_channels(bag, self._topic)
        problems = []
        for each in channels:
            if each.cls is None:
                problems.append(each.problem or f"the type of {self._topic} is not in the recording")
            elif each.cls not in self._extractors:
                self._extractors[each.cls] = FieldExtractor(each.cls, self._paths)
        if not self._extractors:
            raise WebError(f"{self._topic} can't be plotted: {problems[0]}")
        return ChunkTable(
            bag, lambda each: each.info is not None and each.kind == "samples" and each.info.topic == self._topic
        )

    def _read(
        self, bag: Bag, ids: frozenset[int], steps: "MinMaxSteps", number: int, chunk: ChunkRef, most: int | None
    ) -> None:
        """Enter the messages of a chunk, or only so many of them, in the thread of the reader."""
        file = bag.files[number]
        try:
            if most is None:
                records = file.messages(chunk, ids, steps.start, steps.end + 1)
            else:
                records = [each for each in indexed(file, chunk, ids, most) if steps.start <= each[0] <= steps.end]
        except BagError:
            self._reader.damaged.add((number, chunk.offset))
            return
        records.sort(key=_TIME)
        by_channel: dict[int, list[MessageRecord]] = defaultdict(list)
        for each in records:
            by_channel[each[1]].append(each)
        for channel, found in by_channel.items():
            counted = self._progress if most is None else PlotProgress()
            self._enter(file.channels[channel], found, steps, counted)

    def _enter(
        self, channel: BagChannel, records: list[MessageRecord], steps: "MinMaxSteps", counted: PlotProgress
    ) -> None:
        extractor = self._extractors.get(channel.cls) if channel.cls is not None else None
        if extractor is None:
            counted.undecodable += len(records)
            return
        before = extractor.undecodable
        times, packed = _packed(channel, records, counted)
        times, columns = extractor.columns(times, packed)
        counted.messages += len(times)
        counted.undecodable += extractor.undecodable - before
        if times:
            steps.add(times, columns)


def _packed(
    channel: BagChannel, records: list[MessageRecord], counted: PlotProgress
) -> tuple[Sequence[float], list[bytes]]:
    """Return the times (ns) and the packed messages of records."""
    if channel.encoding != CDR:
        return [each[0] for each in records], [each[4] for each in records]
    try:
        from_cdr = channel.from_cdr
        return [each[0] for each in records], [from_cdr(each[4], b"") for each in records]
    except DecodeError:
        return _good(channel, records, counted)


def _good(
    channel: BagChannel, records: list[MessageRecord], counted: PlotProgress
) -> tuple[Sequence[float], list[bytes]]:
    times: list[float] = []
    packed: list[bytes] = []
    for each in records:
        try:
            packed.append(channel.from_cdr(each[4], b""))
            times.append(each[0])
        except DecodeError:
            counted.undecodable += 1
    return times, packed


class MinMaxSteps:
    """The least and the greatest value of some columns in each step from `start` to `end` (ns); all, while they fit."""

    def __init__(self, columns: int, span: tuple[int, int], points: int) -> None:
        self.start, self.end = span
        self._columns = columns
        self._points = points
        self._width = max((self.end - self.start) / max(points // 2, 1), 1.0)
        self._all: list[tuple[float, tuple[float, ...]]] | None = []
        self._steps: dict[int, tuple[float, float, list[float], list[float]]] = {}
        """By number: the first time, the last time, the values for the first and those for the last."""

    @property
    def has_all(self) -> bool:
        """Whether all values so far are points."""
        return self._all is not None

    def add(self, times: Sequence[float], columns: Columns) -> None:
        """Enter values at times (ns) in their order."""
        if self._all is not None:
            if len(self._all) + len(times) <= self._points:
                self._all += zip(times, zip(*columns, strict=True), strict=True)
                return
            kept, self._all = sorted(self._all, key=_TIME), None
            if kept:
                self._fold([time for time, _ in kept], list(zip(*(row for _, row in kept), strict=True)))
        self._fold(times, columns)

    def points(self) -> tuple[list[float], Columns]:
        """Return the times (s) and columns of all points so far."""
        if self._all is not None:
            rows = sorted(self._all, key=_TIME)
            found = list(zip(*(row for _, row in rows), strict=True)) or [()] * self._columns
            return [time / SECOND for time, _ in rows], found
        times: list[float] = []
        values: list[list[float]] = []
        for number in sorted(self._steps):
            first, last, before, after = self._steps[number]
            times.append(first / SECOND)
            values.append(before)
            if last > first or after != before:
                times.append(last / SECOND)
                values.append(after)
        return times, list(zip(*values, strict=True))

    def _fold(self, times: Sequence[float], columns: Columns) -> None:
        """Enter values into the steps of their times."""
        at = 0
        while at < len(times):
            number = int((times[at] - self.start) / self._width)
            limit = self.start + (number + 1) * self._width
            end = max(bisect_left(times, limit, at + 1), at + 1)
            self._enter(number, times[at], times[end - 1], [each[at:end] for each in columns])
            at = end

    def _enter(self, number: int, first: float, last: float, columns: Columns) -> None:
        pairs = [_ends(each) for each in columns]
        before, after = [each[0] for each in pairs], [each[1] for each in pairs]
        known = self._steps.get(number)
        if known is not None:
            merged = [_ends(each) for each in zip(known[2], known[3], before, after, strict=True)]
            first, last = min(first, known[0]), max(last, known[1])
            before, after = [each[0] for each in merged], [each[1] for each in merged]
        self._steps[number] = first, last, before, after


def _ends(values: Sequence[float]) -> tuple[float, float]:
    """Return the minimum and the maximum in the order in which they occur, or NaN twice if there are no numbers."""
    least, greatest = min(values), max(values)
    if not (least <= greatest and math.isfinite(greatest - least)):  # NaN is neither less nor greater
        numbers = [each for each in values if each == each]
        if not numbers:
            return math.nan, math.nan
        values, least, greatest = numbers, min(numbers), max(numbers)
    return (least, greatest) if values.index(least) <= values.index(greatest) else (greatest, least)


def spread(items: Sequence[T]) -> Iterator[T]:
    """Yield all items, in an order in which the first ones are all over the sequence: each second of each second..."""
    seen = 0
    step = 1 << max(len(items) - 1, 0).bit_length()
    while step:
        for i in range(0, len(items), step):
            if seen == 0 or i % (2 * step):
                yield items[i]
                seen += 1
        step //= 2


def topic_of(fields: Sequence[str], topics: Sequence[str] | Any) -> tuple[str, list[str]]:
    """Return the topic of fields, and their paths in it. Raises WebError."""
    if not fields:
        raise WebError("a plot needs fields, as odometry.pose.x")
    topic = fields[0].partition(".")[0]
    if topic not in topics:  # of other programs: it may have a dot
        topic = max((each for each in topics if fields[0].startswith(f"{each}.")), key=len, default=topic)
    if not all(each.startswith(f"{topic}.") for each in fields):
        raise WebError("the fields of a plot are of one topic: plot the others in another stream")
    return topic, [each.removeprefix(f"{topic}.") for each in fields]
