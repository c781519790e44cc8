"""The messages of an RTCAN bus by what its network says, for `r2p bus analyze --via` on any link.

Announced are the publishers with their classes, and the sizes of topics. `bus_load` has the frames of each second, and
`bus_slots` the slots that are granted; one r2p module of the bus publishes both while a tool wants them. Periods and
deadlines are announced by nobody: they follow from the frames, by rules that `ReportedBus.assumed` says.
"""

import asyncio
from collections import defaultdict
from collections.abc import Iterable, Mapping
from collections.abc import Set as AbstractSet

import msgspec

import r2p
from r2p.analysis import BusMessage, MessageClass, SlotSupply, control_rates, management_load
from r2p.bus import FrameKind, Timing
from r2p.codecs import PublisherClass, management, rtcan
from r2p.monitoring.buses import SYNC, TOTAL, BusReports, SlotRows
from r2p.msg import BusSlots, BusTraffic
from r2p.names import BUS_LOAD, BUS_SLOTS, LOG
from r2p.tools.session import Session, wait_until
from r2p.units import SECOND

_NAMED = 5  # topics that a line names
_REPORT = 6.0  # s until a module of the bus, which agree on one of them, has published both topics
_LOOK = 1.0  # s between two looks for new buses
MANAGEMENT_FRAMES = rtcan.fragment_count(management.SIZE)
"""Of a message with all its zeros, as the analysis takes all of them to be."""
_CLASSES = {
    FrameKind.HRT.value: MessageClass.HRT,
    FrameKind.SRT.value: MessageClass.SRT,
    FrameKind.NRT.value: MessageClass.NRT,
}

_OWN = (LOG, BUS_LOAD, BUS_SLOTS)  # topics of r2p itself
_Key = tuple[str, str, str]
"""Topic, module and kind of frames."""


class AnnouncedTopic(msgspec.Struct, frozen=True):
    """What is announced of a topic: bytes of its longest message on the bus (0: unknown), and classes by module."""

    size: int = 0
    classes: dict[str, PublisherClass] = {}


class GrantedSlots(msgspec.Struct, frozen=True):
    """The slots of a topic of a module; of the sync; or, without a topic, those that are reserved and not used."""

    topic: str
    module: str
    slots: tuple[int, ...]


class ReportedBus(msgspec.Struct):
    """A bus: its slots, what each topic of each module sent in its busiest second (frames), what is announced.

    `bit` in ns, `cycle` in s.
    """

    name: str
    bit: int
    slots_in_cycle: int
    cycle: float
    frames: dict[_Key, float] = {}
    slots: list[GrantedSlots] = []
    topics: dict[str, AnnouncedTopic] = {}

    @property
    def timing(self) -> Timing:
        """The slots of the cycle, of whole microseconds."""
        slot = round(self.cycle * SECOND / self.slots_in_cycle / 1000) * 1000
        return Timing(self.slots_in_cycle, slot, self.bit)

    @property
    def supply(self) -> SlotSupply:
        """The free slots: those that are reserved in no cycle."""
        mask = 1
        for row in self.slots:
            for slot in row.slots:
                mask |= 1 << slot
        return SlotSupply(self.timing, [mask])

    @property
    def owners(self) -> set[tuple[str, str]]:
        """Topic and module of all that own slots, without the sync."""
        return {(row.topic, row.module) for row in self.slots if row.topic not in ("", SYNC)}

    @property
    def declared(self) -> list[BusMessage]:
        """The topics that were sent, those with slots first, and those that own slots and were not sent."""
        sent = {(topic, module): kind for topic, module, kind in self.frames if kind == FrameKind.HRT.value}
        silent = {(topic, module, FrameKind.HRT.value): 0.0 for topic, module in self.owners - sent.keys()}
        return [
            self._message(topic, module, _CLASSES[kind], rate)
            for (topic, module, kind), rate in sorted((self.frames | silent).items(), key=lambda each: each[0][2])
            if kind in _CLASSES and not (kind == FrameKind.SRT.value and (topic, module) in self.owners)
        ]

    def _message(self, topic: str, module: str, message_class: MessageClass, rate: float) -> BusMessage:
        size = self._size(topic)
        period = round(rtcan.fragment_count(size) * SECOND / rate) if rate else None
        if message_class is MessageClass.HRT and period:
            period = max(1, round(period / self.timing.slot)) * self.timing.slot
        return BusMessage(
            name=topic,
            node=module,
            size=size,
            period=None if message_class is MessageClass.NRT else period,
            deadline=period if message_class is MessageClass.SRT else None,
            message_class=message_class,
        )

    def _size(self, topic: str) -> int:
        known = self.topics.get(topic)
        return known.size if known is not None and 0 < known.size <= rtcan.PAYLOAD_MAX else rtcan.FRAME_MAX

    @property
    def control(self) -> list[BusMessage]:
        """The management: what RTCAN itself sends by its rules, and as discovery what was measured beyond that."""
        measured: dict[str, float] = defaultdict(float)
        for (_, module, kind), rate in self.frames.items():
            if kind == FrameKind.MANAGEMENT.value:
                measured[module] += rate / MANAGEMENT_FRAMES
        master = next((row.module for row in self.slots if row.topic == SYNC), "")
        rates = control_rates(measured, {module for _, module in self.owners}, master)
        other = max((rate - rates.get(module, 0.0) for module, rate in measured.items()), default=0.0)
        return management_load(rates, max(0.0, other))

    @property
    def assumed(self) -> list[str]:
        """What the analysis assumes, a line each."""
        sent = {(topic, module) for topic, module, kind in self.frames if kind in _CLASSES}
        modules = {module for _, module, _ in self.frames}
        declared = {
            (topic, module): publisher_class
            for topic, known in self.topics.items()
            for module, publisher_class in known.classes.items()
            if module in modules
        }
        lines = [
            "periods: messages come evenly, as often as in the busiest second; an event's deadline is its period",
            f"bits of {self.bit / 1000:g} us (--bitrate); a slot that is granted in any cycle is taken in all of them",
            *declared_otherwise(declared, sent, self.owners),
        ]
        if unknown := [each for each in sent if not self._is_announced(each[0])]:
            lines.append(f"{rtcan.FRAME_MAX} bytes, as no size is announced: {named(unknown)}")
        return lines

    def _is_announced(self, topic: str) -> bool:
        return topic in self.topics and self.topics[topic].size > 0


