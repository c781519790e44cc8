"""Services between r2p and ROS nodes of an in-memory network, in both roles, and through a gateway."""

import asyncio
from collections.abc import Awaitable, Callable
from typing import Annotated, Any

import pytest

import r2p
from r2p.ros.middleware import RosService
from r2p.ros.service_types import RosServiceCodec, service_codec, service_shape
from r2p.ros.std_srvs import SetBool, Trigger
from r2p.services.definition import define
from r2p.testing.network import Network, node_in
from tests.ros.fake import FakeRosNetwork, RosNode

both = pytest.mark.parametrize("version", [1, 2])


class Divide(r2p.Service, name="math_srvs/Divide"):
    class Request(r2p.Message):
        a: r2p.f64 = 0.0
        b: r2p.f64 = 1.0

    class Response(r2p.Message):
        quotient: r2p.f64 = 0.0
        remark: Annotated[str, r2p.Max(100)] = ""


def codec(service: Any, version: int) -> RosServiceCodec:
    definition = define("name", service)
    return service_codec(service_shape(definition.requests, definition.responses), version)


class Peer:
    """A service as ROS nodes use it: with bytes of ROS."""

    def __init__(self, node: RosNode, service: Any) -> None:
        self.node = node
        self.codec = codec(service, node.network.version)
        self.request, self.response = r2p.layout(service.Request), r2p.layout(service.Response)

    def serve(self, name: str, handler: Callable[[Any], Awaitable[Any]], checksum: str = "") -> None:
        async def handle(data: bytes) -> bytes:
            response = await handler(self.request.decode(self.codec.request_from_ros(data)))
            return self.codec.response_to_ros(response.encode())

        kind = self.codec.type
        self.node.serve(name, RosService(kind.name, checksum or kind.checksum), handle)

    async def call(self, name: str, request: r2p.Message) -> Any:
        data = await self.node.call(name, self.codec.request_to_ros(request.encode()))
        return self.response.decode(self.codec.response_from_ros(data))


async def divide(request: Divide.Request) -> Divide.Response:
    if not request.b:
        raise r2p.ServiceError("division by zero")
    return Divide.Response(request.a / request.b, "done")


@both
@pytest.mark.virtual_time
async def test_a_client_calls_a_ros_node(version: int) -> None:
    network = FakeRosNetwork(version)
    server = Peer(network.node("/server"), Divide)
    calls: list[Any] = []

    async def handler(request: Divide.Request) -> Divide.Response:
        calls.append(request)
        return await divide(request)

    async with r2p.Module("PC1", via=network.transport()) as module, node_in(module, name="pilot") as node:
        client = node.client("math/divide", Divide)
        with pytest.raises(r2p.NoServer, match="service math/divide has no server"):
            await client.call(Divide.Request(1.0, 2.0), timeout=3)
        server.serve("/math/divide", handler)
        await client.ready(1)
        assert client.servers == ["server"]
        assert await client.call(Divide.Request(1.0, 2.0)) == Divide.Response(0.5, "done")
        with pytest.raises(r2p.ServiceError, match="service math/divide of server: division by zero"):
            await client.call(Divide.Request(1.0, 0.0))
        answers = await asyncio.gather(*(client.call(Divide.Request(float(n), 1.0)) for n in range(100)))
        assert [answer.quotient for answer in answers] == list(range(100))
        assert len(calls) == 102
        assert network.nodes.keys() == {"/server", "/pilot"}
        server.node.close()
        await asyncio.sleep(1)
        assert client.servers == []


@both
@pytest.mark.virtual_time
async def test_the_end_of_a_call_reaches_a_ros_node(version: int) -> None:
    network = FakeRosNetwork(version)
    ended: list[str] = []

    async def slow(request: SetBool.Request) -> SetBool.Response:
        try:
            await asyncio.sleep(60)
        finally:
            ended.append(f"{request.data}")
        return SetBool.Response()

    Peer(network.node("/server"), SetBool).serve("/slow", slow)
    async with r2p.Module("PC1", via=network.transport()) as module, node_in(module) as node:
        client = node.client("slow", SetBool)
        with pytest.raises(TimeoutError, match="service slow of server did not answer within 2 s"):
            await client.call(SetBool.Request(data=True), timeout=2)
        task = asyncio.create_task(client.call(SetBool.Request(data=False), timeout=20))
        await asyncio.sleep(1)
        task.cancel()
        await asyncio.sleep(0.1)
        assert ended == ["True", "False"]
        assert client.late == 0


