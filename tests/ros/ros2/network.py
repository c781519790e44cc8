"""A zenoh router on loopback, middlewares on it whose users record what they are told, and bare zenoh sessions."""

import asyncio
import json
import random
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager
from typing import Any

import zenoh

from r2p.clock import clock_of
from r2p.ros.middleware import (
    Answer,
    Cancel,
    MiddlewareUser,
    Qos,
    Refuse,
    RosArrival,
    RosEndpoint,
    RosGraph,
    RosServer,
    RosService,
    RosType,
)
from r2p.ros.ros2.middleware import Ros2Middleware
from r2p.ros.ros2.options import parse_options
from r2p.transports.url import parse
from tests.ports import free_port
from tests.ros.ros2.recorded import SET_BOOL_HASH, STRING_HASH

STRING = RosType("std_msgs/String", STRING_HASH)
SET_BOOL = RosService("std_srvs/SetBool", SET_BOOL_HASH)
GUARD = 20.0


class Recorder(MiddlewareUser):
    """A user that notes each call as a text or an object, and answers requests with their bytes."""

    def __init__(self) -> None:
        self.events: list[str] = []
        self.arrivals: list[RosArrival] = []
        self.requests: list[tuple[str, str, bytes]] = []
        self.graph = RosGraph()
        self.notices: list[str] = []
        self.handle: Callable[[bytes, Answer, Refuse], object] = lambda request, answer, _: answer(request)
        self._changed = asyncio.Event()

    async def until(self, condition: Callable[[], object]) -> None:
        """Wait until something is true; it is checked when the user is called, and now and then."""
        async with asyncio.timeout(GUARD):
            while not condition():
                self._changed.clear()
                try:
                    async with asyncio.timeout(0.02):
                        await self._changed.wait()
                except TimeoutError:
                    pass

    def _note(self, event: str) -> None:
        self.events.append(event)
        self._changed.set()

    def middleware_up(self) -> None:
        self._note("up")

    def middleware_down(self, reason: str) -> None:
        self._note(f"down: {reason}")

    def middleware_waits(self, reason: str) -> None:
        self._note(f"waits: {reason}")

    def graph_changed(self, graph: RosGraph) -> None:
        self.graph = graph
        self._changed.set()

    def subscriber_joined(self, topic: str) -> None:
        self._note(f"joined {topic}")

    def subscribers_gone(self, topic: str) -> None:
        self._note(f"gone {topic}")

    def publisher_found(self, topic: str, node: str, type_name: str, definition: str, *, latched: bool = False) -> None:
        self._note(f"found {topic} {node} {type_name}{' latched' * latched}")

    def publisher_gone(self, topic: str, node: str) -> None:
        self._note(f"lost {topic} {node}")

    def received(self, messages: list[RosArrival]) -> None:
        self.arrivals += messages
        self._changed.set()

    def requested(self, service: str, caller: str, request: bytes, answer: Answer, refuse: Refuse) -> Cancel:
        self.requests.append((service, caller, request))
        self.handle(request, answer, refuse)
        return lambda: self._note(f"cancelled {service}")

    def made_room(self) -> None:
        self._note("room")

    def notice(self, kind: str, text: str, *, trouble: bool) -> None:
        self.notices.append(text)
        self._changed.set()

    def shut_down(self, node: str, reason: str) -> None: ...


def matches(sender: zenoh.Publisher | zenoh.Querier) -> bool:
    """Whether a receiver is known: the stubs promise a bool, but it is an object, which is always true."""
    status: object = sender.matching_status
    return bool(getattr(status, "matching", status))


class RouterOfTests:
    """A zenoh router on a free port, which can be stopped and started again."""

    def __init__(self) -> None:
        self.port = free_port()
        self._session: zenoh.Session | None = None

    @property
    def endpoint(self) -> str:
        return f"tcp/127.0.0.1:{self.port}"

    async def start(self) -> None:
        self._session = await asyncio.to_thread(zenoh.open, zenoh_config("router", "listen", self.endpoint))

    async def stop(self) -> None:
        session, self._session = self._session, None
        if session is not None:
            await asyncio.to_thread(session.close)

    @asynccontextmanager
    async def running(self) -> AsyncIterator[None]:
        await self.start()
        try:
            yield
        finally:
            await self.stop()

    @contextmanager
    def plain_session(self) -> Iterator[zenoh.Session]:
        """A program on the router that is none of ours."""
        with zenoh.open(zenoh_config("client", "connect", self.endpoint)) as session:
            yield session


def zenoh_config(mode: str, way: str, endpoint: str) -> zenoh.Config:
    config = zenoh.Config()
    config.insert_json5("mode", json.dumps(mode))
    config.insert_json5(f"{way}/endpoints", json.dumps([endpoint]))
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("scouting/delay", "0")
    config.insert_json5("timestamping/enabled", "true")
    return config


@asynccontextmanager
async def router() -> AsyncIterator[RouterOfTests]:
    network = RouterOfTests()
    async with network.running():
        yield network


@asynccontextmanager
async def joined(
    network: RouterOfTests, node: str = "", **options: Any
) -> AsyncIterator[tuple[Ros2Middleware, Recorder]]:
    """A middleware on the network, with one ROS node, and its user."""
    middleware, user = middleware_on(network, **options), Recorder()
    if node:
        middleware.add_node(node)
    opened = asyncio.Event()
    task = asyncio.create_task(middleware.run(user, opened.set))
    try:
        async with asyncio.timeout(GUARD):
            await asyncio.wait([task, asyncio.create_task(opened.wait())], return_when=asyncio.FIRST_COMPLETED)
        yield middleware, user
    finally:
        task.cancel()
        await asyncio.wait([task])
        if not task.cancelled():
            task.result()


def middleware_on(network: RouterOfTests, **options: Any) -> Ros2Middleware:
    given = ",".join(f"{name}={value}" for name, value in options.items())
    parsed = parse_options(parse(f"ros2:{network.endpoint},{given}"), {})
    return Ros2Middleware(parsed, clock_of(), random.Random(1))


def endpoint(node: str, topic: str = "/chatter", type: RosType = STRING, **qos: Any) -> RosEndpoint:
    return RosEndpoint(node, topic, type, Qos(**qos))


def server(node: str, service: str = "/set") -> RosServer:
    return RosServer(node, service, SET_BOOL)
