"""Figure 4.11 of the thesis: the same events on the same bus, by fixed priorities and by least laxity.

A frame should last 10 units of time. At 12.5 kbit/s it lasts about 10 ms; so a unit is a millisecond, and laxity is as
exact as on a fast bus. Each node tries its oldest event, and at the end of every frame it tries anew.
"""

import asyncio
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from benchmarks.thesis.svg import COLOURS, Plot
from r2p.codecs import rtcan
from r2p.codecs.can_bits import AnyFrame
from r2p.codecs.rtcan import Frame
from r2p.sim import run
from r2p.sim.can import CanBus, CanNode, FrameRecord

MS = 1_000_000
DEADLINES = {"A": 20, "B": 25, "C": 30}
EVENTS = (("B", 0), ("A", 5), ("C", 5), ("A", 29), ("C", 29), ("B", 39))
"""Whose events happen when."""
_BIT_RATE = 12_500
_DATA = b"\x55" * 7  # next to nothing is stuffed in: frames of 120 to 126 bits


class Sent(NamedTuple):
    """What became of an event; instants in ms."""

    source: str
    triggered: float
    start: float
    end: float

    @property
    def deadline(self) -> float:
        return self.triggered + DEADLINES[self.source]

    @property
    def missed(self) -> bool:
        return self.end > self.deadline


def fixed(source: str, _left: int) -> int:
    """Deadline-monotonic: the shorter the deadline, the higher the priority, always."""
    return DEADLINES[source]


def least_laxity(_source: str, left: int) -> int:
    """What RTCAN does."""
    return rtcan.srt_laxity(left)


class Source:
    """A node with its events; `priority(name, ns left)` goes into the identifier."""

    def __init__(self, name: str, bus: CanBus, priority: Callable[[str, int], int]) -> None:
        self.name = name
        self.waiting: list[int] = []
        self._priority = priority
        self._controller = bus.attach(CanNode(name, one_shot=True))
        self._controller.on_sent = self._sent
        self._controller.on_receive = lambda *_: self._retry()

    def trigger(self) -> None:
        """An event."""
        self.waiting.append(self._controller.clock.monotonic())
        self._retry()

    def _retry(self) -> None:
        self._controller.abort()
        if self.waiting:
            left = self.waiting[0] + DEADLINES[self.name] * MS - self._controller.clock.monotonic()
            message = rtcan.message_id(rtcan.FIRST_TOPIC, ord(self.name))
            identifier = rtcan.encode_identifier(self._priority(self.name, left), message)
            self._controller.request(Frame(identifier, _DATA))

    def _sent(self, _frame: AnyFrame, _stamp: int) -> None:
        del self.waiting[0]
        self._retry()


def scheduled(priority: Callable[[str, int], int]) -> list[Sent]:
    """The events in the order in which they were sent."""

    async def main() -> list[Sent]:
        bus = CanBus(asyncio.get_running_loop(), bitrate=_BIT_RATE)
        sources = {name: Source(name, bus, priority) for name in DEADLINES}
        sent: list[Sent] = []

        def write(record: FrameRecord) -> None:
            (name,) = record.senders
            turn = sum(each.source == name for each in sent)
            triggered = [at for source, at in EVENTS if source == name][turn]
            sent.append(Sent(name, triggered, record.start / MS, record.end / MS))

        bus.observers.append(write)
        for name, at in EVENTS:
            bus.timeline.at(at * MS, sources[name].trigger)
        await asyncio.sleep(1)
        return sent

    return run(main())


def draw(path: Path) -> None:
    """Both, one above the other: triangles are events, bars their frames, ticks at the end their deadlines."""
    plot = Plot("Fixed priorities, and least laxity", (0, 72), (0, 7), labels=("ms", ""), size=(720, 330))
    plot.ticks([(ms, str(ms)) for ms in range(0, 75, 10)])
    for base, name, priority in ((3.6, "fixed", fixed), (0.0, "laxity", least_laxity)):
        sent = scheduled(priority)
        for row, source in enumerate("CBA"):
            bottom = base + row
            plot.note(-0.7, bottom + 0.3, f"{name}: {source}", anchor="end")
            for event in (each for each in sent if each.source == source):
                colour = "#c62828" if event.missed else COLOURS[row]
                plot.box((event.start, event.end), (bottom + 0.1, bottom + 0.7), colour, "late" if event.missed else "")
                plot.line([(event.triggered, bottom), (event.triggered, bottom + 0.9)], COLOURS[row])
                plot.line([(event.deadline, bottom), (event.deadline, bottom + 0.9)], colour, dash="3 3")
    plot.note(71.5, 6.75, "line: event, dashed: its deadline", anchor="end")
    plot.write(path)
