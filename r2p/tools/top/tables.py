"""The tables of `r2p top`: which figures are their columns, and how these are shown.

A row is what the snapshot has; where its name is not enough, it is put together with what it belongs to. Each column
returns a value, which sorts and which JSON and CSV have (seconds, bytes, shares), and a text for the screen.
"""

from collections.abc import Callable, Iterable
from operator import itemgetter
from typing import Any

import msgspec

from r2p.log_lines import printable
from r2p.monitoring.snapshot import (
    BusFigures,
    BusTopicFigures,
    LinkFigures,
    ModuleFigures,
    NetworkSnapshot,
    NodeFigures,
    ServiceFigures,
    TopicFigures,
)
from r2p.names import BUS_LOAD, BUS_SLOTS
from r2p.tools.top import drawing
from r2p.tools.top.drawing import UNKNOWN
from r2p.units import SECOND

OK, WARNING, ALARM = 0, 1, 2
"""How much a row needs a user's attention."""

_RECENT = 10 * SECOND  # in which a topic that lost something is marked
_CLASSES = {"periodic": "per", "sporadic": "spo", "non real-time": "nrt"}


class Column(msgspec.Struct, frozen=True):
    """A column: its name for programs and --sort, its head on the screen, its width, and its value and text.

    `extra` ones are shown where the terminal is wide enough for whole names. `of_row` replaces `show` where the text
    needs more than the value.
    """

    name: str
    head: str
    width: int
    value: Callable[[Any], Any]
    show: Callable[[Any], str]
    extra: bool = False
    of_row: Callable[[Any], str] | None = None

    @property
    def is_text(self) -> bool:
        """Whether it is sorted from A to Z, and aligned to the left."""
        return self.show is drawing.text

    def text(self, row: Any) -> str:
        """Return the text of a row."""
        return printable(self.show(self.value(row)) if self.of_row is None else self.of_row(row))


class View(msgspec.Struct, frozen=True):
    """A table. The first column is the name of a row; `alarm` says how much attention a row needs."""

    name: str
    columns: list[Column]
    rows: Callable[[NetworkSnapshot], list[Any]]
    alarm: Callable[[Any], int] = lambda _row: OK

    def column(self, name: str) -> Column | None:
        """Return the column of this name."""
        return next((each for each in self.columns if each.name == name), None)

    def key(self, row: Any) -> str:
        """Return the name of a row."""
        found: str = self.columns[0].value(row)
        return found


class NodeRow(msgspec.Struct, frozen=True):
    """A node, and the module that it belongs to."""

    module: ModuleFigures
    node: NodeFigures


class BusRow(msgspec.Struct, frozen=True):
    """A topic on a bus, with its share of the slots."""

    bus: BusFigures
    topic: BusTopicFigures
    slots: int | None

    @property
    def budget(self) -> float | None:
        """The share of the bus that its slots are; None: it has none."""
        return self.slots / self.bus.slots_in_cycle if self.slots and self.bus.slots_in_cycle else None


def sort(rows: Iterable[Any], column: Column, *, reverse: bool = False) -> list[Any]:
    """Return rows by a column, the largest number or the first text first; unknown values are last either way."""
    pairs = [(column.value(row), row) for row in rows]
    known = [pair for pair in pairs if pair[0] is not None]
    descending = not column.is_text
    known.sort(key=itemgetter(0), reverse=descending != reverse)
    return [row for _, row in known] + [row for value, row in pairs if value is None]


def matching(view: View, rows: list[Any], wanted: str) -> list[Any]:
    """Return the rows with this text in their name, or in another text; without regard to case."""
    lower = wanted.lower()
    texts = [each for each in view.columns if each.is_text]
    if not lower:
        return rows
    return [row for row in rows if any(lower in printable(each.value(row) or "").lower() for each in texts)]


def is_of_tool(module: str) -> bool:
    """Return whether a module is a tool's, such as that of this command."""
    return module.startswith("_")


# Topics


def _class(row: TopicFigures) -> str | None:
    """Return the class of the publishers; "mixed" if they differ."""
    classes = {each.publisher_class for each in row.publishers if each.publisher_class is not None}
    return "mixed" if len(classes) > 1 else next(iter(classes), None)


def _size(row: TopicFigures) -> str:
    return ("≤" if row.varies and row.size is not None else "") + drawing.count(row.size)


def _topic_alarm(row: TopicFigures) -> int:
    return ALARM if row.mismatch else OK


