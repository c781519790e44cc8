"""What a recorder sees of RTCAN buses: their masters and clocks, the owners of their slots, and their load.

`BusReports` measures the buses that the recording module is on, and subscribes to what others report.
"""

from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING

from r2p.messages import Message
from r2p.modules.module import Module
from r2p.monitoring.buses import OWNERS_MAX, TOTAL, BusReports, SlotRows
from r2p.msg import BusTraffic
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
    from r2p.transports.rtcan.link import RtcanLink

Record = Callable[[str, Message], None]
"""Records a message on a channel."""

_NODE = "bus_watch"
_REPEAT = 10 * SECOND  # between two tables of slots without a change
_BURST = 0.05  # s in which the rows of a table arrive
_CHANNELS_MAX = 512  # names come from the network, and channels of a file stay


class BusWatch:
    """Records what is on the buses of a module's network; `look` is called once a second."""

    def __init__(self, module: Module, record: Record) -> None:
        self._module = module
        self._record = record
        self._node = Node(_NODE, module.space)
        self._reports = BusReports(module, self._node, self._record_loads, self._slots_changed)
        self._channels: set[str] = set()
        self._masters: dict[str, str] = {}
        self._written_at: dict[str, int] = {}
        """When the table of slots of each bus was recorded last (monotonic ns)."""
        self._changed: dict[str, SlotRows] = {}

    def look(self) -> None:
        """Record the state of each bus; measure those that are new. Raises Closed if the module is not open."""
        for link in self._reports.look():
            self._record_state(link)
        now = self._module.space.clock.monotonic()
        for bus, table in self._reports.tables.items():
            if now - self._written_at.get(bus, now) >= _REPEAT:
                self._write(table)

    def close(self) -> None:
        """Stop, and record the tables of slots as they are."""
        self._reports.close()
        self._node.close()
        for table in self._reports.tables.values():
            self._write(table)

    def note_master(self, link: str, kind: str, text: str) -> None:
        """Record a change of a bus's master; `kind` names the change."""
        links = self._reports.links
        module = "" if kind == "no master" else next((each.master for each in links if each.name == link), "")
        self._masters[link] = module
        self._record(EVENTS, RecordedEvent(kind=kind, link=cut(link), module=cut(module), text=cut(text, TEXT_MAX)))

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

    def _record_loads(self, bus: str, rows: Iterable[BusTraffic], _complete: bool) -> None:
        for row in rows:
            names = (bus, *((row.kind, row.topic, row.module) if row.kind != TOTAL else ()))
            channel = "/".join((BUS_LOADS, *filter(None, names)))
            if channel not in self._channels:
                if len(self._channels) >= _CHANNELS_MAX:
                    channel = f"{BUS_LOADS}/{row.bus}/others"
                self._channels.add(channel)
            self._record(channel, row)

    # Slots

    def _slots_changed(self, table: SlotRows) -> None:
        """Record a table: at once if it is complete, else as soon as its other rows have arrived."""
        if table.complete:
            self._write(table)
        elif table.bus not in self._changed:
            self._changed[table.bus] = table
            self._module.space.loop.call_later(_BURST, self._write_changed)

    def _write_changed(self) -> None:
        changed, self._changed = self._changed, {}
        for table in changed.values():
            self._write(table)

    def _write(self, table: SlotRows) -> None:
        self._written_at[table.bus] = self._module.space.clock.monotonic()
        message = table_message(table)
        self._record(SLOTS, message)
        known = any(message.bus == link.title for link in self._reports.links)
        if not known and message.master and message.master != self._masters.get(message.bus):
            self._masters[message.bus] = message.master
            text = _master_text(message.master)
            self._record(
                EVENTS, RecordedEvent(kind="master", link=message.bus, module=message.master, text=cut(text, TEXT_MAX))
            )


def _master_text(module: str) -> str:
    return f"{module} is the RTCAN master"


def table_message(table: SlotRows) -> SlotTable:
    """Return the slots of a bus as they are recorded, in their order."""
    rows = table.rows[:OWNERS_MAX]
    return SlotTable(
        bus=cut(table.bus),
        cycle=rows[0].cycle if rows else 0.0,
        slots_in_cycle=rows[0].slots_in_cycle if rows else 0,
        master=table.master,
        owners=tuple(SlotOwner(topic=row.topic, module=row.module, slots=row.slots) for row in rows),
    )