@both
@pytest.mark.virtual_time
async def test_a_ros_node_calls_a_server(version: int) -> None:
    network = FakeRosNetwork(version)
    peer = Peer(network.node("/caller"), Divide)
    async with r2p.Module("PC1", via=network.transport()) as module, node_in(module, name="math") as node:
        server = node.serve("math/divide", Divide, divide)
        await asyncio.sleep(0.1)
        assert {name: entry[1].node for name, entry in network.servers.items()} == {"/math/divide": "/math"}
        assert network.servers["/math/divide"][1].type == codec(Divide, version).type
        assert await peer.call("/math/divide", Divide.Request(3.0, 2.0)) == Divide.Response(1.5, "done")
        with pytest.raises(r2p.ServiceError, match="division by zero"):
            await peer.call("/math/divide", Divide.Request(3.0, 0.0))
        with pytest.raises(r2p.ServiceError, match="Request"):
            await peer.node.call("/math/divide", b"\x00\x01\x00")
        answers = await asyncio.gather(*(peer.call("/math/divide", Divide.Request(float(n))) for n in range(60)))
        assert [answer.quotient for answer in answers] == list(range(60))
        assert server.handled == 62
        assert module.links[0].losses["undecodable"] == 1
        assert server.repeated == 0
        server.close()
        await asyncio.sleep(0.1)
        assert not network.servers
        with pytest.raises(r2p.NoServer):
            await peer.call("/math/divide", Divide.Request())


@both
@pytest.mark.virtual_time
async def test_busy_gone_and_ended(version: int) -> None:
    network = FakeRosNetwork(version)
    peer = Peer(network.node("/caller"), Trigger)
    async with r2p.Module("PC1", via=network.transport()) as module, node_in(module, name="slow") as node:
        ended = asyncio.Event()

        async def slow(request: Trigger.Request) -> Trigger.Response:
            try:
                await asyncio.sleep(600)
            finally:
                ended.set()
            return Trigger.Response(success=True, message="at last")

        server = node.serve("slow", Trigger, slow, limit=1)
        await asyncio.sleep(0.1)
        gone = asyncio.create_task(peer.call("/slow", Trigger.Request()))
        await asyncio.sleep(1)
        gone.cancel()
        await ended.wait()
        patient = asyncio.create_task(peer.call("/slow", Trigger.Request()))
        assert await patient == Trigger.Response(success=True, message="at last")
        waiting = [asyncio.create_task(peer.call("/slow", Trigger.Request())) for _ in range(66)]
        await asyncio.sleep(1)
        assert server.refused == 1
        server.close()
        errors = await asyncio.gather(*waiting, return_exceptions=True)
        texts = [str(error) for error in errors]
        assert texts.count("/slow is busy: call again later") == 1
        assert texts.count("its server was closed") == 65


@both
@pytest.mark.virtual_time
@pytest.mark.parametrize("loss", [0.0, 0.2])
async def test_through_a_gateway(version: int, loss: float) -> None:
    """Where a request or an answer gets lost on the bus, it is repeated; no handler runs twice for one call."""
    network, bus = FakeRosNetwork(version), Network(loss=loss)
    ros = Peer(network.node("/peer"), Divide)
    handled: list[float] = []

    async def handler(request: Divide.Request) -> Divide.Response:
        handled.append(request.a)
        await asyncio.sleep(0.05)
        return await divide(request)

    ros.serve("/ros_divide", handler)
    types: dict[str, Any] = {"motor_divide": Divide}  # that of the other is learnt from its client
    gateway = r2p.Module("GW", via=[bus.transport(), network.transport(types=types)], bridge=True)
    async with gateway, bus.node("MOTOR") as node:
        server, client = node.serve("motor_divide", Divide, handler), node.client("ros_divide", Divide)
        await client.ready(10)
        await asyncio.sleep(10)
        assert "/motor_divide" in network.servers
        calls = (client.call(Divide.Request(float(n)), timeout=30) for n in range(20))
        assert [answer.quotient for answer in await asyncio.gather(*calls)] == list(range(20))
        assert sorted(handled) == list(range(20))
        handled.clear()
        requests = (ros.call("/motor_divide", Divide.Request(float(n))) for n in range(20))
        assert [answer.quotient for answer in await asyncio.gather(*requests)] == list(range(20))
        assert sorted(handled) == list(range(20))
        assert (server.repeated > 0) == bool(loss)
        assert network.servers["/motor_divide"][1].node == "/GW"
        with pytest.raises(r2p.ServiceError, match="division by zero"):
            await client.call(Divide.Request(1.0, 0.0), timeout=30)


