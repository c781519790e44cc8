"""Python source of message classes: what `r2p msg import` prints.

The classes have the fields, defaults and constants of their definitions. A bound that the definition does not have is
the caller's, as r2p needs one for what varies.
"""

import math
import re
from collections.abc import Iterable, Iterator
from typing import Any

import r2p.msg
from r2p.errors import MessageError
from r2p.messages import Layout, Message, layout
from r2p.messages.shapes import (
    SIZE_MAX,
    Chars,
    Field,
    FixedArray,
    Nested,
    Scalar,
    Shape,
    VariableArray,
    VariableText,
    is_reserved,
    show,
)
from r2p.ros.classes import TIMES
from r2p.ros.definitions import ConstantDefinition, Definitions, MessageDefinition

_TEXTS = ("string", "wstring")
_FLOATS = ("float32", "float64")


def source(classes: Iterable[type[Message]], definitions: Definitions, bound: int) -> str:
    """Return the source of message classes, with those that are nested in them and not in r2p.msg before them.

    `bound`: of texts and arrays without one, in bytes and elements.
    """
    writer = _ClassWriter(definitions, bound)
    for cls in classes:
        writer.add(layout(cls))
    return writer.text()


PARTS = {
    ".srv": ("r2p.Service", ("Request", "Response")),
    ".action": ("r2p.ros.Action", ("Goal", "Result", "Feedback")),
}
"""What the file of a service or action becomes: a class with this base, which holds the classes of the parts."""


def source_of_parts(suffix: str, classes: list[type[Message]], definitions: Definitions, bound: int) -> str:
    """Return the source of a service or action (`suffix` of its file) of the classes of its parts, as `source` does."""
    writer = _ClassWriter(definitions, bound)
    writer.add_parts(*PARTS[suffix], [layout(cls) for cls in classes])
    return writer.text()


