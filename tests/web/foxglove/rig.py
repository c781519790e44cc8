"""A viewer without a socket, for tests under virtual time."""

from __future__ import annotations

import asyncio
import contextlib
import json
import struct
from typing import TYPE_CHECKING, Any, NamedTuple, cast

from r2p.ros.cdr import cdr
from r2p.ros.topics import ros_class
from r2p.web.client import WebClient
from r2p.web.foxglove import protocol
from r2p.web.foxglove.network import FoxgloveOptions
from r2p.web.foxglove.server import FoxgloveServer

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

    from websockets.asyncio.server import ServerConnection

    import r2p


class Connection:
    """The connection of a viewer, which reads all, or nothing while `reads` is cleared."""

    subprotocol = protocol.SUBPROTOCOLS[0]

    def __init__(self) -> None:
        self.sent: list[str | bytes] = []
        self.closed: tuple[int, str] | None = None
        self.reads = asyncio.Event()
        self.reads.set()
        self.inbox: asyncio.Queue[str | bytes | None] = asyncio.Queue()

    async def send(self, message: str | bytes) -> None:
        await self.reads.wait()
        self.sent.append(message)

    async def close(self, code: int, reason: str) -> None:
        self.closed = code, reason
        self.inbox.put_nowait(None)

    async def __aiter__(self) -> AsyncIterator[str | bytes]:
        while (message := await self.inbox.get()) is not None:
            yield message


class Data(NamedTuple):
    """A message of a channel."""

    subscription: int
    time: int
    payload: bytes


class Viewer:
    """A client of the protocol: what it says, and what it gets."""

    def __init__(self, connection: Connection) -> None:
        self.connection = connection

    def say(self, op: str, **values: Any) -> None:
        """Send a JSON message."""
        self.send(json.dumps({"op": op, **values}))

    def send(self, message: str | bytes) -> None:
        self.connection.inbox.put_nowait(message)

    def subscribe(self, topic: str, number: int) -> None:
        """Subscribe to the channel of a topic that is advertised."""
        self.say("subscribe", subscriptions=[{"id": number, "channelId": self.channels[topic]["id"]}])

    def call(self, service: int, number: int, encoding: str, data: bytes) -> None:
        self.send(struct.pack("<BIII", 2, service, number, len(encoding)) + encoding.encode() + data)

    def got(self, op: str) -> list[dict[str, Any]]:
        """The JSON messages of one kind."""
        texts = [json.loads(each) for each in self.connection.sent if isinstance(each, str)]
        return [each for each in texts if each["op"] == op]

    def binary(self, opcode: int) -> list[bytes]:
        return [each for each in self.connection.sent if isinstance(each, bytes) and each[0] == opcode]

    @property
    def data(self) -> list[Data]:
        """The messages of channels."""
        heads = ((struct.unpack_from("<IQ", each, 1), each[13:]) for each in self.binary(1))
        return [Data(number, time, payload) for (number, time), payload in heads]

    @property
    def channels(self) -> dict[str, dict[str, Any]]:
        """The channels that are advertised now."""
        found: dict[str, dict[str, Any]] = {}
        for text in (json.loads(each) for each in self.connection.sent if isinstance(each, str)):
            if text["op"] == "advertise":
                found |= {each["topic"]: each for each in text["channels"]}
            elif text["op"] == "unadvertise":
                found = {topic: each for topic, each in found.items() if each["id"] not in text["channelIds"]}
        return found

    @property
    def status(self) -> list[str]:
        """The texts of statuses."""
        return [each["message"] for each in self.got("status")]

    def decoded(self, topic: str) -> list[Any]:
        """The messages of a topic that were received, by the channel's own schema."""
        channel = self.channels[topic]
        cls = ros_class(channel["schemaName"], 2, channel["schema"])
        return [cdr(cls).decode(each.payload) for each in self.data]


@contextlib.asynccontextmanager
async def serving(module: r2p.Module, **options: Any) -> AsyncIterator[FoxgloveServer]:
    async with FoxgloveServer(module, FoxgloveOptions(**options)) as server:
        yield server


@contextlib.asynccontextmanager
async def viewer(server: FoxgloveServer) -> AsyncIterator[Viewer]:
    """A viewer of a server; at its end it leaves, and nothing of it may be left."""
    connection = Connection()
    async with WebClient(cast("ServerConnection", connection)) as client:
        handling = asyncio.create_task(_handle(server, client))
        try:
            yield Viewer(connection)
        finally:
            connection.reads.set()
            connection.inbox.put_nowait(None)
            await handling
    assert not any(client in each.clients for each in server.network.channels.by_number.values())


async def _handle(server: FoxgloveServer, client: WebClient) -> None:
    await server.endpoint.handle(client)


async def until(condition: Callable[[], object]) -> None:
    """Wait for a condition for which there is no event; what viewers got is looked at often."""
    async with asyncio.timeout(60):
        while not condition():  # noqa: ASYNC110 - there is no event
            await asyncio.sleep(0.02)