@pytest.mark.virtual_time
async def test_what_does_not_fit_is_said(caplog: pytest.LogCaptureFixture) -> None:
    class Grid(r2p.Service):
        class Request(r2p.Message):
            cells: Annotated[tuple[Annotated[tuple[r2p.u8, ...], r2p.Len(2)], ...], r2p.Len(2)] = ((0, 0), (0, 0))

        class Response(r2p.Message):
            cells: r2p.u8 = 0

    async def grid(request: Grid.Request) -> Grid.Response:
        return Grid.Response()

    caplog.set_level("INFO")
    network = FakeRosNetwork(2)
    peer = Peer(network.node("/server"), Divide)
    peer.serve("/divide", divide, checksum="RIHS01_0")
    async with r2p.Module("PC1", via=network.transport()) as module, node_in(module) as node:
        client = node.client("divide", Divide)
        with pytest.raises(r2p.NoServer):
            await client.call(Divide.Request(), timeout=3)
        assert "service divide of ROS node /server is another math_srvs/Divide (RIHS01_0 there" in caplog.text
        node.serve("grid", Grid, grid)
        await asyncio.sleep(3)
        assert "service grid is not on ROS: tests/Request.cells: ROS has no arrays of arrays" in caplog.text
        assert module.links[0].losses["service not on ROS"] == 1
        assert list(network.servers) == ["/divide"]


@both
@pytest.mark.virtual_time
async def test_services_of_each_node_are_shown_to_their_clients_only(version: int) -> None:
    network = FakeRosNetwork(version)
    name = "/talker/get_loggers" if version == 1 else "/talker/get_parameters"

    class Get(r2p.Service, name="roscpp/Get" if version == 1 else "rcl_interfaces/Get"):
        class Request(r2p.Message):
            data: bool = False

        class Response(r2p.Message):
            data: bool = False

    async def handler(request: Any) -> Any:
        return Get.Response(data=not request.data)

    Peer(network.node("/talker"), Get).serve(name, handler)
    async with r2p.Module("PC1", via=network.transport()) as module, node_in(module) as node:
        for _ in range(2):
            await asyncio.sleep(1)
            assert not [topic for topic in module.network.topics() if "get_" in topic]
            async with node.client(name, Get) as client:
                await client.ready(2)
                assert (await client.call(Get.Request())).data


@both
@pytest.mark.virtual_time
async def test_a_network_that_comes_back(version: int) -> None:
    network = FakeRosNetwork(version)
    peer = Peer(network.node("/peer"), Divide)
    peer.serve("/theirs", divide)
    async with r2p.Module("PC1", via=network.transport()) as module, node_in(module) as node:
        node.serve("ours", Divide, divide)
        client = node.client("theirs", Divide)
        await client.ready(1)
        network.set_up(False)
        await asyncio.sleep(1)
        with pytest.raises(r2p.NoServer):
            await client.call(Divide.Request())
        network.set_up(True)
        await client.ready(1)
        assert (await client.call(Divide.Request(4.0, 2.0))).quotient == 2
        assert (await peer.call("/ours", Divide.Request(4.0, 2.0))).quotient == 2


@both
@pytest.mark.virtual_time
async def test_a_gateway_learns_the_types_of_a_service(version: int) -> None:
    network, bus = FakeRosNetwork(version), Network()
    peer = Peer(network.node("/peer"), Divide)
    gateway = r2p.Module("GW", via=[bus.transport(), network.transport()], bridge=True)
    async with gateway, bus.node("MOTOR") as node:
        node.serve("divide", Divide, divide)
        await asyncio.sleep(5)
        assert network.servers["/divide"][1].type == codec(Divide, version).type
        assert (await peer.call("/divide", Divide.Request(4.0, 2.0))).quotient == 2


@pytest.mark.virtual_time
async def test_tools_know_the_services_that_every_ros_has() -> None:
    network = FakeRosNetwork(2)

    async def handler(request: SetBool.Request) -> SetBool.Response:
        return SetBool.Response(success=request.data)

    Peer(network.node("/server"), SetBool).serve("/enable", handler)
    async with r2p.Module("PC1", via=network.transport(), observer=True) as module:
        await asyncio.sleep(1)
        view = module.network.topics()["enable_q"]
        fingerprint = r2p.layout(define("enable", SetBool).requests.cls).fingerprint
        assert view.fingerprint == fingerprint
        assert await module.links[0].message_type(fingerprint) is not None


