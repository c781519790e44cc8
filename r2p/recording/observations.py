"""What a recorder sees besides messages, as the messages of `r2p.recording.messages`.

    /r2p/events              RecordedEvent: links, modules, masters, notices
    /r2p/log                 LogRecord: what nodes log, as in ROS
    /r2p/signals             RecordedSignal: messages that were missed, late or lost, and how that is known
    /r2p/buses               BusState: master and clock of each RTCAN bus of the recording module, once a second
    /r2p/slots               SlotTable: the owners of the slots of each bus
    /r2p/bus_load/BUS        BusTraffic: all of a bus, once a second; below it, /KIND/TOPIC/MODULE: its parts
    /r2p/statistics/MODULE   ModuleStatistics, once a second; each 10 s where its link is slow
    /r2p/parameters          ParameterValue: all of them at the beginning, then their changes
    attachments              network.json, parameters.toml, and files of the program, such as r2p.toml

The recording module knows each signal of its own publishers, one by one. Of other modules it knows what they count, and
reasons from their log. Firmware counts nothing, and ROS nodes are not asked.
"""

import asyncio
import json
import platform
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from types import TracebackType
from typing import Any, Self

import msgspec
import tomli_w

from r2p.errors import Closed
from r2p.log_lines import get_logger
from r2p.messages import Message, Timestamp
from r2p.modules.graph import ModuleView, NetworkView
from r2p.modules.module import Module
from r2p.monitoring.log import LogEntry, LogFollower
from r2p.monitoring.polling import can_be_asked
from r2p.parameters.definition import ParameterInfo
from r2p.protocols.discovery.events import Mismatched, ModuleChanged, ModuleGone, NameConflict
from r2p.recording.bus_watch import BusWatch
from r2p.recording.entries import AttachmentEntry, BagEntry, MessageEntry
from r2p.recording.messages import EVENTS, LOGS, SIGNALS, TEXT_MAX, LogRecord, RecordedEvent, RecordedSignal, cut
from r2p.recording.module_watch import ModuleWatch, Parameters
from r2p.runtime.events import LinkDown, LinkNotice, LinkUp, LinkWaits, Listening, ModuleEvent
from r2p.runtime.qos import PublisherSignal, SignalKind
from r2p.units import SECOND
from r2p.version import __version__

SIGNALS_MAX = 1000
"""Signals in a second that are recorded one by one; further ones are added up, by publisher and reason."""

_SETTLED = 3 * SECOND  # ns after which the network is known, and described in attachments
_SETTLED_WITHOUT_ANSWERS = 10 * SECOND  # ns, the same if modules are silent
_FIRMWARE_SILENT = 15.0  # s; it says ALIVE once in all its announcements, one of which it sends each half second
_STAMP_MAX = ((1 << 32) - 1) * SECOND  # ns, the last one that a message can have
_MODULES_MAX = 256  # modules that are asked: names come from the network, and channels of a file stay

logger = get_logger("r2p.recording")

NETWORK, PARAMETERS_FILE = "network.json", "parameters.toml"
"""The names of the attachments that describe the network."""

Attachments = Mapping[str, tuple[str, bytes]]
"""Files by name: their media type, and their contents."""


