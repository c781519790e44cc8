"""Python source of message classes: what `r2p msg import` prints.

The classes have the fields, defaults and constants of their definitions. A bound that the definition does not have is
the caller's, as r2p needs one for what varies.
"""

import keyword
import math
import re
from collections.abc import Callable, Iterable, Iterator
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
_USED = frozenset({"r2p", "Annotated", "ClassVar", "bool", "bytes", "float", "int", "str", "tuple"})
"""Names that the source uses."""


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
        self._builtins: set[str] = set()
        self._typing: set[str] = set()
        self._standard: set[str] = set()
        self._imports = ["import r2p"]
        self._class_names: dict[str, str] = {}
        """The names in Python of classes, by the full names of their types."""
        self._members: frozenset[str] = frozenset()
        """The names of the fields and constants of the class that is being written."""

    def text(self) -> str:
        """Return the whole source."""
        lines = [f"from builtins import {', '.join(sorted(self._builtins))}"] if self._builtins else []
        lines += [f"from typing import {', '.join(sorted(self._typing))}"] if self._typing else []
        lines += [""] * bool(lines) + self._imports
        if self._standard:
            lines.append(f"from r2p.msg import {', '.join(sorted(self._standard))}")
        return "\n".join(lines) + "".join(f"\n\n\n{each}" for each in self._classes.values()) + "\n"

    def add(self, shape: Layout[Any]) -> None:
        """Write a class, after those that it needs."""
        if shape.name in self._classes or self._is_standard(shape):
            return
        name = self._class_name(shape.name)
        self._classes[shape.name] = self._class(shape, name)

    def _class_name(self, full_name: str) -> str:
        """Return the name in Python of a type: without its package, unless another one, or Python, has that name."""
        known = self._class_names.get(full_name)
        if known is None:
            package, _, known = full_name.partition("/")
            if keyword.iskeyword(known) or known in _USED or known in self._class_names.values():
                known = f"{package}_{known}"
            self._class_names[full_name] = known
        return known

    def _class(self, shape: Layout[Any], name: str) -> str:
        """Return the source of a class, after those that it needs are written."""
        definition = self._definitions.get(shape.name, MessageDefinition(shape.name, ()))
        outer = self._members
        self._members = frozenset(
            [*(each.name for each in shape.fields), *(each.name for each in definition.constants)]
        )
        fields = [self._field(field) for field in shape.fields]
        constants = [self._constant(each) for each in definition.constants]
        self._members = outer
        lines = [f'class {name}(r2p.Message, name="{shape.name}"):']
        lines += [f'    """{_summary(definition)}"""', ""]
        lines += [f"    {each}" for each in [*constants, *fields]]
        return "\n".join(lines).rstrip()

    def add_parts(self, base: str, parts: tuple[str, ...], shapes: list[Layout[Any]]) -> None:
        """Write the class of a service or action, with the classes of its parts nested in it."""
        name = shapes[0].name.removesuffix(parts[0]).removesuffix("_")
        lines = [f'class {self._class_name(name)}({base}, name="{name}"):', f'    """{name} of ROS."""']
        for part, shape in zip(parts, shapes, strict=True):
            text = self._class(shape, part).replace(f'"""{shape.name} of ROS."""', f'"""The {part.lower()}."""')
            body = text.split("\n")[1:]
            lines += ["", f"    class {part}(r2p.Message):", *(f"    {line}".rstrip() for line in body)]
        if base.startswith("r2p.ros"):
            self._imports.append("import r2p.ros")
        self._classes[name] = "\n".join(lines)

    def _is_standard(self, shape: Layout[Any]) -> bool:
        """Return whether r2p has a class, after importing it."""
        cls = shape.cls
        if cls in TIMES.values():
            return True
        if vars(r2p.msg).get(cls.__name__) is cls:
            self._standard.add(_as(cls.__name__, self._class_name(shape.name)))
            return True
        return False

    # Names that a field or a constant of the class hides have another one in it

    def _visible(self, name: str) -> str:
        """Return what a name has to be called in the class that is being written."""
        while name in self._members:
            name += "_"
        return name

    @property
    def _r2p(self) -> str:
        name = self._visible("r2p")
        if name != "r2p" and (line := f"import r2p as {name}") not in self._imports:
            self._imports.append(line)
        return name

    def _builtin(self, name: str) -> str:
        visible = self._visible(name)
        if visible != name:
            self._builtins.add(_as(name, visible))
        return visible

    def _from_typing(self, name: str) -> str:
        visible = self._visible(name)
        self._typing.add(_as(name, visible))
        return visible

    def _nested(self, inner: Layout[Any]) -> str:
        """Return the name of the class of a field, after it is written."""
        if inner.cls in TIMES.values():
            return f"{self._r2p}.{inner.cls.__name__}"
        self.add(inner)
        name = self._class_name(inner.name)
        visible = self._visible(name)
        if visible != name:
            self._classes[visible] = f"{visible} = {name}"
        return visible

    # Fields and constants

    def _field(self, field: Field) -> str:
        hint, default = self._hint(field.shape)
        return f"{field.name}: {hint} = {default}"

    def _hint(self, shape: Shape) -> tuple[str, str]:
        """Return the annotation of a field, and its default."""
        match shape:
            case Scalar("bool"):
                return self._builtin("bool"), "False"
            case Scalar(kind):
                return f"{self._r2p}.{kind}", "0.0" if kind.startswith("f") else "0"
            case Chars(length):
                return self._annotated(f"{self._builtin('str')}, {self._r2p}.Len({length})"), '""'
            case VariableText(limit):
                return self._annotated(f"{self._builtin('str')}, {self._max(limit)}"), '""'
            case Nested(inner):
                name = self._nested(inner)
                return name, f"{name}()"
            case FixedArray(item, count, container):
                hint, default = self._hint(item)
                if container == "bytes":
                    octets = self._builtin("bytes")
                    return self._annotated(f"{octets}, {self._r2p}.Len({count})"), f"{octets}({count})"
                elements = f"{self._builtin('tuple')}[{hint}, ...]"
                return self._annotated(f"{elements}, {self._r2p}.Len({count})"), f"({default},) * {count}"
            case VariableArray(item, limit, container):
                hint, _ = self._hint(item)
                array, default = f"{self._builtin('tuple')}[{hint}, ...]", "()"
                if container == "array":
                    array, default = f"{self._r2p}.Array[{hint}]", f"{self._r2p}.Array()"
                return self._annotated(f"{array}, {self._max(limit)}"), default

    def _annotated(self, inner: str) -> str:
        return f"{self._from_typing('Annotated')}[{inner}]"

    def _max(self, limit: int) -> str:
        return f"{self._r2p}.Max({f'{self._bound:_}' if limit == SIZE_MAX else limit})"

    def _constant(self, constant: ConstantDefinition) -> str:
        name = f"{constant.name}_" if is_reserved(constant.name) else constant.name
        kind = self._builtin(_constant_type(constant.type))
        value = _constant_value(constant, self._builtin)
        return f"{name}: {self._from_typing('ClassVar')}[{kind}] = {value}"


