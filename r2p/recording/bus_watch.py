"""What a recorder sees of RTCAN buses: their masters and clocks, the owners of their slots, and their load.

A bus that the recording module is on is measured by its link, which costs the bus nothing. A module that is on none
subscribes to `bus_load` and `bus_slots`, also in the namespaces of other robots.
"""

import asyncio
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING

from r2p.errors import Error
from r2p.log_lines import get_logger
from r2p.messages import Message
from r2p.modules.module import Module
from r2p.msg import BusSlots, BusTraffic
from r2p.names import BUS_LOAD, BUS_SLOTS
from r2p.recording.messages import (
    BUS_LOADS,
    BUSES,
    EVENTS,
    SLOTS,
    TEXT_MAX,
    BusState,
    RecordedEvent,
    SlotOwner,
    SlotTable,
    cut,
)
from r2p.runtime.node import Node
from r2p.units import SECOND

if TYPE_CHECKING:
    from r2p.transports.rtcan.link import BusListener, RtcanLink

Record = Callable[[str, Message], None]
"""Records a message on a channel."""

_NODE = "bus_watch"
_REPEAT = 10 * SECOND  # between two tables of slots without a change
_BURST = 0.05  # s in which the rows of a table arrive
_QUEUE = 1024
_TABLES_MAX, _OWNERS_MAX, _CHANNELS_MAX = 64, 256, 512  # names come from the network, and channels of a file stay

logger = get_logger("r2p.recording")


class BusWatch:
    """Records what is on the buses of a module's network; `look` is called once a second."""

    def __init__(self, module: Module, record: Record) -> None:
        self._module = module
        self._record = record
        self._node = Node(_NODE, module.space)
        self._tables: dict[str, _SlotRows] = {}
        self._channels: set[str] = set()
        self._masters: dict[str, str] = {}
        self._listeners: list[tuple[RtcanLink, BusListener]] = []
        self._subscribed: set[str] = set()

    def look(self, tasks: asyncio.TaskGroup) -> None:
        """Record the state of each bus; measure those that are new. Raises Closed if the module is not open."""
        links = self._links()
        for link in links:
            if all(known is not link for known, _ in self._listeners):
                self._listen(link)
            self._record_state(link)
        if not links:
            for view in self._module.network.modules():
                self._subscribe(view.name.rpartition("/")[0], tasks)
        now = self._module.space.clock.monotonic()
        for table in self._tables.values():
            if now - table.written_at >= _REPEAT:
                self._write(table)

    def close(self) -> None:
        """Stop, and record the tables of slots as they are."""
        for link, listener in self._listeners:
            link.bus_listeners.remove(listener)
        self._node.close()
        for table in self._tables.values():
            self._write(table)

    def note_master(self, link: str, kind: str, text: str) -> None:
        """Record a change of a bus's master; `kind` names the change."""
        module = "" if kind == "no master" else next((each.master for each in self._links() if each.name == link), "")
        self._masters[link] = module
        self._record(EVENTS, RecordedEvent(kind=kind, link=cut(link), module=cut(module), text=cut(text, TEXT_MAX)))

    def _links(self) -> "list[RtcanLink]":
        if not any(link.has_slots for link in self._module.links):
            return []
        from r2p.transports.rtcan.link import RtcanLink  # has been loaded by then

        return [link for link in self._module.links if isinstance(link, RtcanLink)]

    # Buses of this module

    def _listen(self, link: "RtcanLink") -> None:
        def listener(loads: list[BusTraffic], slots: list[BusSlots]) -> None:
            self._record_loads("", loads)
            if (table := self._table(loads[0].bus)) is not None:
                table.replace(slots)
                self._write_changed()

        link.bus_listeners.append(listener)
        self._listeners.append((link, listener))

    def _record_state(self, link: "RtcanLink") -> None:
        clock, master = link.translation(), link.master
        state = BusState(
            link=cut(link.name),
            up=link.up,
            master=cut(master),
            own=bool(master) and master == self._module.name,
            network_time=link.network_time() or 0,
            epoch=clock.epoch if clock else 0,
            clock_offset=clock.offset if clock else 0,
            clock_error=clock.error if clock else -1,
        )
        self._record(BUSES, state)
        if master and master != self._masters.get(link.name):  # its name was not known before
            self.note_master(link.name, "master", _master_text(master))

    # Buses of others

    def _subscribe(self, namespace: str, tasks: asyncio.TaskGroup) -> None:
        """Subscribe to what is on the buses of a robot: those of this network, or of one behind a gateway."""
        if namespace in self._subscribed or len(self._subscribed) >= _TABLES_MAX:
            return
        self._subscribed.add(namespace)
        prefix = f"{namespace}/" if namespace else ""
        tasks.create_task(self._follow(f"{prefix}{BUS_LOAD}", BusTraffic, prefix, self._take_load))
        tasks.create_task(self._follow(f"{prefix}{BUS_SLOTS}", BusSlots, prefix, self._take_slots))

    async def _follow(
        self, topic: str, cls: type[Message], prefix: str, handle: Callable[[str, str, Message], None]
    ) -> None:
        try:
            subscriber = self._node.subscribe(topic, cls, queue=_QUEUE, lossy=True)
        except Error as error:  # a program uses the name for messages of its own
            logger.warning("the recording has no %s: %s", topic, error)
            return
        async for sample in subscriber.samples():
            handle(prefix, sample.source.module, sample.message)

    def _take_load(self, prefix: str, _source: str, row: Message) -> None:
        if isinstance(row, BusTraffic):
            self._record_loads(prefix, [row])

    def _take_slots(self, prefix: str, source: str, row: Message) -> None:
        if not isinstance(row, BusSlots) or (table := self._table(f"{prefix}{row.bus}")) is None:
            return
        table.enter(source, row)
        if not table.changed:
            table.changed = True
            self._module.space.loop.call_later(_BURST, self._write_changed)

    # Both

    def _record_loads(self, prefix: str, rows: Iterable[BusTraffic]) -> None:
        for row in rows:
            names = (f"{prefix}{row.bus}", *((row.kind, row.topic, row.module) if row.kind != "total" else ()))
            channel = "/".join((BUS_LOADS, *filter(None, names)))
            if channel not in self._channels:
                if len(self._channels) >= _CHANNELS_MAX:
                    channel = f"{BUS_LOADS}/{row.bus}/others"
                self._channels.add(channel)
            self._record(channel, row)

    def _table(self, bus: str) -> "_SlotRows | None":
        if bus not in self._tables and len(self._tables) >= _TABLES_MAX:
            return None
        return self._tables.setdefault(bus, _SlotRows(bus))

    def _write_changed(self) -> None:
        for table in self._tables.values():
            if table.changed:
                self._write(table)

    def _write(self, table: "_SlotRows") -> None:
        table.changed = False
        table.written_at = self._module.space.clock.monotonic()
        message = table.message()
        self._record(SLOTS, message)
        known = any(message.bus == link.title for link in self._links())
        if not known and message.master and message.master != self._masters.get(message.bus):
            self._masters[message.bus] = message.master
            text = f"{message.master} is the RTCAN master"
            self._record(
                EVENTS, RecordedEvent(kind="master", link=message.bus, module=message.master, text=cut(text, TEXT_MAX))
            )


