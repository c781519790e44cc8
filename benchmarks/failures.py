"""What a bus of modules loses when a node dies, goes to bus-off, babbles or forges; and what a user sees of it.

    python -m benchmarks.failures             # prints the tables of docs/time-and-failures.md
    python -m benchmarks.failures --write     # and writes them there, with the pictures and results

Six modules of r2p on the exact simulated bus, in virtual time, and a seventh controller without any software of r2p
that sends whatever a case says. Each case is run with ten seeds, of clocks, jitter and the instant of the fault.
"""

from __future__ import annotations

import argparse
import asyncio
import itertools
import logging
import multiprocessing
import random
from collections import Counter
from contextlib import AsyncExitStack
from typing import TYPE_CHECKING, Any

import msgspec

import r2p
from benchmarks import time_page
from r2p import sim
from r2p.codecs import management, rtcan
from r2p.codecs.can_bits import Frame
from r2p.runtime.events import LinkDown, LinkNotice, LinkUp
from r2p.sim.can import CanController, CanNode
from r2p.transports.rtcan.link import RtcanLink
from r2p.units import SECOND

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Sequence

    from r2p.runtime.events import EventListener
    from r2p.sim.can import FrameRecord
    from r2p.sim.transport import SimCan
    from r2p.transports.rtcan.tx import SlottedTopic

MODULES = 6
"""Each has a periodic topic, which the next one subscribes to; M0 has the highest priority, and becomes the master."""
PERIODS = (0.005, 0.01, 0.02)
"""Seconds, in turn."""
PPM = 50.0
LATENCY, JITTER = 4_000, 3_000
FAULT = 0.5
"""Seconds that a fault lasts, where it has a length."""
WATCHED = 3.0
"""Seconds that are watched after its end."""
SEEDS = tuple(range(1, 11))
OWNER = "M3"
"""The module whose slots a case is about; it is not the master, nor the next one."""
_SETTLED = 1.0
_READY = 30.0
_URGENT = Frame(0, b"")  # wins every arbitration
_LEAST = Frame(rtcan.encode_identifier(rtcan.NRT, 0xFFFF, 0x7F), bytes(8))  # loses every arbitration


class FailureCase(msgspec.Struct, frozen=True):
    """A fault: its name on the page, and who is not counted among the others, as it is at fault."""

    name: str
    text: str
    broken: tuple[str, ...]
    inject: Callable[[FailureNetwork], Awaitable[None]]


class FailureOutcome(msgspec.Struct, frozen=True):
    """The fate of the modules that are not at fault, from the fault until 3 s after its end. Times are in ms."""

    expected: int
    """Messages for which there would have been slots."""
    slots_lost: int
    """... that were not in slots."""
    values_lost: int
    """Values that were made, and never reached their subscriber."""
    without_hrt: float
    """The longest time between two messages of one topic in slots."""
    without_values: float
    """The longest time between two values of one topic at its subscriber."""
    sync_gap: float
    """The longest time without a sync, by whomever."""
    kept: bool
    """All topics of the others have the slots that they had, at the end."""
    slotted: bool
    """All topics of the others have slots, at the end."""
    own_back: float | None
    """From the end of the fault until the broken module has its slots, None: it is not there, or did not get them."""
    own_same: bool
    """It has the slots that it had."""
    counts: dict[str, int]
    """What the others' links counted."""
    notices: dict[str, int]
    """Events of the others' modules, by kind."""
    own_notices: dict[str, int]
    """Events of the module that is at fault, or forged."""


