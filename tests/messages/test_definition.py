"""Classes that can't be messages: the error names the class, the field and what to write."""

import dataclasses
import traceback
from collections.abc import Callable
from typing import Any, ClassVar

import msgspec
import pytest

import r2p
from r2p import MessageError
from r2p.messages.definition import explain_arguments

NAMES = {"r2p": r2p, "Message": r2p.Message, "u8": r2p.u8, "dataclass": dataclasses.dataclass, "ClassVar": ClassVar}
BASE = """
class Base(Message):
    a: u8 = 0
class Plain:
    label = "plain"
"""


def define(lines: str) -> type[r2p.Message]:
    """Execute a class statement, and lay its class out."""
    namespace = {**NAMES, "__name__": __name__}
    exec(BASE + lines, namespace)  # noqa: S102 - the statements below
    cls: type[r2p.Message] = namespace["Scan"]  # type: ignore[assignment]
    r2p.layout(cls)
    return cls


@pytest.mark.parametrize(
    ("statement", "error"),
    [
        ("class Scan(Message):\n a: u8 = 0\n b: u8", "Scan.b: a field without a default can't follow one that has"),
        ("class Scan(Base):\n b: u8", "give it a default, or write `class Scan(..., kw_only=True)`"),
        ("class Scan(Message):\n b: tuple[u8, u8] = [0, 1]", "Scan.b: all messages would share the default [0, 1]"),
        ("class Scan(Message):\n b: tuple[u8, u8] = []", "Scan.b (u8[2]) takes a tuple of 2, not []: change the"),
        ("class Scan(Message):\n b: dict = {1: 2}", "Scan.b: a message can't hold a dict: nest a Message with a"),
        ("class Scan(Message):\n b: u8 = None", "Scan.b (u8) takes an integer from 0 to 255, not None: change the"),
        ("class Scan(Message):\n b: u8 = 300", "Scan.b (u8) takes an integer from 0 to 255, not 300: change the"),
        ("class Scan(Message):\n b: u8 = 0\n def b(self): ...", "Scan.b (u8) takes an integer from 0 to 255, not <fun"),
        ("class Scan(Message):\n a: u8 = 0\n b = 1.5", "Scan.b has no annotation: write `b: r2p.f32 = 1.5` for a"),
        ("class Scan(Base):\n a = 1", "Scan.a has no annotation: write `a: r2p.i32 = 1` for a field, or `a: ClassVar"),
        ("class Scan(Message):\n b: 'r2p.u9' = 0", "Scan: module 'r2p' has no attribute 'u9'"),
        ("class Scan(Message):\n _layout: u8 = 0", "Scan._layout: a field name has letters, digits and _"),
        ("class Other(Message):\n b: u8\nclass Scan(Base, Other): ...", "Scan: a message can't inherit the fields of"),
        ("class Scan(Plain, Message):\n b: u8", "Scan: Plain is not a message: give it `__slots__ = ()`"),
        ("@dataclass\nclass Scan(Message):\n b: u8", "Scan: remove @dataclass"),
        ("class Scan(Message):\n b: u8\n def __init__(self): ...", "Scan: remove __init__, a message has one"),
        ("class Scan(Message):\n __slots__ = ('b',)", "Scan: remove __slots__, a message has them"),
        ("class Scan(Message, size=3):\n b: u8", "Scan: size= is not an option of a message class"),
        ("class Scan(Message, order=True, eq=False):\n b: u8", "Scan: "),
    ],
)
def test_a_class_that_can_not_be_a_message(statement: str, error: str) -> None:
    with pytest.raises(MessageError) as caught:
        define(statement)
    assert error in str(caught.value)


def test_constants_and_mixins_are_no_fields() -> None:
    scan = define(
        "class Mixin:\n __slots__ = ()\nclass Scan(Mixin, Message):\n a: u8\n RATE = 1\n x: ClassVar[int] = 1"
    )
    assert r2p.layout(scan).schema == "a:u8"


def test_a_struct_made_by_msgspec_needs_a_class_statement() -> None:
    with pytest.raises(MessageError, match=r"from msgspec.defstruct\? use a class statement"):
        msgspec.defstruct("Scan", [("a", r2p.u8)], bases=(r2p.Message,))


def test_an_assignment_says_what_to_write_instead() -> None:
    message: object = define("class Scan(Base):\n b: u8 = 0")(1)
    with pytest.raises(AttributeError, match=r"Scan is frozen.* msgspec.structs.replace\(message, b=...\)"):
        message.b = 1  # type: ignore[attr-defined]
    with pytest.raises(AttributeError, match=r"Scan has no field c: it has a, b"):
        message.c = 1  # type: ignore[attr-defined]
    with pytest.raises(AttributeError, match="Scan is frozen"):
        del message.b  # type: ignore[attr-defined]


def test_tracebacks_of_packing_have_no_frames_without_source() -> None:
    cls = define("class Scan(Message):\n b: u8 = 0")
    for fails in (cls(300).encode, lambda: cls.decode(b"")):
        with pytest.raises(r2p.Error) as caught:
            fails()
        assert all(frame.line for frame in traceback.extract_tb(caught.tb))


MODULE: Any = r2p


class Lamp(r2p.Message):
    red: r2p.u8
    green: r2p.u8 = 0


ANY_LAMP: Any = Lamp  # whose wrong arguments a type checker does not find


def not_a_lamp(**fields: int) -> None:
    raise TypeError(f"Unexpected keyword argument {next(iter(fields))!r}")


@pytest.mark.parametrize(
    ("make", "error"),
    [
        (lambda: (1, ANY_LAMP(idx=1)), "Unexpected keyword argument 'idx': Lamp has the fields red, green"),
        (lambda: ANY_LAMP(1, 2, 3), "Extra positional arguments provided: Lamp has the fields red, green"),
        (lambda: ANY_LAMP(), "Missing required argument 'red': Lamp has the fields red, green"),
        (lambda: MODULE.Timestamp(red=2), "Unexpected keyword argument 'red': Timestamp has the fields sec, nsec"),
        (lambda: not_a_lamp(idx=1), "Unexpected keyword argument 'idx'"),
    ],
)
def test_wrong_arguments_of_a_message_name_its_class_and_fields(make: Callable[[], object], error: str) -> None:
    with pytest.raises(TypeError) as caught:
        make()
    explain_arguments(caught.value)
    assert str(caught.value).startswith(error)
    assert str(caught.value).count("has the fields") == error.count("has the fields")