def declared_otherwise(
    declared: Mapping[tuple[str, str], PublisherClass],
    sent: AbstractSet[tuple[str, str]],
    slotted: AbstractSet[tuple[str, str]],
) -> list[str]:
    """Return in words where publishers are of another class than their frames, or sent none; by topic and module."""
    lines, seen = [], sent | slotted
    periodic = [each for each, found in declared.items() if found is PublisherClass.PERIODIC]
    if unslotted := [each for each in periodic if each in sent - slotted]:
        lines.append(f"counted as events, as they are periodic and have no slots: {named(unslotted)}")
    if silent := [each for each in declared if each not in seen and each[0] not in _OWN]:
        lines.append(f"not counted, as they are published and nothing was sent: {named(silent)}")
    return lines


def named(topics: Iterable[tuple[str, str]]) -> str:
    """Return topics with their modules as text, at most five of them."""
    found = [f"{topic} of {module}" for topic, module in sorted(topics)]
    more = f" and {len(found) - _NAMED} others" if len(found) > _NAMED else ""
    return ", ".join(found[:_NAMED]) + more


async def collect(session: Session, duration: float, bit: int) -> ReportedBus:
    """Take what the network says of its bus for so many seconds.

    Raises r2p.Error if nothing is said of a bus, or of more than one. `bit` in ns, unless the session is on the bus.
    """
    await session.settle()
    frames: dict[str, dict[_Key, float]] = defaultdict(dict)
    tables: dict[str, SlotRows] = {}

    def on_loads(bus: str, rows: list[BusTraffic], _complete: bool) -> None:
        prefix, most = bus.removesuffix(rows[0].bus), frames[bus]
        for row in rows:
            if row.kind != TOTAL:
                of_message = row.kind in _CLASSES
                key = f"{prefix}{row.topic}" if of_message else row.topic, f"{prefix}{row.module}", row.kind
                most[key] = max(row.frames, most.get(key, 0.0))

    reports = BusReports(session.module, session.node, on_loads, lambda table: tables.update({table.bus: table}))
    try:
        links = reports.look()
        with session.waiting("bus_load and bus_slots"):
            if not await wait_until(lambda: bool(frames and tables), _REPORT):
                raise _nothing(session)
        for _ in range(max(1, round(duration / _LOOK))):
            reports.look()
            await asyncio.sleep(min(_LOOK, duration))
    finally:
        reports.close()
    names = sorted(frames.keys() & tables.keys())
    if len(names) != 1:
        raise r2p.Error(f"{len(names)} buses are reported ({', '.join(names)}): give --via of one of them")
    (name,) = names
    rows = tables[name].rows
    if not rows:
        raise r2p.Error(f"{name} has no slots: no RTCAN master on this bus")
    prefix = name.removesuffix(rows[0].bus)
    own = next((link.engine.timing.bit for link in links if link.title == name), bit)
    slots = [_slots(row, prefix) for row in rows]
    return ReportedBus(name, own, rows[0].slots_in_cycle, rows[0].cycle, frames[name], slots, _announced(session))


def _slots(row: BusSlots, prefix: str) -> GrantedSlots:
    topic = row.topic if row.topic in ("", SYNC) else f"{prefix}{row.topic}"
    return GrantedSlots(topic, f"{prefix}{row.module}" if row.module else "", row.slots)


def _nothing(session: Session) -> r2p.Error:
    return r2p.Error(
        f"no module of {session.network_name} reports an RTCAN bus (bus_load, bus_slots): r2p modules on such a bus do"
    )


def _announced(session: Session) -> dict[str, AnnouncedTopic]:
    return {
        name: AnnouncedTopic(
            rtcan.size_on_bus(view.size, varies=view.varies) if view.size else 0,
            {each.module: each.publisher_class for each in view.publishers if each.publisher_class is not None},
        )
        for name, view in session.module.network.topics().items()
    }
