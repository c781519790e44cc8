"""A recording as the source of pages, and one page: where in its time it is, and what it has asked for."""

import asyncio
import contextlib
import tomllib
from collections.abc import Awaitable, Callable, Coroutine, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from r2p.errors import BagError, Error
from r2p.log_lines import get_logger
from r2p.monitoring.snapshot import NetworkSnapshot
from r2p.recording.bag import Bag
from r2p.recording.mcap_reader import TIME_MAX
from r2p.units import SECOND
from r2p.version import __version__
from r2p.web.client import WebClient
from r2p.web.dash import protocol
from r2p.web.dash.live import describe
from r2p.web.dash.recorded.cursor import Cursor
from r2p.web.dash.recorded.figures import RecordedFigures
from r2p.web.dash.recorded.log import RECORDS_MAX, RecordedLog
from r2p.web.dash.recorded.messages import WatchedTopic
from r2p.web.dash.recorded.plots import Columns, PlotProgress, RecordedPlot, topic_of, wanted_channels
from r2p.web.dash.recorded.reader import RecordingReader
from r2p.web.dash.recorded.scan import STEPS, RecordingScan
from r2p.web.dash.source import DashSource, SourceSession, check_plot, check_watches, log_level

_TICK = 0.1  # s between two news of a recording that plays
_STATES = 5  # ticks between two states of it
_PORTION = 1000  # of events, misses and gaps in one of the news of the time line
_SCAN_STATES = 1.0  # s between two states while the recording is read through

_READ_ONLY = "this is a recording, which can only be looked at: r2p dash without a file shows a running network"

logger = get_logger("r2p.web")
Answer = Callable[[Any], Awaitable[object]]


class RecordedSource(DashSource):
    """The files of one recording, which are opened while its block is open."""

    def __init__(self, paths: Sequence[Path]) -> None:
        """`paths` are those of `r2p.Bag`: files, directories or patterns."""
        super().__init__()
        self.reader = RecordingReader(paths)
        self.scan = RecordingScan(self.reader)
        self.figures = RecordedFigures(self.reader, self.scan)
        self.log = RecordedLog(self.reader)
        self._paths = paths
        self._scanning: asyncio.Task[None] | None = None

    async def __aenter__(self) -> Self:
        """Begin to open the files."""
        await self.reader.__aenter__()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._scanning is not None:
            self._scanning.cancel()
            await asyncio.wait([self._scanning])
        await self.reader.__aexit__(kind, error, trace)

    async def opened(self) -> Bag:
        """Wait until the files are open. Raises BagError if they can't be read."""
        return await self.reader.bag()

    def hello(self) -> dict[str, Any]:
        more = f" and {len(self._paths) - 1} more" if len(self._paths) > 1 else ""
        return {
            "op": "hello",
            "version": __version__,
            "title": f"{self._paths[0].name}{more}",
            "recording": True,
            "publish": False,
            "control": False,
        }

    def session(self, client: WebClient) -> SourceSession:
        if self._scanning is None:  # not before a page is there: it competes with it for the disk
            self._scanning = asyncio.create_task(self._scan(), name="scan recording")
        return RecordedSession(self, client)

    async def _scan(self) -> None:
        try:
            with contextlib.suppress(BagError):  # the command reports it
                await self.scan.run()
        except Exception as error:
            logger.error("internal error, please report it: the time line has no more events", exc_info=error)


