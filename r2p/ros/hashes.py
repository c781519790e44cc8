"""The hashes of types in ROS 2, RIHS01: the SHA-256 of a description of the type, and of all types in it, in JSON.

Names are those of ROS 2 here, `package/msg/Name`. The parts of services and actions are messages with names of their
own, `package/srv/Name_Request`, with some fields that ROS 2 adds.
"""

import hashlib
import json
from typing import Any

from r2p.errors import MessageError
from r2p.ros.definitions import Definitions, FieldDefinition, FieldType, parse
from r2p.ros.type_names import ros2_name

_IDS = {
    "int8": 2,
    "uint8": 3,
    "int16": 4,
    "uint16": 5,
    "int32": 6,
    "uint32": 7,
    "int64": 8,
    "uint64": 9,
    "float32": 10,
    "float64": 11,
    "char": 3,  # in .msg files it is a uint8
    "bool": 15,
    "byte": 16,
    "string": 17,
    "wstring": 18,
}
_NAMES = {number: name for name, number in _IDS.items() if name != "char"}
_NESTED = 1
_BOUNDED_TEXT = 4  # more than the id without a bound
_ARRAY, _BOUNDED_SEQUENCE, _SEQUENCE = 48, 96, 144  # more than the id of the element

_EMPTY = FieldDefinition("structure_needs_at_least_one_member", FieldType("uint8"))
"""The field of a message without any."""
_OF_ROS1 = {"time": "builtin_interfaces/Time", "duration": "builtin_interfaces/Duration"}

_TIME = FieldType("builtin_interfaces/Time")
_GOAL_ID = FieldDefinition("goal_id", FieldType("unique_identifier_msgs/UUID"))
_KNOWN = {
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec",
    "builtin_interfaces/Duration": "int32 sec\nuint32 nanosec",
    "unique_identifier_msgs/UUID": "uint8[16] uuid",
    "service_msgs/ServiceEventInfo": (
        "uint8 event_type\nbuiltin_interfaces/Time stamp\nchar[16] client_gid\nint64 sequence_number"
    ),
}

Fields = tuple[FieldDefinition, ...]


