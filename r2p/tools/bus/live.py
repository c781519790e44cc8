"""The messages that a live RTCAN bus carries, for `r2p bus analyze --via rtcan:can0`, measured frame by frame.

Modules announce the classes of their publishers; neither periods nor deadlines.
"""

from collections import defaultdict

import msgspec

from r2p.analysis import BusMessage, MessageClass, SlotSupply, management_load
from r2p.bus import BusMonitor, FrameKind, SeenFrame, Timing
from r2p.codecs import PublisherClass, rtcan
from r2p.tools.bus.reported import MANAGEMENT_FRAMES, declared_otherwise, named
from r2p.units import MILLISECOND, SECOND

CONTROL_LAXITY_MAX = 10
"""Management with at most this laxity (ms) when it begins keeps the network and its slots; the rest has 50 ms."""

_CLASSES = {FrameKind.HRT: MessageClass.HRT, FrameKind.SRT: MessageClass.SRT, FrameKind.NRT: MessageClass.NRT}


class SeenMessage(msgspec.Struct):
    """One message id: its frames, when messages began (ns), and the laxity of most when they did (ms)."""

    topic: str
    module: str
    kind: FrameKind
    frames: int = 1
    size: int = 0
    begins: list[int] = []
    laxity: int = 0
    control: int = 0

    def see(self, frame: SeenFrame) -> None:
        """Take in a frame; the first of a message has the most frames left, or a mark."""
        self.topic, self.module = frame.topic, frame.module
        if self.kind is FrameKind.MANAGEMENT:
            self.frames = MANAGEMENT_FRAMES
        elif frame.left + 1 > self.frames:  # the ones before were the rest of a message
            self.frames, self.begins, self.laxity, self.control = frame.left + 1, [], 0, 0
        if frame.left == self.frames - 1 or (self.kind is FrameKind.MANAGEMENT and frame.frame.id & rtcan.FIRST_MARK):
            self.begins.append(frame.stamp)
            self.laxity = max(self.laxity, frame.laxity)
            self.control += frame.laxity <= CONTROL_LAXITY_MAX
        if frame.left == 0:
            self.size = max(self.size, (self.frames - 1) * rtcan.FRAME_MAX + len(frame.frame.data))

    @property
    def shortest(self) -> int | None:
        """The shortest time between two of them (ns); None: there was one."""
        return min((b - a for a, b in zip(self.begins, self.begins[1:], strict=False)), default=None)


class LiveBus(msgspec.Struct):
    """What was seen: slots, the messages by id and kind, and every slot that was reserved in any cycle."""

    timing: Timing
    duration: int
    mask: int = 1
    messages: dict[tuple[int, FrameKind], SeenMessage] = {}
    publishers: dict[tuple[str, str], PublisherClass] = {}
    """The classes that were announced meanwhile, by topic and module."""

    def see(self, frame: SeenFrame) -> None:
        """Take in a frame."""
        if frame.kind is FrameKind.SYNC:
            self.mask |= rtcan.decode_sync(frame.frame).mask
        elif frame.kind is not FrameKind.OTHER:
            key = rtcan.message_of(frame.frame.id), frame.kind
            if key not in self.messages:
                self.messages[key] = SeenMessage(frame.topic, frame.module, frame.kind)
            self.messages[key].see(frame)

    @property
    def supply(self) -> SlotSupply:
        """The slots that were free in every cycle."""
        return SlotSupply(self.timing, [self.mask])

    @property
    def declared(self) -> list[BusMessage]:
        """The topics, with the shortest time between two messages as their period; one that was sent once has the whole
        time. Messages that were sent as events, as their topic had no slots yet, are left out.
        """
        return [
            BusMessage(
                name=seen.topic,
                node=seen.module,
                id=message,
                size=max(1, seen.size),
                period=None if kind is FrameKind.NRT else seen.shortest or self.duration,
                deadline=max(1, seen.laxity) * MILLISECOND if kind is FrameKind.SRT else None,
                message_class=_CLASSES[kind],
            )
            for (message, kind), seen in self.messages.items()
            if kind in _CLASSES and not self._gained_slots(message, kind)
        ]

    def _gained_slots(self, message: int, kind: FrameKind) -> bool:
        return kind is FrameKind.SRT and (message, FrameKind.HRT) in self.messages

    @property
    def control(self) -> list[BusMessage]:
        """The management of all modules."""
        rates: dict[str, float] = defaultdict(float)
        other: dict[str, float] = defaultdict(float)
        for (_, kind), seen in self.messages.items():
            if kind is FrameKind.MANAGEMENT:
                rates[seen.module] += seen.control * SECOND / self.duration
                other[seen.module] += (len(seen.begins) - seen.control) * SECOND / self.duration
        return management_load(
            {module: max(1.0, rate) for module, rate in rates.items()}, max(other.values(), default=0)
        )

    @property
    def assumed(self) -> list[str]:
        """What the analysis assumes, a line each."""
        sent = {(seen.topic, seen.module) for (_, kind), seen in self.messages.items() if kind in _CLASSES}
        slotted = {(seen.topic, seen.module) for (_, kind), seen in self.messages.items() if kind is FrameKind.HRT}
        lines = [
            f"periods: the shortest of {self.duration / SECOND:g} s; deadlines: the laxity of the frames",
            "a slot that was reserved in any cycle is taken in all of them",
            *declared_otherwise(self.publishers, sent, slotted),
        ]
        gained = [(seen.topic, seen.module) for key, seen in self.messages.items() if self._gained_slots(*key)]
        if gained:
            lines.append(f"counted in their slots only, though sent without for a while: {named(gained)}")
        return lines


async def watch(bus: BusMonitor, duration: float) -> LiveBus:
    """Listen to a bus for so many seconds."""
    live = LiveBus(bus.timing, round(duration * SECOND))
    end = None
    async for frame in bus:
        end = end or frame.stamp + live.duration
        if frame.stamp > end:
            break
        live.see(frame)
    live.timing, live.publishers = bus.timing, bus.publishers
    return live
