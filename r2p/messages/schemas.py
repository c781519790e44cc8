"""Message classes built from their schema, for tools that find a topic whose type they don't have.

A schema lists the leaves of a message in wire order, each with its path: "stamp.sec:u32 stamp.nsec:u32 wheels[0]:f32".
An array of variable length has the leaves of one element, with empty brackets: "points[].x:f32", "ranges:f32[]".
`_SchemaReader` turns this list back into the tree: leaves that share the first part of their path are one field, and
the rest of their paths describes the field in the same way. An array is built from its first element alone.

A schema comes from the network, so it may be anything: different elements, fields in pieces, a leaf twice. None of this
is checked on the way, where only size and depth are limited. Instead `message_type` compares the schema of the new
class with the given one, which finds any error.
"""

import keyword
import re
from typing import Annotated, Any, TypeAlias, cast

from r2p.errors import MessageError
from r2p.messages.array import Array
from r2p.messages.definition import MessageMeta
from r2p.messages.layouts import Duration, Message, Timestamp, check_field_name, layout
from r2p.messages.shapes import HINTS, SIZE_MAX, Len, Max, is_reserved, show

SCHEMA_MAX = 32_768
"""Characters of the longest schema that is read."""

_DEPTH_MAX = 16  # parts of a path
_CLASSES_MAX = 64  # different nested messages, without Timestamp and Duration

_Leaf: TypeAlias = tuple[tuple[str, ...], str]  # ("wheels", "[0]", ".speed"), "f32"

_CLASS_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]{0,63}")
_PART = re.compile(r"\.?[A-Za-z0-9_]+|\[[0-9]{0,4}\]")
_KIND = re.compile(r"([a-z0-9]{1,8})(?:\[([0-9]{0,4})\])?")
_FIXED_MAX = 65_536  # elements of all arrays of fixed length: a message of zeros is made of each new layout


def message_type(name: str, schema: str) -> type[Message]:
    """Build a message class from its schema ("led:u32 value:u8").

    All fields are required. A nested message of `sec:u32 nsec:u32` becomes a Timestamp, one of `sec:i32 nsec:i32` a
    Duration; other ones get made-up names. Arrays of numbers of variable length become `r2p.Array`. A schema has no
    bounds for what varies, so everything is accepted, up to `SIZE_MAX` bytes. `name` may be a full name
    ("sensor_msgs/LaserScan"); the class has its last part.

    Raises MessageError for a text that is not exactly the schema of a message class, or longer than `SCHEMA_MAX`.
    """
    full, name = name if "/" in name else "", name.rpartition("/")[2]
    if not _CLASS_NAME.fullmatch(name) or keyword.iskeyword(name):
        raise MessageError(f"{show(name)} is not a valid name of a message class")
    if len(schema) > SCHEMA_MAX:
        raise MessageError(f"the schema of {name} has {len(schema)} characters, more than {SCHEMA_MAX}")
    if sum(int(count or 0) for count in re.findall(r":[a-z0-9]+\[([0-9]{1,4})\]", schema)) > _FIXED_MAX:
        raise MessageError(f"the arrays of {name} have more than {_FIXED_MAX} elements")
    cls = _SchemaReader().message(name, tuple(_leaf(text) for text in schema.split(" ") if schema), full)
    if layout(cls).schema != schema:
        raise MessageError(f"{show(schema)} is not the schema of a message class")
    return cls


def _leaf(text: str) -> _Leaf:
    path, _, kind = text.partition(":")
    parts = tuple(_PART.findall(path))
    if len(parts) > _DEPTH_MAX:
        raise MessageError(f"{show(text)}: nested deeper than {_DEPTH_MAX}")
    return parts, kind


class _SchemaReader:
    """Groups leaves by the first part of their path, and each group by the next part."""

    def __init__(self) -> None:
        self._nested: dict[tuple[_Leaf, ...], type[Message]] = {
            (((".sec",), "u32"), ((".nsec",), "u32")): Timestamp,
            (((".sec",), "i32"), ((".nsec",), "i32")): Duration,
        }
        self._known = len(self._nested)
        """The class of each nested message, by its leaves: equal ones share one."""

    def message(self, name: str, leaves: tuple[_Leaf, ...], full_name: str = "") -> type[Message]:
        """Make the class of a message that has these leaves."""
        fields: dict[str, list[_Leaf]] = {}
        for parts, kind in leaves:
            head = "".join(parts[:1]).removeprefix(".")
            fields.setdefault(head, []).append((parts[1:], kind))
        for field in fields:
            check_field_name(f"{name}.{show(field)}", f"{field}_" if is_reserved(field) else field)
        hints = {
            f"{field}_" if is_reserved(field) else field: self._field_type(f"{name}_{field}", tuple(inner))
            for field, inner in fields.items()
        }
        namespace = {"__annotations__": hints, "__module__": __name__}  # not by defstruct, which knows no metaclass
        return cast("type[Message]", MessageMeta(name, (Message,), namespace, name=full_name))

    def _field_type(self, name: str, leaves: tuple[_Leaf, ...]) -> Any:
        """Return the annotation of a field with these leaves; `name` is for its class, if it is a message."""
        parts, kind = leaves[0]
        if not parts:
            return _leaf_type(kind)
        if not parts[0].startswith("["):
            return self._nested_class(name, leaves)
        # An array: `[0]` says what its elements are, and as many follow as there are different indices; `[]` says it
        # for any number. Whether the others are like it, and in order, shows when the schemas are compared.
        first = tuple((rest[1:], kind) for rest, kind in leaves if rest[:1] == parts[:1])
        count = len({rest[:1] for rest, _ in leaves})
        return _array(self._field_type(name, first), Max(SIZE_MAX) if parts[0] == "[]" else Len(count))

    def _nested_class(self, name: str, leaves: tuple[_Leaf, ...]) -> type[Message]:
        if leaves not in self._nested:
            if len(self._nested) - self._known >= _CLASSES_MAX:
                raise MessageError(f"more than {_CLASSES_MAX} different messages in one")
            self._nested[leaves] = self.message(name, leaves)
        return self._nested[leaves]


def _leaf_type(kind: str) -> Any:
    """Return the annotation of a leaf of this kind, such as `u32`, `str`, `char[8]`, `f32[3]` or `f32[]`."""
    found = _KIND.fullmatch(kind)
    base, count = found.groups() if found else ("", None)
    if base == "char" and count:
        return Annotated[str, Len(int(count))]
    if kind == "str":
        return Annotated[str, Max(SIZE_MAX)]
    if base not in HINTS:
        raise MessageError(f"{show(kind)} is not a kind of field")
    if count == "":
        numbers: Any = Array  # a class with a parameter from a table is not an annotation for type checkers
        return Annotated[numbers[HINTS[base]], Max(SIZE_MAX)]
    return HINTS[base] if count is None else _array(HINTS[base], Len(int(count)))


def _array(item: Any, bound: Len | Max) -> Any:
    return Annotated[tuple.__class_getitem__((item, ...)), bound]
