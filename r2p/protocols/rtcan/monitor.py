"""Watch an RTCAN bus without sending: describe each frame, measure the load, and the use of the slots.

Lengths include stuff bits, so loads are true for the given bit rate. The cycle is the
master's, by its sync frames (PROTOCOL.md 6): slots are counted from the start of the last one. A frame counts for the
time at which it was on the bus, however late it is read. `BusDirectory` keeps the names, `Monitor` the numbers.
"""

import enum
from collections import Counter, deque

import msgspec

from r2p.codecs import call_parts, can_bits, management, rtcan
from r2p.codecs.rtcan import Frame, Identifier, OtherFrame
from r2p.errors import DecodeError
from r2p.protocols.rtcan.cycle import Timing
from r2p.protocols.rtcan.reassembly import Reassembly
from r2p.units import NEVER

_SYNC = -1  # in place of a message id
_OTHER = -2
_PUBLISHERS_MAX = 4096
_EARLY = 8  # a frame that starts less than this part of a slot early belongs to the slot


class FrameKind(enum.Enum):
    """The kinds of frames."""

    SYNC = "sync"
    HRT = "hrt"
    SRT = "srt"
    NRT = "nrt"
    MANAGEMENT = "management"
    OTHER = "other"
    """A frame that RTCAN does not use: with an 11-bit identifier, or a remote frame."""


class SeenFrame(msgspec.Struct, frozen=True):
    """One frame. `stamp` is its end (ns), `bits` its length with the intermission, `left` how many fragments follow.

    `cycle` (mod 256) and `slot` are None while there is no sync. `text` describes a whole management message, or a
    frame that is not of RTCAN: of that, `frame` has the identifier and the data.
    """

    stamp: int
    frame: Frame
    kind: FrameKind
    topic: str
    module: str
    laxity: int
    left: int
    bits: int
    fragments: int | None = None
    cycle: int | None = None
    slot: int | None = None
    text: str = ""


class TrafficCount(msgspec.Struct):
    """Frames and bits (stuffed ones and intermission included) of one message id and kind."""

    frames: int = 0
    bits: int = 0


class BusSlot(msgspec.Struct):
    """One slot over all watched cycles: how often it was reserved, had an HRT frame, or another one; by topic.

    `senders` has its HRT frames by topic and module.
    """

    reserved: int = 0
    used: int = 0
    shared: int = 0
    owners: Counter[str] = msgspec.field(default_factory=Counter)
    senders: Counter[tuple[str, str]] = msgspec.field(default_factory=Counter)

    @property
    def missed(self) -> int:
        """Cycles in which the slot was reserved, and its owner sent nothing."""
        return max(0, self.reserved - self.used)


class BusLoad(msgspec.Struct, frozen=True):
    """The load of the bus in `elapsed` ns; shares are of the time: 1.0 is all of it.

    `free` is the share without reservation, `free_frames` how many frames of full length fit in there. `nrt_gap` is
    the longest time without a non real-time frame (ns); None if there was none at all. `slots` are those of the whole
    cycles in that time.
    """

    elapsed: int
    bit: int
    tallies: dict[tuple[str, str, FrameKind], TrafficCount]
    faults: dict[str, int]
    reserved: float
    free_frames: float
    nrt_gap: int | None
    slots: list[BusSlot] = []

    def share(self, bits: int) -> float:
        """Return bits as a share of the time."""
        return bits * self.bit / self.elapsed if self.elapsed else 0.0

    @property
    def total(self) -> float:
        return self.share(sum(tally.bits for tally in self.tallies.values()))

    @property
    def free(self) -> float:
        return max(0.0, 1.0 - self.reserved)

    @property
    def free_used(self) -> float:
        """Return the used part of the unreserved time: by time, or by the frames that fit into a slot."""
        events = [tally for (_, _, kind), tally in self.tallies.items() if kind not in {FrameKind.SYNC, FrameKind.HRT}]
        by_time = self.share(sum(tally.bits for tally in events)) / self.free if self.free else 0.0
        by_frames = sum(tally.frames for tally in events) / self.free_frames if self.free_frames else 0.0
        return min(1.0, max(by_time, by_frames))


