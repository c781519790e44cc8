"""Simulated CAN controllers whose every word is written down."""

from __future__ import annotations

import asyncio
from typing import Any

from r2p.clock import clock_of
from r2p.codecs.can_bits import (
    AnyFrame,
    Frame,
    OtherFrame,
    arbitration_field,
    bits_until_lost,
    frame_bits,
    other_frame_bits,
)
from r2p.codecs.rtcan import encode_identifier
from r2p.sim.can import BusError, CanBus, CanController, CanNode, FrameRecord

BIT = 1000  # ns at 1 Mbit/s
GAP = 3 * BIT

LOW = Frame(encode_identifier(1, 0x0205), b"urgent")
MIDDLE = Frame(encode_identifier(20, 0x0206), b"soon")
HIGH = Frame(encode_identifier(63, 0x0207), b"whenever")


def bits(frame: AnyFrame) -> int:
    return other_frame_bits(frame) if isinstance(frame, OtherFrame) else frame_bits(frame.id, frame.data)


def length(frame: AnyFrame) -> int:
    return bits(frame) * BIT


def gives_up(loser: AnyFrame, winner: AnyFrame) -> int:
    """How long after the start of frame, in ns."""
    return bits_until_lost(arbitration_field(winner), arbitration_field(loser)) * BIT


class Watch:
    """Writes down what its controllers hear, and what the bus did."""

    def __init__(self, bus: CanBus) -> None:
        self.records: list[FrameRecord] = []
        self.heard: list[tuple[Any, ...]] = []
        self.errors: list[tuple[str, BusError, int]] = []
        bus.observers.append(self.records.append)

    def add(self, controller: CanController) -> CanController:
        name = controller.name

        def write(what: str) -> Any:
            return lambda *args: self.heard.append((what, name, *args))

        controller.on_receive = controller.on_other = write("received")
        controller.on_sent = write("sent")
        controller.on_lost = write("lost")
        controller.on_error = write("error")
        controller.on_late = write("late")
        controller.on_state = write("state")
        controller.on_bus_error = lambda *args: self.errors.append((name, *args))
        return controller

    def of(self, what: str) -> list[tuple[Any, ...]]:
        return [entry[1:] for entry in self.heard if entry[0] == what]

    @property
    def spans(self) -> list[tuple[int, int, AnyFrame]]:
        return [(record.start, record.end, record.frame) for record in self.records]


def make(*names: str, seed: int = 0, **settings: Any) -> tuple[CanBus, Watch, list[CanController]]:
    bus = CanBus(asyncio.get_running_loop(), seed=seed)
    watch = Watch(bus)
    return bus, watch, [watch.add(bus.attach(CanNode(name, **settings))) for name in names]


async def at(instant: int) -> None:
    await asyncio.sleep((instant - clock_of().monotonic()) / 1e9)
