"""From annotations to layouts: schemas, sizes, fingerprints, and the classes that have none."""

import gc
import weakref
from collections.abc import Callable
from enum import IntEnum
from hashlib import blake2b
from typing import Annotated, Any, Literal, assert_type

import msgspec
import pytest

from r2p.errors import DecodeError, MessageError
from r2p.messages import (
    SIZE_MAX,
    Array,
    Chars,
    Field,
    FixedArray,
    Layout,
    Len,
    Max,
    Message,
    Nested,
    Scalar,
    Timestamp,
    f32,
    i8,
    i16,
    layout,
    message_type,
    u8,
    u16,
    u32,
)
from r2p.messages.layouts import fingerprint_of_class
from r2p.messages.shapes import format_of
from r2p.msg import Led, Velocity3
from tests.messages import text_annotations
from tests.messages.classes import Derived, Keywords, Numbers, Redefined, Robot, Wheel, define

WHEELS = " ".join(f"wheels[{i}].speed:f32 wheels[{i}].ok:bool wheels[{i}].name:char[4]" for i in range(2))
NAMES = "names[0]:char[3] names[1]:char[3]"
REST = "serial:u8[16] best.speed:f32 best.ok:bool best.name:char[4]"


class Empty(Message):
    pass


def made(hint: object) -> type[Message]:
    """A message class with one field of that annotation."""
    return define("Made", [("x", hint)])  # type: ignore[no-any-return]


@pytest.mark.parametrize(
    ("cls", "size", "schema"),
    [
        (Led, 5, "led:u32 value:u8"),
        (Timestamp, 8, "sec:u32 nsec:u32"),
        (Numbers, 43, "a:u8 b:u16 c:u32 d:u64 e:i8 f:i16 g:i32 h:i64 i:f32 j:f64 k:bool"),
        (
            Robot,
            65,
            f"stamp.sec:u32 stamp.nsec:u32 {WHEELS} grid[0]:u8[3] grid[1]:u8[3] {NAMES} flags:bool[2] {REST}",
        ),
        (Keywords, 9, "a:u8 b.sec:u32 b.nsec:u32"),
        (Derived, 11, "a:u8 b.sec:u32 b.nsec:u32 c:i16"),
        (Redefined, 8, "a:u8 b:u32 c:i16 d:u8"),
    ],
)
def test_schema_and_size(cls: type[Message], size: int, schema: str) -> None:
    shape = layout(cls)
    assert (shape.size, shape.schema) == (size, schema)
    assert shape.fingerprint == blake2b(schema.encode(), digest_size=8).digest()
    assert shape.cls is cls


def test_the_fingerprint_of_a_class_is_that_of_its_layout_and_compiles_none() -> None:
    class Arm(Message):
        name: Annotated[str, Len(4)] = ""
        joints: tuple[Velocity3, Velocity3] = (Velocity3(), Velocity3())

    found = fingerprint_of_class(Arm)
    assert "_layout" not in vars(Arm)
    assert found == layout(Arm).fingerprint == fingerprint_of_class(Arm)


def test_fields_are_a_tree_for_tools() -> None:
    stamp, wheels, grid, names, flags, serial, best = layout(Robot).fields
    assert stamp == Field("stamp", Nested(layout(Timestamp)))
    assert wheels.shape == FixedArray(Nested(layout(Wheel)), 2)
    assert grid.shape == FixedArray(FixedArray(Scalar("u8", "B"), 3), 2)
    assert names.shape == FixedArray(Chars(3), 2)
    assert flags.shape == FixedArray(Scalar("bool", "?"), 2)
    assert (serial.shape.kind, serial.shape.size, format_of(serial.shape)) == ("u8[16]", 16, "16B")
    assert (best.shape.kind, best.shape.size, format_of(best.shape)) == ("Wheel", 9, "f?4s")


@pytest.mark.parametrize(("hint", "limits"), [(u8, (0, 255)), (i8, (-128, 127)), (u16, (0, 65535))])
def test_limits_of_integers(hint: object, limits: tuple[int, int]) -> None:
    shape = layout(made(hint)).fields[0].shape
    assert isinstance(shape, Scalar)
    assert shape.limits == limits


def test_zero_also_where_fields_are_required() -> None:
    assert layout(Numbers).zero == Numbers(0, 0, 0, 0, 0, 0, 0, 0, 0.0, 0.0, False)
    assert layout(Robot).zero == Robot()


def test_a_layout_is_made_once_and_not_taken_from_a_base_class() -> None:
    assert layout(Keywords) is layout(Keywords)
    assert layout(Derived) is not layout(Keywords)
    assert repr(layout(Led)) == "<Layout of Led, 5 bytes: led:u32 value:u8>"


def test_a_layout_goes_with_its_class() -> None:
    cls = message_type("Gone", "a.b:u8 c:u16[3]")
    assert layout(cls).size == 7
    gone = weakref.ref(cls)
    del cls
    gc.collect()
    assert gone() is None