class FailureNetwork:
    """The bus, its modules, and what is seen of them."""

    def __init__(self, can: SimCan, seed: int) -> None:
        self.can = can
        self.numbers = random.Random(f"failures/{seed}")
        self.modules: dict[str, r2p.Module] = {}
        self.attacker: CanController = can.bus.attach(CanNode("X"))
        self.ended = 0
        self.hrt: dict[str, list[int]] = {}
        """Ends of messages in slots, by topic."""
        self.arrived: dict[str, list[tuple[int, int]]] = {}
        """When values arrived, and which, by topic."""
        self.made: Counter[str] = Counter()
        self.syncs: list[int] = []
        self.own_slots_at: int | None = None
        self._topics: dict[int, str] = {}  # by high byte
        can.bus.observers.append(self._saw)

    @property
    def now(self) -> int:
        """True time, ns."""
        return self.can.bus.timeline.now()

    def link(self, name: str) -> RtcanLink:
        """Return the link of a module."""
        link = self.modules[name].links[0]
        assert isinstance(link, RtcanLink)
        return link

    @property
    def links(self) -> dict[str, RtcanLink]:
        """The links by module."""
        return {name: self.link(name) for name in self.modules}

    def slotted(self, name: str) -> SlottedTopic:
        """Return the topic of this module in its slots."""
        return next(iter(self.link(name).slots.values()))

    def ready(self) -> bool:
        """Return whether all have one master and their slots, and all values arrive."""
        links = self.links.values()
        masters = {link.engine.network.master for link in links}
        granted = all(len(link.slots) == 1 and self.slotted(name).period for name, link in self.links.items())
        return granted and len(masters) == 1 and len(self.arrived) == len(self.modules)

    def note_topics(self) -> None:
        """Note the topics' numbers on the bus, which stay."""
        self._topics = {self.slotted(name).high: f"t{name}" for name in self.modules}

    def _saw(self, record: FrameRecord) -> None:
        if record.error is not None or not record.frame.extended:
            return
        identifier = record.frame.id
        if rtcan.is_sync(identifier) and len(record.frame.data) == rtcan.FRAME_MAX:
            self.syncs.append(record.start)
        elif rtcan.laxity_of(identifier) == rtcan.HRT and record.senders != ("X",):
            topic = self._topics.get(rtcan.high_byte(rtcan.message_of(identifier)))
            if topic is not None:
                self.hrt.setdefault(topic, []).append(record.start)

    async def publish(self, node: r2p.Node, topic: str, period: float) -> None:
        """Publish numbers."""

        def fill() -> r2p.Timestamp:
            self.made[topic] += 1
            return r2p.Timestamp.from_ns(self.made[topic])

        node.advertise(topic, r2p.Timestamp, r2p.Periodic(period, fill))
        await asyncio.Event().wait()

    async def listen(self, node: r2p.Node, topic: str) -> None:
        """Note which numbers arrive, and when."""
        async for value in node.subscribe(topic, r2p.Timestamp, queue=100):
            self.arrived.setdefault(topic, []).append((self.now, value.ns))

    def forge(self, laxity: int, message: int, payload: bytes) -> None:
        """Send a message by the broken node, frame by frame."""
        frames = [
            Frame(rtcan.encode_identifier(laxity, message, left), data) for left, data in rtcan.fragments(payload)
        ]
        self._send(frames)

    def _send(self, frames: list[Frame]) -> None:
        def following(*_: Any) -> None:
            if frames:
                self.attacker.request(frames.pop(0))

        self.attacker.on_sent = following
        following()

    def at_cycle(self, offset: int) -> tuple[int, int]:
        """Return the next instant (true ns) that is so far from the start of one of the master's cycles; its count."""
        cycle = self.link("M0").engine.cycle
        clock = self.link("M0").driver.port.monotonic
        start, counter = cycle.reference, cycle.counter
        while clock(start) + offset < self.now + 1_000_000:
            start, counter = start + cycle.timing.cycle, counter + 1
        return clock(start) + offset, counter


# Faults


async def _off(net: FailureNetwork, name: str) -> None:
    net.can.port(name).power_off()
    await asyncio.sleep(FAULT)
    net.can.port(name).power_on()


async def kill_master(net: FailureNetwork) -> None:
    """Cut the power of the master."""
    await _off(net, "M0")


async def kill_owner(net: FailureNetwork) -> None:
    """Cut the power of a module with slots."""
    await _off(net, OWNER)


async def bus_off_owner(net: FailureNetwork) -> None:
    """Destroy what a module sends until its controller leaves the bus."""
    net.can.bus.disturb_next(bit=60, count=40, sender=OWNER)
    await asyncio.sleep(FAULT)


async def bus_off_master(net: FailureNetwork) -> None:
    """Destroy what the master sends until its controller leaves the bus."""
    net.can.bus.disturb_next(bit=60, count=40, sender="M0")
    await asyncio.sleep(FAULT)