class _ClassWriter:
    """Writes classes, each once, and collects what has to be imported for them."""

    def __init__(self, definitions: Definitions, bound: int) -> None:
        self._definitions = definitions
        self._bound = bound
        self._classes: dict[str, str] = {}
        self._typing: set[str] = set()
        self._standard: set[str] = set()
        self._imports = ["import r2p"]

    def text(self) -> str:
        """Return the whole source."""
        lines = [f"from typing import {', '.join(sorted(self._typing))}\n"] if self._typing else []
        lines += self._imports
        if self._standard:
            lines.append(f"from r2p.msg import {', '.join(sorted(self._standard))}")
        return "\n".join(lines) + "".join(f"\n\n\n{each}" for each in self._classes.values()) + "\n"

    def add(self, shape: Layout[Any]) -> None:
        """Write a class, after those that it needs."""
        if shape.name in self._classes or self._is_standard(shape.cls):
            return
        self._classes[shape.name] = self._class(shape)

    def _class(self, shape: Layout[Any]) -> str:
        """Return the source of a class, after those that it needs are written."""
        fields = [self._field(field) for field in shape.fields]
        definition = self._definitions.get(shape.name, MessageDefinition(shape.name, ()))
        constants = [self._constant(each) for each in definition.constants]
        lines = [f'class {shape.cls.__name__}(r2p.Message, name="{shape.name}"):']
        lines += [f'    """{_summary(definition)}"""', ""]
        lines += [f"    {each}" for each in [*constants, *fields]]
        return "\n".join(lines).rstrip()

    def add_parts(self, base: str, parts: tuple[str, ...], shapes: list[Layout[Any]]) -> None:
        """Write the class of a service or action, with the classes of its parts nested in it."""
        name = shapes[0].name.removesuffix(parts[0]).removesuffix("_")
        lines = [f'class {name.partition("/")[2]}({base}, name="{name}"):', f'    """{name} of ROS."""']
        for part, shape in zip(parts, shapes, strict=True):
            body = (
                self._class(shape).replace(f'"""{shape.name} of ROS."""', f'"""The {part.lower()}."""').split("\n")[1:]
            )
            lines += ["", f"    class {part}(r2p.Message):", *(f"    {line}".rstrip() for line in body)]
        if base.startswith("r2p.ros"):
            self._imports.append("import r2p.ros")
        self._classes[name] = "\n".join(lines)

    def _is_standard(self, cls: type[Message]) -> bool:
        if cls in TIMES.values():
            return True
        if vars(r2p.msg).get(cls.__name__) is cls:
            self._standard.add(cls.__name__)
            return True
        return False

    def _field(self, field: Field) -> str:
        hint, default = self._hint(field.shape)
        return f"{field.name}: {hint} = {default}"

    def _hint(self, shape: Shape) -> tuple[str, str]:
        """Return the annotation of a field, and its default."""
        match shape:
            case Scalar("bool"):
                return "bool", "False"
            case Scalar(kind):
                return f"r2p.{kind}", "0.0" if kind.startswith("f") else "0"
            case Chars(length):
                return self._annotated(f"str, r2p.Len({length})"), '""'
            case VariableText(limit):
                return self._annotated(f"str, {self._max(limit)}"), '""'
            case Nested(inner):
                self.add(inner)
                prefix = "r2p." if inner.cls in TIMES.values() else ""
                return f"{prefix}{inner.cls.__name__}", f"{prefix}{inner.cls.__name__}()"
            case FixedArray(item, count, container):
                hint, default = self._hint(item)
                if container == "bytes":
                    return self._annotated(f"bytes, r2p.Len({count})"), f"bytes({count})"
                return self._annotated(f"tuple[{hint}, ...], r2p.Len({count})"), f"({default},) * {count}"
            case VariableArray(item, limit, container):
                hint, _ = self._hint(item)
                array, default = ("r2p.Array[{}]", "r2p.Array()") if container == "array" else ("tuple[{}, ...]", "()")
                return self._annotated(f"{array.format(hint)}, {self._max(limit)}"), default

    def _annotated(self, inner: str) -> str:
        self._typing.add("Annotated")
        return f"Annotated[{inner}]"

    def _max(self, limit: int) -> str:
        return f"r2p.Max({f'{self._bound:_}' if limit == SIZE_MAX else limit})"

    def _constant(self, constant: ConstantDefinition) -> str:
        self._typing.add("ClassVar")
        name = f"{constant.name}_" if is_reserved(constant.name) else constant.name
        return f"{name}: ClassVar[{_constant_type(constant.type)}] = {_constant_value(constant)}"


def _constant_type(name: str) -> str:
    if name in _TEXTS:
        return "str"
    return "bool" if name == "bool" else "float" if name in _FLOATS else "int"


def _constant_value(constant: ConstantDefinition) -> str:
    """Return the value of a constant as Python writes it."""
    text = constant.value
    if constant.type in _TEXTS:
        is_quoted = len(text) > 1 and text[0] == text[-1] and text[0] in "\"'"
        return repr(text[1:-1] if is_quoted else text)
    if constant.type == "bool":
        return str(text.lower() in ("true", "1"))
    try:
        if constant.type not in _FLOATS:
            number = int(text, 0)
            return text.lstrip("+") if text.isascii() else str(number)
        real = float(text)
        return repr(real) if math.isfinite(real) else f'float("{real}")'
    except ValueError:
        raise MessageError(f"{constant.type} {constant.name}={show(text)}: that is not a value of this type") from None


def _summary(definition: MessageDefinition) -> str:
    """Return the first sentence of a definition's first comment, or its name."""
    comments = list(_leading_comment(definition.text))
    text = re.split(r"(?<=[.!?])\s", " ".join(comments))[0].replace('"""', "'''").replace("\\", "/")
    return f"{text[:100].rstrip('.')}." if text.strip() else f"{definition.name} of ROS."


def _leading_comment(text: str) -> Iterator[str]:
    for line in text.splitlines():
        bare = line.strip()
        if not bare.startswith("#"):
            return
        if bare.strip("# "):
            yield bare.strip("# ")