class BusDirectory:
    """Names of modules and topics, and the timing of the network, from the modules' announcements.

    All tables are bounded, but for that of publishers by the 16 bits of a message id.
    """

    def __init__(self, timing: Timing) -> None:
        self.timing = timing
        self.timing_known = False
        """True if the timing comes from the master's NETWORK; else it is the user's."""
        self.modules: dict[int, str] = {}
        """Names by id8."""
        self.topics: dict[int, str] = {}
        """Names by message id."""
        self.sizes: dict[int, int] = {}
        """Bytes of a message, by message id."""
        self.publishers: dict[tuple[int, str], int] = {}
        """Classes of publishers, CLASS_..., by id8 and topic."""
        self._greeted: set[int] = set()  # id8 with a name from a HELLO: a gateway also passes ALIVE on

    def learn(self, data: bytes, source: int) -> str:
        """Learn from a management message of this id8 (0: firmware, which has none); return its description."""
        try:
            if management.type_of(data) == management.ManagementType.CALL_PART:
                part = call_parts.decode(data)
                return f"CallPart sender={part.sender:08x} serial={part.serial} part={part.part} length={part.length}"
            message = management.decode(data)
        except DecodeError:
            return f"unknown management 0x{management.type_of(data):02x}"
        match message:
            case management.Hello(module, hops=0):
                self._greeted.add(source)
                self.modules[source] = module
            case management.Alive(module) if source and source not in self._greeted:
                self.modules[source] = module
            case management.SubscribeResponse(topic, size, _, params):
                number = management.rtcan_message_id(params)
                self.topics[number], self.sizes[number] = topic, size
            case management.Endpoint(management.ROLE_PUBLISHES, topic=topic, publisher_class=publisher_class):
                if len(self.publishers) < _PUBLISHERS_MAX:
                    self.publishers[source, topic] = publisher_class & ~management.CLASS_LATCHES
            case management.Endpoint(role, topic=topic) if role == management.ROLE_PUBLISHES + management.ROLE_GONE:
                self.publishers.pop((source, topic), None)
            case management.Network(slots=slots, slot=slot) if 2 <= slots <= rtcan.SLOTS_MAX and slot:
                self.timing_known = True
                self.timing = Timing(slots, slot, self.timing.bit)
        return describe(message)

    def topic(self, message: int) -> str:
        """Return the topic of a message id; its number if the topic is not known yet."""
        if rtcan.high_byte(message) <= rtcan.MANAGEMENT and message not in self.topics:
            return "R2P"
        return self.topics.get(message, f"0x{message:04X}")

    def module(self, message: int) -> str:
        """Return the module that uses a message id."""
        id8 = rtcan.id8_of(message)
        return self.modules.get(id8, f"id {id8}") if id8 else "?"

    def names(self, message: int) -> tuple[str, str]:
        """Return topic and module of a message id."""
        return self.topic(message), self.module(message)


