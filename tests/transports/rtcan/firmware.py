"""A module of 2014 on a simulated bus, which sends what was recorded, and receives as the recorded one did."""

import asyncio
from collections import deque
from typing import Self

from r2p.codecs import management, rtcan
from r2p.codecs.rtcan import Frame
from r2p.errors import DecodeError
from r2p.sim import SimCan
from r2p.sim.can import CanNode
from tests.vectors import Entry, cases

MESSAGE = 0x1828
"""The id under which the recorded module publishes `leds`."""
_CASE = "gw_auto_leds"
_MODULE = "IMU1"


def recorded(kind: str, topic: str = "") -> list[Frame]:
    """The frames of the first recorded message of this type (about this topic) of IMU1."""
    frames: list[Frame] = []
    for entry in _entries():
        frames.append(_frame(entry))
        if not entry.decoded or rtcan.decode_identifier(frames[-1].id).left:
            continue
        if entry.decoded.get("type") == kind and topic in ("", entry.decoded["name"]):
            return frames
        frames = []
    raise AssertionError(f"{kind} of {topic} was not recorded")


def recorded_data() -> list[Frame]:
    """The recorded messages of `leds`, one frame each."""
    frames = [_frame(entry) for entry in _entries() if entry.can_id is not None]
    return [frame for frame in frames if rtcan.decode_identifier(frame.id).message_id == MESSAGE]


def _entries() -> list[Entry]:
    (case,) = cases(name=_CASE, build="can/gw")
    return [entry for entry in case.transcript if entry.dir == f"{_MODULE}->can"]


def _frame(entry: Entry) -> Frame:
    assert entry.can_id is not None
    return Frame(entry.can_id, entry.data)


class Firmware:
    """IMU1: publishes `leds`, subscribes `cmd` (12 bytes). `repeats`: it goes through ALIVE, ADVERTISE and its request.

    Of `cmd` it receives what has the high byte in its SUBSCRIBE_RESPONSE, and tells sources apart by the low byte.
    """

    def __init__(self, bus: SimCan, *, repeats: bool = True) -> None:
        self.repeats = repeats
        self.received: list[management.Management] = []
        self.commands: list[tuple[int, bytes]] = []
        """Message ids and payloads of `cmd`."""
        self._controller = bus.bus.attach(CanNode("firmware", one_shot=False))
        self._controller.on_receive = self._receive
        self._controller.on_sent = lambda _frame, _stamp: self._next()
        self._waiting: deque[Frame] = deque()
        self._management = b""
        self._parts: dict[int, bytes] = {}
        self._high: int | None = None
        self._publishes = False
        self._tasks: list[asyncio.Task[None]] = []

    async def __aenter__(self) -> Self:
        self._tasks = [asyncio.create_task(self._iterate()), asyncio.create_task(self._publish())]
        return self

    async def __aexit__(self, *_: object) -> None:
        for task in self._tasks:
            task.cancel()
        await asyncio.wait(self._tasks)
        self._controller.power_off()

    def send(self, frames: list[Frame]) -> None:
        self._waiting.extend(frames)
        self._next()

    async def _iterate(self) -> None:
        """Even with `repeats` off, each message is sent once."""
        steps = [recorded("ALIVE"), recorded("ADVERTISE", "leds"), recorded("SUBSCRIBE_REQUEST", "cmd")]
        self.send(steps[0])
        await asyncio.sleep(0.5)
        for step in steps:
            self.send(step)
        while True:
            for step in steps:
                await asyncio.sleep(0.5)
                if self.repeats:
                    self.send(step)

    async def _publish(self) -> None:
        for frame in recorded_data() * 20:
            await asyncio.sleep(0.5)
            if self._publishes:
                self.send([frame])

    def _next(self) -> None:
        if self._waiting and self._controller.request(self._waiting[0]):
            self._waiting.popleft()

    def _receive(self, frame: Frame, _stamp: int) -> None:
        found = rtcan.decode_identifier(frame.id)
        if found.message_id == rtcan.FIRMWARE_MANAGEMENT:
            self._receive_management(frame.data if found.left == 3 else self._management + frame.data, found.left)
        elif rtcan.high_byte(found.message_id) == self._high:
            self._parts[found.message_id] = self._parts.get(found.message_id, b"") + frame.data
            if not found.left:
                self.commands.append((found.message_id, self._parts.pop(found.message_id)))

    def _receive_management(self, data: bytes, left: int) -> None:
        self._management = data
        if left:
            return
        try:
            message = management.decode(data)
        except DecodeError:
            return
        self.received.append(message)
        match message:
            case management.SubscribeRequest("leds", queue=queue):
                assert queue > 0  # it would halt
                self._publishes = True
                self.send(recorded("SUBSCRIBE_RESPONSE", "leds"))
            case management.Advertise("cmd"):
                self.send(recorded("SUBSCRIBE_REQUEST", "cmd"))
            case management.SubscribeResponse("cmd", params=params):
                self._high = params[1]
