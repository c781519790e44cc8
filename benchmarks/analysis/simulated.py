"""Message sets on the simulated bus, for comparison with the bounds: plain CAN, and RTCAN with its real engine."""

import asyncio
import random
from collections import defaultdict, deque
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any

import msgspec

from r2p.analysis import BusMessage, MessageClass
from r2p.codecs import management, rtcan
from r2p.codecs.can_bits import AnyFrame, Frame, OtherFrame
from r2p.protocols.rtcan.calendar import Reservation
from r2p.protocols.rtcan.cycle import Timing
from r2p.protocols.rtcan.engine import Engine
from r2p.protocols.rtcan.events import Action, Due, EngineSettings, Profile, Ready, SlotsGranted
from r2p.sim import run
from r2p.sim.can import CanBus, CanNode, FrameRecord
from r2p.sim.transport import SimCan, SimPort
from r2p.transports.rtcan.driver import EngineDriver
from r2p.units import SECOND

SETTLED = 3 * SECOND
"""When an RTCAN network has a master, and all nodes have their slots."""


class Arrival(msgspec.Struct, frozen=True):
    """An instance of a message: when it should have been queued, and when it was (ns)."""

    due: int
    queued: int


def arrivals(message: BusMessage, numbers: random.Random, duration: int, *, offset: int) -> list[Arrival]:
    """All instances from `offset` on: each after a period, with the jitter at random, the first one with all of it.

    They keep their order, also if the jitter is longer than the period.
    """
    assert message.period is not None
    found: list[Arrival] = []
    for due in range(offset, offset + duration, message.period):
        jitter = numbers.randint(0, message.jitter) if found else message.jitter
        found.append(Arrival(due, max(due + jitter, found[-1].queued if found else 0)))
    return found


def frame_of(message: BusMessage, data: bytes) -> AnyFrame:
    return Frame(message.id, data) if message.extended else OtherFrame(message.id, data)


class PlainSource:
    """One message at a controller of its own, which gets the oldest instance that waits."""

    def __init__(self, bus: CanBus, message: BusMessage, data: bytes) -> None:
        self.responses: list[int] = []
        self._frame = frame_of(message, data)
        self._controller = bus.attach(CanNode(message.name))
        self._controller.on_sent = self._sent
        self._waiting: deque[Arrival] = deque()

    def queue(self, arrival: Arrival) -> None:
        self._waiting.append(arrival)
        if len(self._waiting) == 1:
            self._controller.request(self._frame)

    def _sent(self, _frame: AnyFrame, stamp: int) -> None:
        self.responses.append(stamp - self._waiting.popleft().due)
        if self._waiting:
            self._controller.request(self._frame)


