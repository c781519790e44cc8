"""What all protocols share: the bus, the nodes with their clocks and latencies, the releases, and the measurement."""

from __future__ import annotations

import asyncio
import random
from abc import ABC, abstractmethod
from collections import defaultdict
from typing import TYPE_CHECKING, ClassVar, Protocol

import msgspec

from benchmarks.protocols.outbox import MessageOutbox
from benchmarks.protocols.recorder import MessageTrack
from r2p.codecs.can_bits import FRAME_MAX, INTERMISSION, wire_identifier
from r2p.sim.can import CanBus, CanNode, ControllerState, Latency
from r2p.units import MILLISECOND, SECOND

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from benchmarks.protocols.message_sets import MessageSet, SetMessage
    from benchmarks.protocols.recorder import MessageInstance
    from r2p.codecs.can_bits import AnyFrame
    from r2p.sim.can import CanController, FrameRecord

SETTLED = 150 * MILLISECOND
"""Ns after which it counts, where the network needs no time to start."""


class ProtocolSetup(msgspec.Struct, frozen=True, kw_only=True):
    """What is run. `duration` in s; `ppm`: clocks are off by so much at most; `latency` ± `jitter` ns: of interrupts.

    `bit_error_rate`: errors that all nodes see; `drop`: a value that is overdue before its first frame starts is given
    up.
    """

    messages: MessageSet
    seed: int = 1
    duration: float = 1.0
    bit_error_rate: float = 0.0
    ppm: float = 50.0
    latency: int = 4_000
    jitter: int = 3_000
    drop: bool = True


class ReleaseTarget(Protocol):
    """Where the values of a message go that its node releases by its own clock."""

    track: MessageTrack
    message: SetMessage

    @property
    def controller(self) -> CanController:
        """The controller of its node."""

    def put(self, instance: MessageInstance) -> None:
        """Send this value."""


