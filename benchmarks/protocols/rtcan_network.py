"""RTCAN: the engine of the `rtcan:` and `sim:` transports with the driver that they have, not a second one.

Periodic messages ask the master for slots, those with the shortest period first; those that get none, and events, are
soft real-time with their deadline. A cycle has 60 slots: 10 ms at 1 Mbit/s, and longer in proportion on a slower bus.
Identifiers have 29 bits, as always.
"""

from __future__ import annotations

import asyncio
import random
from typing import TYPE_CHECKING, NamedTuple

from benchmarks.protocols.network import ProtocolNetwork
from r2p.codecs import rtcan
from r2p.codecs.can_bits import EXTENDED, INTERMISSION, Frame
from r2p.protocols.rtcan.engine import Engine
from r2p.protocols.rtcan.events import Done, Due, EngineSettings, Fate, Ready, SlotsGranted
from r2p.protocols.rtcan.master import Role
from r2p.sim.can import CanNode, Latency
from r2p.sim.transport import SimCan, SimPort
from r2p.transports.rtcan.driver import EngineDriver
from r2p.units import MILLISECOND, SECOND

if TYPE_CHECKING:
    from collections.abc import Mapping

    from benchmarks.protocols.message_sets import SetMessage
    from benchmarks.protocols.network import ProtocolSetup
    from benchmarks.protocols.recorder import MessageInstance, MessageTrack
    from r2p.codecs.can_bits import AnyFrame
    from r2p.protocols.rtcan.events import Action
    from r2p.sim.can import CanBus, CanController, FrameRecord

SLOTS = 60
_NOMINAL = 10 * MILLISECOND
_APART = 0.03  # s, between two steps while the network starts
_LISTENED = 1.8  # s, until the last node has its id8 for sure


class SoftHandle(NamedTuple):
    """The value that a soft real-time message carries."""

    name: str
    instance: MessageInstance


class RtcanNode:
    """One node: its engine, driven as by the transport, and its messages by their high byte."""

    def __init__(self, network: RtcanNetwork, name: str, place: int) -> None:
        setup = network.setup
        numbers = random.Random(f"{setup.seed}/{name}")
        latency = Latency(setup.latency, setup.jitter)
        offset, drift = numbers.randrange(SECOND), numbers.uniform(-setup.ppm, setup.ppm)
        node = CanNode(name, one_shot=True, offset=offset, drift_ppm=drift, transmit=latency, receive=latency)
        self.name = name
        self.messages: dict[int, MessageTrack] = {}
        self.granted: dict[int, int] = {}
        """True periods of the messages that have slots."""
        self.slotted: dict[int, MessageInstance] = {}
        self.answer: asyncio.Future[int] | None = None
        """Gets the instant at which the master next grants slots."""
        self.port = SimPort(network.shared, node)
        self.engine = Engine(
            EngineSettings(
                number=numbers.getrandbits(64),
                id8=10 + place,
                priority=max(1, 200 - place),
                slots=SLOTS,
                cycle=_NOMINAL * 1_000_000 // setup.messages.bitrate,
                bit_rate=setup.messages.bitrate,
                receive_latency=setup.latency,
                transmit_latency=setup.latency,
            )
        )
        self.driver = EngineDriver(self.engine, self.port, self)
        self._network = network
        self._payload = network.payload

    async def run(self) -> None:
        """Take part, until cancelled."""
        await self.port.run(self.driver, lambda: None)

    def reserve(self, high: int, message: SetMessage) -> None:
        """Ask for slots."""
        self.driver.carry_out(self.engine.reserve(self.driver.now(), high, message.size, message.period))

    def act(self, action: Action) -> None:
        if isinstance(action, Due):
            self._fill(action)
        elif isinstance(action, Done):
            if action.fate is Fate.SENT and isinstance(action.handle, SoftHandle):
                self._network.finished(action.handle.name, action.handle.instance)
        elif isinstance(action, SlotsGranted):
            self.granted[action.high] = action.interval
            if self.answer is not None and not self.answer.done():
                self.answer.set_result(self._network.bus.timeline.now())
        elif isinstance(action, Ready):
            self.driver.update_filters()

    def _fill(self, due: Due) -> None:
        data = None
        track = self.messages[due.high]
        if due.slotted and track.paced:
            self.slotted[due.high] = track.release(self.port.controller.clock.true(due.at))
            data = self._payload(track.message.size)
        self.driver.carry_out(self.engine.fill(self.driver.now(), due.high, data))

    def bus_up(self) -> None:
        pass

    def bus_down(self, reason: str) -> None:
        pass

    def bus_waits(self, reason: str) -> None:
        pass

    def bus_fault(self, kind: str) -> None:
        pass

    def internal_error(self, error: Exception) -> None:
        raise error


class SoftMessage:
    """A message that goes as a soft real-time one: where an outbox is with other protocols."""

    def __init__(self, node: RtcanNode, high: int, track: MessageTrack, *, drop: bool) -> None:
        self.track = track
        self.message = track.message
        self._node = node
        self._high = high
        self._drop = drop

    @property
    def controller(self) -> CanController:
        return self._node.port.controller

    def put(self, instance: MessageInstance) -> None:
        """Send this value."""
        node, message = self._node, self.message
        if not node.engine.ready:
            return
        now = node.driver.now()
        payload = random.Random(instance.released).randbytes(message.size)
        publish = node.engine.publish
        deadline = now + message.deadline
        node.driver.carry_out(
            publish(
                now, self._high, payload, deadline=deadline, drop=self._drop, handle=SoftHandle(message.name, instance)
            )
        )


