"""The services of the network, which clients call: their types in `ros2msg`, requests and responses in CDR or JSON."""

import asyncio
from collections.abc import Callable, Mapping
from typing import Any

import msgspec

from r2p.codecs.services import REQUESTS, RESPONSES, is_of_service
from r2p.errors import DecodeError, Error
from r2p.messages import Message, layout
from r2p.messages.values import from_plain, to_plain
from r2p.modules.graph import TopicView
from r2p.monitoring.topic_types import TypeFinder
from r2p.ros.cdr import cdr
from r2p.ros.ros2_schemas import ROS2MSG, schema_of
from r2p.ros.service_types import ServiceShape, service_shape
from r2p.ros.type_names import ros2_name
from r2p.runtime.node import Node
from r2p.services.client import ServiceClient
from r2p.web.foxglove.protocol import CDR, JSON, PartInfo, ServiceInfo

TIMEOUT = 10.0
"""Seconds that a call may take."""

_ASKED_AGAIN = 10  # reviews after which a type that was unknown is looked for again


class OfferedService(msgspec.Struct, eq=False):
    """A service that clients may call; its own client is made by the first call."""

    info: ServiceInfo
    name: str
    shape: ServiceShape
    client: ServiceClient[Any, Any] | None = None


Changed = Callable[[OfferedService], None]
"""Called with a service that has come or gone."""


class ServiceTable:
    """The services of a network, as of the last `review`."""

    def __init__(self, node: Node, types: TypeFinder, added: Changed, removed: Changed) -> None:
        self.by_number: dict[int, OfferedService] = {}
        self._node = node
        self._types = types
        self._added = added
        self._removed = removed
        self._by_name: dict[str, OfferedService] = {}
        self._wanted: set[str] = set()
        self._looking: dict[str, asyncio.Task[None]] = {}
        self._unknown: dict[str, int] = {}
        self._named: set[str] = set()
        """Topics of requests with a receiver that is known by its name."""
        self._numbers = 0

    def review(self, views: Mapping[str, TopicView]) -> None:
        """Add services that now have a server, and remove services whose last server has gone."""
        topics = [name for name in views if name.endswith(REQUESTS) and is_of_service(name, views)]
        self._wanted = {name.removesuffix(REQUESTS) for name in topics if self._is_served(views[name])}
        self._named.intersection_update(views)
        for name in self._by_name.keys() - self._wanted:
            self._remove(name)
        for name in self._unknown.keys() - self._wanted:
            del self._unknown[name]
        for name in sorted(self._wanted - self._by_name.keys() - self._looking.keys()):
            reviews = self._unknown[name] = (self._unknown.get(name, -1) + 1) % _ASKED_AGAIN
            if not reviews:
                self._looking[name] = asyncio.create_task(self._find(name), name=f"types of {name} for Foxglove")

    def _is_served(self, requests: TopicView) -> bool:
        """Return whether requests have a receiver; firmware names no nodes, and what it has announced stays known."""
        if requests.subscribers:
            self._named.add(requests.name)
        return bool(requests.subscribers or (requests.subscribed_on and requests.name not in self._named))

    def _remove(self, name: str) -> None:
        service = self._by_name.pop(name)
        del self.by_number[service.info.id]
        if service.client is not None:
            service.client.close()
        self._removed(service)

    async def _find(self, name: str) -> None:
        """Add a service if its types are known, or other modules know them, and ROS can define them."""
        try:
            requests, responses = [await self._types.find(name + end) for end in (REQUESTS, RESPONSES)]
            if requests is None or responses is None or name not in self._wanted:
                return
            service = self._offer(name, service_shape(layout(requests), layout(responses)))
        except Error:  # not a service, a type that ROS can't define, or a module that was closed meanwhile
            return
        finally:
            del self._looking[name]
        self._by_name[name] = self.by_number[service.info.id] = service
        self._added(service)

    def _offer(self, name: str, shape: ServiceShape) -> OfferedService:
        kind = ros2_name(shape.name, "srv")
        request, response = _part(shape.request.cls, f"{kind}_Request"), _part(shape.response.cls, f"{kind}_Response")
        self._numbers += 1
        info = ServiceInfo(self._numbers, f"/{name}", kind, request, response)
        return OfferedService(info, name, shape)

    async def call(self, service: OfferedService, encoding: str, data: bytes) -> bytes:
        """Return the response to a request. Raises Error and TimeoutError with the reason, for the user."""
        request = decode_as(service.shape.request.cls, encoding, data)
        if service.client is None:
            service.client = self._node.client(service.name, service.shape.request.cls, service.shape.response.cls)
        response = await service.client.call(request, timeout=TIMEOUT)
        if encoding == JSON:
            return msgspec.json.encode(to_plain(response))
        cls: type[Message] = service.shape.response.cls
        return cdr(cls).encode(response)

    def close(self) -> None:
        """End the clients, and stop asking for types."""
        for task in list(self._looking.values()):
            task.cancel()
        for name in list(self._by_name):
            self._remove(name)


def decode_as(cls: type[Message], encoding: str, data: bytes) -> Message:
    """Return the message that a client has sent in an encoding. Raises Error."""
    if encoding == CDR:
        message: Message = cdr(cls).decode(data)
        return message
    if encoding != JSON:
        raise Error(f"the encoding is {encoding[:40]!r}: send {CDR} or {JSON}")
    try:
        return from_plain(cls, msgspec.json.decode(data or b"{}", type=dict[str, Any]))
    except (msgspec.DecodeError, RecursionError, UnicodeError) as error:
        raise DecodeError(f"not JSON of a {cls.__name__}: {error}") from None


def _part(cls: type[Message], name: str) -> PartInfo:
    """Return a request or response; the class may be learnt, and then has a made-up name."""
    return PartInfo(CDR, name, ROS2MSG, schema_of(cls).text)
