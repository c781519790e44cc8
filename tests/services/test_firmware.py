"""Firmware serves and calls, with raw bytes as docs/PROTOCOL.md has them: on a debug line, and on a CAN bus of 2014."""

from __future__ import annotations

import asyncio
import struct
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING

import pytest

import r2p
from r2p.codecs import debug, management, rtcan
from r2p.codecs.rtcan import Frame
from r2p.errors import DecodeError
from r2p.names import MANAGEMENT
from r2p.sim.can import CanNode
from r2p.testing.network import node_in
from tests.services.common import Add, Desk, add, outcome, until
from tests.transports.conversation import Script
from tests.transports.rtcan.networks import Lab

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

pytestmark = pytest.mark.virtual_time

HEADER = "<IHBBI"
REQUEST_SIZE, RESPONSE_SIZE = 12 + 8, 12 + 32
CALLER = 0xC0FFEE


class Program:
    """What a C programmer writes. `publish` is set by the board that it runs on."""

    publishes = subscribes = ("", 0)
    publish: Callable[[bytes], None]

    def receive(self, data: bytes) -> None:
        raise NotImplementedError


class ServerProgram(Program):
    """Adds; remembers its last answer, so that a repeated request is not handled again."""

    publishes, subscribes = ("add_r", RESPONSE_SIZE), ("add_q", REQUEST_SIZE)

    def __init__(self) -> None:
        self.handled = 0
        self.cancelled = 0
        self.deaf = 0
        """Requests that get lost on the way."""
        self._last = b""
        self._answer = b""

    def receive(self, data: bytes) -> None:
        instance, number, kind, version, server = struct.unpack_from(HEADER, data)
        if version != 1 or server != 0:
            return
        if self.deaf:
            self.deaf -= 1
            return
        if data[:6] != self._last:
            self._last = data[:6]
            a, b = struct.unpack_from("<II", data, 12)
            answer, body = 2, struct.pack("<Q", (a + b) & 0xFFFFFFFFFFFFFFFF)
            if kind == 1:
                answer, body = 3, b"cancelled"
            elif a == 13:
                answer, body = 3, b"unlucky number"
            elif a == 14:
                answer, body = 4, b""
            self.handled += kind == 0
            self._answer = struct.pack(HEADER, instance, number, answer, 1, 0) + body.ljust(32, b"\0")
        self.cancelled += kind == 1
        self.publish(self._answer)


class ClientProgram(Program):
    """Asks once, and again each 100 ms until there is an answer."""

    publishes, subscribes = ("add_q", REQUEST_SIZE), ("add_r", RESPONSE_SIZE)

    def __init__(self) -> None:
        self.answers: list[bytes] = []

    def receive(self, data: bytes) -> None:
        if struct.unpack_from("<I", data)[0] == CALLER:
            self.answers.append(data)

    async def ask(self, number: int, a: int, b: int) -> bytes:
        self.answers.clear()
        request = struct.pack(HEADER, CALLER, number, 0, 1, 0) + struct.pack("<II", a, b)
        while not self.answers:
            self.publish(request)
            await asyncio.sleep(0.1)
        return self.answers[0]


class Board:
    """The module FW, which runs a program: it announces one thing each half second, and answers, as firmware does."""

    def __init__(self, program: Program) -> None:
        program.publish = lambda data: self.send(program.publishes[0], data)
        self.program = program
        self.attached = False

    def manage(self, message: management.Management) -> None:
        raise NotImplementedError

    def send(self, topic: str, data: bytes) -> None:
        raise NotImplementedError

    def params(self, _topic: str) -> bytes:
        return bytes(10)

    async def announce(self) -> None:
        (out, out_size), (into, into_size) = self.program.publishes, self.program.subscribes
        while True:
            for message in (
                management.Alive("FW"),
                management.Advertise(out, out_size),
                management.SubscribeRequest(into, into_size, 5),
            ):
                self.manage(message)
                await asyncio.sleep(0.5)

    def received(self, data: bytes) -> None:
        (out, out_size), (into, into_size) = self.program.publishes, self.program.subscribes
        try:
            message = management.decode(data)
        except DecodeError:
            return
        match message:
            case management.SubscribeRequest(topic) if topic == out:
                self.attached = True
                self.manage(management.SubscribeResponse(out, out_size, 5, self.params(out)))
            case management.Advertise(topic) if topic == into:
                self.manage(management.SubscribeRequest(into, into_size, 5))
            case management.SubscribeResponse(topic, params=params) if topic == into:
                self.answered(params)

    def answered(self, _params: bytes) -> None:
        """The other end sends what this one subscribes."""


class LineBoard(Board):
    """... on a debug line."""

    def __init__(self, program: Program) -> None:
        super().__init__(program)
        self.script = Script()
        self._send, self.script.send = self.script.send, self._heard  # type: ignore[method-assign]

    def manage(self, message: management.Management) -> None:
        self.send(MANAGEMENT, management.encode(message))

    def send(self, topic: str, data: bytes) -> None:
        self.script.hear(debug.encode(topic.encode(), data, deadline=0))

    def _heard(self, data: bytes) -> None:
        known = len(self.script.said)
        self._send(data)
        for each in self.script.said[known:]:
            handle = self.received if each.topic == MANAGEMENT else self.program.receive
            asyncio.get_running_loop().call_soon(handle, each.data)


