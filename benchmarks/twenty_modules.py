"""A robot of 20 modules on one bus (thesis 3.3.1): start, share of management, modules that are unplugged.

`python -m benchmarks.twenty_modules` runs the emulated hexapod under virtual time, once for each seed, and prints
tables in Markdown, the same each time. `--part` measures one thing only: start or unplug.
"""

import argparse
import asyncio
import functools
import logging
import random
import statistics
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import msgspec

from r2p import sim
from r2p.codecs import rtcan
from r2p.codecs.can_bits import INTERMISSION, Frame
from r2p.sim.can import FrameRecord
from r2p.sim.robots.hexapod.robot import MODULES, Hexapod
from r2p.sim.transport import SimCan
from r2p.transports.rtcan.link import RtcanLink
from r2p.transports.rtcan.tx import SlottedTopic
from r2p.units import SECOND

VIA = "sim:twenty"
_POLL = 0.005  # s, of what is looked at
_LOOK = 0.05  # s, of what every module knows of all others
_LIMIT = 30.0  # s for anything to happen
_SETTLED = 5.0  # s after the start, when there is nothing new to announce
_WATCHED = 5.0  # s

Phases = dict[str, tuple[int, int]]
"""Period and phase of the slots of each topic."""


class Traffic:
    """Counts frames and their bits, by class."""

    def __init__(self, can: SimCan) -> None:
        self.frames: Counter[str] = Counter()
        self.bits: Counter[str] = Counter()
        self.sync_gap = 0
        """The longest time between two syncs, ns."""
        self._bit = can.bus.bit
        self._sync: int | None = None
        can.bus.observers.append(self._saw)

    def reset(self) -> None:
        """Begin anew."""
        self.frames.clear()
        self.bits.clear()
        self.sync_gap = 0

    def _saw(self, record: FrameRecord) -> None:
        if not isinstance(record.frame, Frame):
            return
        kind = _kind(record)
        self.frames[kind] += 1
        self.bits[kind] += (record.end - record.start) // self._bit + INTERMISSION
        if kind == "sync":
            if self._sync is not None:
                self.sync_gap = max(self.sync_gap, record.start - self._sync)
            self._sync = record.start


def _kind(record: FrameRecord) -> str:
    identifier = record.frame.id
    high, laxity = rtcan.high_byte(rtcan.message_of(identifier)), rtcan.laxity_of(identifier)
    if record.error is not None:
        return "errors"
    if high in (rtcan.SYNC, rtcan.MANAGEMENT):
        return "sync" if high == rtcan.SYNC else "management"
    return "hard" if laxity == rtcan.HRT else "no" if laxity == rtcan.NRT else "soft"


def links(robot: Hexapod) -> dict[str, RtcanLink]:
    """Return the modules' connections to the bus."""
    return {name: link for name, board in robot.modules.items() for link in board.links if isinstance(link, RtcanLink)}


def slotted(robot: Hexapod) -> list[SlottedTopic]:
    """Return all topics that have, or want, slots."""
    return [topic for link in links(robot).values() for topic in link.slots.values()]


def phases(robot: Hexapod) -> Phases:
    """Return who has which slots."""
    return {each.topic.name: (each.period, each.phase) for each in slotted(robot) if each.period}


async def until(done: Callable[[], bool], poll: float = _POLL) -> float:
    """Wait until something is so; return how long it took, s."""
    time = asyncio.get_running_loop().time
    start = time()
    async with asyncio.timeout(_LIMIT):
        while not done():  # noqa: ASYNC110 - a benchmark looks from outside
            await asyncio.sleep(poll)
    return time() - start


# Start


class Start(msgspec.Struct, frozen=True):
    """When the last module was ready, s from when the last one got power; and the bus until then, and after that."""

    ids: float
    master: float
    slots: float
    known: float
    frames: dict[str, float] = {}
    """A second, by class, during the start."""
    bits: dict[str, float] = {}
    """Share of the bus."""
    later_frames: dict[str, float] = {}
    later_bits: dict[str, float] = {}