async def short_circuit(net: FailureNetwork) -> None:
    """Short the wires for 20 ms."""
    net.can.bus.short(20_000_000)
    await asyncio.sleep(0.02)


def _babble(frame: Frame, seconds: float) -> Callable[[FailureNetwork], Awaitable[None]]:
    async def babble(net: FailureNetwork) -> None:
        net.attacker.babble(frame)
        await asyncio.sleep(seconds)
        net.attacker.babble(None)

    return babble


def _forged_syncs(offset: int, mask: int, *, count_off: int = 0) -> Callable[[FailureNetwork], Awaitable[None]]:
    """Send a sync in each cycle, `offset` ns from the start of the master's, with this mask."""

    async def forge(net: FailureNetwork) -> None:
        end = net.now + round(FAULT * SECOND)
        while net.now < end:
            at, counter = net.at_cycle(offset)
            await asyncio.sleep((at - net.now) / SECOND)
            net.attacker.request(rtcan.encode_sync(counter + count_off, mask))

    return forge


async def forged_network(net: FailureNetwork) -> None:
    """Claim in each cycle to be a better master, of another run, and send no sync."""
    end = net.now + round(FAULT * SECOND)
    timing = net.link("M0").engine.timing
    while net.now < end:
        network = management.Network(250, 255, 0x12345678, 1000, timing.slots, timing.slot)
        net.forge(rtcan.SRT_MIN, rtcan.message_id(rtcan.MANAGEMENT, 250), management.encode(network))
        await asyncio.sleep(timing.cycle / SECOND)


async def forged_id(net: FailureNetwork) -> None:
    """Send data with a module's id8, as a node that claims nothing."""
    await _send_as(net, OWNER)


async def forged_id_of_master(net: FailureNetwork) -> None:
    """Send data with the master's id8."""
    await _send_as(net, "M0")


async def _send_as(net: FailureNetwork, name: str) -> None:
    id8, end = net.link(name).engine.id8 or 0, net.now + 2 * round(FAULT * SECOND)
    while net.now < end:
        net.forge(rtcan.SRT_MAX, rtcan.message_id(0xFE, id8), bytes(8))
        await asyncio.sleep(0.01)


async def forged_claims(net: FailureNetwork) -> None:
    """Claim a module's id8 with the lowest number, again and again."""
    id8, end = net.link(OWNER).engine.id8 or 0, net.now + round(FAULT * SECOND)
    while net.now < end:
        claim = management.encode(management.Claim(id8, 0))
        net.forge(rtcan.SRT_MIN, rtcan.message_id(rtcan.MANAGEMENT, id8), claim)
        await asyncio.sleep(0.02)


async def forged_release(net: FailureNetwork) -> None:
    """Release a module's slots in its name, in each cycle."""
    end, topic = net.now + round(FAULT * SECOND), net.slotted(OWNER)
    message = rtcan.message_id(topic.high, net.link(OWNER).engine.id8 or 0)
    while net.now < end:
        net.forge(
            rtcan.SRT_MIN, rtcan.message_id(rtcan.MANAGEMENT, 250), management.encode(management.Release(message))
        )
        await asyncio.sleep(0.01)