@pytest.mark.virtual_time
async def test_a_flood_of_calls_is_refused_and_counted() -> None:
    network = FakeRosNetwork(2)
    peer = Peer(network.node("/caller"), Trigger)

    async def slow(request: Trigger.Request) -> Trigger.Response:
        await asyncio.sleep(60)
        return Trigger.Response()

    async with r2p.Module("PC1", via=network.transport()) as module, node_in(module) as node:
        for name in ("slow", "other", "third"):
            node.serve(name, Trigger, slow, limit=2000)
        await asyncio.sleep(0.1)
        calls = [
            asyncio.create_task(peer.call(name, Trigger.Request()))
            for name, count in (("/slow", 520), ("/other", 500), ("/third", 15))
            for _ in range(count)
        ]
        errors = [
            str(each) for each in await asyncio.gather(*calls, return_exceptions=True) if isinstance(each, Exception)
        ]
        # One service leaves room for others, and all of them have a limit.
        assert errors[:8] == ["512 requests wait for their answers: call again later"] * 8
        assert errors[8:] == ["1024 requests wait for their answers: call again later"] * 3
        assert module.links[0].losses["too many calls"] == 11


@both
@pytest.mark.virtual_time
async def test_the_text_of_an_error_arrives_whole_also_where_responses_are_short(version: int) -> None:
    class Home(r2p.Service, name="arm_msgs/Home"):
        class Request(r2p.Message):
            speed: r2p.f32 = 0.0

        class Response(r2p.Message):
            angle: r2p.f32 = 0.0

    async def home(request: Home.Request) -> Home.Response:
        raise r2p.ServiceError(f"{request.speed} m/s is too fast")

    network = FakeRosNetwork(version)
    async with r2p.Module("PC1", via=network.transport()) as module, node_in(module) as node:
        node.serve("home", Home, home)
        await asyncio.sleep(0.1)
        with pytest.raises(r2p.ServiceError, match=r"^2\.0 m/s is too fast"):
            await Peer(network.node("/caller"), Home).call("/home", Home.Request(2.0))


@pytest.mark.virtual_time
@pytest.mark.parametrize(("serving", "calling"), [(1, 2), (2, 1)])
async def test_a_gateway_between_ros_1_and_ros_2_passes_services_of_every_ros_on(serving: int, calling: int) -> None:
    """Nobody gives it their types."""
    one, other = FakeRosNetwork(serving), FakeRosNetwork(calling)

    async def enable(request: SetBool.Request) -> SetBool.Response:
        return SetBool.Response(success=request.data, message="on")

    async with (
        r2p.Module("GW", via=[one.transport(), other.transport()], bridge=True),
        r2p.Module("PC1", via=one.transport()) as pc1,
        r2p.Module("PC2", via=other.transport()) as pc2,
        node_in(pc1, name="motors") as server,
        node_in(pc2, name="pilot") as caller,
    ):
        server.serve("motors/enable", SetBool, enable)
        await asyncio.sleep(5)
        assert other.servers["/motors/enable"][1].node == "/GW"
        client = caller.client("motors/enable", SetBool)
        await client.ready(5)
        assert await client.call(SetBool.Request(data=True), timeout=3) == SetBool.Response(True, "on")


@both
@pytest.mark.virtual_time
async def test_two_gateways_handle_a_call_once(version: int) -> None:
    network, bus = FakeRosNetwork(version), Network()
    peer = Peer(network.node("/peer"), Divide)
    handled: list[str] = []

    async def ours(request: Divide.Request) -> Divide.Response:
        handled.append("ours")
        return await divide(request)

    async def theirs(request: Divide.Request) -> Divide.Response:
        handled.append("theirs")
        return await divide(request)

    peer.serve("/theirs", theirs)
    gateways = [r2p.Module(name, via=[bus.transport(), network.transport()], bridge=True) for name in ("GW1", "GW2")]
    async with gateways[0], gateways[1], bus.node("MOTOR") as node:
        node.serve("ours", Divide, ours)
        client = node.client("theirs", Divide)
        await asyncio.sleep(20)
        assert (await peer.call("/ours", Divide.Request(4.0, 2.0))).quotient == 2
        assert (await client.call(Divide.Request(4.0, 2.0))).quotient == 2
        assert handled == ["ours", "theirs"]