class RecentLosses:
    """Notes which topics have lost something of late: what a robot lost at its start must not be red for ever."""

    def __init__(self) -> None:
        self._rows: dict[str, TopicFigures] = {}
        self._until: dict[str, int] = {}  # ns

    def note(self, snapshot: NetworkSnapshot) -> None:
        """Compare the losses of all topics with those of the last snapshot, as far as they were known then."""
        before, self._rows = self._rows, {row.name: row for row in snapshot.topics}
        # Most rows are the same object as before, as long as nothing of them has changed.
        pairs = [(last, row) for name, row in self._rows.items() if (last := before.get(name, row)) is not row]
        grown = [row.name for last, row in pairs if _has_lost_more(last, row)]
        self._until = {name: end for name, end in self._until.items() if end > snapshot.time}
        self._until |= dict.fromkeys(grown, snapshot.time + _RECENT)

    def alarm(self, row: Any) -> int:
        """Return the attention that the row of a topic needs."""
        return ALARM if row.name in self._until else TOPICS.alarm(row)


def _has_lost_more(before: TopicFigures, row: TopicFigures) -> bool:
    return (
        _has_grown(before.lost_on_way, row.lost_on_way)
        or _has_grown(before.missed, row.missed)
        or _has_grown(before.lost_here, row.lost_here)
    )


def _has_grown(before: int | None, now: int | None) -> bool:
    return before is not None and now is not None and now > before


def _topics(snapshot: NetworkSnapshot) -> list[TopicFigures]:
    """Return the topics, without those of services, and those that only the monitor of this tool subscribes to."""
    unpublished = (row.name for row in snapshot.topics if not row.publishers and row.rate is None)
    hidden = {BUS_LOAD, BUS_SLOTS}.intersection(unpublished)
    return [row for row in snapshot.topics if not row.is_of_service and row.name not in hidden]


TOPICS = View(
    "topics",
    [
        Column("topic", "TOPIC", 16, lambda row: row.name, drawing.text),
        Column("class", "CLASS", 5, _class, lambda value: _CLASSES.get(value, value or UNKNOWN)),
        Column("rate", "Hz", 6, lambda row: row.rate, drawing.number),
        Column("size", "BYTES", 6, lambda row: row.size, drawing.count, of_row=_size),
        Column("laxity", "LAX ms", 6, lambda row: row.laxity, drawing.milliseconds),
        Column("p50", "P50 ms", 6, lambda row: row.latency and row.latency.p50, drawing.milliseconds),
        Column("p99", "P99 ms", 6, lambda row: row.latency and row.latency.p99, drawing.milliseconds),
        Column("missed", "MISS", 5, lambda row: row.missed, drawing.count),
        Column("lost_on_way", "WAY", 5, lambda row: row.lost_on_way, drawing.count),
        Column("lost_here", "HERE", 5, lambda row: row.lost_here, drawing.count),
        Column("late", "LATE", 5, lambda row: row.late, drawing.count, extra=True),
        Column("publishers", "PUB", 4, lambda row: len(row.publishers), drawing.count, extra=True),
        Column("subscribers", "SUB", 4, lambda row: len(row.subscribers), drawing.count, extra=True),
        Column("bandwidth", "B/s", 6, lambda row: row.bandwidth, drawing.number, extra=True),
        Column("rate_source", "Hz FROM", 8, lambda row: row.rate_source, drawing.text, extra=True),
        Column("type", "TYPE", 24, lambda row: row.type, drawing.text, extra=True),
        Column("varies", "VARIES", 6, lambda row: row.varies, drawing.answer, extra=True),
        Column("age", "AGE", 8, lambda row: row.age, drawing.age, extra=True),
    ],
    _topics,
    _topic_alarm,
)

# Modules and nodes


def _module_alarm(row: ModuleFigures) -> int:
    if row.answers is False or row.rebooted:
        return ALARM
    return OK if row.state in {"running", "observer"} else WARNING


def _module_state(row: ModuleFigures) -> str:
    return "silent" if row.answers is False else row.state


MODULES = View(
    "modules",
    [
        Column("module", "MODULE", 16, lambda row: row.name, drawing.text),
        Column("state", "STATE", 8, lambda row: row.state, drawing.text, of_row=_module_state),
        Column("kind", "KIND", 8, lambda row: row.kind, drawing.text),
        Column("age", "AGE", 8, lambda row: row.age, drawing.age),
        Column("release", "VERSION", 8, lambda row: row.release, drawing.text),
        Column("cpu", "CPU %", 5, lambda row: row.cpu, drawing.percent),
        Column("uptime", "UP", 8, lambda row: row.uptime, drawing.age),
        Column("nodes", "NODES", 5, lambda row: len(row.nodes), drawing.count),
        Column("answers", "ANSWERS", 7, lambda row: row.answers, drawing.answer, extra=True),
        Column("rebooted", "REBOOTED", 8, lambda row: row.rebooted, drawing.answer, extra=True),
        Column("link", "LINK", 24, lambda row: row.link or None, drawing.text, extra=True),
    ],
    lambda snapshot: [row for row in snapshot.modules if not is_of_tool(row.name)],
    _module_alarm,
)


