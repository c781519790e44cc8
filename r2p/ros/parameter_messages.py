"""What ROS 2's parameter services and events carry, and how r2p's parameters look in it. Nothing here does I/O.

| kind in r2p | type in ROS 2 |
| --- | --- |
| bool, int, float | bool, integer, double; `min` and `max` are a range |
| str, enum | string; the members of an enum are in the constraints |
| ints, floats | integer array, double array; their length and limits are in the constraints |

The types are made of these definitions, as the hashes of the services are.
"""

import functools
import sys
from collections.abc import Iterable, Mapping
from typing import Any

import msgspec

from r2p.codecs.parameters import Plain
from r2p.errors import ParameterError
from r2p.messages import Array, Message
from r2p.parameters.definition import ParameterInfo
from r2p.ros.cdr import CdrCodec, cdr
from r2p.ros.classes import RosTypes
from r2p.ros.definitions import MessageDefinition, parse, parse_service
from r2p.ros.hashes import TypeDescriptions, service_hash
from r2p.ros.middleware import RosService, RosType

NOT_SET, BOOL, INTEGER, DOUBLE, STRING, BYTES, BOOLS, INTEGERS, DOUBLES, STRINGS = range(10)
"""The types of values in ROS 2."""
TYPE_NAMES = (
    "not set",
    "a bool",
    "an integer",
    "a double",
    "a string",
    "a byte array",
    "a bool array",
    "an integer array",
    "a double array",
    "a string array",
)

_PACKAGE = "rcl_interfaces"
_FIELDS = (
    "",
    "bool_value",
    "integer_value",
    "double_value",
    "string_value",
    "byte_array_value",
    "bool_array_value",
    "integer_array_value",
    "double_array_value",
    "string_array_value",
)
_TYPES = {
    "bool": BOOL,
    "int": INTEGER,
    "float": DOUBLE,
    "str": STRING,
    "enum": STRING,
    "ints": INTEGERS,
    "floats": DOUBLES,
}
_INT_MAX = (1 << 63) - 1

_MESSAGES = {
    "ParameterValue": "uint8 type\nbool bool_value\nint64 integer_value\nfloat64 double_value\nstring string_value\n"
    "byte[] byte_array_value\nbool[] bool_array_value\nint64[] integer_array_value\nfloat64[] double_array_value\n"
    "string[] string_array_value",
    "Parameter": "string name\nParameterValue value",
    "IntegerRange": "int64 from_value\nint64 to_value\nuint64 step",
    "FloatingPointRange": "float64 from_value\nfloat64 to_value\nfloat64 step",
    "ParameterDescriptor": "string name\nuint8 type\nstring description\nstring additional_constraints\n"
    "bool read_only\nbool dynamic_typing\nFloatingPointRange[<=1] floating_point_range\n"
    "IntegerRange[<=1] integer_range",
    "ListParametersResult": "string[] names\nstring[] prefixes",
    "SetParametersResult": "bool successful\nstring reason",
    "ParameterEvent": "builtin_interfaces/Time stamp\nstring node\nParameter[] new_parameters\n"
    "Parameter[] changed_parameters\nParameter[] deleted_parameters",
}
_SERVICES = {
    "DescribeParameters": "string[] names\n---\nParameterDescriptor[] descriptors",
    "GetParameterTypes": "string[] names\n---\nuint8[] types",
    "GetParameters": "string[] names\n---\nParameterValue[] values",
    "ListParameters": "string[] prefixes\nuint64 depth\n---\nListParametersResult result",
    "SetParameters": "Parameter[] parameters\n---\nSetParametersResult[] results",
    "SetParametersAtomically": "Parameter[] parameters\n---\nSetParametersResult result",
}
SERVICE_NAMES = {
    "describe_parameters": "DescribeParameters",
    "get_parameter_types": "GetParameterTypes",
    "get_parameters": "GetParameters",
    "list_parameters": "ListParameters",
    "set_parameters": "SetParameters",
    "set_parameters_atomically": "SetParametersAtomically",
}
"""The services of each node, below its name, and their types."""


class ParameterService(msgspec.Struct, frozen=True, eq=False):
    """A service: its type, what reads its requests and writes its responses, and their class."""

    kind: RosService
    request: CdrCodec
    response: CdrCodec
    response_class: type[Message]


@functools.cache
def _definitions() -> dict[str, MessageDefinition]:
    found: dict[str, MessageDefinition] = {}
    for name, text in _MESSAGES.items():
        found |= parse(f"{_PACKAGE}/{name}", text)
    return found


@functools.cache
def _types() -> RosTypes:
    parts = {part.name: part for name in _SERVICES for part in _service_parts(name)}
    return RosTypes(2, _definitions() | parts)


def _service_parts(name: str) -> tuple[MessageDefinition, MessageDefinition]:
    return parse_service(f"{_PACKAGE}/srv/{name}", _SERVICES[name])


def message_class(name: str) -> type[Message]:
    """Return the class of a type of rcl_interfaces: "Parameter"."""
    return _types().load(f"{_PACKAGE}/{name}")