class Observations:
    """Observes the network of an open module in its block, and hands what it sees to `add`, within the event loop.

    `files` are attached as they are. It is a part of a `Recorder`.
    """

    def __init__(self, module: Module, add: Callable[[BagEntry], object], files: Attachments | None = None) -> None:
        self._module = module
        self._add = add
        self._files = files or {}
        self._clock = module.space.clock
        self._began = self._clock.monotonic()
        self._signals = _SignalRecorder(module.name, self._record)
        self._states: dict[str, str] = {}  # of modules, as they were recorded last
        self._watches: dict[str, tuple[ModuleWatch, asyncio.Task[None]]] = {}
        self._asked: set[str] = set()
        self._former: dict[str, Parameters] = {}  # of modules that are gone
        self._described = False

    def _record(self, channel: str, message: Message) -> None:
        self._add(MessageEntry(channel, message, self._clock.now()))

    async def __aenter__(self) -> Self:
        """Begin to observe. Raises Closed if the module is not open."""
        self._buses = BusWatch(self._module, self._record)
        self._log = LogFollower(self._module)
        self._log.listeners.append(lambda entry: self._record(LOGS, log_record(entry)))
        await self._log.__aenter__()
        self._events = self._module.events()
        self._module.space.signal_listeners.append(self._signals.write)
        self._begin()
        self._task = asyncio.create_task(self._run(), name=f"{self._module.name} observations")
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End, and record what was kept back."""
        self._module.space.signal_listeners.remove(self._signals.write)
        self._task.cancel()
        await asyncio.wait([self._task])
        self._signals.flush()
        self._buses.close()
        await self._log.__aexit__(None, None, None)
        self._describe()

    async def _run(self) -> None:
        try:
            async with asyncio.TaskGroup() as tasks:
                looking = tasks.create_task(self._look_each_second(tasks))
                await self._follow_events()
                looking.cancel()
                for _, task in self._watches.values():
                    task.cancel()
        except Exception as error:
            logger.error("internal error, please report it: the recording goes on with messages only", exc_info=error)

    async def _follow_events(self) -> None:
        """Record events until the module is closed."""
        lost = 0
        async for event in self._events:
            self._record_event(event)
            if self._events.lost > lost:
                self._record(EVENTS, RecordedEvent(kind="events lost", count=self._events.lost - lost))
                lost = self._events.lost

    def _begin(self) -> None:
        """Record what is there at the beginning."""
        for name, (media_type, data) in self._files.items():
            self._attach(name, media_type, data)
        for link in self._module.links:
            kind = "link up" if link.up else "link down"
            self._record(EVENTS, RecordedEvent(kind=kind, link=cut(link.name), text="as the recording began"))
        for view in self._module.network.modules():
            self._record_module(view)

    # Events

    def _record_event(self, event: ModuleEvent) -> None:
        match event:
            case ModuleChanged(info):
                views = (each for each in self._module.network.modules() if each.name == info.name and each.link)
                if (view := next(views, None)) is not None:
                    self._record_module(view)
            case ModuleGone(info):
                self._states.pop(info.name, None)
                self._record(EVENTS, event_message(event))
            case LinkNotice(link, "master" | "no master" as kind, text):
                self._buses.note_master(link, kind, text)
            case _:
                self._record(EVENTS, event_message(event))

    def _record_module(self, view: ModuleView) -> None:
        """Record that a module is new, or that its state or version is another one; but not a tool that records."""
        if not view.link and self._module.observer:
            return
        text = ", ".join(filter(None, (view.state, view.kind, view.release)))
        before = self._states.get(view.name)
        if text == before or (before is None and len(self._states) >= _MODULES_MAX):
            return
        self._states[view.name] = text
        kind = "module found" if before is None else "module changed"
        event = RecordedEvent(kind=kind, module=cut(view.name), link=cut(view.link), text=cut(text, TEXT_MAX))
        self._record(EVENTS, event)

    # Once a second

    async def _look_each_second(self, tasks: asyncio.TaskGroup) -> None:
        while True:
            try:
                self._note_silent_firmware()
                self._watch_modules(tasks)
                self._buses.look()
            except Closed:
                return
            if self._is_known():
                self._describe()
            await asyncio.sleep(1.0)
            self._signals.flush()

    def _note_silent_firmware(self) -> None:
        """Record firmware that is heard no more, or again: discovery remembers it for good."""
        for view in self._module.network.modules():
            if view.kind != "firmware":
                continue
            if view.age < _FIRMWARE_SILENT:
                self._record_module(view)
            elif self._states.pop(view.name, None) is not None:
                text = f"firmware: not heard for {_FIRMWARE_SILENT:.0f} s"
                self._record(EVENTS, RecordedEvent(kind="module silent", module=cut(view.name), text=text))

    def _watch_modules(self, tasks: asyncio.TaskGroup) -> None:
        """Begin to ask new modules, and stop asking those that have left."""
        names = {view.name for view in self._module.network.modules() if can_be_asked(view)}
        for name in sorted(self._watches.keys() - names):
            watch, task = self._watches.pop(name)
            task.cancel()
            self._former[name] = watch.parameters or {}
        for name in sorted(names - self._watches.keys()):
            if name not in self._asked and len(self._asked) >= _MODULES_MAX:
                continue
            self._asked.add(name)
            watch = ModuleWatch(self._module, name, self._record, self._began)
            self._watches[name] = watch, tasks.create_task(watch.run(), name=f"recorder asks {name}")

    # Attachments

    def _is_known(self) -> bool:
        """Return whether the network has announced all that it has, and its modules have answered or had their time."""
        elapsed = self._clock.monotonic() - self._began
        answered = all(watch.parameters is not None for watch, _ in self._watches.values())
        return elapsed >= _SETTLED and (answered or elapsed >= _SETTLED_WITHOUT_ANSWERS)

    def _describe(self) -> None:
        """Attach descriptions of the network, once."""
        if self._described:
            return
        self._described = True
        known = self._former | {name: each.parameters for name, (each, _) in self._watches.items() if each.parameters}
        infos = [info for parameters in known.values() for info in parameters.values()]
        self._attach(NETWORK, "application/json", network_file(self._module.network))
        if infos:
            self._attach(PARAMETERS_FILE, "application/toml", parameters_file(infos))

    def _attach(self, name: str, media_type: str, data: bytes) -> None:
        self._add(AttachmentEntry(name, media_type, data, self._clock.now()))


def log_record(entry: LogEntry) -> LogRecord:
    """Return a log record as it is recorded: as those of ROS, which Foxglove and rqt show as a log."""
    name = "/".join(filter(None, (entry.module, entry.node)))
    stamp = Timestamp.from_ns(min(max(entry.stamp, 0), _STAMP_MAX))
    return LogRecord(stamp=stamp, level=entry.level, name=cut(name), msg=cut(entry.text, TEXT_MAX))


def event_message(event: ModuleEvent) -> RecordedEvent:
    """Return an event of a module as it is recorded."""
    match event:
        case LinkUp(link, outage, lost):
            return RecordedEvent(kind="link up", link=cut(link), outage=outage, count=lost)
        case LinkDown(link, reason):
            return RecordedEvent(kind="link down", link=cut(link), text=cut(reason, TEXT_MAX))
        case LinkWaits(link, reason):
            return RecordedEvent(kind="link waits", link=cut(link), text=cut(reason, TEXT_MAX))
        case LinkNotice(link, kind, text):
            return RecordedEvent(kind="notice", link=cut(link), notice=cut(kind), text=cut(text, TEXT_MAX))
        case Listening(url, address):
            return RecordedEvent(kind="listening", link=cut(url), text=cut(address, TEXT_MAX))
        case Mismatched():
            return RecordedEvent(kind="mismatch", topic=cut(event.topic), text=cut(event.describe(), TEXT_MAX))
        case NameConflict(module):
            return RecordedEvent(kind="name conflict", module=cut(module))
        case ModuleGone(info, silent):
            return RecordedEvent(kind="module silent" if silent else "module gone", module=cut(info.name))
        case ModuleChanged(info):
            return RecordedEvent(kind="module changed", module=cut(info.name))


def network_file(network: NetworkView) -> bytes:
    """Return the modules, nodes and topics of a network, and the versions of what records it."""
    modules = [msgspec.to_builtins(view) for view in network.modules()]
    nodes = [
        {"module": module, "node": node, "publishes": published, "subscribes": subscribed}
        for (module, node), (published, subscribed) in network.nodes().items()
    ]
    topics = [
        {"topic": view.name, "type": view.layout.name if view.layout else view.ros_type, "size": view.size}
        for view in network.topics().values()
    ]
    versions = {"r2p": __version__, "python": platform.python_version(), "system": platform.system()}
    content = {"versions": versions, "modules": modules, "nodes": nodes, "topics": topics}
    return json.dumps(content, indent=2).encode()


def parameters_file(infos: Iterable[ParameterInfo]) -> bytes:
    """Return parameters as a file that `r2p run --params` and `r2p param load` read.

    Modules have the names that they have themselves, without the prefix of a gateway, unless two would be the same.
    """
    infos = list(infos)
    modules = {info.module for info in infos}
    short = {name: name.rpartition("/")[2] for name in modules}
    taken = list(short.values())
    tables: dict[str, Any] = {}
    for info in infos:
        own = short[info.module]
        name = own if taken.count(own) == 1 else info.module
        value = list(info.value) if isinstance(info.value, tuple) else info.value
        tables.setdefault(name, {}).setdefault(info.node, {})[info.name] = value
    return tomli_w.dumps({"format": 1, "params": tables}).encode()


class _SignalRecorder:
    """Records signals of the publishers of this module: in a flood, those beyond SIGNALS_MAX a second added up."""

    def __init__(self, module: str, record: Callable[[str, Message], None]) -> None:
        self._module = module
        self._record = record
        self._written = 0
        self._sums: dict[RecordedSignal, int] = Counter()

    def write(self, signal: PublisherSignal) -> None:
        message = self._message(signal)
        if self._written < SIGNALS_MAX:
            self._written += 1
            self._record(SIGNALS, message)
        else:
            key = msgspec.structs.replace(message, late=0.0, count=0, sequence=0)
            self._sums[key] += message.count

    def flush(self) -> None:
        """Record the sums of the last second."""
        sums, self._sums, self._written = self._sums, Counter(), 0
        for message, count in sums.items():
            self._record(SIGNALS, msgspec.structs.replace(message, count=count, interval=1.0))

    def _message(self, signal: PublisherSignal) -> RecordedSignal:
        missed = signal.missed
        return RecordedSignal(
            kind=signal.kind.value,
            source="publisher",
            topic=cut(missed.topic),
            module=cut(self._module),
            node=cut(signal.node),
            publisher_class=int(signal.publisher_class),
            reason=cut(missed.reason, TEXT_MAX),
            where=cut(missed.where),
            late=missed.late,
            # A publisher counts one message as late, also where that has skipped periods.
            count=1 if signal.kind is SignalKind.LATE else missed.count,
            sequence=signal.sequence,
        )
