"""The screens of `r2p top`: one table at a time, and what opens from it."""

import asyncio
from typing import Any, ClassVar

from rich.text import Text
from textual import events, on
from textual.app import App, ComposeResult
from textual.binding import Binding, BindingType
from textual.screen import ModalScreen, Screen
from textual.widgets import Input

from r2p.log_lines import printable
from r2p.monitoring.monitor import NetworkMonitor
from r2p.monitoring.snapshot import BusFigures, NetworkSnapshot, ServiceFigures, TopicFigures
from r2p.tools.session import Session
from r2p.tools.top import drawing
from r2p.tools.top.bus_panel import BusPanel
from r2p.tools.top.details import TopDetails
from r2p.tools.top.figures_table import FiguresTable
from r2p.tools.top.node_screen import NodeScreen
from r2p.tools.top.tables import TOPICS, VIEWS, BusRow, NodeRow, RecentLosses, View, matching, sort
from r2p.tools.top.text_lines import KeyLine, TextLines
from r2p.tools.top.topic_screen import TopicScreen

_LINES_MIN = 8  # of a terminal that has room for the keys
_KEYS = "q quit  ? help  / filter  s sort  r reverse  p pause  m measure  Enter open"
_HELP = """\
1 to 6, Tab     tables: topics, modules, nodes, links, buses, services
up, down, PgUp, PgDn, Home, End          move the cursor; j and k, too
left, right     columns that do not fit
Enter           open a topic (fields), a node (log, parameters), a module
/               show only rows with a text; Escape ends that
s, S            sort by the next column, by the one before
r               sort the other way
p, Space        pause, and go on
m               measure the topic, or end that: rate, latency and losses
b               the next bus
q, Ctrl-C       quit

MISS            periods that a publisher missed; LATE: sent late
WAY, HERE       lost by links, gateways and subscribers; by this tool
LAX ms          the least time that was left to its deadline, on a bus
P50, P99        latency of half, of 99 % of the messages, if measured
-               not known
!               needs attention: red ones lost something in the last 10 s
"""


class TopApp(App[None]):
    """Shows what a monitor collects. `wanted` is the first filter; `sorted_by` names a column of `view`."""

    ENABLE_COMMAND_PALETTE = False
    CSS = """
    Screen { background: ansi_default; color: ansi_default; }
    FiguresTable { height: 1fr; }
    Input, Input:focus { height: 1; border: none; padding: 0; background: ansi_default; display: none; }
    Input.shown { display: block; }
    BusPanel { display: none; }
    BusPanel.shown { display: block; }
    .small #views, .small KeyLine { display: none; }
    HelpScreen { align: center middle; }
    HelpScreen TextLines { width: 76; box-sizing: content-box; border: solid ansi_cyan; background: ansi_default; }
    """

    def __init__(
        self,
        session: Session,
        monitor: NetworkMonitor,
        *,
        view: View = TOPICS,
        sorted_by: str = "",
        wanted: str = "",
        allow_control: bool = False,
    ) -> None:
        super().__init__(ansi_color=True)  # the terminal's own colours: on any background, and with any number
        self.details = TopDetails(session, monitor, allow_control=allow_control)
        self.tables = TablesScreen(self.details, view, sorted_by, wanted)

    async def on_mount(self) -> None:
        """Show the tables, and follow the monitor."""
        self.theme = "ansi-dark"
        # Textual has set another factory, whose tasks begin before they are awaited: not what modules are tested with.
        asyncio.get_running_loop().set_task_factory(None)
        await self.push_screen(self.tables)
        self.tables.begin_capture()
        self.run_worker(self._follow(), exit_on_error=True)

    async def _follow(self) -> None:
        while True:
            self.show(await self.details.monitor.changed())

    def show(self, snapshot: NetworkSnapshot) -> None:
        """Show a snapshot."""
        self.tables.show(snapshot)
        for screen in self.screen_stack:
            if isinstance(screen, TopicScreen | NodeScreen):
                screen.show(snapshot)


class HelpScreen(ModalScreen[None]):
    """What the keys do, and what the columns mean. Any key closes it."""

    def compose(self) -> ComposeResult:
        """Return the text."""
        yield TextLines(*_HELP.splitlines())

    def on_key(self, event: events.Key) -> None:
        """Close it."""
        event.stop()
        self.app.call_later(self.app.pop_screen)  # not awaited here: the screen itself would wait for its end


