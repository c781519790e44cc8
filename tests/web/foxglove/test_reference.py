"""The same session with foxglove-sdk's server and ours, over real sockets: JSON of the same shape, the same binary.

The SDK has no client, so one that knows nothing of r2p talks to both.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import struct
from typing import TYPE_CHECKING, Any

import foxglove
import pytest
from foxglove import Channel, Context, Schema
from foxglove import websocket as sdk
from websockets.asyncio.client import connect
from websockets.exceptions import InvalidStatus
from websockets.typing import Subprotocol

import r2p
from r2p.ros.cdr import cdr
from r2p.ros.ros2_schemas import ROS2MSG, schema_of
from r2p.testing.network import Network, node_in
from r2p.web.foxglove.network import FoxgloveOptions
from r2p.web.foxglove.protocol import SUBPROTOCOLS
from r2p.web.foxglove.server import FoxgloveServer
from r2p.web.server import WebOptions, WebServer

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

pytestmark = pytest.mark.anyio


@pytest.fixture
def anyio_backend() -> tuple[str, dict[str, Any]]:
    return "asyncio", {"use_uvloop": True}


class Sonar(r2p.Message, name="lab/Sonar"):
    """What is published: the same bytes by both."""

    distance: r2p.f64 = 0.0


class Double(r2p.Service, name="lab/Double"):
    """A service that both have."""

    class Request(r2p.Message):
        value: r2p.f64 = 0.0

    class Response(r2p.Message):
        result: r2p.f64 = 0.0


PING = Sonar(1.5)
REQUEST, RESPONSE = cdr(Double.Request).encode(Double.Request(2.0)), cdr(Double.Response).encode(Double.Response(4.0))
GAIN = "BASE/test.gain"


class _Listener(sdk.ServerListener):
    def on_get_parameters(self, client: Any, param_names: list[str], request_id: str | None = None) -> Any:
        return [sdk.Parameter(GAIN, value=1.5)]

    def on_set_parameters(self, client: Any, parameters: Any, request_id: str | None = None) -> Any:
        return parameters


@contextlib.asynccontextmanager
async def of_sdk() -> AsyncIterator[tuple[int, Callable[[], None]]]:
    """foxglove-sdk's server: its port, and what publishes a message."""
    context = Context()
    schema = schema_of(Sonar)
    kind = Schema(name=schema.name, encoding=ROS2MSG, data=schema.text.encode())
    channel = Channel("/sonar", schema=kind, message_encoding="cdr", context=context)
    parts = [
        sdk.MessageSchema(encoding="cdr", schema=Schema(name=name, encoding=ROS2MSG, data=b"float64 value\n"))
        for name in ("lab/srv/Double_Request", "lab/srv/Double_Response")
    ]
    service = sdk.Service(
        name="/double",
        schema=sdk.ServiceSchema("lab/srv/Double", request=parts[0], response=parts[1]),
        handler=lambda request: RESPONSE,
    )
    graph = sdk.ConnectionGraph()
    graph.set_published_topic("/sonar", ["BASE/test"])
    server = foxglove.start_server(
        port=0,
        capabilities=[
            sdk.Capability.ClientPublish,
            sdk.Capability.Parameters,
            sdk.Capability.ConnectionGraph,
            sdk.Capability.Services,
        ],
        supported_encodings=["cdr", "json"],
        server_listener=_Listener(),
        services=[service],
        asset_handler=lambda uri: None,
        context=context,
    )
    server.publish_connection_graph(graph)
    try:
        yield server.port, lambda: channel.log(cdr(Sonar).encode(PING))
    finally:
        server.stop()


@contextlib.asynccontextmanager
async def of_r2p() -> AsyncIterator[tuple[int, Callable[[], None]]]:
    """Our server for a module with the same topic, service and parameter."""
    network = Network()
    options = FoxgloveOptions(allow_publish=True, allow_control=True)
    async with network.module("BASE") as base, node_in(base) as node, network.module("PC", observer=True) as pc:
        sonar = node.advertise("sonar", Sonar)
        node.parameter("gain", 1.5)

        async def double(request: Double.Request) -> Double.Response:
            return Double.Response(2 * request.value)

        node.serve("double", Double, double)
        async with FoxgloveServer(pc, options) as server, WebServer(WebOptions(), {"/": server.endpoint}) as web:
            yield web.address[1], lambda: _publish(sonar)


def _publish(publisher: Any) -> None:
    publisher.publish_nowait(PING)


class Client:
    """Collects what a server sends; `wait` waits for the first message of a kind that was not waited for yet."""

    def __init__(self, socket: Any) -> None:
        self.socket = socket
        self._kept: list[Any] = []

    async def say(self, op: str, **values: Any) -> None:
        await self.socket.send(json.dumps({"op": op, **values}))

    async def wait(self, kind: str | int, having: str = "") -> Any:
        """Return a message by its `op` or opcode; of others with a list `having`, one in which that is not empty."""
        async with asyncio.timeout(60):
            while True:
                for each in self._kept:
                    if _kind(each) == kind and (not having or each.get(having)):
                        self._kept.remove(each)
                        return each
                message = await self.socket.recv()
                self._kept.append(json.loads(message) if isinstance(message, str) else message)