NONE, MASTER, VICTIM = (), ("M0",), (OWNER,)
CASES = (
    FailureCase("master", "the master loses power for 0.5 s", MASTER, kill_master),
    FailureCase("owner", "an owner of slots loses power for 0.5 s", VICTIM, kill_owner),
    FailureCase("bus-off", "an owner of slots goes to bus-off", VICTIM, bus_off_owner),
    FailureCase("bus-off-master", "the master goes to bus-off", MASTER, bus_off_master),
    FailureCase("short", "the wires are shorted for 20 ms", NONE, short_circuit),
    FailureCase("babble-20ms", "babbling, most urgent frame, 20 ms", NONE, _babble(_URGENT, 0.02)),
    FailureCase("babble", "babbling, most urgent frame, 0.5 s", NONE, _babble(_URGENT, FAULT)),
    FailureCase("babble-least", "babbling, least urgent frame, 0.5 s", NONE, _babble(_LEAST, FAULT)),
    FailureCase("sync-off-grid", "a sync in the middle of each cycle, 0.5 s", NONE, _forged_syncs(5_000_000, 0)),
    FailureCase("sync-wrong-count", "a sync in place of the master's, with another count, 0.5 s", NONE,
                _forged_syncs(-140_000, 0, count_off=7)),
    FailureCase("sync-early", "a sync in place of the master's that reserves no slot, 0.5 s", NONE,
                _forged_syncs(-140_000, 0)),
    FailureCase("sync-late", "the master's sync once more in each cycle, no slot reserved, 0.5 s", NONE,
                _forged_syncs(150_000, 0)),
    FailureCase("network", "NETWORK of a better master that sends no sync, 0.5 s", NONE, forged_network),
    FailureCase("id", "data with the id of an owner of slots, 1 s", VICTIM, forged_id),
    FailureCase("id-master", "data with the id of the master, 1 s", MASTER, forged_id_of_master),
    FailureCase("claims", "claims of the id of an owner of slots, 0.5 s", VICTIM, forged_claims),
    FailureCase("release", "RELEASE of another's slots, 0.5 s", NONE, forged_release),
)  # fmt: skip


# One run


def simulate(name: str, seed: int) -> FailureOutcome:
    """Run one case with one seed."""
    case = next(each for each in CASES if each.name == name)
    return sim.run(lambda: _simulate(case, seed), seed=seed)


async def _simulate(case: FailureCase, seed: int) -> FailureOutcome:
    can = sim.can_bus("failures", seed=seed)
    net = FailureNetwork(can, seed)
    async with AsyncExitStack() as stack:
        for number in range(MODULES):
            await _add(net, stack, number)
        await _until(net.ready, _READY)
        net.note_topics()
        await asyncio.sleep(_SETTLED + net.numbers.random() * 0.1)
        return await _watch(net, case)


async def _add(net: FailureNetwork, stack: AsyncExitStack, number: int) -> None:
    """Add a module, which publishes in slots, and listens to the one before it."""
    drift, priority = net.numbers.uniform(-PPM, PPM), {0: 9, 1: 5}.get(number, 1)
    via = f"sim:failures,drift={drift},latency={LATENCY}ns,jitter={JITTER}ns,priority={priority}"
    name = f"M{number}"
    module = net.modules[name] = await stack.enter_async_context(r2p.Module(name, via=via, watchdog=False))
    module.start(net.publish, f"t{name}", PERIODS[number % len(PERIODS)])
    module.start(net.listen, f"tM{(number - 1) % MODULES}")


async def _until(done: Callable[[], bool], limit: float) -> None:
    async with asyncio.timeout(limit):
        while not done():  # noqa: ASYNC110 - a benchmark looks from outside
            await asyncio.sleep(0.002)