def plain_responses(
    messages: Sequence[BusMessage], bit: int, plan: dict[str, list[Arrival]], data: dict[str, bytes], errors: int = 0
) -> dict[str, list[int]]:
    """Return the responses of all instances of each message (ns), in their order. `errors`: frames destroyed."""

    async def main() -> dict[str, list[int]]:
        bus = CanBus(asyncio.get_running_loop(), bitrate=SECOND // bit)
        bus.attach(CanNode("listener"))
        bus.disturb_next(count=errors)
        sources = {each.name: PlainSource(bus, each, data[each.name]) for each in messages}
        for name, instances in plan.items():
            for each in instances:
                bus.timeline.at(each.queued, sources[name].queue, each)
        await asyncio.sleep(max(each.queued for instances in plan.values() for each in instances) / SECOND + 1)
        return {name: source.responses for name, source in sources.items()}

    return run(main())


class RtcanNode:
    """A node with its real engine, without any latency, as the transport drives it."""

    def __init__(self, shared: SimCan, number: int, timing: Timing) -> None:
        self.name = f"n{number}"
        self.port = SimPort(shared, CanNode(self.name, one_shot=True))
        settings = EngineSettings(
            number=number,
            id8=10 + number,
            priority=100 - number,
            profile=Profile.RTCAN,
            slots=timing.slots,
            cycle=timing.cycle,
            bit_rate=SECOND // timing.bit,
            capacity=1024,
        )
        self.engine = Engine(settings)
        self.driver = EngineDriver(self.engine, self.port, self)
        self.granted: dict[int, Reservation] = {}
        self._sizes: dict[int, int] = {}

    async def run(self) -> None:
        await self.port.run(self.driver, lambda: None)

    def reserve(self, high: int, message: BusMessage) -> None:
        assert message.period is not None
        self._sizes[high] = message.size
        self.driver.carry_out(self.engine.reserve(self.driver.now(), high, message.size, message.period))

    def publish(self, high: int, payload: bytes, deadline: int | None) -> None:
        now = self.driver.now()
        if deadline is None:
            self.driver.carry_out(self.engine.publish(now, high, payload))
        else:
            self.driver.carry_out(self.engine.publish(now, high, payload, deadline=now + deadline, drop=False))

    def discover(self, payload: bytes) -> None:
        """Send a message of discovery."""
        self.driver.carry_out(self.engine.manage(self.driver.now(), payload))

    def act(self, action: Action) -> None:
        if isinstance(action, Due):
            self.driver.carry_out(self.engine.fill(self.driver.now(), action.high, bytes(self._sizes[action.high])))
        elif isinstance(action, SlotsGranted):
            self.granted[action.high] = Reservation(
                action.high, action.period, action.phase, rtcan.fragment_count(self._sizes[action.high])
            )
        elif isinstance(action, Ready):
            self.driver.update_filters()

    def bus_up(self) -> None:
        pass

    def bus_down(self, reason: str) -> None:
        raise AssertionError(reason)

    bus_waits = bus_fault = bus_down

    def internal_error(self, error: Exception) -> None:
        raise error


class RtcanRun(msgspec.Struct):
    """The responses of all events by name (ns), of those that still wait so far; the reservations, and the master."""

    responses: dict[str, list[int]]
    reservations: list[Reservation]
    master: str


class _Watcher:
    """Sees when events are through: the messages of a topic go in order."""

    def __init__(self) -> None:
        self.waiting: defaultdict[int, deque[int]] = defaultdict(deque)
        self.responses: defaultdict[int, list[int]] = defaultdict(list)

    def see(self, record: FrameRecord) -> None:
        assert record.error is None
        message, left = rtcan.message_of(record.frame.id), record.frame.id & rtcan.LEFT_MASK
        if message in self.waiting and not left:
            self.responses[message].append(record.end - self.waiting[message].popleft())


def rtcan_responses(
    messages: Sequence[BusMessage],
    timing: Timing,
    plan: dict[str, list[Arrival]],
    duration: int,
    discovery: Mapping[str, Sequence[int]] = MappingProxyType({}),
) -> RtcanRun:
    """Run a network in which each node of the messages is one; the plan counts from when it has settled.

    `discovery`: when nodes send messages of discovery, by name (ns).
    """

    async def main() -> RtcanRun:
        asyncio.get_running_loop().set_exception_handler(_stop)
        shared = SimCan(seed=1, bitrate=SECOND // timing.bit)
        names = list(dict.fromkeys(each.node for each in messages))
        nodes = {name: RtcanNode(shared, number, timing) for number, name in enumerate(names)}
        shared.bus.attach(CanNode("listener"))
        watcher = _Watcher()
        async with asyncio.TaskGroup() as group:
            running = [group.create_task(each.run()) for each in nodes.values()]
            await asyncio.sleep(2)
            highs = {each.name: rtcan.FIRST_TOPIC + index for index, each in enumerate(messages)}
            for each in messages:
                if each.message_class is MessageClass.HRT:
                    nodes[each.node].reserve(highs[each.name], each)
                    await asyncio.sleep(0.05)
            await asyncio.sleep(SETTLED / SECOND - asyncio.get_running_loop().time())
            shared.bus.observers.append(watcher.see)
            ids = {each.name: rtcan.message_id(highs[each.name], nodes[each.node].engine.id8 or 0) for each in messages}
            for each in messages:
                for arrival in plan.get(each.name, ()):
                    publish = _publishing(nodes[each.node], highs[each.name], each, watcher.waiting[ids[each.name]])
                    shared.bus.timeline.at(SETTLED + arrival.queued, publish, SETTLED + arrival.queued)
            for name, instants in discovery.items():
                for number, instant in enumerate(instants):
                    # Without zeros, so that it takes all frames that a message may take.
                    parts = bytes(0x80 | number >> shift & 0x7F for shift in (21, 14, 7, 0))
                    payload = parts * (management.SIZE // len(parts))
                    shared.bus.timeline.at(SETTLED + instant, nodes[name].discover, payload)
            await asyncio.sleep(duration / SECOND)
            for task in running:
                task.cancel()
        shared.bus.close()
        events = [each for each in messages if each.name in plan]
        for each in events:  # what still waits took at least as long as this
            watcher.responses[ids[each.name]] += [SETTLED + duration - at for at in watcher.waiting[ids[each.name]]]
        return RtcanRun(
            {each.name: watcher.responses[ids[each.name]] for each in events},
            [reservation for node in nodes.values() for reservation in node.granted.values()],
            names[0],  # with the highest priority in the election, and the first to start
        )

    return run(main())


def _publishing(node: RtcanNode, high: int, message: BusMessage, waiting: deque[int]) -> Any:
    def publish(at: int) -> None:
        waiting.append(at)
        node.publish(high, bytes([0x55]) * message.size, message.deadline)

    return publish


def _stop(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
    loop.default_exception_handler(context)
    loop.stop()
