"""Message classes of ROS types, and the definitions of r2p's own classes.

    RosTypes(1, definitions).load("sensor_msgs/Imu")     the class of a type; its bytes are those of ROS 1
    definitions_of(Led, 2)                               the definitions that ROS 2 needs of a class

A type that is in `r2p.msg` with the same fields is that class. In others, arrays of numbers of any length are
`r2p.Array`, octets of fixed length are bytes, and every bound that ROS does not have is as large as messages may be.
"""

import functools
from collections.abc import Mapping
from typing import Annotated, Any, cast

import r2p.msg
from r2p.errors import MessageError
from r2p.messages import Array, Duration, Layout, Len, Max, Message, Timestamp, layout
from r2p.messages.definition import MessageMeta
from r2p.messages.shapes import (
    HINTS,
    SIZE_MAX,
    Chars,
    FixedArray,
    Nested,
    Scalar,
    Shape,
    VariableArray,
    VariableText,
    is_reserved,
)
from r2p.ros.cdr import WIDE
from r2p.ros.definitions import (
    Definitions,
    FieldDefinition,
    FieldType,
    MessageDefinition,
    find,
    plain_text,
)

_KINDS = {
    "bool": "bool",
    "char": "u8",
    **{f"{sign}{bits}": f"{kind}{bits}" for bits in (8, 16, 32, 64) for sign, kind in (("int", "i"), ("uint", "u"))},
    "float32": "f32",
    "float64": "f64",
}
_ROS_KINDS = {kind: name for name, kind in _KINDS.items() if name != "char"}
TIMES: dict[str, type[Message]] = {
    "time": Timestamp,
    "duration": Duration,
    "builtin_interfaces/Time": Timestamp,
    "builtin_interfaces/Duration": Duration,
}
_TIME_NAMES: dict[int, dict[type[Message], str]] = {
    1: {Timestamp: "time", Duration: "duration"},
    2: {Timestamp: "builtin_interfaces/Time", Duration: "builtin_interfaces/Duration"},
}
HEADER = "std_msgs/Header"

_DEPTH_MAX = 32  # types in one another
_FIELDS_MAX = 4096  # of a type, with those of all types in it; the largest of ROS have some hundred
_VALUES_MAX = 1 << 20  # the same, each element of an array of fixed length counted


@functools.cache
def standard_classes() -> dict[str, type[Message]]:
    """Return the classes of r2p.msg by their full names."""
    classes = [each for each in vars(r2p.msg).values() if isinstance(each, type) and Message in each.__bases__]
    return {layout(cls).name: cls for cls in classes}


