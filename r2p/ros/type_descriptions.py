"""The service by which ROS 2's nodes describe their types, `NODE/get_type_description`, in both roles.

    describe(request, classes)        the answer of a node that has these types
    ask(middleware, node, peer)       the definition of another node's type, as in a header of ROS 1's connections;
    request_for, definition_in        the bytes of the question, and what is in the answer

With it, tools decode types that they have no package for: those of r2p in ROS's tools, and those of ROS nodes here.
"""

import functools
from collections.abc import Iterable
from typing import Any

from r2p.errors import DecodeError, MessageError, NoServer, ServiceError
from r2p.messages import Message, layout, show
from r2p.ros.cdr import cdr
from r2p.ros.classes import RosTypes
from r2p.ros.definitions import (
    SEPARATOR,
    Definitions,
    FieldDefinition,
    MessageDefinition,
    parse,
    parse_service,
    plain_text,
)
from r2p.ros.hashes import TypeDescriptions, field_type, service_hash
from r2p.ros.library import definitions_with_those_of_ros
from r2p.ros.middleware import Middleware, RosPeerEndpoint, RosService
from r2p.ros.type_names import ros2_name, short_name

NAME = "get_type_description"
"""The service, below the name of its node."""

_TIMEOUT = 5.0  # seconds that another node has for its answer

_PACKAGE = "type_description_interfaces"
_MESSAGES = {
    "FieldType": "uint8 type_id\nuint64 capacity\nuint64 string_capacity\nstring<=255 nested_type_name",
    "Field": "string name\nFieldType type\nstring default_value",
    "IndividualTypeDescription": "string<=255 type_name\nField[] fields",
    "TypeDescription": (
        "IndividualTypeDescription type_description\nIndividualTypeDescription[] referenced_type_descriptions"
    ),
    "TypeSource": "string type_name\nstring encoding\nstring raw_file_contents",
    "KeyValue": "string key\nstring value",
}
_SERVICE = """string type_name
string type_hash
bool include_type_sources
---
bool successful
string failure_reason
TypeDescription type_description
TypeSource[] type_sources
KeyValue[] extra_information
"""


@functools.cache
def _definitions() -> dict[str, MessageDefinition]:
    found: dict[str, MessageDefinition] = {}
    for name, text in _MESSAGES.items():
        found |= parse(f"{_PACKAGE}/{name}", text)
    return found | {part.name: part for part in parse_service(f"{_PACKAGE}/srv/GetTypeDescription", _SERVICE)}


@functools.cache
def _types() -> RosTypes:
    return RosTypes(2, _definitions())


def _class(name: str) -> type[Message]:
    return _types().load(f"{_PACKAGE}/{name}")


@functools.cache
def service() -> RosService:
    """Return the type of the service."""
    found, name = _definitions(), f"{_PACKAGE}/GetTypeDescription"
    request, response = found[f"{name}_Request"], found[f"{name}_Response"]
    return RosService(name, service_hash(name, request.fields, response.fields, found))


# The answer


def describe(request: bytes, classes: Iterable[type[Message]]) -> bytes:
    """Return the answer to a request: the description of a type of one of these classes, or the reason for a failure.

    Raises DecodeError for what is not a request.
    """
    asked: Any = cdr(_class("GetTypeDescription_Request")).decode(request)
    for cls in classes:
        if ros2_name(layout(cls).name) == asked.type_name:
            found = _described(cls)
            if found is not None and asked.type_hash in ("", found[0]):
                return response_with(found[1], found[2] if asked.include_type_sources else {})
    kind = _class("GetTypeDescription_Response")
    reason = f"this node has no type {show(asked.type_name)} with the hash {show(asked.type_hash)}"
    return cdr(kind).encode(kind(failure_reason=reason))


@functools.lru_cache(maxsize=256)
def _described(cls: type[Message]) -> tuple[str, dict[str, Any], Definitions] | None:
    """Return the hash, the description and the definitions of a class; None if ROS 2 can't have it."""
    try:
        definitions = definitions_with_those_of_ros(cls, 2)
        types = TypeDescriptions(definitions)
        return types.hash(layout(cls).name), types.description(layout(cls).name), definitions
    except MessageError:
        return None


def response_with(description: dict[str, Any], sources: Definitions) -> bytes:
    """Return the answer with this description (`TypeDescriptions.description`), and the texts of these definitions."""
    kind, source = _class("GetTypeDescription_Response"), _class("TypeSource")
    texts = (
        source(type_name=ros2_name(name), encoding="msg", raw_file_contents=each.text) for name, each in sources.items()
    )
    whole = _class("TypeDescription")(
        type_description=_individual(description["type_description"]),
        referenced_type_descriptions=tuple(map(_individual, description["referenced_type_descriptions"])),
    )
    return cdr(kind).encode(kind(successful=True, type_description=whole, type_sources=tuple(texts)))


def _individual(description: dict[str, Any]) -> Message:
    field, kind = _class("Field"), _class("FieldType")
    fields = (field(name=each["name"], type=kind(**each["type"])) for each in description["fields"])
    return _class("IndividualTypeDescription")(type_name=description["type_name"], fields=tuple(fields))


# The question


async def ask(middleware: Middleware, node: str, peer: RosPeerEndpoint) -> str:
    """Ask another node, in the name of this one, for the definition of its type; empty if it does not give it."""
    try:
        name = f"{peer.node}/{NAME}"
        return definition_in(
            await middleware.call(node, name, service(), request_for(peer.type, peer.checksum), _TIMEOUT)
        )
    except (TimeoutError, NoServer, ServiceError, DecodeError):
        return ""


def request_for(name: str, checksum: str) -> bytes:
    """Return the request for the description of a type (`package/Name`)."""
    kind = _class("GetTypeDescription_Request")
    return cdr(kind).encode(kind(type_name=ros2_name(name), type_hash=checksum, include_type_sources=False))


def definition_in(response: bytes) -> str:
    """Return the definition in an answer, with those of nested types behind it; empty if the node has none.

    Raises DecodeError for an answer that is none, or that describes what no definition can say.
    """
    answer: Any = cdr(_class("GetTypeDescription_Response")).decode(response)
    if not answer.successful:
        return ""
    described = answer.type_description
    try:
        first = _text(described.type_description)
        rest = [(short_name(each.type_name), _text(each)) for each in described.referenced_type_descriptions]
    except MessageError as error:
        raise DecodeError(str(error)) from None
    return "\n".join([first, *(f"{SEPARATOR}\nMSG: {name}\n{text}" for name, text in rest)])


def _text(description: Any) -> str:
    fields = []
    for each in description.fields:
        kind = each.type
        nested = short_name(kind.nested_type_name) if kind.nested_type_name else ""
        fields.append(FieldDefinition(each.name, field_type(kind.type_id, kind.capacity, kind.string_capacity, nested)))
    if [each.name for each in fields] == ["structure_needs_at_least_one_member"]:
        fields = []
    return plain_text(MessageDefinition(short_name(description.type_name), tuple(fields)))