def _master_text(module: str) -> str:
    return f"{module} is the RTCAN master"


class _SlotRows:
    """The slots of a bus, as one module reports them."""

    def __init__(self, bus: str) -> None:
        self.changed = False
        self.written_at = 0
        self._bus = bus
        self._source = ""
        self._rows: dict[tuple[str, str], BusSlots] = {}

    def replace(self, rows: list[BusSlots]) -> None:
        """Enter a complete table."""
        table = {(row.topic, row.module): row for row in rows}
        self.changed = self.changed or table != self._rows
        self._rows = table

    def enter(self, source: str, row: BusSlots) -> None:
        """Enter a row. Another module that takes over sends all of them, but not those that are gone by then."""
        if source != self._source:
            self._source = source
            self._rows.clear()
        owner = row.topic, row.module
        if not row.slots:
            self._rows.pop(owner, None)
        elif owner in self._rows or len(self._rows) < _OWNERS_MAX:
            self._rows[owner] = row

    def message(self) -> SlotTable:
        """Return the table, in the order of slots."""
        rows = sorted(self._rows.values(), key=lambda row: (row.slots, row.topic))[:_OWNERS_MAX]
        owners = tuple(SlotOwner(topic=row.topic, module=row.module, slots=row.slots) for row in rows)
        return SlotTable(
            bus=cut(self._bus),
            cycle=rows[0].cycle if rows else 0.0,
            slots_in_cycle=rows[0].slots_in_cycle if rows else 0,
            master=next((row.module for row in rows if row.topic == "sync"), ""),
            owners=owners,
        )