def _kind(message: Any) -> str | int:
    kind: str | int = message[0] if isinstance(message, bytes) else message["op"]
    return kind


async def session(client: Client, publish: Callable[[], None]) -> dict[str, Any]:
    """The script: what each request was answered with."""
    found: dict[str, Any] = {"info": await client.wait("serverInfo")}
    channels: dict[str, Any] = {}
    while "/sonar" not in channels:
        advertised = await client.wait("advertise")
        channels |= {each["topic"]: each for each in advertised["channels"]}
    found["channel"] = channels["/sonar"]
    found["service"] = (await client.wait("advertiseServices"))["services"][0]
    await client.say("subscribe", subscriptions=[{"id": 7, "channelId": found["channel"]["id"]}])
    await client.say("getParameters", parameterNames=[GAIN], id="q")
    found["get"] = await client.wait("parameterValues")
    publish()
    found["data"] = await client.wait(1)
    await client.say("setParameters", parameters=[{"name": GAIN, "value": 2.5, "type": "float64"}], id="s")
    found["set"] = await client.wait("parameterValues")
    await client.socket.send(struct.pack("<BIII", 2, found["service"]["id"], 55, 3) + b"cdr" + REQUEST)
    found["response"] = await client.wait(3)
    await client.socket.send(struct.pack("<BIII", 2, 99, 56, 3) + b"cdr" + REQUEST)
    found["failure"] = await client.wait("serviceCallFailure")
    await client.say("fetchAsset", uri="package://robot", requestId=9)
    found["asset"] = await client.wait(4)
    await client.say("subscribeConnectionGraph")
    found["graph"] = await client.wait("connectionGraphUpdate", having="publishedTopics")
    await client.socket.send("{")
    found["malformed"] = await client.wait("status")
    await client.say("subscribe", subscriptions=[{"id": 8, "channelId": 99}])
    found["unknown"] = await client.wait("status")
    await client.say("subscribe", subscriptions=[{"id": 9, "channelId": found["channel"]["id"]}])
    found["again"] = await client.wait("status")
    return found


def shape(value: Any) -> Any:
    """The keys and kinds of a JSON value."""
    if isinstance(value, dict):
        return {key: shape(each) for key, each in value.items()}
    if isinstance(value, list):
        return [shape(value[0])] if value else []
    return type(value).__name__


async def played(serving: Any, subprotocol: str = SUBPROTOCOLS[0]) -> dict[str, Any]:
    async with serving() as (port, publish):
        url, protocols = f"ws://127.0.0.1:{port}", [Subprotocol(subprotocol)]
        async with connect(url, subprotocols=protocols, compression=None) as socket:
            assert socket.subprotocol == subprotocol
            return await session(Client(socket), publish)


async def test_our_messages_look_like_those_of_the_sdk() -> None:
    theirs, ours = await played(of_sdk), await played(of_r2p)
    for name in ("channel", "service", "get", "set", "failure", "malformed", "unknown", "again"):
        assert shape(ours[name]) == shape(theirs[name]), name
    assert shape(ours["info"]) | {"metadata": {}} == shape(theirs["info"]) | {"metadata": {}}
    assert ours["channel"] | {"id": 0} == theirs["channel"] | {"id": 0}
    assert [ours[each]["parameters"] for each in ("get", "set")] == [
        theirs[each]["parameters"] for each in ("get", "set")
    ]
    assert [ours[each]["level"] for each in ("malformed", "unknown", "again")] == [2, 2, 1]
    assert [theirs[each]["level"] for each in ("malformed", "unknown", "again")] == [2, 2, 1]
    assert (ours["data"][:5], ours["data"][13:]) == (theirs["data"][:5], theirs["data"][13:])
    assert ours["response"][5:] == theirs["response"][5:]
    assert ours["asset"][:6] == theirs["asset"][:6]
    assert ours["graph"].keys() == theirs["graph"].keys()
    assert {"name": "/sonar", "publisherIds": ["BASE/test"]} in ours["graph"]["publishedTopics"]
    assert theirs["graph"]["publishedTopics"] == [{"name": "/sonar", "publisherIds": ["BASE/test"]}]
    assert set(ours["info"]["capabilities"]) | {"assets"} == set(theirs["info"]["capabilities"])


async def test_the_older_protocol_is_served_too_and_no_other() -> None:
    assert (await played(of_r2p, SUBPROTOCOLS[1]))["data"][13:] == cdr(Sonar).encode(PING)
    async with of_r2p() as (port, _):
        url = f"ws://127.0.0.1:{port}/"
        async with connect(url, subprotocols=[Subprotocol("mqtt")]) as socket:
            await socket.wait_closed()
            assert (socket.close_code, socket.close_reason) == (
                1002,
                "offer a subprotocol: " + " or ".join(SUBPROTOCOLS),
            )


async def test_pages_of_others_are_refused() -> None:
    async with of_r2p() as (port, _):
        with pytest.raises(InvalidStatus):
            async with connect(f"ws://127.0.0.1:{port}", origin="https://example.com"):  # type: ignore[arg-type]
                pass