class TypeDescriptions:
    """The fields of types of ROS 2 as they are on the wire, by full name, and the hashes of these types."""

    def __init__(self, definitions: Definitions) -> None:
        self._fields: dict[str, Fields] = {}
        for name, text in _KNOWN.items():
            self.add(name, parse(name, text)[name].fields)
        for definition in definitions.values():
            self.add(definition.name, definition.fields)

    def add(self, name: str, fields: Fields) -> None:
        """Add a type: a message if its name is `package/Name`."""
        self._fields[ros2_name(name)] = fields or (_EMPTY,)

    def add_service(self, name: str, request: Fields, response: Fields) -> None:
        """Add the four types of a service, `package/srv/Name`: itself, and what is called, answered and recorded."""
        parts = [f"{name}_{part}" for part in ("Request", "Response", "Event")]
        info = FieldDefinition("info", FieldType("service_msgs/ServiceEventInfo"))
        recorded = [
            FieldDefinition(field, FieldType(part, count=1, bounded=True))
            for field, part in zip(("request", "response"), parts, strict=False)
        ]
        for part, fields in zip(parts, (request, response, (info, *recorded)), strict=True):
            self.add(part, fields)
        self.add(name, _members(request_message=parts[0], response_message=parts[1], event_message=parts[2]))

    def add_action(self, name: str, goal: Fields, result: Fields, feedback: Fields) -> None:
        """Add all types of an action, `package/action/Name`, with those of its two services."""
        self.add(f"{name}_Goal", goal)
        self.add(f"{name}_Result", result)
        self.add(f"{name}_Feedback", feedback)
        send, get, message = f"{name}_SendGoal", f"{name}_GetResult", f"{name}_FeedbackMessage"
        accepted = FieldDefinition("accepted", FieldType("bool")), FieldDefinition("stamp", _TIME)
        self.add_service(send, (_GOAL_ID, *_members(goal=f"{name}_Goal")), accepted)
        status = FieldDefinition("status", FieldType("int8"))
        self.add_service(get, (_GOAL_ID,), (status, *_members(result=f"{name}_Result")))
        self.add(message, (_GOAL_ID, *_members(feedback=f"{name}_Feedback")))
        parts = _members(goal=f"{name}_Goal", result=f"{name}_Result", feedback=f"{name}_Feedback")
        services = _members(send_goal_service=send, get_result_service=get, feedback_message=message)
        self.add(name, (*parts, *services))

    def hash(self, name: str) -> str:
        """Return the hash of a type, "RIHS01_" and 64 hexadecimal digits. Raises MessageError for a missing type."""
        return f"RIHS01_{hashlib.sha256(json.dumps(self.description(name)).encode()).hexdigest()}"

    def description(self, name: str) -> dict[str, Any]:
        """Return the description of a type, and of all types in it, whose JSON the hash is made of.

        Raises MessageError for a missing type.
        """
        name = ros2_name(name)
        nested: set[str] = set()
        self._collect(name, (), nested)
        return {
            "type_description": self._describe(name),
            "referenced_type_descriptions": [self._describe(each) for each in sorted(nested)],
        }

    def _collect(self, name: str, outer: tuple[str, ...], nested: set[str]) -> None:
        """Add the names of all types in a type."""
        if name in outer:
            raise MessageError(f"{name} contains itself")
        if name not in self._fields:
            where = f", which is in {outer[-1]}" if outer else ""
            raise MessageError(f"the definition of {name} is missing{where}")
        for field in self._fields[name]:
            inner = _nested_name(field.type)
            if inner:
                if inner not in nested:
                    self._collect(inner, (*outer, name), nested)
                nested.add(inner)

    def _describe(self, name: str) -> dict[str, Any]:
        fields = [{"name": field.name, "type": _describe_type(field.type)} for field in self._fields[name]]
        return {"type_name": name, "fields": fields}


def service_hash(name: str, request: Fields, response: Fields, definitions: Definitions) -> str:
    """Return the hash of a service with these fields; `definitions` has those of the types in it."""
    types, name = TypeDescriptions(definitions), ros2_name(name, "srv")
    types.add_service(name, request, response)
    return types.hash(name)


def _members(**types: str) -> Fields:
    return tuple(FieldDefinition(name, FieldType(base)) for name, base in types.items())


def _nested_name(kind: FieldType) -> str:
    """Return the full name of the type of a field; empty for a builtin one."""
    base = _OF_ROS1.get(kind.base, kind.base)
    return ros2_name(base) if "/" in base else ""


def _describe_type(kind: FieldType) -> dict[str, Any]:
    nested = _nested_name(kind)
    number = _NESTED if nested else _IDS[kind.base] + _BOUNDED_TEXT * bool(kind.text_max)
    if kind.count is not None:
        number += _BOUNDED_SEQUENCE if kind.bounded else _ARRAY if kind.count else _SEQUENCE
    return {
        "type_id": number,
        "capacity": kind.count or 0,
        "string_capacity": kind.text_max,
        "nested_type_name": nested,
    }


def field_type(number: int, capacity: int, text_max: int, nested: str) -> FieldType:
    """Return the type of a field of these parts of a description. Raises MessageError if r2p has none such."""
    element, kind = number % _ARRAY, number - number % _ARRAY
    bounded_text = element - _BOUNDED_TEXT in (_IDS["string"], _IDS["wstring"])
    base = _NAMES.get(element - _BOUNDED_TEXT if bounded_text else element, nested if element == _NESTED else "")
    if not base or kind not in (0, _ARRAY, _BOUNDED_SEQUENCE, _SEQUENCE):
        raise MessageError(f"type {number} of a field is not known here")
    count = None if not kind else 0 if kind == _SEQUENCE else capacity
    return FieldType(base, text_max if bounded_text else 0, count, kind == _BOUNDED_SEQUENCE)
