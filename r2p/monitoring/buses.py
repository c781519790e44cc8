"""What is on the RTCAN buses of a module's network, once a second.

A bus that the module itself is on is measured by its link, which costs the bus nothing. A module that is on none
subscribes to `bus_load` and `bus_slots`, also in the namespaces of other robots.
"""

import contextlib
import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING

from r2p.errors import DecodeError, Error
from r2p.log_lines import get_logger, printable
from r2p.messages import Message, layout
from r2p.modules.module import Module
from r2p.monitoring.snapshot import BusFigures, BusTopicFigures, SlotFigures
from r2p.msg import BusSlots, BusTraffic
from r2p.names import BUS_LOAD, BUS_SLOTS
from r2p.runtime.immediate import ImmediateSubscriber
from r2p.runtime.node import Node
from r2p.runtime.sample import Sample
from r2p.units import MILLISECOND, SECOND

if TYPE_CHECKING:
    from r2p.transports.rtcan.link import BusListener, RtcanLink

BUSES_MAX, OWNERS_MAX = 64, 256
"""Buses, and owners of the slots of one bus, that are kept: their names come from the network."""

SYNC = "sync"
"""What the slot of the master's frame has for a topic."""
TOTAL = "total"
"""The kind of the row of a whole bus, the first one of each second."""

_MESSAGE_KINDS = ("hrt", "srt", "nrt")
_ROWS_MAX = 1024  # topics of modules on one bus
_BURST = 300 * MILLISECOND  # ns in which the rows of one second arrive
_SILENT = 5 * SECOND  # ns without a row after which nothing is known of a bus
_FORGOTTEN = 60 * SECOND  # ns after which it is gone

logger = get_logger("r2p.monitoring")


class BusReports:
    """Collects what is reported of buses, from `look` to `close`; `look` is called about once a second.

    `on_loads` gets the name of a bus, what is on it, and whether that is all of it. `on_slots` gets the table of a bus
    of which a row has changed.
    """

    def __init__(
        self,
        module: Module,
        node: Node,
        on_loads: Callable[[str, list[BusTraffic], bool], None],
        on_slots: Callable[["SlotRows"], None],
    ) -> None:
        self.tables: dict[str, SlotRows] = {}
        """The slots of each bus, by its name."""
        self.undecodable = 0
        self._module = module
        self._node = node
        self._on_loads = on_loads
        self._on_slots = on_slots
        self._listeners: list[tuple[RtcanLink, BusListener]] = []
        self._subscribers: dict[str, list[ImmediateSubscriber]] = {}

    @property
    def links(self) -> "list[RtcanLink]":
        """The links of this module to RTCAN buses."""
        if not any(link.has_slots for link in self._module.links):
            return []
        from r2p.transports.rtcan.link import RtcanLink  # has been loaded by then

        return [link for link in self._module.links if isinstance(link, RtcanLink)]

    def look(self) -> "list[RtcanLink]":
        """Listen to buses that are new, and return the links of this module to buses.

        Raises Closed if the module is not open.
        """
        links = self.links
        for link in links:
            if all(known is not link for known, _ in self._listeners):
                self._listen(link)
        if not links:
            names = (name for each in self._module.links for name in each.discovery.modules)
            for namespace in sorted({"", *(name.rpartition("/")[0] for name in names)}):
                self._subscribe(namespace)
        return links

    def close(self) -> None:
        """End all subscriptions."""
        for link, listener in self._listeners:
            with contextlib.suppress(ValueError):
                link.bus_listeners.remove(listener)
        for subscriber in (each for pair in self._subscribers.values() for each in pair):
            subscriber.close()

    # Buses of this module

    def _listen(self, link: "RtcanLink") -> None:
        def listener(loads: list[BusTraffic], slots: list[BusSlots]) -> None:
            bus = loads[0].bus
            self._on_loads(bus, loads, True)
            if (table := self._table(bus)) is not None and table.replace(slots):
                self._on_slots(table)

        link.bus_listeners.append(listener)
        self._listeners.append((link, listener))

    # Buses of others

    def _subscribe(self, namespace: str) -> None:
        """Subscribe to what is on the buses of a robot: those of this network, or of one behind a gateway."""
        if namespace in self._subscribers or len(self._subscribers) >= BUSES_MAX:
            return
        prefix = f"{namespace}/" if namespace else ""

        def take_load(_source: str, row: Message) -> None:
            if isinstance(row, BusTraffic):
                self._on_loads(f"{prefix}{row.bus}", [row], False)

        def take_slots(source: str, row: Message) -> None:
            if isinstance(row, BusSlots) and (table := self._table(f"{prefix}{row.bus}")) is not None:
                table.enter(source, row)
                self._on_slots(table)

        self._subscribers[namespace] = [
            self._open(f"{prefix}{BUS_LOAD}", BusTraffic, take_load),
            self._open(f"{prefix}{BUS_SLOTS}", BusSlots, take_slots),
        ]

    def _open(self, topic: str, cls: type[Message], take: Callable[[str, Message], None]) -> ImmediateSubscriber:
        def handle(sample: Sample) -> None:
            message = sample.message
            if message is None:
                try:
                    message = layout(cls).decode(sample.data)
                except DecodeError:
                    self.undecodable += 1
                    return
            take(sample.source.module, message)

        subscriber = ImmediateSubscriber(self._module.space, self._node, handle, lossy=True)
        try:
            subscriber.open(topic, layout(cls))
        except Error as error:  # a program uses the name for messages of its own
            logger.warning("nothing is known of buses by %s: %s", topic, error)
        return subscriber

    def _table(self, bus: str) -> "SlotRows | None":
        if bus not in self.tables and len(self.tables) >= BUSES_MAX:
            return None
        return self.tables.setdefault(bus, SlotRows(bus))


