"""The network of section 4.4 of the thesis: three nodes that send, and a listener, on a simulated bus.

Each node sends three hard real-time messages in slots of their own, and events of three kinds at random instants. What
is measured is what a perfect listener sees: the true instants of all frames.
"""

import asyncio
import random
from collections import defaultdict
from itertools import pairwise
from typing import Any, NamedTuple

import msgspec

from r2p.codecs import rtcan
from r2p.codecs.can_bits import AnyFrame
from r2p.protocols.rtcan.cycle import timing
from r2p.protocols.rtcan.engine import Engine
from r2p.protocols.rtcan.events import Action, Due, EngineSettings, Ready, SlotsGranted
from r2p.sim import run
from r2p.sim.can import CanBus, CanNode, FrameRecord, Latency
from r2p.sim.transport import SimCan, SimPort
from r2p.transports.rtcan.driver import EngineDriver

SECOND = 1_000_000_000
MS = 1_000_000
TIMING = timing()
"""60 slots of 166 us."""
NODES = ("1", "2", "3")
_FIRST_ID8 = 10
_LATENCY = 4_000  # ns, nominal: from a timer's instant to the start of frame, and from the end of a frame to its stamp
_APART = 0.06  # s, between two steps while the network starts
_LISTENED = 1.8  # s, until the last node has its id8 for sure
_SETTLED = 3 * SECOND


class Cyclic(NamedTuple):
    """A hard real-time message of 8 bytes: its name, its period in slots, its topic's high byte."""

    name: str
    period: int
    high: int


class Sporadic(NamedTuple):
    """A kind of event: bytes, deadline in ns, how often compared with C."""

    name: str
    size: int
    deadline: int
    weight: float
    high: int


