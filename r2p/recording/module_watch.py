"""What a recorder asks of one module: its statistics, once a second, and its parameters with their changes.

Each module has tasks of its own, so a slow or silent one delays no other. A slow one is asked less often: see
`QuestionPace`.

The counters of a module only grow, so `growth` is what happened between two answers. A module that ends takes what it
counted since its last answer with it.
"""

import asyncio
import math
from collections import Counter
from collections.abc import Callable, Iterator

import msgspec
import tomli_w

from r2p.codecs.parameters import Plain
from r2p.errors import Error
from r2p.messages import Message
from r2p.modules.module import Module
from r2p.modules.statistics import ModuleStatistics
from r2p.monitoring.polling import PERIOD, RETRY, QuestionPace
from r2p.parameters.definition import ParameterInfo
from r2p.recording.messages import (
    EVENTS,
    PARAMETERS,
    SIGNALS,
    STATISTICS,
    TEXT_MAX,
    VALUE_MAX,
    ParameterValue,
    RecordedEvent,
    RecordedSignal,
    cut,
)

_COUNT_MAX = (1 << 64) - 1  # sums of what modules say may be greater
_TOOL = "recorder"  # the name for what `r2p bag record` has lost itself, such as on its link

Parameters = dict[tuple[str, str], ParameterInfo]
"""The parameters of a module, by node and name."""


class ModuleWatch:
    """Asks one module, this one or another, and records its answers."""

    def __init__(self, module: Module, name: str, record: Callable[[str, Message], None], since: int) -> None:
        """`since` is when the recording began (monotonic ns): what a younger module has counted happened in it."""
        self.parameters: Parameters | None = None
        """The parameters as they are now; None: not known yet."""
        self.name = name
        self._module = module
        self._record = record
        self._clock = module.space.clock
        self._since = since
        self._is_own = name == module.name
        self._is_tool = self._is_own and module.observer
        self._pace = QuestionPace(module, name)
        self._silent = False

    async def run(self) -> None:
        """Ask until cancelled."""
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(self._follow_parameters())
            tasks.create_task(self._follow_statistics())

    # Statistics

    async def _follow_statistics(self) -> None:
        before: ModuleStatistics | None = None
        asked_at = self._since
        while True:
            started = self._clock.monotonic()
            try:
                statistics = await self._statistics()
            except (Error, TimeoutError) as error:
                self._note_silence(str(error))
                await self._pace.pause(RETRY)
                continue
            now = self._clock.monotonic()
            self._pace.took = (now - started) * 1e-9
            self._note_answer()
            if not self._is_tool:  # whose name is a random one
                self._record(f"{STATISTICS}/{self.name}", statistics)
            if before is None and statistics.uptime < (now - self._since) * 1e-9:
                before = ModuleStatistics()
            if before is not None:
                interval = (now - asked_at) * 1e-9
                for signal in growth(_TOOL if self._is_tool else self.name, before, statistics, own=self._is_own):
                    self._record(SIGNALS, msgspec.structs.replace(signal, interval=interval))
            before, asked_at = statistics, now
            await self._pace.pause()

    async def _statistics(self) -> ModuleStatistics:
        return self._module.statistics() if self._is_own else await self._module.network.statistics(self.name)

    def _note_silence(self, reason: str) -> None:
        if not self._silent:
            self._silent = True
            self._record(EVENTS, RecordedEvent(kind="no answer", module=cut(self.name), text=cut(reason, TEXT_MAX)))

    def _note_answer(self) -> None:
        if self._silent:
            self._silent = False
            self._record(EVENTS, RecordedEvent(kind="answers", module=cut(self.name)))

    # Parameters

    async def _follow_parameters(self) -> None:
        while True:
            try:
                following = self._module.network.follow_parameters(self.name, period=PERIOD, pause=self._pace.pause)
                async for parameters in following:
                    self._record_changes(parameters)
            except (Error, TimeoutError):  # as its statistics, which say so
                await self._pace.pause(RETRY)

    def _record_changes(self, parameters: Parameters) -> None:
        before = self.parameters or {}
        for name, info in parameters.items():
            if before.get(name) != info:
                self._record(PARAMETERS, parameter_value(info))
        for name in sorted(before.keys() - parameters.keys()):
            self._record(PARAMETERS, msgspec.structs.replace(parameter_value(before[name]), gone=True))
        self.parameters = parameters


def parameter_value(info: ParameterInfo) -> ParameterValue:
    """Return a parameter as it is recorded."""
    value = info.value
    return ParameterValue(
        module=cut(info.module),
        node=cut(info.node),
        name=cut(info.name),
        kind=info.kind,
        value=cut(_toml(value), VALUE_MAX),
        number=float(value) if isinstance(value, bool | int | float) else math.nan,
        unit=cut(info.unit),
        origin=info.origin,
    )


def _toml(value: Plain) -> str:
    """Return a value as TOML has it, on one line."""
    if isinstance(value, tuple):
        return f"[{', '.join(map(_toml, value))}]"
    return tomli_w.dumps({"v": value}).removeprefix("v = ").rstrip("\n")


# Growth

_Key = tuple[str, ...]


def growth(
    module: str, before: ModuleStatistics, after: ModuleStatistics, *, own: bool = False
) -> Iterator[RecordedSignal]:
    """Yield what was missed, late or lost between two statistics of a module; since its start, if it has restarted.

    Of the recording module (`own`), signals of publishers are recorded one by one, and left out here.
    """
    earlier = _losses(before, own=own) if after.uptime >= before.uptime else Counter[_Key]()
    for key, count in _losses(after, own=own).items():
        grown = count - earlier[key] if count >= earlier[key] else count  # less: it was closed, and opened anew
        if grown:
            kind, topic, node, publisher_class, where, reason = key
            yield RecordedSignal(
                kind=kind,
                source="statistics",
                topic=cut(topic),
                module=cut(module),
                node=cut(node),
                publisher_class=int(publisher_class or 0),
                reason=cut(reason, TEXT_MAX),
                where=cut(where),
                count=min(grown, _COUNT_MAX),
            )


def _losses(statistics: ModuleStatistics, *, own: bool) -> Counter[_Key]:
    """Return all counters of losses: by kind, topic, node, class, place and reason."""
    counts = Counter[_Key]()
    for each in () if own else statistics.publishers:
        key = each.topic, each.node, f"{each.publisher_class}", "", ""
        counts["missed", *key] += each.missed
        counts["late", *key] += each.late
    for sub in statistics.subscribers:
        for reason, name in _SUBSCRIBER_LOSSES.items():
            counts["lost", sub.topic, sub.node, "", "subscriber", reason] += getattr(sub, name)
    for link in statistics.links:
        for loss in link.lost:
            counts["lost", "", "", "", link.link, loss.reason] += loss.count
    for route in statistics.forwarded:
        counts["lost", route.topic, "", "", f"{route.source} to {route.target}", "not forwarded"] += route.dropped
    return counts


_SUBSCRIBER_LOSSES = {"queue full": "lost", "undecodable": "undecodable", "too long": "too_long", "stale": "stale"}