async def start(seed: int, apart: float = 0.0, watched: float = _WATCHED) -> Start:
    """Switch on all modules, one `apart` (s) from the other, and watch the bus for a while afterwards."""
    can = sim.can_bus("twenty", seed=seed)
    traffic = Traffic(can)
    time = asyncio.get_running_loop().time
    async with Hexapod(VIA, seed=seed, modules=[]) as robot:
        began = time()
        for name in random.Random(seed).sample(MODULES, len(MODULES)):
            await robot.switch_on(name)
            await asyncio.sleep(apart if len(robot.modules) < len(MODULES) else 0)
        powered = time()
        everything = list(links(robot).values())
        ids = await until(lambda: all(link.engine.ready for link in everything))
        master = ids + await until(lambda: len({link.engine.network.master for link in everything} - {None}) == 1)
        slots = master + await until(lambda: all(topic.period for topic in slotted(robot)))
        names = {each.topic for each in robot.publishers()}
        known = slots + await until(lambda: all(_knows(robot, name, names) for name in MODULES), _LOOK)
        during = _rates(traffic, time() - began, can)
        found = Start(ids, master, slots, known, *during)
        if watched:
            await asyncio.sleep(max(0.0, powered + _SETTLED - time()))
            traffic.reset()
            await asyncio.sleep(watched)
            later = _rates(traffic, watched, can)
            found = msgspec.structs.replace(found, later_frames=later[0], later_bits=later[1])
        return found


def _knows(robot: Hexapod, name: str, topics: set[str]) -> bool:
    """Return whether a module knows all others, and who publishes what."""
    network = robot.modules[name].network
    if not {each.name for each in network.modules()} >= set(MODULES):
        return False
    published = {topic for topic, view in network.topics().items() if view.published_on}
    return published >= topics


def _rates(traffic: Traffic, seconds: float, can: SimCan) -> tuple[dict[str, float], dict[str, float]]:
    frames = {kind: count / seconds for kind, count in traffic.frames.items()}
    bits = {kind: count / seconds / can.bitrate for kind, count in traffic.bits.items()}
    return frames, bits


# Unplugged


class Replug(msgspec.Struct, frozen=True):
    """A module that lost its power and got it back. Seconds, and slots."""

    noticed: float
    """Until the last of the others knew that it was gone."""
    sync_gap: float
    """The longest time between two syncs."""
    missed: int
    """Slots of the others that stayed empty."""
    suspended: int
    """Topics of the others that lost their slots for a while."""
    slots_back: float
    """From power to its own slots."""
    known: float
    """From power until it knew all others and all topics, and they knew it."""
    kept: bool
    """The others have the slots that they had."""
    same: bool
    """It has the slots that it had."""


async def unplug(seed: int, *, master: bool = False, away: float | None = None) -> Replug:
    """Cut the power of a joint's module, or of the master, in the middle of the operation; then plug it in again.

    `away`: for so many seconds; None: until a second after everybody has noticed.
    """
    can = sim.can_bus("twenty", seed=seed)
    traffic = Traffic(can)
    async with Hexapod(VIA, seed=seed) as robot:
        await robot.ready(_LIMIT)
        numbers = random.Random(seed)
        await asyncio.sleep(1.0 + numbers.random())
        name = links(robot)["GW"].master if master else "LM2"
        name = name if name != "GW" or not master else links(robot)["PS"].master
        before, own = phases(robot), {topic.topic.name for topic in links(robot)[name].slots.values()}
        others = [(each, each.sent, each.missed) for each in slotted(robot) if each.topic.name not in own]
        events: list[str] = []
        traffic.reset()
        await robot.unplug(name)
        topics = [each for each, *_ in others]
        watching = asyncio.create_task(_count_suspended(topics, events))
        gone = functools.partial(_forgotten, robot, name)
        noticed = await until(gone) if away is None else 0.0
        await asyncio.sleep(1.0 if away is None else away)
        await robot.switch_on(name)
        everybody = {each.topic for each in robot.publishers()}
        mine = links(robot)[name]
        back = await until(lambda: mine.up and all(each.period for each in mine.slots.values()))
        known = back + await until(lambda: all(_knows(robot, each, everybody) for each in MODULES), _LOOK)
        watching.cancel()
        after = phases(robot)
        return Replug(
            noticed,
            traffic.sync_gap / SECOND,
            sum(each.missed - missed for each, _, missed in others),
            len(set(events)),
            back,
            known,
            all(after.get(topic) == slots for topic, slots in before.items() if topic not in own),
            all(after.get(topic) == slots for topic, slots in before.items() if topic in own),
        )


