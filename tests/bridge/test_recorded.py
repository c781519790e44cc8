"""The recorded conversations between a peer on a debug line and a firmware module on the CAN bus, with our gateway in
the place of the firmware's.

The module on the bus says what it said then, at the recorded times, frame by frame; the peer says its lines. What
reaches either of them must be what the firmware's gateway passed on. Ours is quicker where data flows only after a
second round of firmware's (PROTOCOL.md 4), so more may come through; never less.
"""

from __future__ import annotations

import asyncio
from collections import deque
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING

import pytest

import r2p
from r2p.codecs import debug, management, rtcan
from r2p.codecs.rtcan import Frame
from r2p.sim import can_bus
from r2p.sim.can import CanController, CanNode, FrameRecord
from tests.transports.conversation import Script
from tests.vectors import FROM_NODE, TO_NODE, Case, Entry, cases

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from r2p.transports.link import Transport

pytestmark = [pytest.mark.golden, pytest.mark.virtual_time]

CASES = [case for case in cases("gateway-rtcan") if case.name.startswith("gw_")]
START = 3.0
"""Seconds until our gateway has listened, on the bus and for other gateways."""
GATEWAY = "IMUGW"
MODULE = "IMU1->can"

Key = tuple[type[management.Management], str]


class Speaker:
    """Sends frames one after the other, as firmware does."""

    def __init__(self, controller: CanController) -> None:
        self._controller = controller
        self._waiting: deque[Frame] = deque()
        controller.on_sent = lambda _frame, _stamp: self._next()

    def say(self, frame: Frame) -> None:
        self._waiting.append(frame)
        if self._controller.pending() is None:
            self._next()

    def _next(self) -> None:
        if self._waiting:
            self._controller.request(self._waiting.popleft())


class Bus:
    """What our gateway put on the bus: whole messages, by message id."""

    def __init__(self) -> None:
        self.messages: list[tuple[int, bytes]] = []
        self._parts: dict[int, bytes] = {}

    def note(self, record: FrameRecord) -> None:
        if record.error is not None or GATEWAY not in record.senders:
            return
        found = rtcan.decode_identifier(record.frame.id)
        self._parts[found.message_id] = self._parts.get(found.message_id, b"") + record.frame.data
        if found.left == 0:
            self.messages.append((found.message_id, self._parts.pop(found.message_id)))

    def management(self) -> list[management.Management]:
        return [message for _, data in self.messages if (message := decoded(data)) is not None]

    def data(self, size: int) -> list[bytes]:
        return [data for message, data in self.messages if message != rtcan.FIRMWARE_MANAGEMENT and len(data) == size]


@asynccontextmanager
async def replayed(case: Case) -> AsyncIterator[tuple[Script, Bus]]:
    """Our gateway after the conversation."""
    script, bus = Script(), Bus()
    via: list[str | Transport] = [script, "sim:lab,profile=firmware-2014"]
    async with r2p.Module(GATEWAY, via=via, bridge=True, watchdog=False):
        wire = can_bus("lab").bus
        wire.observers.append(bus.note)
        module = Speaker(wire.attach(CanNode("IMU1")))
        loop = asyncio.get_running_loop()
        for at, entry in enumerate(case.transcript):
            await asyncio.sleep(START + entry.t_ms / 1000 + at * 1e-6 - loop.time())
            if entry.dir == MODULE:
                assert entry.can_id is not None
                module.say(Frame(entry.can_id, entry.data))
            elif entry.dir == TO_NODE:
                script.hear(entry.data)
        await asyncio.sleep(0.1)
        yield script, bus


def decoded(data: bytes) -> management.Management | None:
    try:
        return management.decode(data) if len(data) == management.SIZE else None
    except r2p.DecodeError:
        return None


def key(message: management.Management) -> Key | None:
    """What it is about, for what firmware says."""
    name = getattr(message, "topic", None) or getattr(message, "module", None)
    return (type(message), name) if name and management.encode(message)[-1] < 0x40 else None


def keys(messages: list[management.Management]) -> set[Key]:
    return {found for message in messages if (found := key(message)) is not None}


def lines(entries: list[Entry], topic: str) -> list[bytes]:
    return [each.data for entry in entries for each in debug.Reader().feed(entry.data) if each.topic == topic.encode()]


def on_bus(case: Case, direction: str) -> Bus:
    """What others put on the bus."""
    bus = Bus()
    for entry in case.transcript:
        if entry.dir == direction and entry.can_id is not None:
            bus.note(FrameRecord(0, 0, Frame(entry.can_id, entry.data), (GATEWAY,), 0, None))
    return bus


def on_line(case: Case, direction: str) -> list[management.Management]:
    entries = [entry for entry in case.transcript if entry.dir == direction]
    return [each for data in lines(entries, "R2P") if (each := decoded(data)) is not None]


@pytest.mark.parametrize("case", CASES, ids=str)
async def test_the_line(case: Case) -> None:
    async with replayed(case) as (script, _):
        passed_on = keys(on_line(case, FROM_NODE)) & keys(on_bus(case, MODULE).management())
        assert passed_on <= keys([each.management for each in script.said if each.topic == "R2P"])
        leds = lines([entry for entry in case.transcript if entry.dir == FROM_NODE], "leds")
        assert not leds or script.topics("leds")[-len(leds) :] == leds


@pytest.mark.parametrize("case", CASES, ids=str)
async def test_the_bus(case: Case) -> None:
    async with replayed(case) as (_, bus):
        firmware = on_bus(case, f"{GATEWAY}->can")
        passed_on = keys(firmware.management()) & keys(on_line(case, TO_NODE))
        assert passed_on <= keys(bus.management())
        commands = firmware.data(12)
        assert not commands or bus.data(12)[-len(commands) :] == commands
        assert orders(bus.management()) == orders(firmware.management())


def orders(messages: list[management.Management]) -> list[management.Stop | management.Reboot | management.Bootload]:
    return [each for each in messages if isinstance(each, management.Stop | management.Reboot | management.Bootload)]