def test_a_class_in_a_function_with_what_the_function_holds() -> None:
    class Inner(Message):
        x: u8

    class Outer(Message):
        inner: Inner
        many: tuple[Inner, Inner]

    assert layout(Outer).schema == "inner.x:u8 many[0].x:u8 many[1].x:u8"


def test_annotations_that_are_text() -> None:
    assert layout(text_annotations.Stamped).schema == "stamp.sec:u32 stamp.nsec:u32 names[0]:char[4] names[1]:char[4]"
    assert layout(text_annotations.local()).schema == "a:u16 s.stamp.sec:u32 s.stamp.nsec:u32 " + " ".join(
        f"s.names[{i}]:char[4]" for i in range(2)
    )


@pytest.mark.parametrize("build", [text_annotations.names_a_local, text_annotations.names_a_type_checking_import])
def test_text_that_names_nothing_at_run_time(build: Callable[[], type[Message]]) -> None:
    with pytest.raises(MessageError, match="is not defined: import the names in its annotations at run time"):
        layout(build())


@pytest.mark.parametrize(
    ("hint", "instead"),
    [
        (int, "r2p.u8 .. r2p.u64, r2p.i8 .. r2p.i64"),
        (float, "use r2p.f32 or r2p.f64"),
        (str, r"use Annotated\[str, r2p.Max\(256\)\], or r2p.Len"),
        (bytes, r"Annotated\[bytes, r2p.Max"),
        (Array[f32], r": r2p.Array\[r2p.f32\] has no bound for its size, use Annotated\[r2p.Array\[r2p.f32\], r2p.Max"),
        (Annotated[Array[Led], Max(3)], r"the elements of an r2p.Array are numbers; use a tuple of Led"),
        (Annotated[tuple[Empty, ...], Max(3)], "Empty has no bytes, so an array of it says nothing"),
        (
            list[int],
            r": list\[int\] has no bound for its size, use tuple\[r2p.i32, r2p.i32\], Annotated\[tuple\[r2p.i32, ...\]",
        ),
        (list[f32], r": list\[r2p.f32\] has no bound for its size, use tuple\[r2p.f32, r2p.f32\]"),
        (list[Led], r": list\[Led\] has no bound for its size, use tuple\[Led, Led\]"),
        (list, r"use tuple\[r2p.f32"),
        (tuple, "an array has one type and a length"),
        (dict[str, int], r"use a Message with a field for each key"),
        (u8 | None, r": r2p.u8 \| None has no bound for its size, use r2p.u8, and a bool beside it"),
        ((u8, u8), r": \(r2p.u8, r2p.u8\) has no bound for its size, use tuple\[r2p.u8, r2p.u8\]"),
        ([f32], r": \[r2p.f32\] has no bound for its size, use tuple\[r2p.f32, r2p.f32\]"),
        (IntEnum, "use r2p.u8, which takes the members of an IntEnum"),
        (set[u8], "has no bound for its size, use r2p.u8 .. r2p.f64, bool, a Message, a tuple"),
        (Any, "use r2p.u8 .. r2p.f64, bool"),
        (Literal[1, 2], "use r2p.u8 .. r2p.f64, bool"),
        (msgspec.Struct, "use r2p.u8 .. r2p.f64, bool"),
        (Annotated[u8, Len(3)], r": Annotated\[r2p.u8, r2p.Len\(3\)\] has no bound for its size, use one of r2p.u8"),
        (Annotated[bool, Len(3)], "has no bound for its size"),
        (Annotated[Led, Len(3)], "has no bound for its size"),
        (tuple[u8, ...], "an array has one type and a length"),
        (tuple[()], "an array has one type and a length"),
        (tuple[u8, f32], "for different types nest a Message"),
        (tuple[u8, u8, u16], "for different types nest a Message"),
        (Annotated[tuple[u8, u8], Len(3)], "an array has one type and a length"),
        (tuple[int, int], r"\[\]: .* use one of r2p.u8"),
        (Annotated[str, Len(0)], "Len takes an integer from 1 to 67108864, not 0"),
        (Annotated[str, Len(-1)], "Len takes an integer from 1 to 67108864, not -1"),
        (Annotated[tuple[u8, ...], Len(10**9)], "Len takes an integer"),
        (Annotated[str, Len("8")], "Len takes an integer .* not '8'"),  # type: ignore[arg-type]
        (Annotated[str, Max(0)], "Max takes an integer from 1 to 67108864, not 0"),
        (Annotated[tuple[u8, u8], Max(2)], "an array has one type and a length"),
        (Annotated[tuple[Annotated[tuple[u8, ...], Len(10_000)], ...], Len(10_000)], "has 100000000 bytes"),
    ],
)
def test_no_fixed_layout(hint: object, instead: str) -> None:
    with pytest.raises(MessageError, match=f"^Made.x.*{instead}"):
        layout(made(hint))