async def _count_suspended(topics: list[SlottedTopic], events: list[str]) -> None:
    while True:
        events += [each.topic.name for each in topics if not each.period]
        await asyncio.sleep(_POLL)


def _forgotten(robot: Hexapod, name: str) -> bool:
    return not any(name in {info.name for info in link.discovery.modules.values()} for link in links(robot).values())


# Tables


def _run(main: Callable[..., Any], seed: int, *arguments: Any, **options: Any) -> Any:
    return sim.run(lambda: main(seed, *arguments, **options), seed=seed)


def _row(*cells: object) -> str:
    return f"| {' | '.join(str(cell) for cell in cells)} |"


def _seconds(values: Iterable[float]) -> str:
    """Median and worst."""
    found = sorted(values)
    return f"{statistics.median(found):.2f} | {found[-1]:.2f}"


def print_start(seeds: Sequence[int]) -> None:
    """How long the start takes, and what the bus does meanwhile and later."""
    together = [_run(start, seed) for seed in seeds]
    apart = [_run(start, seed, 0.1, 0.0) for seed in seeds]
    print(_row("s after the last module got power", "all at once: median", "worst", "0.1 s apart: median", "worst"))
    print("| --- | ---: | ---: | ---: | ---: |")
    for field, what in (
        ("ids", "all have an id"),
        ("master", "all have the same master"),
        ("slots", "all slots are granted"),
        ("known", "everybody knows all modules and topics"),
    ):
        cells = [_seconds(getattr(each, field) for each in found) for found in (together, apart)]
        print(_row(what, *cells))
    print()
    print(_row("", "start: frames/s", "share of the bus", "later: frames/s", "share of the bus"))
    print("| --- | ---: | ---: | ---: | ---: |")
    for kind in ("management", "sync", "hard", "soft", "no", "errors"):
        cells = [
            f"{statistics.mean(getattr(each, field).get(kind, 0.0) for each in together) * scale:.{digits}f}{unit}"
            for field, scale, digits, unit in (
                ("frames", 1, 0, ""),
                ("bits", 100, 1, " %"),
                ("later_frames", 1, 0, ""),
                ("later_bits", 100, 1, " %"),
            )
        ]
        print(_row(_KINDS[kind], *cells))


_KINDS = {
    "management": "management",
    "sync": "sync",
    "hard": "hard real-time",
    "soft": "soft real-time",
    "no": "no real time",
    "errors": "error frames",
}


def print_unplug(seeds: Sequence[int]) -> None:
    """A module and the master, unplugged and plugged in again."""
    cases: tuple[tuple[str, dict[str, Any]], ...] = (
        ("a joint", {}),
        ("a joint, for 0.5 s", {"away": 0.5}),
        ("the master", {"master": True}),
        ("the master, for 0.5 s", {"master": True, "away": 0.5}),
    )
    head = "gone: median s", "worst", "no sync: median s", "worst", "others: slots missed", "lost for a while"
    print(_row("unplugged", *head, "own slots back: median s", "worst", "all known: median s", "worst", "phases kept"))
    print("| --- |" + " ---: |" * 11)
    for what, options in cases:
        found = [_run(unplug, seed, **options) for seed in seeds]
        print(
            _row(
                what,
                "- | -" if "away" in options else _seconds(each.noticed for each in found),
                _seconds(each.sync_gap for each in found),
                max(each.missed for each in found),
                max(each.suspended for each in found),
                _seconds(each.slots_back for each in found),
                _seconds(each.known for each in found),
                f"others {sum(each.kept for each in found)}, own {sum(each.same for each in found)} of {len(found)}",
            ),
            flush=True,
        )


def main() -> None:
    """Print the tables."""
    parts = {"start": print_start, "unplug": print_unplug}
    parser = argparse.ArgumentParser(prog="python -m benchmarks.twenty_modules", description=__doc__)
    parser.add_argument("--part", choices=parts, action="append", help="what to measure; may be repeated")
    parser.add_argument("--seeds", type=int, default=10, help="how many runs")
    options = parser.parse_args()
    logging.disable()
    for number, part in enumerate(options.part or parts):
        print(end="\n" if number else "")
        parts[part](range(1, options.seeds + 1))


if __name__ == "__main__":
    main()