class CanBoard(Board):
    """... on a CAN bus, with the id8 21; it publishes with one id, and tells what it subscribes by the high byte."""

    ID8, MESSAGE = 0x15, 0x2515

    def __init__(self, program: Program, lab: Lab) -> None:
        super().__init__(program)
        self._controller = lab.can.bus.attach(CanNode("firmware", one_shot=False))
        self._controller.on_receive = self._frame
        self._controller.on_sent = lambda _frame, _stamp: self._next()
        self._waiting: list[Frame] = []
        self._parts: dict[int, bytes] = {}
        self._high: int | None = None

    def manage(self, message: management.Management) -> None:
        self._put(rtcan.FIRMWARE_MANAGEMENT, management.encode(message))

    def send(self, _topic: str, data: bytes) -> None:
        self._put(self.MESSAGE, data)

    def params(self, _topic: str) -> bytes:
        return struct.pack("<H", self.MESSAGE).ljust(10, b"\0")

    def answered(self, params: bytes) -> None:
        self._high = params[1]

    def _put(self, message: int, data: bytes) -> None:
        self._waiting += [
            Frame(rtcan.encode_identifier(30, message, left), part) for left, part in rtcan.fragments(data)
        ]
        self._next()

    def _next(self) -> None:
        while self._waiting and self._controller.request(self._waiting[0]):
            del self._waiting[0]

    def _frame(self, frame: Frame, _stamp: int) -> None:
        found = rtcan.decode_identifier(frame.id)
        data = self._parts[found.message_id] = self._parts.get(found.message_id, b"") + frame.data
        if found.left:
            return
        del self._parts[found.message_id]
        if found.message_id == rtcan.FIRMWARE_MANAGEMENT:
            self.received(data[-management.SIZE :])
        elif rtcan.high_byte(found.message_id) == self._high:
            self.program.receive(data)


@asynccontextmanager
async def on(kind: str, program: Program) -> AsyncIterator[r2p.Node]:
    """A node of a module that is on a line, or on a bus, with a board that runs the program."""
    lab = Lab()
    board = LineBoard(program) if kind == "line" else CanBoard(program, lab)
    via = board.script if isinstance(board, LineBoard) else lab.can.transport()
    announcing = asyncio.create_task(board.announce()) if kind == "bus" else None
    async with r2p.Module("PC1", via=via, watchdog=False) as module, node_in(module) as node:
        announcing = announcing or asyncio.create_task(board.announce())
        yield node
        announcing.cancel()


@pytest.mark.parametrize("kind", ["line", "bus"])
async def test_firmware_serves(kind: str) -> None:
    program = ServerProgram()
    async with on(kind, program) as node:
        calls = node.client("add", Add)
        await calls.ready(30)
        assert await calls.call(Add.Request(a=1, b=2), timeout=5.0) == Add.Response(total=3)
        assert calls.servers == ["?"]
        program.deaf = 2
        assert await calls.call(Add.Request(a=4, b=2), timeout=5.0) == Add.Response(total=6)
        assert str(await outcome(calls.call(Add.Request(a=13), timeout=5.0))) == "service add: unlucky number"
        assert isinstance(await outcome(calls.call(Add.Request(a=14), timeout=5.0)), r2p.ServiceBusy)
        assert program.handled == 4
        program.deaf = 1000
        assert isinstance(await outcome(calls.call(Add.Request(a=1), timeout=1.0)), TimeoutError)
        program.deaf = 0
        await until(lambda: program.cancelled)


@pytest.mark.parametrize("kind", ["line", "bus"])
async def test_firmware_calls(kind: str) -> None:
    program, desk = ClientProgram(), Desk()

    async def handle(request: Add.Request) -> Add.Response:
        if request.a == 13:
            raise r2p.ServiceError("unlucky")
        return await (desk.handle(request) if request.a == 7 else add(request))

    async with on(kind, program) as node:
        served = node.serve("add", Add, handle)
        instance = struct.pack("<I", node._space.instance)
        await asyncio.sleep(5)
        answer = await program.ask(1, 2, 3)
        assert answer == bytes.fromhex("eeffc000 0100 02 01") + instance + struct.pack("<Q24x", 5)
        answer = await program.ask(2, 13, 0)
        assert answer == bytes.fromhex("eeffc000 0200 03 01") + instance + b"unlucky".ljust(32, b"\0")
        asking = asyncio.create_task(program.ask(3, 7, 0))
        await asyncio.sleep(1)
        assert desk.begun == [7]  # of ten requests
        desk.gate.set()
        assert (await asking)[6] == 2
        assert served.handled == 3
        assert served.repeated >= 9