class RosTypes:
    """Makes the classes of types of ROS 1 or 2 (`version`) from their definitions, each once.

    All fields have defaults, as in ROS: zero, or empty. `known` are classes that are taken where they have the fields
    of the type with their name; by default those of r2p.msg.
    """

    def __init__(
        self, version: int, definitions: Definitions, known: Mapping[str, type[Message]] | None = None
    ) -> None:
        self._byte = "i8" if version == 1 else "u8"
        self._definitions = definitions
        self._known = standard_classes() if known is None else known
        self._classes: dict[str, type[Message]] = {}
        self._extents: dict[str, tuple[int, int]] = {}

    def load(self, name: str, outer: tuple[str, ...] = ()) -> type[Message]:
        """Return the class of a type (`package/Name`), which is nested in the types `outer`.

        Raises MessageError for a type whose definition is missing, that r2p has no class for, or that is far larger
        than any of ROS: a definition of a few lines may mean 10 GB.
        """
        if name in TIMES:
            return TIMES[name]
        if name == HEADER:  # that of ROS 2 has a field less
            return self._known.get(name, r2p.msg.Header)
        if name not in self._classes:
            self._extent(name, outer)
            self._classes[name] = self._make(find(name, self._definitions, outer), outer)
        return self._classes[name]

    def _extent(self, name: str, outer: tuple[str, ...]) -> tuple[int, int]:
        """Return the numbers of fields and of values that a type has. Raises MessageError if these are too many."""
        if name in TIMES or name == HEADER:
            return 1, 1
        if name not in self._extents:
            if len(outer) > _DEPTH_MAX:
                raise MessageError(f"{outer[0]} has more than {_DEPTH_MAX} types in one another, down to {name}")
            fields = values = 0
            for field in find(name, self._definitions, outer).fields:
                kind = field.type
                inner = (1, 1) if kind.is_builtin else self._extent(kind.base, (*outer, name))
                fields += inner[0]
                values += inner[1] * (kind.count or 1 if kind.has_fixed_count else 1)
            for count, most, what in ((fields, _FIELDS_MAX, "fields"), (values, _VALUES_MAX, "values")):
                if count > most:
                    raise MessageError(f"{name} has {count} {what} with all types in it, more than {most}")
            self._extents[name] = fields, values
        return self._extents[name]

    def _make(self, definition: MessageDefinition, outer: tuple[str, ...]) -> type[Message]:
        hints: dict[str, Any] = {}
        members: dict[str, Any] = {"__annotations__": hints, "__module__": __name__}
        for field in definition.fields:
            name = f"{field.name}_" if is_reserved(field.name) else field.name
            if name in hints:
                raise MessageError(f"{definition.name}: a class can't have both fields {name.rstrip('_')} and {name}")
            hints[name], members[name] = self._field(field.type, (*outer, definition.name))
        name = definition.name.rpartition("/")[2]
        made = cast("type[Message]", MessageMeta(name, (Message,), members, name=definition.name))
        known = self._known.get(definition.name)
        return known if known is not None and layout(known).schema == layout(made).schema else made

    def _field(self, kind: FieldType, outer: tuple[str, ...]) -> tuple[Any, Any]:
        """Return the annotation of a field, and its default."""
        item, default = self._item(kind, outer)
        if kind.count is None:
            return item, default
        is_number = kind.base == "byte" or kind.base in _KINDS
        if not kind.has_fixed_count:
            bound = Max(kind.count or SIZE_MAX)
            numbers: Any = Array  # a class with a parameter from a table is not an annotation for type checkers
            return (Annotated[numbers[item], bound], Array()) if is_number else (_tuple(item, bound), ())
        if item == HINTS["u8"]:
            return Annotated[bytes, Len(kind.count)], bytes(kind.count)
        return _tuple(item, Len(kind.count)), (default,) * kind.count

    def _item(self, kind: FieldType, outer: tuple[str, ...]) -> tuple[Any, Any]:
        """Return the annotation and the default of one element."""
        if kind.base in ("string", "wstring"):
            text: Any = Annotated[str, Max(kind.text_max or SIZE_MAX)]
            return (Annotated[text, WIDE] if kind.base == "wstring" else text), ""
        scalar = self._byte if kind.base == "byte" else _KINDS.get(kind.base)
        if scalar is not None:
            return HINTS[scalar], False if scalar == "bool" else 0.0 if scalar.startswith("f") else 0
        cls = self.load(kind.base, outer)
        return cls, cls()


def _tuple(item: Any, bound: Len | Max) -> Any:
    return Annotated[tuple.__class_getitem__((item, ...)), bound]


def definitions_of(cls: type[Message], version: int) -> dict[str, MessageDefinition]:
    """Return the definition of a message class for ROS 1 or 2 (`version`), and then those of all messages in it.

    Raises MessageError for a class that ROS can't define: one with an array of arrays, or with two types of one name.
    """
    found: dict[str, MessageDefinition] = {}
    schemas: dict[str, str] = {}

    def visit(shape: Shape) -> None:
        match shape:
            case Nested(inner) if inner.cls not in _TIME_NAMES[version] and inner.name not in found:
                found[inner.name], schemas[inner.name] = _definition(inner, version), inner.schema
                for field in inner.fields:
                    visit(field.shape)
            case Nested(inner) if schemas.get(inner.name, inner.schema) != inner.schema:
                raise MessageError(f"{layout(cls).name} has two types in it that are named {inner.name}: rename one")
            case FixedArray(item) | VariableArray(item):
                visit(item)
            case _:
                pass

    visit(Nested(layout(cls)))
    return found


def _definition(shape: Layout[Any], version: int) -> MessageDefinition:
    fields = [
        FieldDefinition(field.wire_name, _field_type(f"{shape.name}.{field.wire_name}", field.shape, version))
        for field in shape.fields
        if (version, shape.name, field.name) != (2, HEADER, "seq")
    ]
    definition = MessageDefinition(shape.name, tuple(fields))
    return MessageDefinition(shape.name, tuple(fields), text=plain_text(definition))


def _field_type(path: str, shape: Shape, version: int) -> FieldType:
    match shape:
        case Scalar(kind):
            return FieldType(_ROS_KINDS[kind])
        case VariableText():
            return FieldType("string")
        case Chars(length):
            return FieldType("uint8", count=length)
        case Nested(inner):
            return FieldType(_TIME_NAMES[version].get(inner.cls, inner.name))
        case FixedArray(item) | VariableArray(item):
            element = _field_type(path, item, version)
            if element.count is not None:
                raise MessageError(f"{path}: ROS has no arrays of arrays: nest a message with the inner one")
            return FieldType(element.base, count=shape.count if isinstance(shape, FixedArray) else 0)