def test_array_written_out_and_with_its_length() -> None:
    assert layout(made(Annotated[tuple[u8, u8], Len(2)])).schema == "x:u8[2]"
    assert layout(made(tuple[u8])).schema == "x:u8[1]"
    assert layout(made(Annotated[u8, "whatever else"])).schema == "x:u8"


def test_size_limits() -> None:
    assert layout(made(Annotated[str, Len(SIZE_MAX)])).size == 64 << 20
    with pytest.raises(MessageError, match="Message is not a message class"):
        layout(Message)


def test_empty_messages() -> None:
    """They have no bytes, and travel as messages of variable length: a link without a length has no sign of them."""
    assert (layout(Empty).size, layout(Empty).varies, Empty().encode(), Empty.decode(b"")) == (0, True, b"", Empty())
    holder: Any = define("Holder", [("a", Empty), ("b", u8)])
    assert (layout(holder).size, layout(holder).varies, layout(holder).schema) == (1, False, "b:u8")
    assert holder.decode(b"\7") == holder(Empty(), 7)
    with pytest.raises(DecodeError, match="Empty: takes 0 bytes, not 1"):
        Empty.decode(b"x")


def test_a_value_without_an_annotation_is_no_field() -> None:
    class Bare(Message):
        speed = 1.5

    with pytest.raises(MessageError, match=r"Bare has no fields: annotate them, as in `speed: r2p.f32 = 1.5`"):
        layout(Bare)


def test_too_large_in_all() -> None:
    class Large(Message):
        a: Annotated[str, Len(SIZE_MAX)]
        b: u8

    with pytest.raises(MessageError, match="Large has 67108865 bytes: a message has at most 67108864"):
        layout(Large)


def test_a_class_that_holds_itself() -> None:
    with pytest.raises(MessageError, match="Endless contains itself"):
        layout(text_annotations.Endless)


@pytest.mark.parametrize("name", ["encode", "decode", "_x", "größe", "class"])
def test_field_names_that_are_refused(name: str) -> None:
    cls = define("Made", [(name, u8)])
    with pytest.raises(MessageError, match=f"Made.{name}: a field name has letters, digits and _ of ASCII"):
        layout(cls)


def test_a_message_is_frozen() -> None:
    class Loose(Message, frozen=False):  # type: ignore[misc]
        x: u8 = 0

    with pytest.raises(MessageError, match="Loose is not frozen"):
        layout(Loose)
    with pytest.raises(AttributeError):
        Led().value = 1  # type: ignore[misc]


def test_a_class_that_refuses_zero() -> None:
    class Picky(Message):
        x: u8

        def __post_init__(self) -> None:
            if not self.x:
                raise ValueError("x is 0")

    with pytest.raises(MessageError, match=r"Picky can't be all zero.*x is 0"):
        layout(Picky)


@pytest.mark.parametrize(
    ("what", "instead"),
    [
        (int, r"int is not a message class: write `class int\(r2p.Message\)`"),
        (msgspec.Struct, "Struct is not a message class: write"),
        (Led(), r"Led\(led=0, value=0\) is a message, not its class: pass Led"),
        (None, "None is not a message class: subclass r2p.Message"),
        ("Led", "'Led' is not a message class: the topic comes first"),
        (tuple[u8, u8], "is not a message class: subclass r2p.Message"),
    ],
)
def test_no_message_class(what: Any, instead: str) -> None:
    with pytest.raises(MessageError, match=instead):
        layout(what)


def test_timestamps_are_exact() -> None:
    stamp = Timestamp.from_ns(1_700_000_000_123_456_789)
    assert stamp == Timestamp(sec=1_700_000_000, nsec=123_456_789)
    assert stamp.ns == 1_700_000_000_123_456_789
    assert Timestamp.from_ns((1 << 32) * 10**9 - 1) == Timestamp((1 << 32) - 1, 999_999_999)
    for ns in (-1, (1 << 32) * 10**9):
        with pytest.raises(MessageError, match="not between 1970 and 2106"):
            Timestamp.from_ns(ns)


def test_what_type_checkers_see() -> None:
    """These lines are checked when the tests are type-checked; an ignore that nothing needs is an error there."""
    led = Led(led=3, value=1)
    assert_type(led.value, int)
    assert_type(Velocity3(x=1.5).x, float)
    assert_type(Led.decode(led.encode()), Led)
    assert_type(layout(Led), Layout[Led])
    assert_type(layout(Led).zero, Led)
    assert_type(layout(Led).decode(bytes(5)), Led)
    assert_type(Robot().wheels[0].ok, bool)
    Led(led="3")  # type: ignore[arg-type]
    Led(4, 5)
    with pytest.raises(TypeError):
        Wheel(colour=1)  # type: ignore[call-arg]
    with pytest.raises(TypeError):
        Numbers(a=1)  # type: ignore[call-arg]
    with pytest.raises(MessageError):
        layout(Led).encode(Wheel())  # type: ignore[arg-type]
    assert i16 is not u16
    assert u32 is not u8