class RtcanNetwork(ProtocolNetwork):
    """All nodes of the set; each can be the master."""

    title = "RTCAN"
    paces = True

    def __init__(self, setup: ProtocolSetup) -> None:
        self.shared = SimCan(seed=setup.seed, bitrate=setup.messages.bitrate)
        self.members: dict[str, RtcanNode] = {}
        self._places: dict[str, tuple[RtcanNode, int]] = {}
        self._tracks: dict[int, tuple[RtcanNode, int, MessageTrack]] = {}
        self._started: dict[int, int] = {}
        self._ended: dict[str, tuple[int, int]] = {}
        self._running: list[asyncio.Task[None]] = []
        self.later: set[str] = set()
        """Messages that the network does not start with."""
        self.management_frames = 0
        """Frames of management, without syncs."""
        super().__init__(setup)

    def make_bus(self) -> CanBus:
        return self.shared.bus

    def attach_all(self) -> dict[str, CanController]:
        for place, name in enumerate(self.set.nodes):
            self.members[name] = RtcanNode(self, name, place)
        return {}

    def start(self) -> None:
        for high, message in enumerate(self.set.messages, start=rtcan.FIRST_TOPIC):
            node = self.members[message.node]
            track = self.tracks[message.name]
            node.messages[high] = track
            self._places[message.name] = node, high
            self._tracks[rtcan.message_id(high, 10 + self.set.nodes.index(message.node))] = node, high, track

    async def ready(self) -> None:
        loop = asyncio.get_running_loop()
        for node in self.members.values():
            self._running.append(loop.create_task(node.run(), name=f"node {node.name}"))
            await asyncio.sleep(_APART)
        await asyncio.sleep(_LISTENED)
        for message in self.set.by_rate():
            if not message.sporadic and message.name not in self.later:
                await self._reserve(message)
        await asyncio.sleep(1.0)
        self.controllers.update({name: node.port.controller for name, node in self.members.items()})
        for message in self.set.messages:
            node, high = self._places[message.name]
            if high not in node.granted and message.name not in self.later:
                self.release_freely(SoftMessage(node, high, self.tracks[message.name], drop=self.setup.drop))
        await asyncio.sleep(0.2)
        self.master = self.leader.name if self.leader else None
        if not all(node.engine.ready for node in self.members.values()):
            raise RuntimeError("the network has not started")

    async def _reserve(self, message: SetMessage) -> None:
        """Ask for slots and wait for the answer; give a request up that is refused."""
        node, high = self._places[message.name]
        track = self.tracks[message.name]
        track.paced = True
        node.reserve(high, message)
        await asyncio.sleep(_APART)
        if high in node.granted:
            track.period = node.granted[high]
        else:
            track.paced = False
            node.driver.carry_out(node.engine.release(node.driver.now(), high))

    async def add(self, name: str) -> int:
        """Ask for slots for a message while the network runs; return the instant of the answer."""
        node, high = self._places[name]
        node.answer = asyncio.get_running_loop().create_future()
        node.reserve(high, self.tracks[name].message)
        return await node.answer

    @property
    def leader(self) -> RtcanNode | None:
        """The node that is the master now."""
        return next((each for each in self.members.values() if each.engine.election.role is Role.MASTER), None)

    def sync_identifier(self) -> int | None:
        leader = self.leader
        assert leader is not None
        counter = leader.engine.cycle.counter + 1
        return (counter & rtcan.CYCLE_MASK) << rtcan.MESSAGE_SHIFT | EXTENDED

    def kill(self, name: str) -> None:
        self.members[name].port.power_off()

    def babble(self, name: str, message: str, *, on: bool) -> None:
        """A periodic message as if it had a slot; an event with the laxity that it has at first."""
        frame = None
        if on:
            node, high = self._places[message]
            track = node.messages[high]
            laxity = rtcan.srt_laxity(track.message.deadline) if track.message.sporadic else rtcan.HRT
            number = rtcan.message_id(high, node.engine.id8 or 0)
            frame = Frame(rtcan.encode_identifier(laxity, number), bytes(rtcan.FRAME_MAX))
        self.controllers[name].babble(frame)

    def configuration(self) -> Mapping[str, object]:
        return {message.name: "own" for message in self.set.messages}

    def close(self) -> None:
        for task in self._running:
            task.cancel()
        super().close()

    def finished(self, name: str, instance: MessageInstance) -> None:
        """Note the end of a soft real-time message."""
        instance.start, instance.end = self._ended[name]

    def observe(self, record: FrameRecord) -> None:
        frame: AnyFrame = record.frame
        found = self._tracks.get(rtcan.message_of(frame.id))
        if found is None:
            self.sync_bits += record.bits + INTERMISSION
            self.management_frames += rtcan.high_byte(rtcan.message_of(frame.id)) == rtcan.MANAGEMENT
        if found is None or record.error is not None or found[0].name not in record.senders:
            return
        node, high, track = found
        left, name = frame.id & rtcan.LEFT_MASK, track.message.name
        if left + 1 == rtcan.fragment_count(track.message.size):
            self._started[high] = record.start
        if left:
            return
        start = self._started.get(high, record.start)
        if rtcan.laxity_of(frame.id) != rtcan.HRT:
            self._ended[name] = start, record.end
        elif (instance := node.slotted.get(high)) is not None:
            instance.start, instance.end = start, record.end