class ProtocolNetwork(ABC):
    """All nodes of a set on one bus, with one protocol."""

    title: ClassVar[str]
    one_shot: ClassVar[bool] = False
    paces: ClassVar[bool] = False
    """True if the protocol gives periodic messages a time."""
    master: str | None = None
    """Node that sends the sync, if there is one."""

    def __init__(self, setup: ProtocolSetup) -> None:
        self.setup = setup
        self.set = setup.messages
        self.bus = self.make_bus()
        self.bus.bit_error_rate = setup.bit_error_rate
        self.numbers = random.Random(f"{setup.seed}/{self.set.name}")
        self.payload: Callable[[int], bytes] = random.Random(f"{setup.seed}/data").randbytes
        self.tracks = {each.name: MessageTrack(each, each.interval) for each in self.set.messages}
        self.boxes: defaultdict[str, list[MessageOutbox]] = defaultdict(list)
        self.sync_bits = 0
        """Bits of the frames that carry no message of the set, intermission included."""
        self._routes: dict[int, MessageOutbox] = {}
        self.controllers = self.attach_all()
        self.bus.attach(CanNode("listener")).filters = [(0x7FFF_FFFF, 0x7FFF_FFFF)]
        self.bus.observers.append(self.observe)

    # For protocols

    def make_bus(self) -> CanBus:
        """Return the bus."""
        return CanBus(asyncio.get_running_loop(), bitrate=self.set.bitrate, seed=self.setup.seed)

    def attach_all(self) -> dict[str, CanController]:
        """Attach all nodes to the bus."""
        return {name: self._attach(name) for name in [*self.set.nodes, *self.extra_nodes()]}

    def extra_nodes(self) -> list[str]:
        """Return names of nodes that the protocol needs besides those of the set."""
        return []

    @abstractmethod
    def start(self) -> None:
        """Start all nodes."""

    def latency_of(self, name: str) -> Latency:
        """Return the latency of the interrupts of this node."""
        return Latency(self.setup.latency, self.setup.jitter)

    def sync_identifier(self) -> int | None:
        """Return the identifier, with flags, of the next sync; None: there is none."""
        return None

    def configuration(self) -> Mapping[str, object]:
        """Return what each node has to know of each message of its own, by message."""
        return {}

    def add_box(
        self,
        message: SetMessage,
        make: Callable[[MessageInstance, bytes], AnyFrame],
        *,
        payload_max: int = FRAME_MAX,
        overhead: int = 0,
        extra: int = 0,
    ) -> MessageOutbox:
        """Give this message a mailbox at its node."""
        boxes = self.boxes[message.node]
        box = MessageOutbox(
            self,
            self.tracks[message.name],
            self.controllers[message.node],
            len(boxes) + 1,  # mailbox 0 is for syncs
            make,
            payload_max=payload_max,
            overhead=overhead,
            extra=extra,
        )
        boxes.append(box)
        return box

    def route(self, frame: AnyFrame, box: MessageOutbox) -> None:
        """Remember whose frame has this identifier."""
        self._routes[wire_identifier(frame)] = box

    def release_freely(self, box: ReleaseTarget) -> None:
        """Let the node release this message by its own clock from now on: at random phase, or at random instants."""
        message, numbers = box.message, random.Random(f"{self.setup.seed}/{box.message.name}")
        clock, call_at = box.controller.clock, box.controller.call_at
        due = clock.monotonic() + numbers.randrange(message.interval)

        def fire() -> None:
            nonlocal due
            box.put(box.track.release(self.bus.timeline.now()))
            due += message.period
            if message.sporadic:
                due += round(numbers.expovariate(1) * message.slack)
            jitter = numbers.randrange(message.jitter + 1) if message.jitter else 0
            call_at(due + jitter, fire)

        call_at(due, fire)

    async def ready(self) -> None:
        """Wait until the network has started."""
        await asyncio.sleep(SETTLED / SECOND)

    def kill(self, name: str) -> None:
        """Cut the power of a node."""
        self.controllers[name].power_off()

    def babble(self, name: str, message: str, *, on: bool) -> None:
        """Let a node send a frame of this message of its own over and over, or stop it."""
        box = next((each for each in self.boxes[name] if each.message.name == message), None)
        self.controllers[name].babble(box.example() if on and box is not None else None)

    def close(self) -> None:
        """Drop all events."""
        self.bus.close()

    def observe(self, record: FrameRecord) -> None:
        """Note a frame or a failed attempt."""
        box = self._routes.get(wire_identifier(record.frame))
        if box is None or box.service or box.controller.name not in record.senders:
            self.sync_bits += record.bits + INTERMISSION
        if box is None or box.controller.name not in record.senders:
            return
        if record.error is None and box.queue:
            box.observed(record)

    # Inside

    def _attach(self, name: str) -> CanController:
        numbers, setup = random.Random(f"{self.setup.seed}/{name}"), self.setup
        offset, drift = numbers.randrange(SECOND), numbers.uniform(-setup.ppm, setup.ppm)
        latency = self.latency_of(name)
        count = 3 + sum(each.node == name for each in self.set.messages)
        controller = self.bus.attach(
            CanNode(
                name,
                one_shot=self.one_shot,
                mailboxes=count,
                offset=offset,
                drift_ppm=drift,
                transmit=latency,
                receive=latency,
            )
        )
        controller.on_sent = self._sent
        controller.on_late = controller.on_lost = self._returned
        controller.on_error = lambda frame, _kind, stamp: self._returned(frame, stamp)
        controller.on_state = lambda state, _stamp: self._recovered(name, state)
        controller.filters = [(0x7FFF_FFFF, 0x7FFF_FFFF)]  # no frame: protocols open what they need
        return controller

    def _sent(self, frame: AnyFrame, _stamp: int) -> None:
        box = self._routes.get(wire_identifier(frame))
        if box is not None:
            box.sent()

    def _returned(self, frame: AnyFrame, _stamp: int) -> None:
        box = self._routes.get(wire_identifier(frame))
        if box is not None:
            box.returned()

    def _recovered(self, name: str, state: ControllerState) -> None:
        if state is ControllerState.ACTIVE:
            for box in self.boxes[name]:
                box.offer()