def _as(name: str, visible: str) -> str:
    """Return a name in a line that imports it, under another name or not."""
    return name if visible == name else f"{name} as {visible}"


def _constant_type(name: str) -> str:
    if name in _TEXTS:
        return "str"
    return "bool" if name == "bool" else "float" if name in _FLOATS else "int"


def _constant_value(constant: ConstantDefinition, builtin: Callable[[str], str]) -> str:
    """Return the value of a constant as Python writes it; `builtin` returns what a builtin is called there."""
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
        return repr(real) if math.isfinite(real) else f'{builtin("float")}("{real}")'
    except ValueError:
        raise MessageError(f"{constant.type} {constant.name}={show(text)}: that is not a value of this type") from None


def _summary(definition: MessageDefinition) -> str:
    """Return the first sentence of a definition's first comment, or its name."""
    comments = list(_leading_comment(definition.text))
    text = re.split(r"(?<=[.!?])\s", " ".join(comments))[0].replace('"""', "'''").replace("\\", "/")
    text = "".join(each if each.isprintable() else " " for each in text[:100])
    return f"{text.rstrip('.')}." if text.strip() else f"{definition.name} of ROS."


def _leading_comment(text: str) -> Iterator[str]:
    for line in text.splitlines():
        bare = line.strip()
        if not bare.startswith("#"):
            return
        if bare.strip("# "):
            yield bare.strip("# ")
