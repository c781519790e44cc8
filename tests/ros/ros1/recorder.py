"""A middleware with a user that keeps what it is told; and a socket without a network."""

from __future__ import annotations

import asyncio
import contextlib
from collections import Counter
from typing import TYPE_CHECKING, Any

from r2p.ros.middleware import (
    Answer,
    Cancel,
    MiddlewareUser,
    Qos,
    Refuse,
    RosArrival,
    RosEndpoint,
    RosGraph,
    RosService,
    RosType,
)
from r2p.ros.ros1.environment import RosAddress
from r2p.ros.ros1.middleware import Ros1Middleware
from r2p.ros.ros1.tcpros import frame
from r2p.transports.stats import LoggedCounter

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

    from tests.ros.ros1.programs import Ros1


class Recorder(MiddlewareUser):
    """Keeps what a middleware reports; `until` waits for it."""

    def __init__(self) -> None:
        self.log: list[tuple[str, ...]] = []
        self.arrivals: list[RosArrival] = []
        self.notices: dict[str, str] = {}
        self.requests: list[tuple[str, str, bytes, Answer, Refuse]] = []
        self.serve: Callable[[bytes], bytes] | None = None
        """Answers each request at once."""
        self.graph = RosGraph()
        self.parameters: dict[str, Any] = {}
        self._changed = asyncio.Event()

    async def until(self, found: Callable[[], Any], limit: float = 30.0) -> None:
        """Wait until something reported makes this true."""
        async with asyncio.timeout(limit):
            while not found():
                self._changed.clear()
                await self._changed.wait()

    def note(self, *entry: str) -> None:
        self.log.append(entry)
        self._changed.set()

    def middleware_up(self) -> None:
        self.note("up")

    def middleware_down(self, reason: str) -> None:
        self.note("down", reason)

    def middleware_waits(self, reason: str) -> None:
        self.note("waits", reason)

    def graph_changed(self, graph: RosGraph) -> None:
        self.graph = graph
        self._changed.set()

    def subscriber_joined(self, topic: str) -> None:
        self.note("subscriber joined", topic)

    def subscribers_gone(self, topic: str) -> None:
        self.note("subscribers gone", topic)

    def publisher_found(self, topic: str, node: str, type_name: str, definition: str, *, latched: bool = False) -> None:
        self.note("publisher found", topic, node, type_name)

    def publisher_gone(self, topic: str, node: str) -> None:
        self.note("publisher gone", topic, node)

    def received(self, messages: list[RosArrival]) -> None:
        self.arrivals += messages
        self._changed.set()

    def requested(self, service: str, caller: str, request: bytes, answer: Answer, refuse: Refuse) -> Cancel:
        self.requests.append((service, caller, request, answer, refuse))
        self._changed.set()
        if self.serve is not None:
            answer(self.serve(request))
        return lambda: self.note("cancelled", service)

    def made_room(self) -> None:
        self.note("made room")

    def parameter_changed(self, key: str, value: object) -> None:
        self.parameters[key] = value
        self._changed.set()

    def notice(self, kind: str, text: str, *, trouble: bool) -> None:
        self.notices[kind] = text
        self._changed.set()

    def shut_down(self, node: str, reason: str) -> None:
        self.note("shut down", node, reason)

    def data(self, topic: str) -> list[bytes]:
        """The bytes of the messages that came on a topic."""
        return [each.data for each in self.arrivals if each.topic == topic.encode()]


STRING = RosType("std_msgs/String", "992ce8a1687cec8c8bd883ec73ca41d1", "string data\n")
INT = RosType("std_msgs/Int32", "da5909fbe378aeaf85e547e830cc1bb7", "int32 data")
ANY = RosType("*", "*")
SET_BOOL = RosService("std_srvs/SetBool", "09fb03525b03e7ea1fd3992bafd87e16")
DONE = b"\1" + frame(b"done")
QOS = Qos()


@contextlib.asynccontextmanager
async def running(ros1: Ros1, *nodes: str) -> AsyncIterator[tuple[Ros1Middleware, Recorder]]:
    """A middleware with these nodes, that is registered."""
    user = Recorder()
    middleware = Ros1Middleware(RosAddress(ros1.uri, "127.0.0.1", "127.0.0.1"), LoggedCounter("ros1:"))
    for node in nodes or ("/blink",):
        middleware.add_node(node)
    task = asyncio.ensure_future(middleware.run(user, lambda: None))
    try:
        await user.until(lambda: ("up",) in user.log)
        yield middleware, user
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task


def talk(topic: str, node: str = "/blink", kind: RosType = STRING, qos: Qos = QOS) -> RosEndpoint:
    return RosEndpoint(node, topic, kind, qos)


class Wire(asyncio.Transport):
    """A transport that keeps what is written; while `takes` is False it holds that back, and says so."""

    def __init__(self) -> None:
        super().__init__()
        self.written = bytearray()
        self.held = bytearray()
        self.takes = True
        self.reads = True
        self.closed = False
        self.protocol: Any = None
        self.counts: Counter[str] = Counter()

    def connect(self, protocol: asyncio.Protocol) -> None:
        self.protocol = protocol
        protocol.connection_made(self)

    def receive(self, data: bytes) -> None:
        """Let the other side send this."""
        self.protocol.data_received(data)

    def sent(self) -> bytes:
        """What was written since the last time."""
        data = bytes(self.written)
        self.written.clear()
        return data

    def release(self) -> None:
        """Send what is held, and take more."""
        self.takes = True
        self.written += self.held
        self.held.clear()
        self.protocol.resume_writing()

    def get_extra_info(self, name: str, default: Any = None) -> Any:
        return ("10.0.0.7", 40_000) if name == "peername" else default

    def set_protocol(self, protocol: asyncio.BaseProtocol) -> None:
        self.protocol = protocol

    def set_write_buffer_limits(self, high: int | None = None, low: int | None = None) -> None:
        assert high == 0

    def get_write_buffer_size(self) -> int:
        return len(self.held)

    def write(self, data: Any) -> None:
        assert not self.closed
        self.counts["writes"] += 1
        (self.written if self.takes else self.held).extend(data)
        if not self.takes:
            self.protocol.pause_writing()

    def pause_reading(self) -> None:
        self.reads = False

    def resume_reading(self) -> None:
        self.reads = True

    def is_reading(self) -> bool:
        return self.reads

    def is_closing(self) -> bool:
        return self.closed

    def close(self) -> None:
        if not self.closed:
            self.closed = True
            self.protocol.connection_lost(None)

    abort = close