class TablesScreen(Screen[None]):
    """The tables."""

    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("q,ctrl+c", "app.quit", show=False, priority=False),
        Binding("question_mark,h,f1", "help", show=False),
        *(Binding(str(i), f"view('{name}')", show=False) for i, name in enumerate(VIEWS, start=1)),
        Binding("tab", "next_view(1)", show=False),
        Binding("shift+tab", "next_view(-1)", show=False),
        Binding("slash", "filter", show=False),
        Binding("escape", "no_filter", show=False),
        Binding("s", "sort(1)", show=False),
        Binding("S", "sort(-1)", show=False),
        Binding("r", "reverse", show=False),
        Binding("p,space", "pause", show=False),
        Binding("m", "measure", show=False),
        Binding("b", "next_bus", show=False),
    ]

    def __init__(self, details: TopDetails, view: View, sorted_by: str, wanted: str) -> None:
        super().__init__()
        self.view = view
        self.wanted = wanted
        self.paused = False
        self._details = details
        self._snapshot = self._newest = details.monitor.snapshot
        self._sorting = {view.name: (sorted_by or view.columns[0].name, False)}
        self._rows: dict[str, list[Any]] = {}
        self._losses = RecentLosses()
        self._bus = 0

    def compose(self) -> ComposeResult:
        """Return the lines and the table."""
        yield TextLines("", id="network")
        yield TextLines("", id="views")
        yield BusPanel()
        yield FiguresTable(self.view)
        yield Input(placeholder="show only rows with this text; Enter keeps it, Escape ends it", compact=True)
        yield KeyLine(_KEYS)

    def on_mount(self) -> None:
        """Show what is known already."""
        self.query_one(FiguresTable).focus()
        self._draw()

    def on_resize(self) -> None:
        """Leave out what is not figures where there are only a few lines."""
        self.set_class(self.size.height < _LINES_MIN, "small")

    def begin_capture(self) -> None:
        """Show log records and notices in the line of keys."""
        self.app.begin_capture_print(self.query_one(KeyLine))

    def show(self, snapshot: NetworkSnapshot) -> None:
        """Show new figures, unless it is paused."""
        self._newest = snapshot
        self._losses.note(snapshot)
        if not self.paused:
            self._take(snapshot)
            if self.is_mounted:
                self._draw()

    def _rows_of(self, name: str) -> list[Any]:
        """Return the rows of a table; they are put together once for each snapshot."""
        if name not in self._rows:
            self._rows[name] = VIEWS[name].rows(self._snapshot)
        return self._rows[name]

    def _take(self, snapshot: NetworkSnapshot) -> None:
        self._snapshot = snapshot
        self._rows.clear()

    def rows(self) -> list[Any]:
        """Return the rows of the table, filtered and sorted."""
        rows = self._rows_of(self.view.name)
        if self.view.name == "buses":
            bus = self._shown_bus()
            rows = [row for row in rows if row.bus is bus]
        name, reverse = self._sorted_by()
        column = self.view.column(name) or self.view.columns[0]
        return sort(matching(self.view, rows, self.wanted), column, reverse=reverse)

    def _draw(self) -> None:
        if not self.is_current and not self.app.screen_stack:
            return
        rows = self.rows()
        table = self.query_one(FiguresTable)
        table.sorted_by = self._sorted_by()
        table.show(rows, self._losses.alarm if self.view is TOPICS else None)
        self.query_one("#network", TextLines).show(self._network_line())
        self.query_one("#views", TextLines).show(self._views_line(len(rows)))
        panel = self.query_one(BusPanel)
        panel.set_class(self.view.name == "buses", "shown")
        if self.view.name == "buses":
            buses = self._snapshot.buses
            which = f"  ({self._bus + 1} of {len(buses)}, b: next)" if len(buses) > 1 else ""
            panel.show_bus(self._shown_bus(), which)

    def _network_line(self) -> Text:
        snapshot = self._snapshot
        rates = [row.rate for row in snapshot.topics if row.rate is not None]
        text = Text("r2p top ", style="bold")
        if not any(link.up for link in self._details.session.module.links):
            text.append("NO CONNECTION  ", style="bold red")
        if self.paused:
            text.append("PAUSED  ", style="bold yellow")
        text.append(printable(snapshot.network or self._details.session.network_name), style="not bold cyan")
        parts = [
            _how_many(len(self._rows_of("modules")), "module"),
            _how_many(len(self._rows_of("topics")), "topic"),
            f"  {drawing.number(sum(rates) if rates else None)} messages/s",
            *(printable(f"  {bus.name} {drawing.percent(bus.share)} %") for bus in snapshot.buses),
        ]
        return text.append("".join(parts), style="not bold")

    def _views_line(self, count: int) -> Text:
        text = Text()
        for i, name in enumerate(VIEWS, start=1):
            text.append(f"{i} {name}", style="reverse" if name == self.view.name else "").append("  ")
        total = len(self._rows_of(self.view.name))
        if self.wanted:
            text.append(printable(f"{count} of {total} with {self.wanted!r}"), style="bold yellow")
        else:
            text.append(drawing.count(count), style="dim")
        return text

    def _shown_bus(self) -> BusFigures | None:
        buses = self._snapshot.buses
        return buses[self._bus % len(buses)] if buses else None

    # Keys

    def on_key(self) -> None:
        """Show the keys again, where a message has taken their place."""
        self.query_one(KeyLine).show_keys()

    async def action_help(self) -> None:
        """Explain the keys and the columns."""
        await self.app.push_screen(HelpScreen())

    def action_view(self, name: str) -> None:
        """Show another table."""
        if name != self.view.name:
            self.view, self.wanted = VIEWS[name], ""
            self.query_one(FiguresTable).show_view(self.view)
            self._draw()

    def action_next_view(self, step: int) -> None:
        """Show the next table, or the one before."""
        names = list(VIEWS)
        self.action_view(names[(names.index(self.view.name) + step) % len(names)])

    def action_filter(self) -> None:
        """Ask for a text that rows must have."""
        entry = self.query_one(Input)
        entry.value = printable(self.wanted)
        entry.add_class("shown")
        self.query_one(KeyLine).display = False
        entry.focus()

    def action_no_filter(self) -> None:
        """Show all rows."""
        self.wanted = ""
        self._close_filter()

    @on(Input.Changed)
    def _filter(self, event: Input.Changed) -> None:
        if self.query_one(Input).has_class("shown"):
            self.wanted = event.value
            self._draw()

    @on(Input.Submitted)
    def _close_filter(self) -> None:
        self.query_one(Input).remove_class("shown")
        self.query_one(KeyLine).display = True
        self.query_one(FiguresTable).focus()
        self._draw()

    def _sorted_by(self) -> tuple[str, bool]:
        return self._sorting.setdefault(self.view.name, (self.view.columns[0].name, False))

    def action_sort(self, step: int) -> None:
        """Sort by the next column that is shown."""
        names = [each.name for each in self.query_one(FiguresTable).columns()]
        name, _ = self._sorted_by()
        index = names.index(name) if name in names else 0
        self._sorting[self.view.name] = (names[(index + step) % len(names)], False)
        self._draw()

    def action_reverse(self) -> None:
        """Sort the other way."""
        name, reverse = self._sorted_by()
        self._sorting[self.view.name] = (name, not reverse)
        self._draw()

    def action_pause(self) -> None:
        """Freeze what is shown, or show the newest figures again."""
        self.paused = not self.paused
        if not self.paused:
            self._take(self._newest)
        self._draw()

    def action_measure(self) -> None:
        """Measure the topic at the cursor, or end that."""
        topic = self._topic_of(self.query_one(FiguresTable).selected)
        line = self.query_one(KeyLine)
        if topic is None:
            line.say("only topics can be measured: choose one in table 1")
        else:
            line.say(self._details.toggle_measuring(topic))

    def action_next_bus(self) -> None:
        """Show another bus."""
        self._bus = (self._bus + 1) % max(1, len(self._snapshot.buses))
        self._draw()

    @on(FiguresTable.Opened)
    async def _open(self, event: FiguresTable.Opened) -> None:
        """Open what the row is about."""
        row = event.row
        topic = self._topic_of(row)
        if topic is not None:
            await self.app.push_screen(TopicScreen(self._details, topic))
        elif isinstance(row, NodeRow):
            await self.app.push_screen(NodeScreen(self._details, row.module.name, row.node.name))
        elif self.view.name == "modules":
            self.action_view("nodes")
            self.wanted = printable(f"{row.name}/")
            self._draw()
        elif isinstance(row, ServiceFigures) and row.servers:
            module, _, node = row.servers[0].rpartition("/")
            await self.app.push_screen(NodeScreen(self._details, module, node))

    def _topic_of(self, row: Any) -> str | None:
        if isinstance(row, BusRow):
            return row.topic.topic or None
        return row.name if isinstance(row, TopicFigures) else None


def _how_many(number: int, what: str) -> str:
    return f"  {drawing.count(number)} {what}{'' if number == 1 else 's'}"