def _state(row: NodeRow) -> str | None:
    running = row.node.running
    return None if running is None else "running" if running else "ended"


def _nodes(snapshot: NetworkSnapshot) -> list[NodeRow]:
    return [NodeRow(module, node) for module in MODULES.rows(snapshot) for node in module.nodes]


NODES = View(
    "nodes",
    [
        Column("node", "NODE", 16, lambda row: f"{row.module.name}/{row.node.name}", drawing.text),
        Column("state", "STATE", 8, _state, drawing.text),
        Column("restarts", "RESTARTS", 8, lambda row: row.node.restarts, drawing.count),
        Column("publishes", "PUB", 4, lambda row: len(row.node.publishes), drawing.count),
        Column("subscribes", "SUB", 4, lambda row: len(row.node.subscribes), drawing.count),
        Column("topics", "TOPICS", 30, lambda row: ", ".join(row.node.publishes) or None, drawing.text, extra=True),
    ],
    _nodes,
    lambda row: WARNING if row.node.running is False else OK,
)

# Networks: links, buses, services


def _sum(losses: Any) -> int | None:
    return None if losses is None else sum(losses.values())


def _reasons(row: LinkFigures) -> str | None:
    both = {**(row.lost or {}), **(row.faults or {})}
    return ", ".join(f"{number} {reason}" for reason, number in both.items() if number) or None


LINKS = View(
    "links",
    [
        Column("link", "MODULE LINK", 24, lambda row: f"{row.module} {row.name}", drawing.text),
        Column("up", "UP", 3, lambda row: row.up, drawing.answer),
        Column("sent", "OUT/s", 6, lambda row: row.sent, drawing.number),
        Column("received", "IN/s", 6, lambda row: row.received, drawing.number),
        Column("bytes_sent", "B/s OUT", 7, lambda row: row.bytes_sent, drawing.number),
        Column("bytes_received", "B/s IN", 7, lambda row: row.bytes_received, drawing.number),
        Column("waiting", "WAIT", 4, lambda row: row.waiting, drawing.count),
        Column("lost", "LOST", 5, lambda row: _sum(row.lost), drawing.count),
        Column("faults", "FAULTS", 6, lambda row: _sum(row.faults), drawing.count, extra=True),
        Column("ups", "UPS", 4, lambda row: row.ups, drawing.count, extra=True),
        Column("reasons", "REASONS", 40, _reasons, drawing.text, extra=True),
    ],
    lambda snapshot: [row for row in snapshot.links if not is_of_tool(row.module)],
    lambda row: OK if row.up else ALARM,
)


def _bus_rows(snapshot: NetworkSnapshot) -> list[BusRow]:
    rows: list[BusRow] = []
    for bus in snapshot.buses:
        slots = {(each.topic, each.module): len(each.slots) for each in bus.slots}
        rows += [BusRow(bus, each, slots.get((each.topic, each.module))) for each in bus.topics]
    return rows


def _bus_topic(row: BusRow) -> str:
    return row.topic.topic or row.topic.kind


def _bus_key(row: BusRow) -> str:
    return " ".join((_bus_topic(row), row.topic.kind, row.topic.module, row.bus.name))


BUSES = View(
    "buses",
    [
        Column("topic", "TOPIC", 16, _bus_key, drawing.text, of_row=_bus_topic),
        Column("kind", "KIND", 10, lambda row: row.topic.kind, drawing.text),
        Column("module", "MODULE", 10, lambda row: row.topic.module or None, drawing.text),
        Column("share", "USED %", 6, lambda row: row.topic.share, drawing.percent),
        Column("budget", "SLOTS %", 7, lambda row: row.budget, drawing.percent),
        Column("slots", "SLOTS", 5, lambda row: row.slots, drawing.count),
        Column("frames", "FRAMES/s", 8, lambda row: row.topic.frames, drawing.number),
    ],
    _bus_rows,
)

SERVICES = View(
    "services",
    [
        Column("service", "SERVICE", 20, lambda row: row.name, drawing.text),
        Column("servers", "SERVERS", 7, lambda row: len(row.servers), drawing.count),
        Column("handled", "DONE", 6, lambda row: row.handled, drawing.count),
        Column("failed", "FAILED", 6, lambda row: row.failed, drawing.count),
        Column("refused", "REFUSED", 7, lambda row: row.refused, drawing.count),
        Column("running", "RUN", 4, lambda row: row.running, drawing.count),
        Column("waiting", "WAIT", 4, lambda row: row.waiting, drawing.count),
        Column("type", "TYPE", 24, lambda row: row.type, drawing.text, extra=True),
    ],
    lambda snapshot: list[ServiceFigures](snapshot.services),
)

VIEWS = {view.name: view for view in (TOPICS, MODULES, NODES, LINKS, BUSES, SERVICES)}
"""All tables, in the order of their keys, 1 to 6."""
