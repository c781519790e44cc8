"""Definitions of ROS types: the texts of .msg, .srv and .action files, and what ROS 1 computes from them.

    parse           the text of one message, with those of nested messages behind it as they travel in ROS 1
    parse_service   request, `---`, response
    parse_action    goal, `---`, result, `---`, feedback
    md5, definition_text    what the two ends of a connection of ROS 1 compare and send

Names of types are `package/Name` here, as in ROS 1.
"""

import hashlib
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping

import msgspec

from r2p.errors import MessageError
from r2p.messages.shapes import show
from r2p.ros.type_names import NAME, short_name

SEPARATOR = "=" * 80
"""The line between a definition and those of nested types."""

TEXT_MAX = 1 << 20
"""Characters of the longest definition that is read, with everything nested."""

_INTEGERS = [f"{sign}{bits}" for bits in (8, 16, 32, 64) for sign in ("int", "uint")]

BUILTIN = frozenset(
    ["bool", "byte", "char", *_INTEGERS, "float32", "float64", "string", "wstring", "time", "duration"],
)
"""Types that need no definition. `time` and `duration` are of ROS 1 only, `wstring` of ROS 2."""

_TYPE = re.compile(
    r"(?P<base>[A-Za-z][A-Za-z0-9_]*(?:/(?:msg/)?[A-Za-z][A-Za-z0-9_]*)?)(?:<=(?P<text>[0-9]{1,9}))?"
    r"(?:\[(?P<bound><=)?(?P<count>[0-9]{0,9})\])?"
)
_NESTED_MAX = 512  # types in one definition


class FieldType(msgspec.Struct, frozen=True):
    """The type of a field: `base`, a builtin or `package/Name`, in an array or not.

    An array has `count` elements, or at most so many if it is `bounded`; None: no array, 0: any number of elements.
    `text_max` is the bound of a text, in characters; 0: none.
    """

    base: str
    text_max: int = 0
    count: int | None = None
    bounded: bool = False

    @property
    def is_builtin(self) -> bool:
        return self.base in BUILTIN

    @property
    def has_fixed_count(self) -> bool:
        return bool(self.count) and not self.bounded

    @property
    def text(self) -> str:
        """The type as in a file."""
        text = f"{self.base}<={self.text_max}" if self.text_max else self.base
        if self.count is None:
            return text
        return f"{text}[{'<=' * self.bounded}{self.count or ''}]"


class FieldDefinition(msgspec.Struct, frozen=True):
    """A field; `default` is the text of its default value in ROS 2."""

    name: str
    type: FieldType
    default: str = ""


class ConstantDefinition(msgspec.Struct, frozen=True):
    """A constant; `value` is as in the file."""

    name: str
    type: str
    value: str


class MessageDefinition(msgspec.Struct, frozen=True):
    """The definition of one message. `text` is that of its file, with comments."""

    name: str
    fields: tuple[FieldDefinition, ...]
    constants: tuple[ConstantDefinition, ...] = ()
    text: str = ""

    @property
    def nested(self) -> tuple[str, ...]:
        """The names of the types in it, in the order of the fields."""
        return tuple(dict.fromkeys(field.type.base for field in self.fields if not field.type.is_builtin))


Definitions = Mapping[str, MessageDefinition]
"""Definitions by name: at least those that a message needs."""


def parse(name: str, text: str) -> dict[str, MessageDefinition]:
    """Return the definitions in a text: that of the type `name` first, then those of nested types that follow it.

    Raises MessageError, which names the type and the line, for a text that is not a definition.
    """
    name = short_name(name)
    _check_length(name, text)
    first, *rest = re.split(rf"^={{{len(SEPARATOR)}}}[ \t]*\n", text, flags=re.MULTILINE)
    if len(rest) > _NESTED_MAX:
        raise MessageError(f"the definition of {name} has {len(rest)} nested types, more than {_NESTED_MAX}")
    found = {name: _parse_one(name, first.removesuffix("\n") if rest else first)}
    for number, part in enumerate(rest, 1):
        title, _, body = part.partition("\n")
        if not title.startswith("MSG: "):
            raise MessageError(f"{name}: {show(title)} is not the title of a nested type, as in MSG: std_msgs/Header")
        nested = short_name(title.removeprefix("MSG: ").strip())
        found[nested] = _parse_one(nested, body.removesuffix("\n") if number < len(rest) else body)
    return found


def parse_service(name: str, text: str) -> tuple[MessageDefinition, MessageDefinition]:
    """Return request and response of a service. Raises MessageError."""
    request, response = _parts(name, text, ["Request", "Response"], "_" if "/srv/" in name else "")
    return request, response


def parse_action(name: str, text: str) -> tuple[MessageDefinition, MessageDefinition, MessageDefinition]:
    """Return goal, result and feedback of an action. Raises MessageError."""
    goal, result, feedback = _parts(name, text, ["Goal", "Result", "Feedback"], "_" if "/action/" in name else "")
    return goal, result, feedback


def _parts(name: str, text: str, kinds: list[str], joint: str) -> Iterator[MessageDefinition]:
    _check_length(name, text)
    parts = re.split(r"^---[ \t]*$\n?", text, flags=re.MULTILINE)
    if len(parts) != len(kinds):
        raise MessageError(f"{name} has {len(parts) - 1} lines of ---, not {len(kinds) - 1}")
    return (_parse_one(f"{short_name(name)}{joint}{kind}", part) for kind, part in zip(kinds, parts, strict=True))


def _check_length(name: str, text: str) -> None:
    if len(text) > TEXT_MAX:
        raise MessageError(f"the definition of {name} has {len(text)} characters, more than {TEXT_MAX}")