@functools.cache
def service(last: str) -> ParameterService:
    """Return a service by the last part of its name: "get_parameters"."""
    kind = SERVICE_NAMES[last]
    request, response = _service_parts(kind)
    name = f"{_PACKAGE}/{kind}"
    checksum = service_hash(name, request.fields, response.fields, _definitions())
    classes = [_types().load(part.name) for part in (request, response)]
    return ParameterService(RosService(name, checksum), cdr(classes[0]), cdr(classes[1]), classes[1])


@functools.cache
def event_type() -> RosType:
    """Return the type of /parameter_events."""
    name = f"{_PACKAGE}/ParameterEvent"
    return RosType(name, TypeDescriptions(_definitions()).hash(name))


# Values


def type_of(info: ParameterInfo) -> int:
    """Return the type in ROS 2 of a parameter."""
    return _TYPES[info.kind]


def to_ros(info: ParameterInfo) -> Any:
    """Return the value of a parameter as a ParameterValue."""
    kind = type_of(info)
    value: Any = Array(info.value) if isinstance(info.value, tuple) else info.value
    return message_class("ParameterValue")(type=kind, **{_FIELDS[kind]: value})


def types_of(infos: Iterable[ParameterInfo]) -> Array[Any]:
    """Return the types of parameters, as a response has them."""
    return Array([type_of(each) for each in infos])


def from_ros(info: ParameterInfo, value: Any) -> Plain:
    """Return a ParameterValue for a parameter. Raises ParameterError for one of another type; an integer is a double,
    too, as in r2p.
    """
    kind, given = type_of(info), value.type
    if given >= len(TYPE_NAMES):
        raise ParameterError(f"it takes {TYPE_NAMES[kind]}, and {given} is not the number of a type")
    if given == NOT_SET:
        raise ParameterError("it can't be deleted: r2p param reset gives it the value of its start")
    if (kind, given) not in ((DOUBLE, INTEGER), (DOUBLES, INTEGERS)) and kind != given:
        raise ParameterError(f"it takes {TYPE_NAMES[kind]}, not {TYPE_NAMES[given]}")
    plain: Plain = getattr(value, _FIELDS[given])
    return plain if isinstance(plain, bool | int | float | str) else tuple(plain)


# Descriptions


def descriptor(name: str, info: ParameterInfo) -> Any:
    """Return the ParameterDescriptor of a parameter that has this name there."""
    kind = type_of(info)
    ranges: dict[str, Any] = {}
    if info.minimum is not None or info.maximum is not None:
        if kind == INTEGER:
            ranges["integer_range"] = (_range("IntegerRange", info, -_INT_MAX - 1, _INT_MAX),)
        elif kind == DOUBLE:
            most = sys.float_info.max
            ranges["floating_point_range"] = (_range("FloatingPointRange", info, -most, most),)
    return message_class("ParameterDescriptor")(
        name=name,
        type=kind,
        description=f"{info.doc} [{info.unit}]".lstrip() if info.unit else info.doc,
        additional_constraints=_constraints(info),
        read_only=info.read_only,
        **ranges,
    )


def _range(name: str, info: ParameterInfo, least: float, most: float) -> Any:
    low = least if info.minimum is None else info.minimum
    return message_class(name)(from_value=low, to_value=most if info.maximum is None else info.maximum)


def _constraints(info: ParameterInfo) -> str:
    """Return in words what a descriptor has no fields for."""
    if info.choices:
        return f"one of {', '.join(info.choices)}"
    if not isinstance(info.value, tuple):
        return ""
    limits = (("at least", info.minimum), ("at most", info.maximum))
    texts = [f"{len(info.value)} numbers", *(f"{text} {limit!r}" for text, limit in limits if limit is not None)]
    return ", ".join(texts)


def listed(names: Iterable[str], prefixes: Iterable[str], depth: int) -> tuple[list[str], list[str]]:
    """Return the names that `list_parameters` finds, and what they have before their last dots.

    A name is found below each of the prefixes, or below none if there are none, with fewer than `depth` dots behind the
    prefix; 0: any number.
    """
    given = list(prefixes)
    found = [name for name in names if not given and _is_within(name, depth)]
    if given:
        found = [name for name in names if any(_is_below(name, prefix, depth) for prefix in given)]
    parents = dict.fromkeys(name.rpartition(".")[0] for name in found if "." in name)
    return found, list(parents)


def _is_below(name: str, prefix: str, depth: int) -> bool:
    return name == prefix or (name.startswith(f"{prefix}.") and _is_within(name[len(prefix) + 1 :], depth))


def _is_within(name: str, depth: int) -> bool:
    return not depth or name.count(".") < depth


def event(node: str, stamp: Any, new: Any, changed: Any, deleted: Any) -> bytes:
    """Return the message about changed parameters of a node, each a mapping of name -> `ParameterInfo`."""
    return cdr(message_class("ParameterEvent")).encode(
        message_class("ParameterEvent")(
            stamp=stamp,
            node=node,
            new_parameters=_parameters(new),
            changed_parameters=_parameters(changed),
            deleted_parameters=tuple(message_class("Parameter")(name=name) for name in deleted),
        )
    )


def _parameters(infos: Mapping[str, ParameterInfo]) -> tuple[Any, ...]:
    return tuple(message_class("Parameter")(name=name, value=to_ros(info)) for name, info in infos.items())