class SlotRows:
    """The slots of a bus, as one module reports them."""

    def __init__(self, bus: str) -> None:
        self.bus = bus
        self.complete = False
        """Whether the rows came all at once; else those of one second follow one another."""
        self._source = ""
        self._rows: dict[tuple[str, str], BusSlots] = {}

    def replace(self, rows: Iterable[BusSlots]) -> bool:
        """Enter a complete table; return whether it has changed."""
        self.complete = True
        before, self._rows = self._rows, {(row.topic, row.module): row for row in rows}
        return self._rows != before

    def enter(self, source: str, row: BusSlots) -> None:
        """Enter a row. Another module that takes over sends all of them, but not those that are gone by then."""
        if source != self._source:
            self._source = source
            self._rows.clear()
        owner = row.topic, row.module
        if not row.slots:
            self._rows.pop(owner, None)
        elif owner in self._rows or len(self._rows) < OWNERS_MAX:
            self._rows[owner] = row

    @property
    def rows(self) -> list[BusSlots]:
        """The owners of slots, in the order of these."""
        return sorted(self._rows.values(), key=lambda row: (row.slots, row.topic))[:OWNERS_MAX]

    @property
    def master(self) -> str:
        """The module that sends the sync; empty if it is unknown."""
        return next((row.module for row in self._rows.values() if row.topic == SYNC), "")