def _parse_one(name: str, text: str) -> MessageDefinition:
    fields: list[FieldDefinition] = []
    constants: list[ConstantDefinition] = []
    package = name.partition("/")[0]
    for number, line in enumerate(text.splitlines(), 1):
        bare = _without_comment(line)
        if not bare:
            continue
        try:
            parsed = _parse_line(bare, line, package)
        except MessageError as error:
            raise MessageError(f"{name}, line {number}: {error}") from None
        if isinstance(parsed, FieldDefinition):
            fields.append(parsed)
        else:
            constants.append(parsed)
    (twice, times), *_ = Counter(field.name for field in fields).most_common(1) or [("", 0)]
    if times > 1:
        raise MessageError(f"{name} has two fields {twice}")
    return MessageDefinition(name, tuple(fields), tuple(constants), text)


def _without_comment(line: str) -> str:
    """Return a line up to its comment; a `#` in quotes, as in a default text of ROS 2, begins none."""
    quote = ""
    for at, char in enumerate(line):
        if quote:
            quote = "" if char == quote and line[at - 1] != "\\" else quote
        elif char in "\"'":
            quote = char if line.find(char, at + 1) > 0 else ""
        elif char == "#":
            return line[:at].strip()
    return line.strip()


def _parse_line(bare: str, line: str, package: str) -> FieldDefinition | ConstantDefinition:
    """Parse a line, `bare` without its comment."""
    type_text, _, rest = bare.replace("\t", " ").partition(" ")
    kind = _field_type(type_text, package)
    name, equals, _ = rest.partition("=")
    if equals and NAME.fullmatch(name.strip()):
        value = line.partition("=")[2] if type_text == "string" else bare.partition("=")[2]
        if kind.count is not None or not kind.is_builtin:
            raise MessageError(f"{show(bare)}: a constant is a number, a bool or a text")
        return ConstantDefinition(name.strip(), type_text, value.strip())
    name, _, default = rest.strip().partition(" ")
    if not NAME.fullmatch(name):
        raise MessageError(f"{show(bare)} is not a field, as in `float32 range`, or a constant, as in `uint8 OK=0`")
    return FieldDefinition(name, kind, default.strip())


def _field_type(text: str, package: str) -> FieldType:
    found = _TYPE.fullmatch(text)
    if found is None:
        raise MessageError(f"{show(text)} is not a type, such as float32[3] or geometry_msgs/Point")
    base = found["base"]
    if base == "Header":
        base = "std_msgs/Header"
    elif base not in BUILTIN:
        base = short_name(base if "/" in base else f"{package}/{base}")
    elif found["text"] and "string" not in base:
        raise MessageError(f"{show(text)}: only texts have a bound")
    count = found["count"]
    return FieldType(base, int(found["text"] or 0), None if count is None else int(count or 0), bool(found["bound"]))


# ROS 1


def md5(name: str, definitions: Definitions) -> str:
    """Return the md5 sum of a message of ROS 1, in hexadecimal. Raises MessageError if a nested type is missing."""
    return _digest(_md5_text(name, definitions, (), {}))


def service_md5(request: str, response: str, definitions: Definitions) -> str:
    """Return the md5 sum of a service of ROS 1, by the names of its two parts."""
    known: dict[str, str] = {}
    return _digest("".join(_md5_text(each, definitions, (), known) for each in (request, response)))


def _digest(text: str) -> str:
    return hashlib.md5(text.encode(), usedforsecurity=False).hexdigest()


def _md5_text(name: str, definitions: Definitions, outer: tuple[str, ...], known: dict[str, str]) -> str:
    """Return what the sum of a type is made of. `known` are the sums of nested types, each of which is made once."""
    definition = find(name, definitions, outer)
    lines = [f"{each.type} {each.name}={each.value}" for each in definition.constants]
    for field in definition.fields:
        base = field.type.base
        if not field.type.is_builtin and base not in known:
            known[base] = _digest(_md5_text(base, definitions, (*outer, name), known))
        lines.append(f"{known.get(base, field.type.text)} {field.name}")
    return "\n".join(lines)


def find(name: str, definitions: Definitions, outer: tuple[str, ...] = ()) -> MessageDefinition:
    """Return the definition of a type that is nested in the types `outer`. Raises MessageError for a missing one."""
    if name in outer:
        raise MessageError(f"{name} contains itself")
    if name not in definitions:
        where = f", which is in {outer[-1]}" if outer else ""
        raise MessageError(f"the definition of {name} is missing{where}")
    return definitions[name]


def with_nested(name: str, definitions: Definitions) -> list[MessageDefinition]:
    """Return the definition of a type and those of all types in it, each once, the outer ones first.

    Raises MessageError if one is missing, or contains itself.
    """
    found: dict[str, MessageDefinition] = {}

    def visit(each: str, outer: tuple[str, ...]) -> None:
        definition = find(each, definitions, outer)
        if each not in found:
            found[each] = definition
            for inner in definition.nested:
                visit(inner, (*outer, each))

    visit(name, ())
    return list(found.values())


def definition_text(name: str, definitions: Definitions) -> str:
    """Return the text of a type with those of all types in it behind it, as a publisher of ROS 1 sends it."""
    first, *rest = with_nested(name, definitions)
    return "\n".join([first.text, *(f"{SEPARATOR}\nMSG: {each.name}\n{each.text}" for each in rest)])


def plain_text(definition: MessageDefinition) -> str:
    """Return the text of a definition without comments."""
    lines: Iterable[str] = [f"{each.type} {each.name}={each.value}" for each in definition.constants]
    fields = [f"{field.type.text} {field.name} {field.default}".rstrip() for field in definition.fields]
    return "".join(f"{line}\n" for line in [*lines, *fields])
