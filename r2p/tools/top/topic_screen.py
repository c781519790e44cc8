"""One topic in `r2p top`: its figures, who has it, and its fields, each with a sparkline.

It is subscribed and measured while the screen is open. Four times a second the newest message is decoded and shown, so
a sparkline has a point for each quarter of a second, and none where no message came.
"""

import asyncio
import math
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any, ClassVar

import msgspec
from rich.text import Text
from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.screen import Screen

import r2p
from r2p.log_lines import printable
from r2p.messages.values import flatten, to_plain
from r2p.monitoring.snapshot import NetworkSnapshot, TopicFigures
from r2p.tools.top import drawing
from r2p.tools.top.details import TopDetails
from r2p.tools.top.figures_table import FiguresTable
from r2p.tools.top.tables import Column, View, is_of_tool
from r2p.tools.top.text_lines import KeyLine, TextLines

REFRESH = 0.25
"""Seconds between two points of a sparkline."""

_POINTS = 120  # of a sparkline: half a minute
_FIELDS_MAX = 1000
_BYTES_MAX, _BYTES_PER_LINE = 256, 4  # of a message of unknown type that are shown, in hex
_KEYS = "Esc back  q quit  p pause  up/down fields  left/right columns"


class FieldRow(msgspec.Struct):
    """A field, its newest value, and its numbers before."""

    path: str
    value: Any = None
    history: deque[float] = msgspec.field(default_factory=lambda: deque(maxlen=_POINTS))

    def add(self, value: Any) -> None:
        """Note the value of a message."""
        self.value = value
        self.history.append(_as_number(value))

    def extreme(self, choose: Callable[[list[float]], float]) -> float | None:
        """Return the smallest or the largest number."""
        known = [each for each in self.history if math.isfinite(each)]
        return choose(known) if known else None


def _as_number(value: Any) -> float:
    """Return a value as a point of a sparkline; NaN: it has none."""
    return float(value) if isinstance(value, bool | int | float) and abs(value) < 1e300 else math.nan


def _value_text(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)


FIELDS = View(
    "fields",
    [
        Column("field", "FIELD", 16, lambda row: row.path, drawing.text),
        Column("value", "VALUE", 14, lambda row: row.value, _value_text),
        Column("min", "MIN", 7, lambda row: row.extreme(min), drawing.number),
        Column("max", "MAX", 7, lambda row: row.extreme(max), drawing.number),
        Column("history", "LAST 6 s", 24, lambda row: drawing.sparkline(list(row.history), 24), drawing.text),
    ],
    lambda _snapshot: [],
)