HRT = (Cyclic("A", 6, 2), Cyclic("B", 30, 3), Cyclic("C", 60, 4))
SRT = (
    Sporadic("A", 8, 20 * MS, 5.26, 5),
    Sporadic("B", 16, 20 * MS, 2.03, 6),
    Sporadic("C", 10, 50 * MS, 1.0, 7),
)
SLOTS_EACH = sum(each.weight * rtcan.fragment_count(each.size) for each in SRT)
"""Slots for one C and what comes with it; and bits of payload."""
BITS_EACH = sum(each.weight * each.size * 8 for each in SRT)
RESERVED = sum(len(NODES) * TIMING.slots // each.period for each in HRT) + 1


class Scenario(msgspec.Struct, frozen=True, kw_only=True):
    """What is run. `load`: events, as a share of the free slots; `drop`: what is overdue is given up.

    `duration` in s, after the network has started; `jitter`: of each latency, in ns either way; `ppm`: how far off the
    clocks are at most. `hrt`: there are hard real-time messages; `kinds`: of the events.
    """

    seed: int = 1
    duration: float = 60.0
    load: float = 0.95
    drop: bool = True
    jitter: int = 3_000
    ppm: float = 50.0
    hrt: bool = True
    kinds: tuple[Sporadic, ...] = SRT

    @property
    def free(self) -> float:
        """Free slots a second."""
        reserved = RESERVED if self.hrt else 1
        return (TIMING.slots - reserved) * SECOND / TIMING.cycle

    @property
    def events(self) -> float:
        """Events of kind C a second, at each node; of the other kinds there are `weight` times as many."""
        slots = sum(each.weight * rtcan.fragment_count(each.size) for each in self.kinds)
        return self.load * self.free / slots / len(NODES)


class Track(msgspec.Struct):
    """One hard real-time message of one node. Of each frame: the slot it was in, counted from the start of cycle 0,
    its true start of frame, and by how much that is off the master's grid, in ns.
    """

    message: Cyclic
    phase: int
    slots: list[int] = []
    starts: list[int] = []
    errors: list[int] = []

    @property
    def periods(self) -> list[int]:
        """From each start of frame to the next one, in ns."""
        return [after - before for before, after in pairwise(self.starts)]

    def missed(self, scenario: Scenario) -> int:
        """How many of its slots it did not use, and how many frames were in other ones."""
        period = self.message.period * TIMING.slot
        instants = [_SETTLED, *self.starts, _SETTLED + round(scenario.duration * SECOND)]
        astray = sum((slot - self.phase) % self.message.period != 0 for slot in self.slots)
        return astray + sum(max(0, (b - a + period // 2) // period - 1) for a, b in pairwise(instants))


class Events(msgspec.Struct):
    """All events of one kind: how many, how many of them were not through by their deadline, and what it took those
    that got through, in ns.
    """

    count: int = 0
    missed: int = 0
    latencies: list[int] = []


class Outcome(msgspec.Struct):
    """The result of a scenario. `hrt` is by node and message, `owners` has the owner of each slot of the cycle.

    `strays`: hard real-time messages that went without a slot; `payload`: bits of whole messages carried; `busy`: the
    share of time in which the bus was occupied.
    """

    scenario: Scenario
    hrt: dict[tuple[str, str], Track]
    srt: dict[str, Events]
    owners: dict[int, tuple[str, str]]
    strays: int
    payload: int
    busy: float
    frames: int
    syncs: list[int]
    counts: dict[str, dict[str, int]]


class Node:
    """One node: its engine, driven as by the transport, and its messages."""

    def __init__(self, name: str, shared: SimCan, scenario: Scenario) -> None:
        numbers = random.Random(f"{scenario.seed}/{name}")
        latency = Latency(_LATENCY, scenario.jitter)
        offset, drift = numbers.randrange(SECOND), numbers.uniform(-scenario.ppm, scenario.ppm)
        self.name = name
        self.grants: dict[int, SlotsGranted] = {}
        node = CanNode(name, one_shot=True, offset=offset, drift_ppm=drift, transmit=latency, receive=latency)
        self.port = SimPort(shared, node)
        self.engine = Engine(
            EngineSettings(
                number=numbers.getrandbits(64),
                id8=_FIRST_ID8 + NODES.index(name),
                priority=len(NODES) - NODES.index(name),
                receive_latency=_LATENCY,
                transmit_latency=_LATENCY,
            )
        )
        self.driver = EngineDriver(self.engine, self.port, self)
        self._data = numbers.randbytes
        self._sizes: dict[int, int] = {}

    async def run(self) -> None:
        """Take part, until cancelled."""
        await self.port.run(self.driver, lambda: None)

    def reserve(self, high: int, size: int, period: int) -> None:
        """Ask for slots, every `period` slots, for a message of `size` bytes. Its data are random."""
        self._sizes[high] = size
        self.driver.carry_out(self.engine.reserve(self.driver.now(), high, size, period * TIMING.slot))

    def publish(self, kind: Sporadic, payload: bytes, *, drop: bool) -> None:
        """Send an event."""
        now = self.driver.now()
        self.driver.carry_out(self.engine.publish(now, kind.high, payload, deadline=now + kind.deadline, drop=drop))

    # What the driver calls

    def act(self, action: Action) -> None:
        if isinstance(action, Due):
            data = self._data(self._sizes[action.high])
            self.driver.carry_out(self.engine.fill(self.driver.now(), action.high, data))
        elif isinstance(action, SlotsGranted):
            self.grants[action.high] = action
        elif isinstance(action, Ready):
            self.driver.update_filters()

    def bus_up(self) -> None:
        pass

    def bus_down(self, reason: str) -> None:
        raise RuntimeError(f"node {self.name}: {reason}")

    def bus_waits(self, reason: str) -> None:
        raise RuntimeError(f"node {self.name}: {reason}")

    def bus_fault(self, kind: str) -> None:
        raise RuntimeError(f"node {self.name}: {kind}")

    def internal_error(self, error: Exception) -> None:
        raise error


class Source:
    """The events of one kind at one node, at random instants. Each begins with its number."""

    def __init__(self, node: Node, kind: Sporadic, bus: CanBus, scenario: Scenario, until: int) -> None:
        self.kind = kind
        self.triggered: list[int] = []
        self.done: dict[int, int] = {}
        self._node = node
        self._timeline = bus.timeline
        self._until = until
        self._drop = scenario.drop
        self._gap = SECOND / (scenario.events * kind.weight)
        self._numbers = random.Random(f"{scenario.seed}/{node.name}/{kind.name}")

    def start(self) -> None:
        """The first one is due after a random time, as every other."""
        due = self._timeline.now() + round(self._numbers.expovariate(1) * self._gap)
        if due < self._until:
            self._timeline.at(due, self._fire)

    def _fire(self) -> None:
        number = len(self.triggered).to_bytes(4, "little")
        self.triggered.append(self._timeline.now())
        self._node.publish(self.kind, number + self._numbers.randbytes(self.kind.size - 4), drop=self._drop)
        self.start()

    def count(self, events: Events) -> None:
        """Add those whose deadline is over."""
        for number, at in enumerate(self.triggered):
            deadline = at + self.kind.deadline
            if deadline < self._until:
                done = self.done.get(number)
                events.count += 1
                events.missed += done is None or done > deadline
                if done is not None:
                    events.latencies.append(done - at)


class Listener:
    """Writes down what is on the bus, from now on."""

    def __init__(self, bus: CanBus, sources: dict[int, Source]) -> None:
        self.periodic: defaultdict[int, list[int]] = defaultdict(list)
        self.syncs: list[int] = []
        self.strays = 0
        self.payload = 0
        self.frames = 0
        self._sources = sources
        self._open: dict[int, int] = {}
        self._cyclic = {each.high for each in HRT}
        bus.observers.append(self._write)

    def _write(self, record: FrameRecord) -> None:
        frame = record.frame
        message = frame.id >> 7
        self.frames += 1
        if message > 0xFFFF:
            self._unslotted(message & 0xFFFF, frame, record.end)
        elif message >> 8 == rtcan.SYNC:
            self.syncs.append(record.start)
        else:
            self.periodic[message].append(record.start)
            self.payload += 8 * len(frame.data)

    def _unslotted(self, message: int, frame: AnyFrame, end: int) -> None:
        source = self._sources.get(message)
        if source is not None:
            self._event(source, message, frame.id & 0x7F, frame.data, end)
        else:
            self.strays += message >> 8 in self._cyclic

    def _event(self, source: Source, message: int, left: int, data: bytes, end: int) -> None:
        if left + 1 == rtcan.fragment_count(source.kind.size):
            self._open[message] = int.from_bytes(data[:4], "little")
        if not left:
            source.done[self._open[message]] = end
            self.payload += 8 * source.kind.size


async def simulate(scenario: Scenario) -> Outcome:
    """Start the network, then watch it for the scenario's duration."""
    asyncio.get_running_loop().set_exception_handler(_failed)
    shared = SimCan(seed=scenario.seed)
    bus = shared.bus
    nodes = [Node(name, shared, scenario) for name in NODES]
    bus.attach(CanNode("listener"))
    async with asyncio.TaskGroup() as group:
        running = await _come_up(group, nodes, scenario)
        listener, sources = _begin(bus, nodes, scenario)
        await asyncio.sleep(scenario.duration)
        outcome = _outcome(scenario, bus, nodes, listener, sources)
        for task in running:
            task.cancel()
    bus.close()
    return outcome


def _failed(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
    loop.default_exception_handler(context)
    loop.stop()


def simulated(scenario: Scenario) -> Outcome:
    """The same, in virtual time of its own."""
    outcomes = []

    async def main() -> None:  # without a result: asyncio's runner makes a text of that, and this one is long
        outcomes.append(await simulate(scenario))

    run(main, seed=scenario.seed)
    return outcomes[0]


async def _come_up(group: asyncio.TaskGroup, nodes: list[Node], scenario: Scenario) -> list[asyncio.Task[None]]:
    """One node after the other; then the messages, those of the shortest period first: they need the most slots."""
    running = []
    for node in nodes:
        running.append(group.create_task(node.run(), name=f"node {node.name}"))
        await asyncio.sleep(_APART)
    await asyncio.sleep(_LISTENED)
    for message in HRT if scenario.hrt else ():
        for node in nodes:
            node.reserve(message.high, rtcan.FRAME_MAX, message.period)
            await asyncio.sleep(_APART)
    await asyncio.sleep(_SETTLED / SECOND - asyncio.get_running_loop().time())
    wanted = len(HRT) if scenario.hrt else 0
    if any(len(node.grants) != wanted or not node.engine.ready for node in nodes):
        raise RuntimeError("the network has not started")
    return running


def _begin(bus: CanBus, nodes: list[Node], scenario: Scenario) -> tuple[Listener, dict[int, Source]]:
    """Now it counts."""
    until = _SETTLED + round(scenario.duration * SECOND)
    sources = {}
    for node in nodes:
        for kind in scenario.kinds if scenario.load else ():
            message = rtcan.message_id(kind.high, node.engine.id8 or 0)
            sources[message] = Source(node, kind, bus, scenario, until)
    bus.reset_statistics()
    for source in sources.values():
        source.start()
    return Listener(bus, sources), sources


def _outcome(
    scenario: Scenario, bus: CanBus, nodes: list[Node], listener: Listener, sources: dict[int, Source]
) -> Outcome:
    events = {kind.name: Events() for kind in SRT}
    for source in sources.values():
        source.count(events[source.kind.name])
    return Outcome(
        scenario,
        hrt={(n.name, m.name): _track(nodes[0], n, m, listener) for n in nodes for m in HRT if scenario.hrt},
        srt=events,
        owners=_owners(nodes),
        strays=listener.strays,
        payload=listener.payload,
        busy=bus.load(),
        frames=listener.frames,
        syncs=listener.syncs,
        counts={node.name: dict(node.engine.counts) for node in nodes},
    )


def _track(master: Node, node: Node, message: Cyclic, listener: Listener) -> Track:
    clock, now = master.port.controller.clock, master.driver.now()
    zero = now - (master.engine.network_time(now) or 0)
    starts = listener.periodic[rtcan.message_id(message.high, node.engine.id8 or 0)]
    at = [clock.local(start) - zero for start in starts]
    slots = [(each + TIMING.slot // 2) // TIMING.slot for each in at]
    errors = [each - slot * TIMING.slot for each, slot in zip(at, slots, strict=True)]
    return Track(message, node.grants[message.high].phase, slots, starts, errors)


def _owners(nodes: list[Node]) -> dict[int, tuple[str, str]]:
    owners = {}
    for node in nodes:
        for message in HRT:
            grant = node.grants.get(message.high)
            for slot in range(grant.phase, TIMING.slots, grant.period) if grant else ():
                owners[slot] = node.name, message.name
    return owners