async def _watch(net: FailureNetwork, case: FailureCase) -> FailureOutcome:
    others = [name for name in net.modules if name not in case.broken]
    phases = {name: _slots(net, name) for name in net.modules}
    before = {name: Counter(net.link(name).stats.faults) + Counter(net.link(name).losses) for name in others}
    events = {name: module.events() for name, module in net.modules.items()}
    start, made = net.now, Counter(net.made)
    await case.inject(net)
    net.ended = net.now
    back = await _own_back(net, case.broken)
    await asyncio.sleep(WATCHED - (net.now - net.ended) / SECOND)
    counts: Counter[str] = Counter()
    for name in others:
        counts += Counter(net.link(name).stats.faults) + Counter(net.link(name).losses) - before[name]
    end = net.now
    gaps = [_gaps(net.hrt.get(f"t{name}", []), start, end) for name in others]
    intervals = [net.link(name).engine.timing.slot * phases[name][0] for name in others]
    missing = [_missing(each, interval) for each, interval in zip(gaps, intervals, strict=True)]
    listened = [name for number, name in enumerate(net.modules) if name in others and _reader(number) in others]
    return FailureOutcome(
        expected=sum((end - start) // interval for interval in intervals),
        slots_lost=sum(missing),
        values_lost=sum(_values_lost(net, f"t{name}", made[f"t{name}"]) for name in listened),
        without_hrt=max(max(each) for each in gaps) / 1e6,
        without_values=max(max(_gaps([at for at, _ in net.arrived[f"t{name}"]], start, end)) for name in listened)
        / 1e6,
        sync_gap=max(_gaps(net.syncs, start, end)) / 1e6,
        kept=all(_slots(net, name) == phases[name] for name in others),
        slotted=all(_slots(net, name)[0] for name in others),
        own_back=back,
        own_same=all(_slots(net, name) == phases[name] for name in case.broken),
        counts=dict(sorted(counts.items())),
        notices=_notices([events[name] for name in others]),
        own_notices=_notices([events[name] for name in case.broken]),
    )


def _reader(number: int) -> str:
    return f"M{(number + 1) % MODULES}"


def _slots(net: FailureNetwork, name: str) -> tuple[int, int]:
    topics = net.link(name).slots
    each = next(iter(topics.values()), None)
    return (each.period, each.phase) if each is not None else (0, 0)


async def _own_back(net: FailureNetwork, broken: Sequence[str]) -> float | None:
    if not broken:
        return None
    try:
        await _until(lambda: all(_slots(net, name)[0] for name in broken), WATCHED - 0.1)
    except TimeoutError:
        return None
    return (net.now - net.ended) / 1e6


def _gaps(instants: Sequence[int], start: int, end: int) -> list[int]:
    """Return the times between instants (ns) from the last one before the start on, with the one that is open."""
    last = max((at for at in instants if at <= start), default=start)
    points = [last, *(at for at in instants if start < at <= end), end]
    return [after - before for before, after in itertools.pairwise(points)]


def _missing(gaps: Sequence[int], interval: int) -> int:
    """Return how many messages are missing in these gaps; in the last one, none is due before it is over."""
    *closed, last = gaps
    return sum(max(0, round(gap / interval) - 1) for gap in closed) + last // (interval + interval // 8)


def _values_lost(net: FailureNetwork, topic: str, before: int) -> int:
    arrived = {number for _, number in net.arrived[topic]}
    last = max(arrived, default=0)
    return sum(number not in arrived for number in range(before + 1, max(last, net.made[topic] - 1) + 1))


def _notices(listeners: Sequence[EventListener]) -> dict[str, int]:
    found: Counter[str] = Counter()
    for event in (each for listener in listeners for each in listener.queue):
        if isinstance(event, LinkNotice):
            found[event.kind] += 1
        elif isinstance(event, LinkDown | LinkUp):
            found[type(event).__name__] += 1
    return dict(sorted(found.items()))


class FailureRow(msgspec.Struct, frozen=True):
    """The runs of one case, by seed."""

    name: str
    text: str
    broken: list[str]
    runs: list[FailureOutcome]


def study(cases: Sequence[str], seeds: Sequence[int], workers: int = 1) -> list[FailureRow]:
    """Run these cases with these seeds, in so many processes, which changes nothing but the time that it takes."""
    chosen = [each for each in CASES if each.name in cases]
    jobs = [(each.name, seed) for each in chosen for seed in seeds]
    if workers > 1:
        with multiprocessing.get_context("spawn").Pool(workers, logging.disable) as pool:
            found = pool.starmap(simulate, jobs, chunksize=1)
    else:
        found = [simulate(*job) for job in jobs]
    runs = dict(zip(jobs, found, strict=True))
    return [
        FailureRow(each.name, each.text, list(each.broken), [runs[each.name, seed] for seed in seeds])
        for each in chosen
    ]


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the tables in Markdown, and write the page if asked to."""
    names = [each.name for each in CASES]
    parser = argparse.ArgumentParser(prog="python -m benchmarks.failures", description=__doc__)
    parser.add_argument("--case", choices=names, action="append", help="one fault only; may be repeated")
    parser.add_argument("--seeds", type=int, default=len(SEEDS), help="how many runs of each")
    parser.add_argument("--workers", type=int, default=1, help="processes")
    parser.add_argument("--write", action="store_true", help="write the results, the tables and the picture")
    options = parser.parse_args(arguments)
    logging.disable()
    rows = study(options.case or names, SEEDS[: options.seeds], options.workers)
    time_page.show(time_page.failure_tables(rows))
    if options.write:
        time_page.write_failures(rows)


if __name__ == "__main__":
    main()