class TopicScreen(Screen[None]):
    """A topic, until Escape."""

    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("escape,backspace", "app.pop_screen", show=False),
        Binding("q,ctrl+c", "app.quit", show=False),
        Binding("p,space", "pause", show=False),
    ]

    def __init__(self, details: TopDetails, topic: str) -> None:
        super().__init__()
        self.topic = topic
        self.rows: dict[str, FieldRow] = {}
        self.received = 0
        """Messages since the screen was opened."""
        self._details = details
        self._cls: type[r2p.Message] | None = None
        self._newest: r2p.Sample | None = None
        self._paused = False

    def compose(self) -> ComposeResult:
        """Return the lines and the table of fields."""
        yield TextLines(Text(printable(self.topic), style="bold cyan"), "", "", "", id="topic")
        yield FiguresTable(FIELDS)
        yield KeyLine(_KEYS)

    def on_mount(self) -> None:
        """Subscribe."""
        self.query_one(FiguresTable).focus()
        self.show(self._details.snapshot)
        self.run_worker(self._read(), exit_on_error=True)
        self.run_worker(self._refresh(), exit_on_error=True)

    async def _read(self) -> None:
        """Receive messages until the screen is closed, and have the topic measured meanwhile."""
        try:
            self._details.monitor.measure(self.topic)
        except r2p.Error as error:
            self.query_one(KeyLine).say(str(error))
            return
        try:
            async with self._details.session.node.subscribe(self.topic, None, queue=16, lossy=True) as subscriber:
                async for sample in subscriber.samples():
                    self._newest = sample
                    self.received += 1
        finally:
            self._details.monitor.stop_measuring(self.topic)

    async def _refresh(self) -> None:
        self._cls = await self._details.type_of(self.topic)
        while True:
            await asyncio.sleep(REFRESH)
            if not self._paused:
                self.take_newest()

    def take_newest(self) -> None:
        """Show the newest message, or that none has come since the last call."""
        sample, self._newest = self._newest, None
        self.show_message(None if sample is None else sample.data)

    def show_message(self, data: bytes | None) -> None:
        """Show the fields of a message; None: a gap."""
        if data is None:
            for row in self.rows.values():
                row.history.append(math.nan)
        else:
            self._add(self._decoded(data))
        self.query_one(FiguresTable).show(list(self.rows.values()))

    def _decoded(self, data: bytes) -> Mapping[str, Any]:
        """Return the fields of a message; its bytes, if the type is not known or does not fit."""
        try:
            if self._cls is not None:
                return flatten(to_plain(self._cls.decode(data), "short"))
        except r2p.DecodeError:
            self._cls = None
        self.query_one(KeyLine).say("the type of this topic is unknown: name it in [types] of r2p.toml")
        lines = range(0, min(len(data), _BYTES_MAX), _BYTES_PER_LINE)
        return {f"bytes {i}": data[i : i + _BYTES_PER_LINE].hex(" ") for i in lines}

    def _add(self, fields: Mapping[str, Any]) -> None:
        if fields.keys() != self.rows.keys():
            known = {path: self.rows.get(path) or FieldRow(path) for path in list(fields)[:_FIELDS_MAX]}
            self.rows = known
        for path, row in self.rows.items():
            row.add(fields[path])

    def show(self, snapshot: NetworkSnapshot) -> None:
        """Show the figures of a snapshot."""
        row = next((each for each in snapshot.topics if each.name == self.topic), TopicFigures(self.topic))
        if self.is_mounted and not self._paused:
            self.query_one("#topic", TextLines).show(*topic_lines(row))

    def action_pause(self) -> None:
        """Freeze what is shown, or go on."""
        self._paused = not self._paused
        self.query_one(KeyLine).say("paused: p goes on") if self._paused else self.query_one(KeyLine).show_keys()


def topic_lines(row: TopicFigures) -> list[Text]:
    """Return what is known of a topic."""
    size = drawing.count(row.size)
    classes = sorted({each.publisher_class for each in row.publishers if each.publisher_class})
    head = Text(printable(row.name), style="bold cyan")
    about = f"  {row.type or 'type unknown'}  {'up to ' * row.varies}{size} bytes  {', '.join(classes)}"
    head.append(printable(about), style="not bold default")
    if row.mismatch:
        head.append("  DIFFERENT TYPES", style="bold red")
    p50, p99 = (None, None) if row.latency is None else (row.latency.p50, row.latency.p99)
    figures = (
        f"{drawing.number(row.rate)} Hz ({row.rate_source or 'source unknown'})  {drawing.number(row.bandwidth)} B/s  "
        f"latency p50 {drawing.milliseconds(p50)} p99 {drawing.milliseconds(p99)} ms"
    )
    losses = (
        f"missed {drawing.count(row.missed)}  late {drawing.count(row.late)}  lost on the way "
        f"{drawing.count(row.lost_on_way)}  lost here {drawing.count(row.lost_here)}  "
        f"laxity {drawing.milliseconds(row.laxity)} ms"
    )
    publishers = ", ".join(f"{each.module}/{each.node}" for each in row.publishers) or drawing.UNKNOWN
    tools = sum(is_of_tool(each.module) for each in row.subscribers)
    others = [f"{each.module}/{each.node}" for each in row.subscribers if not is_of_tool(each.module)]
    subscribers = ", ".join([*others, *([f"{tools} of tools"] if tools else [])]) or drawing.UNKNOWN
    return [head, Text(figures), Text(losses), Text(printable(f"from {publishers}  to {subscribers}"))]
