"""The metaclass of messages: its errors name the class, the field and what to write, where msgspec's name neither.

It works when a class is defined, and on assignments to a message, which always fail. Packing does not pass here, nor
does making a message: a `__call__` would take ten times as long, so `explain_arguments` names the class afterwards.
"""

import linecache
import re
from types import TracebackType
from typing import Any

import msgspec

from r2p.errors import MessageError
from r2p.messages.shapes import show

TYPE_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*/(?:(?:srv|action)/)?[A-Za-z][A-Za-z0-9_]*")
"""A full name of a type; that of a part of a service or action of ROS 2 has its kind in the middle."""
_REQUIRED = re.compile(r"Required field '(\w+)' cannot follow optional fields")
_OPTION = re.compile(r"(?=.*keyword argument).*'(\w+)'")  # Python's text depends on its version
_ARGUMENTS = re.compile(
    r"(Unexpected keyword|Missing required) argument '\w+'|Extra positional arguments|Argument '\w+' given by name and"
)
_CALLED = re.compile(r"[\w.]+(?=\s*\()")
_TWO_BASES = "multiple bases have instance lay-out conflict"


class MessageMeta(msgspec.StructMeta):
    """Makes message classes. Raises MessageError for a class that can't be one."""

    _name: str
    """The full name that the class statement gives; empty for that of package and class."""

    def __new__(mcls, name: str, bases: tuple[type, ...], members: dict[str, Any], /, **options: Any) -> "MessageMeta":
        """Make the class of a `class` statement; the option `name` is the full name of the type."""
        full_name = options.pop("name", "")
        if full_name and not TYPE_NAME.fullmatch(str(full_name)):
            raise MessageError(f"{name}: {full_name!r} is not the full name of a type, such as sensor_msgs/LaserScan")
        try:
            cls = super().__new__(mcls, name, bases, members, **options)
        except (TypeError, ValueError) as error:
            text = _explained(name, bases, members, str(error))
            if text is None:
                raise MessageError(f"{name}: {error}") from error
            raise MessageError(text) from None
        cls._name = full_name
        if cls.__struct_config__.frozen:  # msgspec's own methods, set in each class, do not say what to write
            cls.__setattr__ = cls.__delattr__ = _refuse_assignment  # type: ignore[assignment, method-assign]
        return cls

    def give_name(cls, full_name: str) -> None:
        """Set the full name of a class that has none; before its layout is made."""
        cls._name = cls._name or full_name

    def __setattr__(cls, name: str, value: object) -> None:
        """Refuse what the decorator `dataclass` sets first; its own error would say `readonly attribute`."""
        if name in ("__dataclass_params__", "__dataclass_fields__"):
            raise MessageError(f"{cls.__name__}: remove @dataclass, a message class needs no decorator")
        super().__setattr__(name, value)


def _refuse_assignment(message: msgspec.Struct, name: str, _value: object = None) -> None:
    kind, fields = type(message).__name__, message.__struct_fields__
    if name not in fields:
        raise AttributeError(f"{kind} has no field {name}: it has {', '.join(fields)}")
    raise AttributeError(
        f"{kind} is frozen, because all subscribers share it: make a new one, {kind}(...), or change a copy with "
        f"msgspec.structs.replace(message, {name}=...)"
    )


def _explained(name: str, bases: tuple[type, ...], namespace: dict[str, Any], text: str) -> str | None:
    """Return what to write instead of this class, which msgspec refused with this text; None if that is unknown."""
    others = [base for base in bases if not isinstance(base, MessageMeta)]
    if required := _REQUIRED.match(text):
        return (
            f"{name}.{required[1]}: a field without a default can't follow one that has a default: give it a default, "
            f"or write `class {name}(..., kw_only=True)`"
        )
    if "mutable collection" in text:
        return _mutable_default(name, namespace)
    if text == _TWO_BASES:
        return (
            f"{name}: a message can't inherit the fields of {' and '.join(base.__name__ for base in bases)}: "
            "inherit from one, and make the others fields"
        )
    if "gc=False" in text and others:
        return f"{name}: {others[0].__name__} is not a message: give it `__slots__ = ()` and no fields"
    if "__init__" in text:
        return f"{name}: remove __init__, a message has one: check values in __post_init__, or add a class method"
    if "__slots__" in text:
        return f"{name}: remove __slots__, a message has them (from msgspec.defstruct? use a class statement)"
    option = _OPTION.match(text)
    return f"{name}: {option[1]}= is not an option of a message class" if option else None


def _mutable_default(name: str, namespace: dict[str, Any]) -> str | None:
    for field, value in namespace.items():
        if isinstance(value, list | set | bytearray) and value:
            return f"{name}.{field}: all messages would share the default {show(value)}: write {show(tuple(value))}"
        if isinstance(value, dict) and value and not field.startswith("__"):
            return f"{name}.{field}: a message can't hold a dict: nest a Message with a field for each key"
    return None


def explain_arguments(error: BaseException) -> None:
    """Let an error of msgspec about the arguments of a message class name the class and its fields."""
    trace = error.__traceback__
    if trace is None or not (isinstance(error, TypeError) and _ARGUMENTS.match(str(error))):
        return
    while trace.tb_next is not None:
        trace = trace.tb_next  # up to the call of the class, which has no frame
    cls = _called(trace)
    if isinstance(cls, MessageMeta):
        error.args = (f"{error}: {cls.__name__} {_fields(cls)}",)


def _fields(cls: MessageMeta) -> str:
    names = cls.__struct_fields__
    return f"has the field{'' if len(names) == 1 else 's'} {', '.join(names)}" if names else "has no fields"


def _called(trace: TracebackType) -> object:
    """Return what the code of a frame was calling, by its source; None if that is unknown."""
    frame = trace.tb_frame
    line, _, column, _ = list(frame.f_code.co_positions())[trace.tb_lasti // 2]
    source = linecache.getline(frame.f_code.co_filename, line or 0, frame.f_globals).encode()[column or 0 :]
    if (name := _CALLED.match(source.decode(errors="replace"))) is None:
        return None
    first, *rest = name[0].split(".")
    found: object = (frame.f_globals | frame.f_locals).get(first)
    for part in rest:
        found = getattr(found, part, None)
    return found
