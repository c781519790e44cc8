"""Typed topics on SocketCAN, with a firmware module made of python-can alone, cansend and candump."""

from __future__ import annotations

import asyncio
import contextlib
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import can
import pytest

import r2p
from r2p.codecs import management
from r2p.msg import Led
from tests.bench import hold
from tests.can.rig import GUARD, Candump, cansend, ip, until

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

pytestmark = [pytest.mark.can, pytest.mark.anyio, pytest.mark.one_loop]

MANAGEMENT = 0x0000
OPAQUE = 0x1707
"""The message id of a topic of the module, as firmware of 2014 computes it."""
LAXITY = 20

T = TypeVar("T")


class Long(r2p.Message):
    """20 bytes: three fragments."""

    numbers: tuple[r2p.u32, r2p.u32, r2p.u32, r2p.u32, r2p.u32] = (0,) * 5


class Firmware:
    """A module with one topic, on a socket of python-can."""

    def __init__(self, name: str) -> None:
        self._bus = can.Bus(interface="socketcan", channel=name)
        self._reader = can.AsyncBufferedReader()
        self._notifier = can.Notifier(self._bus, [self._reader], loop=asyncio.get_running_loop())
        self._parts: dict[int, bytes] = {}

    def send(self, message: int, data: bytes) -> None:
        parts = [data[at : at + 8] for at in range(0, len(data), 8)]
        for left, part in zip(reversed(range(len(parts))), parts, strict=True):
            self._bus.send(can.Message(arbitration_id=LAXITY << 23 | message << 7 | left, data=part))

    def manage(self, said: management.Management) -> None:
        self.send(MANAGEMENT, management.encode(said))

    async def message(self) -> tuple[int, bytes]:
        """The next message on the bus: its id and its bytes."""
        while True:
            frame = await self._reader.get_message()
            message, left = frame.arbitration_id >> 7 & 0xFFFF, frame.arbitration_id & 0x7F
            data = self._parts.pop(message, b"") + bytes(frame.data)
            if not left:
                return message, data
            self._parts[message] = data

    async def heard(self, kind: type[T], topic: str = "") -> T:
        """The next management message of this kind, about this topic."""
        async with asyncio.timeout(GUARD):
            while True:
                message, data = await self.message()
                said = management.decode(data) if message == MANAGEMENT else None
                if isinstance(said, kind) and topic in ("", getattr(said, "topic", None)):
                    return said

    def close(self) -> None:
        self._notifier.stop()
        self._bus.shutdown()


@contextlib.asynccontextmanager
async def network(name: str) -> AsyncIterator[tuple[r2p.Node, Firmware]]:
    """A node of r2p, and the firmware module."""
    firmware = Firmware(name)
    try:
        async with r2p.Module("PC", via=f"rtcan:{name},profile=firmware-2014", watchdog=False) as module:
            yield module.start(hold, name="node"), firmware
            await module.stop()
    finally:
        firmware.close()


def filters(name: str) -> dict[tuple[int, int], int]:
    """The kernel's filters, as (identifier, mask), and how many frames each has passed so far."""
    lines = [line.split() for line in Path("/proc/net/can/rcvlist_fil").read_text(encoding="ascii").splitlines()]
    return {
        (int(line[1], 16) & 0x1FFFFFFF, int(line[2], 16) & 0x1FFFFFFF): int(line[5])
        for line in lines
        if line and line[0] == name
    }


async def publishes(firmware: Firmware, topic: str, size: int) -> None:
    """The firmware publishes a topic, and a node subscribes it."""
    await firmware.heard(management.Alive)
    firmware.manage(management.Advertise(topic, size))
    await firmware.heard(management.SubscribeRequest, topic)
    firmware.manage(management.SubscribeResponse(topic, size, 5, OPAQUE.to_bytes(2, "little").ljust(10, b"\0")))


async def subscribes(firmware: Firmware, topic: str, size: int) -> management.SubscribeResponse:
    """The firmware receives an ADVERTISE, and subscribes the topic."""
    await firmware.heard(management.Advertise, topic)
    firmware.manage(management.SubscribeRequest(topic, size, 5))
    return await firmware.heard(management.SubscribeResponse, topic)


async def test_frames_typed_with_cansend_reach_a_typed_subscriber(vcan: str) -> None:
    async with network(vcan) as (node, firmware):
        subscriber = node.subscribe("leds", Led)
        await publishes(firmware, "leds", 5)
        await subscriber.wait_publisher()
        cansend(vcan, f"{LAXITY << 23 | OPAQUE << 7:08X}#0300000001")
        async with asyncio.timeout(GUARD):
            assert await subscriber.fetch() == Led(led=3, value=1)


async def test_fragments_of_python_can_reach_a_typed_subscriber(vcan: str) -> None:
    async with network(vcan) as (node, firmware):
        subscriber = node.subscribe("long", Long)
        await publishes(firmware, "long", 20)
        await subscriber.wait_publisher()
        async with asyncio.timeout(GUARD):
            for number in range(50):  # one by one: 150 frames at once are more than any bus brings
                message = Long(numbers=(number,) * 5)
                firmware.send(OPAQUE, message.encode())
                assert await subscriber.fetch() == message


async def test_what_is_not_subscribed_stays_in_the_kernel(vcan: str) -> None:
    async with network(vcan) as (node, firmware):
        subscriber = node.subscribe("leds", Led)
        await publishes(firmware, "leds", 5)
        await subscriber.wait_publisher()
        firmware.send(OPAQUE + 1, Led(led=1).encode())
        firmware.send(OPAQUE, Led(led=2).encode())
        async with asyncio.timeout(GUARD):
            assert (await subscriber.fetch()).led == 2
        passed = filters(vcan)
        assert passed[OPAQUE << 7, 0xFFFF << 7] == 1
        assert all(mask & 0xFF << 7 or mask & 0xFF00 << 7 for _, mask in passed)


async def test_what_a_typed_publisher_sends_is_what_candump_prints(vcan: str) -> None:
    async with network(vcan) as (node, firmware), Candump(vcan) as candump:
        publisher = node.advertise("leds", Led)
        response = await subscribes(firmware, "leds", 5)
        message = int.from_bytes(response.params[:2], "little")
        await publisher.wait_subscriber()  # firmware gets no data in the 50 ms after its response: it would drop them
        await publisher.publish(Led(led=0x01020304, value=1))
        identifier = f"{63 << 23 | message << 7:08X}"
        async with asyncio.timeout(GUARD):
            while identifier not in (line := await candump.line()):
                pass
        assert line == f"{vcan} {identifier} [5] 04 03 02 01 01"


async def test_topics_survive_an_interface_that_goes_and_comes(vcan: str) -> None:
    """Announced again, subscribed again; what is published meanwhile is gone."""
    async with network(vcan) as (node, firmware):
        publisher = node.advertise("leds", Led)
        await subscribes(firmware, "leds", 5)
        firmware.close()  # python-can does not get over what comes
        ip("set", vcan, "down")
        links: list[Any] = list(node._space.links)
        await until(lambda: not links[0].up)
        await publisher.publish(Led(led=1))
        ip("set", vcan, "up")
        again = Firmware(vcan)
        await subscribes(again, "leds", 5)
        await publisher.wait_subscriber()
        await publisher.publish(Led(led=2))
        async with asyncio.timeout(GUARD):
            while (data := (await again.message())[1]) != Led(led=2).encode():
                assert data != Led(led=1).encode()
        again.close()