class RecordedSession(SourceSession):
    """Serves one page. Each page has an instant of its own."""

    def __init__(self, source: RecordedSource, client: WebClient) -> None:
        self._source = source
        self._client = client
        self._cursor: Cursor | None = None
        self._due = asyncio.Event()  # figures have to be sent
        self._due.set()
        self._moved = asyncio.Event()  # the cursor stands, and is at another instant, or something else is to be shown
        self._stale = asyncio.Event()  # so do messages and the log
        self._tasks: set[asyncio.Task[None]] = set()
        self._plots: dict[int, asyncio.Task[None] | None] = {}
        """The plots by stream; None while it is being looked up."""
        self._watched: dict[str, WatchedTopic] = {}
        self._level: int | None = None
        """The level from which on the page follows the log; None: it does not."""
        self._logged: int | None = None
        """The instant up to which the page has the log; None: it has to be sent anew."""
        self._has_timeline = False
        self._answers: dict[type, Answer] = {
            protocol.Plot: self._plot,
            protocol.StopPlot: self._stop_plot,
            protocol.Watch: self._watch,
            protocol.Unwatch: self._unwatch,
            protocol.FollowLog: self._follow_log,
            protocol.Describe: self._describe,
            protocol.ListParameters: self._list_parameters,
            protocol.Seek: self._seek,
            protocol.Play: self._play,
            protocol.ReadTimeline: self._read_timeline,
        }

    async def snapshots(self) -> NetworkSnapshot:
        try:
            cursor = await self._opened()
        except BagError as error:
            self._client.close(1011, str(error).encode()[:120].decode(errors="ignore"))
            await asyncio.get_running_loop().create_future()
        await self._due.wait()
        self._due.clear()
        return await self._source.figures.at(cursor.time)

    async def answer(self, request: protocol.DashRequest) -> object:
        act = self._answers.get(type(request))
        if act is None:
            self._source.refused["recording"] += 1
            raise self.refuse(request, _READ_ONLY)
        return await act(request)

    async def close(self) -> None:
        tasks = [*self._tasks, *filter(None, self._plots.values())]
        for each in tasks:
            each.cancel()
        if tasks:
            await asyncio.wait(tasks)

    async def _opened(self) -> Cursor:
        """Wait until the recording is open, and return the cursor. Raises BagError."""
        bag = await self._source.opened()
        if self._cursor is None:
            self._cursor = Cursor(bag.start, bag.end)
            self._moved.set()
            self._begin(self._follow_cursor(self._cursor))
            self._begin(self._follow_topics(self._cursor))
            self._begin(self._follow_scan())
        return self._cursor

    def _begin(self, work: Coroutine[Any, Any, None]) -> None:
        """Begin something that ends with the page."""
        task = asyncio.create_task(_reported(work), name="recording in a page")
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    def _send(self, news: dict[str, Any], stream: str | None = None) -> None:
        self._client.send(protocol.encode(news).decode(), stream)

    # Time

    async def _seek(self, request: protocol.Seek) -> None:
        cursor = await self._opened()
        cursor.seek(request.time)
        self._logged = None
        self._moved.set()

    async def _play(self, request: protocol.Play) -> None:
        cursor = await self._opened()
        before = cursor.time
        cursor.play(request.rate)
        if cursor.time < before:
            self._logged = None
        self._moved.set()

    async def _follow_cursor(self, cursor: Cursor) -> None:
        """Send where the cursor is, after each move, and while it runs; and have the rest sent."""
        tick = 0
        while True:
            if cursor.playing:
                await asyncio.sleep(_TICK)
                cursor.stop_at_end()
            else:
                await self._moved.wait()
            self._moved.clear()
            tick += 1
            if not cursor.playing or tick % _STATES == 0:
                self._due.set()
            self._send({"op": "clock", "time": cursor.time, "playing": cursor.playing, "rate": cursor.rate}, "clock")
            self._stale.set()

    async def _follow_topics(self, cursor: Cursor) -> None:
        """Send messages and the log as they are at the cursor; what takes long to find comes later."""
        while True:
            await self._stale.wait()
            self._stale.clear()
            time = cursor.time
            for topic, watched in list(self._watched.items()):
                if (news := await watched.news(time)) is not None and topic in self._watched:
                    self._send(news, f"message {topic}")
            await self._send_log(time)

    async def _follow_scan(self) -> None:
        """Send figures again as more of the recording is known."""
        while self._source.scan.share < 1:
            await self._source.scan.changed()
            self._due.set()
            await asyncio.sleep(_SCAN_STATES)

    # What happened

    async def _read_timeline(self, _request: protocol.ReadTimeline) -> object:
        bag = await self._source.opened()
        if not self._has_timeline:
            self._has_timeline = True
            self._begin(self._send_timeline())
        return {
            "start": bag.start,
            "end": bag.end,
            "step": max((bag.end - bag.start) // STEPS, 1),
            "files": [each.file.path.name for each in bag.files],
            "problems": bag.problems,
        }

    async def _send_timeline(self) -> None:
        """Send what the scan has found, and then what it finds, in portions."""
        scan = self._source.scan
        found: tuple[list[Any], ...] = (scan.events, scan.misses, scan.gaps)
        sent = [0, 0, 0]
        while True:
            share = scan.share
            parts = [each[at : at + _PORTION] for each, at in zip(found, sent, strict=True)]
            sent = [at + len(part) for at, part in zip(sent, parts, strict=True)]
            is_all = sent == [len(each) for each in found]
            self._send(
                {
                    "op": "timeline",
                    "share": share if is_all else min(share, 0.99),
                    "events": parts[0],
                    "misses": parts[1],
                    "gaps": parts[2],
                    "left_out": scan.left_out.total(),
                    "damaged": len(self._source.reader.damaged),
                }
            )
            await self._client.room()
            if share == 1 and is_all:
                return
            if is_all:
                await scan.changed()

    # Plots and messages

    async def _plot(self, request: protocol.Plot) -> None:
        bag = await self._source.opened()
        check_plot(request, self._plots)
        topic, paths = topic_of(request.fields, bag.topics)
        plot = RecordedPlot(self._source.reader, topic, paths, (_ns(request.start), _ns(request.end)), request.points)
        await self._stop_plot(request)
        self._plots[request.stream] = None
        try:
            await plot.prepare()
        except Error:
            self._plots.pop(request.stream, None)
            raise
        if self._plots.get(request.stream, plot) is None:  # neither stopped nor replaced meanwhile
            self._plots[request.stream] = asyncio.create_task(_reported(self._run_plot(request.stream, plot)))

    async def _run_plot(self, stream: int, plot: RecordedPlot) -> None:
        def send(times: list[float], columns: Columns, progress: PlotProgress) -> None:
            self._client.send(protocol.points(stream, times, columns), f"plot {stream}")
            self._send(
                {
                    "op": "plotted",
                    "stream": stream,
                    "share": progress.share,
                    "messages": progress.messages,
                    "undecodable": progress.undecodable,
                },
                f"plotted {stream}",
            )

        await plot.run(send)

    async def _stop_plot(self, request: protocol.StopPlot | protocol.Plot) -> None:
        task = self._plots.pop(request.stream, None)
        if task is not None:
            task.cancel()

    async def _watch(self, request: protocol.Watch) -> None:
        if request.topic in self._watched:
            return
        check_watches(self._watched)
        watched = WatchedTopic(self._source.reader, request.topic)
        await watched.open()
        self._watched[request.topic] = watched
        self._moved.set()

    async def _unwatch(self, request: protocol.Unwatch) -> None:
        self._watched.pop(request.topic, None)

    async def _follow_log(self, request: protocol.FollowLog) -> None:
        self._level, self._logged = log_level(request.level), None
        self._moved.set()

    async def _send_log(self, time: int) -> None:
        """Send the log up to an instant: what is new, or all of it after a jump."""
        level, before = self._level, self._logged
        if not level or before == time:
            return
        is_new = before is None or before > time
        records = await self._source.log.before(time, level, -1 if is_new or before is None else before)
        if self._level != level or self._logged != before:  # the page has asked for another part meanwhile
            self._stale.set()
            return
        self._logged = time
        is_cleared = is_new or len(records) >= RECORDS_MAX
        if records or is_cleared:
            self._send({"op": "log", "records": records, "dropped": 0, "cleared": is_cleared}, "log")

    # Types and parameters

    async def _describe(self, request: protocol.Describe) -> object:
        if request.service:
            raise self.refuse(request, "a recording does not have the types of services")
        bag = await self._source.opened()
        channels = wanted_channels(bag, request.topic)
        found = await self._source.reader.run(lambda: next((each.cls for each in channels if each.cls), None))
        if found is None:
            raise self.refuse(request, channels[0].problem or f"the type of {request.topic} is not in the recording")
        return describe(found)

    async def _list_parameters(self, request: protocol.ListParameters) -> object:
        cursor = await self._opened()
        return [
            {
                "module": each.module,
                "node": each.node,
                "name": each.name,
                "kind": each.kind,
                "value": _value(each.value),
                "unit": each.unit,
                "origin": each.origin,
                "choices": [each.value.strip('"')] if each.kind == "enum" else [],
            }
            for each in self._source.scan.parameters.at(cursor.time).values()
            if each.module == request.module and not each.gone
        ]


async def _reported(work: Coroutine[Any, Any, None]) -> None:
    """Do some work for a page. An error ends only this work."""
    try:
        await work
    except Exception as error:
        logger.error("internal error, please report it: a page lacks a part of the recording", exc_info=error)


def _ns(seconds: float | None) -> int | None:
    """Return an instant that a page names, in ns; within what a file can have."""
    return None if seconds is None else int(min(max(seconds, 0.0), TIME_MAX / SECOND) * SECOND)


def _value(text: str) -> object:
    """Return the value of a parameter, which a recording has as TOML; the text itself if it can't be read."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except (ValueError, KeyError, RecursionError):
        return text
