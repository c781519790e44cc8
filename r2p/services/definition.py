"""The definition of a service: its name, and the types of its request and its response.

On the network a service is a pair of topics whose messages are the header of `r2p.codecs.services` and one field, the
request or the response. Their layouts are ordinary ones, so discovery compares the types, gateways pass the topics on,
and tools decode them.
"""

import re
import types
from typing import Any, Generic, Protocol, TypeVar

import msgspec

from r2p.codecs.services import HEADER_SIZE, REQUESTS, RESPONSES
from r2p.errors import MessageError
from r2p.messages import Layout, Message, Nested, layout, message_type, show, u8, u16, u32
from r2p.messages.definition import TYPE_NAME, MessageMeta

Q = TypeVar("Q", bound=Message)
R = TypeVar("R", bound=Message)
Q_co = TypeVar("Q_co", bound=Message, covariant=True)
R_co = TypeVar("R_co", bound=Message, covariant=True)

_NOT_IN_NAMES = re.compile(r"^[^A-Za-z]+|[^A-Za-z0-9_]", re.ASCII)
"""What a class may have in its name, and the full name of a type may not."""

TEXT_ROOM = 200
"""Bytes of the text of an error for which there is room where the length of responses varies: on any link."""

_HEADER: list[tuple[str, Any]] = [("instance", u32), ("number", u16), ("kind", u8), ("version", u8), ("server", u32)]


class Service:
    """The base of classes that name the two types of a service:

        class Calibrate(r2p.Service):
            class Request(r2p.Message):
                gain: r2p.f32 = 1.0

            class Response(r2p.Message):
                offset: r2p.f32 = 0.0

    The class stands for both types in `Node.service`, `Node.serve` and `Node.client`, and after --type.
    `class Calibrate(r2p.Service, name="arm_msgs/Calibrate")` gives the type another name than that of package and
    class, as ROS compares it.
    """

    def __init_subclass__(cls, name: str = "", **options: Any) -> None:
        """Name the nested classes after the service. Raises MessageError for what is not a full name."""
        super().__init_subclass__(**options)
        if not name:
            return
        if not TYPE_NAME.fullmatch(name):
            raise MessageError(f"{cls.__name__}: {name!r} is not the full name of a service, such as std_srvs/SetBool")
        full_name = name if name.count("/") > 1 else name.replace("/", "/srv/")
        for part in ("Request", "Response"):
            name_nested(cls, part, f"{full_name}_{part}")


def name_nested(outer: type, part: str, full_name: str) -> None:
    """Give a message class that is defined in another class this name, if it has none of its own."""
    found = vars(outer).get(part)
    if isinstance(found, MessageMeta) and found.__qualname__ == f"{outer.__qualname__}.{part}":
        found.give_name(full_name)


class ServiceType(Protocol[Q_co, R_co]):
    """A class with nested classes Request and Response, as type checkers see it."""

    @property
    def Request(self) -> type[Q_co]:  # noqa: N802 - the name of the nested class
        """The class of requests."""

    @property
    def Response(self) -> type[R_co]:  # noqa: N802
        """The class of responses."""


class Definition(msgspec.Struct, Generic[Q, R], frozen=True):
    """A service: its name, its types, and the layouts of its two topics."""

    name: str
    request: Layout[Q]
    response: Layout[R]
    requests: Layout[Any]
    responses: Layout[Any]

    @property
    def request_topic(self) -> str:
        return self.name + REQUESTS

    @property
    def response_topic(self) -> str:
        return self.name + RESPONSES

    @property
    def topics(self) -> tuple[tuple[str, Layout[Any]], ...]:
        """The names of both topics, with their layouts."""
        return (self.request_topic, self.requests), (self.response_topic, self.responses)


def define(name: str, request: Any, response: Any = None) -> Definition[Any, Any]:
    """Return the definition of a service by two message classes, or one class with Request and Response.

    Raises MessageError for anything else.
    """
    if response is None:
        request, response = _nested(name, request, "Request"), _nested(name, request, "Response")
    asked, answered = layout(request), layout(response)
    requests, responses = _topic_layout(asked, REQUESTS, "request"), _topic_layout(answered, RESPONSES, "response")
    if responses.varies:  # the text of an error takes the place of a response
        responses = msgspec.structs.replace(responses, size=max(responses.size, HEADER_SIZE + TEXT_ROOM))
    return Definition(name, asked, answered, requests, responses)


def body_of(cls: type[Message], field: str) -> type[Message] | None:
    """Return the type of the field of a topic's messages that holds request or response; None if it is not a service's.

    A class that was made from a schema lacks a field whose type has no fields: then this is a new class without any.
    """
    for each in layout(cls).fields:
        if each.name == field and isinstance(each.shape, Nested):
            found: type[Message] = each.shape.layout.cls
            return found
    return message_type(field.title(), "") if is_header(cls) else None


def is_header(cls: type[Message]) -> bool:
    """Return whether a topic's messages have the header alone, as those of all services without fields in the body."""
    found = layout(cls)
    leaves = [each for each in found.fields if not isinstance(each.shape, Nested) or each.shape.size]
    return [each.name for each in leaves] == [name for name, _ in _HEADER] and found.size == HEADER_SIZE


def _nested(name: str, service: Any, part: str) -> type[Message]:
    """Return the nested class Request or Response."""
    found = getattr(service, part, None)
    if isinstance(found, type) and issubclass(found, Message):
        return found
    what = service.__name__ if isinstance(service, type) else show(service)
    if isinstance(service, type) and issubclass(service, Message):
        raise MessageError(f"service {name}: {what} is the type of one message: give those of request and response")
    raise MessageError(f"service {name}: {what} lacks a message class {part}: nest `class {part}(r2p.Message)` in it")


def _topic_layout(body: Layout[Any], end: str, field: str) -> Layout[Any]:
    """Return the layout of a topic of the pair: the header, then one field, after whose type it is named."""
    package, *kind, name = body.name.split("/")
    if not kind:  # not named as a part of a service: with the classes that it is nested in
        name = body.cls.__qualname__.rpartition("<locals>.")[2].replace(".", "_")
    name += end
    package = re.sub(_NOT_IN_NAMES, "", package) or "r2p"
    full_name = "/".join([package, *(each for each in kind if each == "action"), re.sub(_NOT_IN_NAMES, "", name)])
    members = {"__annotations__": dict([*_HEADER, (field, body.cls)]), "__module__": __name__}
    return layout(types.new_class(name, (Message,), {"name": full_name}, lambda space: space.update(members)))
