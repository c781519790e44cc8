"""One node in `r2p top`: its state, its parameters, which can be set with --allow-control, and its log."""

import asyncio
import logging
from collections import deque
from typing import ClassVar

from rich.text import Text
from textual import on
from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.screen import Screen
from textual.widgets import Input

import r2p
from r2p.log_lines import printable
from r2p.monitoring.log import LogEntry, LogFollower
from r2p.monitoring.snapshot import NetworkSnapshot, NodeFigures
from r2p.tools.log import clock_text
from r2p.tools.param.texts import range_text, shown
from r2p.tools.top import drawing
from r2p.tools.top.details import TopDetails
from r2p.tools.top.figures_table import FiguresTable
from r2p.tools.top.tables import Column, View
from r2p.tools.top.text_lines import KeyLine, TextLines

_LOG_LINES = 8
_KEYS = "Esc back  q quit  up/down parameters  Enter set"
_STYLES = {logging.DEBUG: "dim", logging.WARNING: "yellow", logging.ERROR: "red", logging.CRITICAL: "bold red"}

PARAMETERS = View(
    "parameters",
    [
        Column("name", "PARAMETER", 16, lambda row: row.name, drawing.text),
        Column("value", "VALUE", 12, lambda row: f"{shown(row, row.value)} {row.unit}".strip(), drawing.text),
        Column("range", "RANGE", 16, lambda row: range_text(row) or None, drawing.text),
        Column("origin", "FROM", 10, lambda row: row.origin, drawing.text),
        Column("doc", "MEANING", 30, lambda row: row.doc or None, drawing.text, extra=True),
    ],
    lambda _snapshot: [],
)


class NodeScreen(Screen[None]):
    """A node, until Escape. Its log is subscribed, and its parameters are watched, while the screen is open."""

    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("escape,backspace", "back", show=False),
        Binding("q,ctrl+c", "app.quit", show=False),
    ]

    def __init__(self, details: TopDetails, module: str, node: str) -> None:
        super().__init__()
        self.module = module
        self.node_name = node
        self._details = details
        self._entries: deque[LogEntry] = deque(maxlen=_LOG_LINES)
        self._setting: r2p.ParameterInfo | None = None

    def compose(self) -> ComposeResult:
        """Return the lines, the parameters and the log."""
        yield TextLines(Text(printable(f"{self.module}/{self.node_name}"), style="bold cyan"), "", "", id="node")
        yield FiguresTable(PARAMETERS)
        yield TextLines(Text("log: new records appear here", style="dim"), id="log")
        yield Input(compact=True)
        yield KeyLine(_KEYS)

    def on_mount(self) -> None:
        """Subscribe to the log, and ask for the parameters."""
        self.query_one(FiguresTable).focus()
        self.show(self._details.snapshot)
        self.run_worker(self._follow_log(), exit_on_error=True)
        self.run_worker(self._watch_parameters(), exit_on_error=True)

    async def _follow_log(self) -> None:
        async with LogFollower(self._details.session.module) as follower:
            follower.listeners.append(self._add_entry)
            await asyncio.get_running_loop().create_future()

    def _add_entry(self, entry: LogEntry) -> None:
        if (entry.module, entry.node) == (self.module, self.node_name):
            self._entries.append(entry)
            self.query_one("#log", TextLines).show(*map(log_line, self._entries))

    async def _watch_parameters(self) -> None:
        network = self._details.session.module.network
        try:
            async for known in network.follow_parameters(self.module):
                rows = [info for (node, _), info in known.items() if node == self.node_name]
                self.query_one(FiguresTable).show(rows)
                if not rows:
                    self.query_one(KeyLine).say(f"{self.node_name} has no parameters; Esc goes back")
        except (r2p.Error, TimeoutError) as error:
            self.query_one(KeyLine).say(f"parameters: {error}")

    def show(self, snapshot: NetworkSnapshot) -> None:
        """Show the state of the node in a snapshot."""
        nodes = (each for module in snapshot.modules if module.name == self.module for each in module.nodes)
        node = next((each for each in nodes if each.name == self.node_name), NodeFigures(self.node_name))
        if self.is_mounted:
            self.query_one("#node", TextLines).show(*node_lines(self.module, node))

    @on(FiguresTable.Opened)
    def _open(self, event: FiguresTable.Opened) -> None:
        """Ask for the new value of a parameter."""
        info: r2p.ParameterInfo = event.row
        if not self._details.allow_control:
            self.query_one(KeyLine).say(f"to set {info.name}, start r2p top with --allow-control")
        elif info.read_only:
            self.query_one(KeyLine).say(f"{info.name} is read-only: it is set when the module starts")
        else:
            self._setting = info
            entry = self.query_one(Input)
            value = shown(info, info.value)
            entry.value = value if value.isprintable() else ""  # an entry is drawn as it is
            entry.placeholder = printable(f"{info.name}: {range_text(info) or info.kind} {info.unit}".strip())
            self._show_entry(visible=True)

    def _show_entry(self, *, visible: bool) -> None:
        entry = self.query_one(Input)
        entry.set_class(visible, "shown")
        self.query_one(KeyLine).display = not visible
        (entry if visible else self.query_one(FiguresTable)).focus()

    @on(Input.Submitted)
    async def _set(self, event: Input.Submitted) -> None:
        info, self._setting = self._setting, None
        self._show_entry(visible=False)
        if info is not None:
            self.run_worker(self._set_parameter(info, event.value), exit_on_error=True)

    async def _set_parameter(self, info: r2p.ParameterInfo, text: str) -> None:
        """Set a parameter, and say what its module has answered."""
        line = self.query_one(KeyLine)
        try:
            value = info.parse(text)
            await self._details.session.module.network.set_parameters(self.module, {(info.node, info.name): value})
        except (r2p.Error, TimeoutError) as error:
            line.say(str(error))
        else:
            line.say(f"{info.full_name} = {shown(info, value)} (was {shown(info, info.value)})")

    def action_back(self) -> None:
        """Close the entry of a value, or the screen."""
        if self.query_one(Input).has_class("shown"):
            self._show_entry(visible=False)
        else:
            self.app.call_later(self.app.pop_screen)  # not awaited here: the screen itself would wait for its end

    def on_key(self) -> None:
        """Show the keys again, where a message has taken their place."""
        self.query_one(KeyLine).show_keys()


def node_lines(module: str, node: NodeFigures) -> list[Text]:
    """Return what is known of a node."""
    head = Text(printable(f"{module}/{node.name}"), style="bold cyan")
    state = drawing.UNKNOWN if node.running is None else "running" if node.running else "ended"
    head.append(f"  {state}  {drawing.count(node.restarts)} restarts", style="not bold default")
    publishes = ", ".join(node.publishes) or drawing.UNKNOWN
    subscribes = ", ".join(node.subscribes) or drawing.UNKNOWN
    return [head, Text(printable(f"publishes {publishes}")), Text(printable(f"subscribes {subscribes}"))]


def log_line(entry: LogEntry) -> Text:
    """Return a record of the log as a line."""
    level = max((each for each in _STYLES if each <= entry.level), default=logging.DEBUG)
    style = "" if logging.DEBUG < entry.level < logging.WARNING else _STYLES[level]
    name = logging.getLevelName(entry.level)
    return Text(f"{clock_text(entry.stamp)} {name:<8} {printable(entry.text)}", style=style)