class Monitor:
    """Counts the frames of a bus. Instants are ns of one clock."""

    def __init__(self, timing: Timing) -> None:
        self.directory = BusDirectory(timing)
        self.cycles = 0
        """Whole cycles watched since the last `reset`."""
        self.last_frame = 0
        """Time of the last frame on the bus."""
        self._loads: deque[BusLoad] = deque()  # of the periods that are over
        self._reassembly = Reassembly()
        self._sync: int | None = None  # start of the current cycle
        self._cycle = 0
        self._mask = 0
        self._filled: set[int] = set()
        self.reset(0)

    def reset(self, now: int, period: int = NEVER) -> None:
        """Count from now on, in periods of so many ns, each of which `next_load` returns once."""
        self._period = period
        self._end = now + period
        self._loads.clear()
        self._begin_period(now)

    def next_load(self) -> BusLoad:
        """Return the load of the next period; call it after all frames of the period."""
        if not self._loads:
            self._end_period()
        return self._loads.popleft()

    def _end_period(self) -> None:
        end = self._end
        self._loads.append(self.load(end))
        self._begin_period(end)
        self._end = end + self._period

    def _begin_period(self, now: int) -> None:
        self._since = now
        self._tallies: dict[tuple[int, FrameKind], TrafficCount] = {}
        self._faults: Counter[str] = Counter()
        self._reserved = 0
        self._nrt: int | None = None
        self._nrt_gap: int | None = None
        self._forget_slots()

    def _forget_slots(self) -> None:
        self._slots: list[BusSlot] = []
        self._owners: list[Counter[int]] = []  # by slot, of message ids: names may be learnt later
        self.cycles = 0
        self._whole = False

    def fault(self, kind: str) -> None:
        """Count an error frame, or another fault reported by the interface."""
        self._faults[kind] += 1

    def frame(self, frame: Frame, stamp: int) -> SeenFrame:
        """Count a frame that was on the bus until `stamp`."""
        self._on_bus(stamp)
        identifier = rtcan.decode_identifier(frame.id)
        message = identifier.message_id
        kind = self._kind_of(frame, identifier)
        bits = can_bits.frame_bits(frame.id, frame.data)
        start = stamp - bits * self.directory.timing.bit
        if kind is FrameKind.SYNC:
            self._begin_cycle(start, frame)
        slot = self._slot_of(start, message, kind)
        self._count(message, kind, bits)
        if kind is FrameKind.NRT:
            self._note_nrt(stamp)
        text = self._management_text(frame, message, stamp) if kind is FrameKind.MANAGEMENT else ""
        size = self.directory.sizes.get(message)
        return SeenFrame(
            stamp,
            frame,
            kind,
            "" if kind is FrameKind.SYNC else self.directory.topic(message),
            "" if kind is FrameKind.SYNC else self.directory.module(message),
            identifier.laxity,
            identifier.left & ~rtcan.FIRST_MARK if kind is FrameKind.MANAGEMENT else identifier.left,
            bits + can_bits.INTERMISSION,
            rtcan.fragment_count(size) if size and size <= rtcan.PAYLOAD_MAX else None,
            self._cycle if self._sync is not None else None,
            slot,
            text,
        )

    def other(self, frame: OtherFrame, stamp: int) -> SeenFrame:
        """Count a frame that RTCAN does not use, and that was on the bus until `stamp`."""
        self._on_bus(stamp)
        bits = can_bits.other_frame_bits(frame)
        slot = self._slot_of(stamp - bits * self.directory.timing.bit, _OTHER, FrameKind.OTHER)
        self._count(_OTHER, FrameKind.OTHER, bits)
        text = f"{'29-bit' if frame.extended else '11-bit'} identifier {frame.id:X}"
        if frame.remote is not None:
            text += f", asks for {frame.remote} bytes"
        cycle = self._cycle if self._sync is not None else None
        seen = Frame(frame.id, frame.data)
        bits += can_bits.INTERMISSION
        return SeenFrame(stamp, seen, FrameKind.OTHER, "", "", 0, 0, bits, None, cycle, slot, text)

    def _on_bus(self, stamp: int) -> None:
        self.last_frame = max(self.last_frame, stamp)
        while stamp >= self._end:
            self._end_period()

    def _count(self, message: int, kind: FrameKind, bits: int) -> None:
        tally = self._tallies.setdefault((message, kind), TrafficCount())
        tally.frames += 1
        tally.bits += bits + can_bits.INTERMISSION

    @property
    def slots(self) -> list[BusSlot]:
        """Return the use of each slot since the last `reset`, with the names known by now."""
        for slot, owners in zip(self._slots, self._owners, strict=True):
            slot.owners, slot.senders = Counter(), Counter()
            for message, count in owners.items():
                topic, module = ("sync", "") if message == _SYNC else self.directory.names(message)
                slot.owners[topic] += count
                slot.senders[topic, module] += count
        return self._slots

    def load(self, now: int) -> BusLoad:
        """Return the load since the last `reset`."""
        gap = self._nrt_gap
        if self._nrt is not None:
            gap = max(gap or 0, now - self._nrt)
        elapsed = now - self._since
        tallies: dict[tuple[str, str, FrameKind], TrafficCount] = {}
        for (message, kind), tally in self._tallies.items():
            nameless = kind is FrameKind.SYNC or kind is FrameKind.OTHER
            names = ("", "") if nameless else self.directory.names(message)
            total = tallies.setdefault((*names, kind), TrafficCount())
            total.frames += tally.frames
            total.bits += tally.bits
        timing = self.directory.timing
        reserved = min(1.0, self._reserved * timing.slot / elapsed) if elapsed else 0.0
        longest = (can_bits.frame_bits_max(rtcan.FRAME_MAX) + can_bits.INTERMISSION) * timing.bit
        free = (1.0 - reserved) * elapsed / timing.slot * (timing.slot // longest) if self._reserved else 0.0
        return BusLoad(elapsed, timing.bit, tallies, dict(self._faults), reserved, free, gap, self.slots)

    def _begin_cycle(self, start: int, frame: Frame) -> None:
        sync = rtcan.decode_sync(frame)
        timing = self.directory.timing
        if self._whole and self._sync is not None and abs(start - self._sync - timing.cycle) < timing.slot:
            self._end_cycle()
        self._whole = True
        self._sync, self._cycle, self._mask = start, sync.cycle, sync.mask | 1
        self._filled = set()
        self._reserved += self._mask.bit_count()

    def _end_cycle(self) -> None:
        """Count the slots of a cycle that was watched from its beginning."""
        self.cycles += 1
        self._grow(self._mask.bit_length() - 1)
        for index, slot in enumerate(self._slots):
            if self._mask >> index & 1:
                slot.reserved += 1
                slot.used += index in self._filled

    def _slot_of(self, start: int, message: int, kind: FrameKind) -> int | None:
        """Return the slot in which a frame started; the frame is counted there."""
        timing = self.directory.timing
        if self._sync is None:
            return None
        index = (start - self._sync + timing.slot // _EARLY) // timing.slot
        if not 0 <= index < timing.slots:
            self._sync = self._sync if index < 0 else None  # too late: no sync came
            return None
        if self._whole:
            self._note_slot(index, message, kind)
        return index

    def _note_slot(self, index: int, message: int, kind: FrameKind) -> None:
        self._grow(index)
        if kind in {FrameKind.SYNC, FrameKind.HRT}:
            self._filled.add(index)
            self._owners[index][_SYNC if kind is FrameKind.SYNC else message] += 1
        else:
            self._slots[index].shared += 1

    def _grow(self, index: int) -> None:
        while len(self._slots) <= max(index, self.directory.timing.slots - 1):
            self._slots.append(BusSlot())
            self._owners.append(Counter())

    def _note_nrt(self, stamp: int) -> None:
        since = self._since if self._nrt is None else self._nrt
        self._nrt_gap = max(self._nrt_gap or 0, stamp - since)
        self._nrt = stamp

    def _management_text(self, frame: Frame, message: int, stamp: int) -> str:
        packed = message != rtcan.FIRMWARE_MANAGEMENT
        self._reassembly.subscribe(message, management.SIZE, packed=packed)
        received = self._reassembly.receive(frame, stamp)
        if received is None:
            return ""
        before = self.directory.timing
        text = self.directory.learn(received.payload, rtcan.id8_of(message))
        if self.directory.timing != before:
            self._forget_slots()
        return text

    def _kind_of(self, frame: Frame, identifier: Identifier) -> FrameKind:
        message, laxity = identifier.message_id, identifier.laxity
        # Overdue management of firmware ends with the identifier of the sync of cycle 0.
        ends_management = message == rtcan.FIRMWARE_MANAGEMENT and self._reassembly.ends_with_next(message)
        if rtcan.is_sync(frame.id) and len(frame.data) == rtcan.FRAME_MAX and not ends_management:
            return FrameKind.SYNC
        if rtcan.high_byte(message) <= rtcan.MANAGEMENT and message not in self.directory.topics:
            return FrameKind.MANAGEMENT  # firmware of 2014 may have topics there
        return FrameKind.HRT if laxity == rtcan.HRT else FrameKind.NRT if laxity == rtcan.NRT else FrameKind.SRT


def describe(message: management.Management) -> str:
    """Return a management message as text."""
    fields = {
        name: getattr(message, name)
        for name in message.__struct_fields__
        if name != "params" and getattr(message, name) not in {"", 0}
    }
    if fields.get("size", 0) >= management.SIZE_VARIES:
        fields["size"] = f"up to {management.decode_size(fields['size'])[0]}"
    if isinstance(message, management.SubscribeResponse):
        fields["id"] = f"0x{management.rtcan_message_id(message.params):04X}"
    text = " ".join(f"{name}={each.hex() if isinstance(each, bytes) else each}" for name, each in fields.items())
    return f"{type(message).__name__} {text}".rstrip()