class BusTables:
    """The figures of all buses, from `look` to `close`; both are called by the monitor."""

    def __init__(self, module: Module, node: Node) -> None:
        self.frames: dict[str, float] = {}
        """Frames per second of each topic, on the bus where it has most of them."""
        self._clock = module.space.clock
        self._reports = BusReports(module, node, self._take_loads, lambda _table: None)
        self._loads: dict[str, _BusLoads] = {}

    def close(self) -> None:
        """End all subscriptions."""
        self._reports.close()

    def look(self) -> list[BusFigures]:
        """Listen to buses that are new, and return the figures of all. Raises Closed if the module is not open."""
        masters = {link.title: link.master for link in self._reports.look()}
        now = self._clock.monotonic()
        for bus in [bus for bus, loads in self._loads.items() if now - loads.came_at > _FORGOTTEN]:
            del self._loads[bus]
            self._reports.tables.pop(bus, None)
        rows = {bus: self._loads[bus].rows(now) for bus in self._loads}
        self.frames = _frames_of_topics(rows)
        names = sorted({*rows, *masters})
        return [self._figures(name, rows.get(name, []), masters.get(name)) for name in names]

    def _take_loads(self, bus: str, rows: list[BusTraffic], complete: bool) -> None:
        if bus not in self._loads and len(self._loads) >= BUSES_MAX:
            return
        loads = self._loads.setdefault(bus, _BusLoads())
        loads.came_at = self._clock.monotonic()
        if complete:
            loads.complete, loads.filling = rows, []
        else:
            loads.enter(rows[0])

    def _figures(self, name: str, rows: list[BusTraffic], master: str | None) -> BusFigures:
        table = self._reports.tables.get(name)
        slots = table.rows if table is not None and rows else []
        figures = BusFigures(
            printable(name),
            master=printable(master or (table.master if table is not None else "")) or None,
            topics=[_topic_figures(name, each) for each in rows[1:]],
            slots=[_slot_figures(name, each) for each in slots],
        )
        if rows:
            total = rows[0]
            figures.share, figures.frames, figures.errors = total.share, total.frames, total.errors
            figures.reserved, figures.free_used = total.reserved, total.free_used
        if slots:
            figures.slots_in_cycle, figures.cycle = slots[0].slots_in_cycle, slots[0].cycle
        return figures


def _topic_figures(bus: str, row: BusTraffic) -> BusTopicFigures:
    prefix = bus.removesuffix(row.bus)
    topic = f"{prefix}{row.topic}" if row.kind in _MESSAGE_KINDS else row.topic
    module = f"{prefix}{row.module}" if row.module else ""
    return BusTopicFigures(printable(row.kind), printable(topic), printable(module), row.share, row.frames)


def _slot_figures(bus: str, row: BusSlots) -> SlotFigures:
    prefix = bus.removesuffix(row.bus)
    topic = row.topic if row.topic in ("", SYNC) else f"{prefix}{row.topic}"
    return SlotFigures(printable(topic), printable(f"{prefix}{row.module}" if row.module else ""), list(row.slots))


class _BusLoads:
    """What is on one bus: all of the last second, and what has arrived of the next one."""

    def __init__(self) -> None:
        self.complete: list[BusTraffic] = []
        """First the whole bus, then its topics."""
        self.filling: list[BusTraffic] = []
        self.came_at = 0
        """The time of the last row (monotonic ns)."""

    def enter(self, row: BusTraffic) -> None:
        """Enter a row. The one of the whole bus is the first of its second."""
        if not all(map(math.isfinite, (row.share, row.frames, row.reserved, row.free_used))):
            return
        if row.kind == TOTAL:
            self.complete, self.filling = self.filling or self.complete, [row]
        elif self.filling and len(self.filling) < _ROWS_MAX:
            self.filling.append(row)

    def rows(self, now: int) -> list[BusTraffic]:
        """Return the rows of the last complete second; an empty list once the reports have stopped."""
        if now - self.came_at > _SILENT:
            return []
        if self.filling and now - self.came_at >= _BURST:
            self.complete, self.filling = self.filling, []
        return self.complete


def _frames_of_topics(buses: Mapping[str, list[BusTraffic]]) -> dict[str, float]:
    most: dict[str, float] = {}
    for bus, rows in buses.items():
        frames: defaultdict[str, float] = defaultdict(float)
        for row in rows:
            if row.kind in _MESSAGE_KINDS:
                frames[bus.removesuffix(row.bus) + row.topic] += row.frames
        for topic, rate in frames.items():
            most[topic] = max(rate, most.get(topic, 0.0))
    return most
