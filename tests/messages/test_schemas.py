"""Classes built back from schemas, which anybody may have sent."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from r2p.errors import MessageError
from r2p.messages import Message, Timestamp, layout, message_type
from r2p.messages.schemas import SCHEMA_MAX
from r2p.tools.types import standard_types
from tests.messages.classes import Derived, Keywords, Numbers, Redefined, Robot
from tests.messages.strategies import messages

STANDARD = standard_types()


@settings(max_examples=30)  # of each class
@given(st.data())
@pytest.mark.parametrize("cls", [*STANDARD, Numbers, Robot, Keywords, Derived, Redefined])
def test_a_class_built_back_reads_the_same(cls: type[Message], data: st.DataObject) -> None:
    other = layout(message_type(cls.__name__, layout(cls).schema))
    assert (other.schema, other.fingerprint, other.exact_size) == (
        layout(cls).schema,
        layout(cls).fingerprint,
        layout(cls).exact_size,
    )
    packed = data.draw(messages(layout(cls))).encode()
    assert other.encode(other.decode(packed)) == packed


def test_what_it_looks_like() -> None:
    cls = message_type("Point", "at.sec:u32 at.nsec:u32 x:f32[2] label:char[4] near[0].ok:bool near[1].ok:bool")
    assert layout(cls).decode(bytes(8 + 8 + 4 + 2)) == layout(cls).zero
    assert isinstance(layout(cls).zero.at, Timestamp)  # type: ignore[attr-defined]
    near = "near=(Point_near(ok=False), Point_near(ok=False))"
    assert repr(layout(cls).zero) == f"Point(at=Timestamp(sec=0, nsec=0), x=(0.0, 0.0), label='', {near})"


def test_the_same_inside_is_the_same_class() -> None:
    zero = layout(message_type("Pair", "a.x:u8 a.y:u8 b.x:u8 b.y:u8 c.x:u8")).zero
    assert type(zero.a) is type(zero.b)  # type: ignore[attr-defined]
    assert type(zero.a) is not type(zero.c)  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    "schema",
    [
        " ",
        ":",
        "x",
        "x:",
        ":u8",
        "x:u8 ",
        " x:u8",
        "x:u8  y:u8",
        "x:u8\ty:u8",
        "x:u8\n",
        "x:u7",
        "x:char",
        "x:char[0]",
        "x:char[10000]",
        "x:char[]",
        "x:f64[9999] " * 20,
        "x:str[]",
        "x[]:u8",
        "x[].y",
        "x[].:u8",
        "x[]:f32[] x[]:f32[]",
        "x[].a:u8 x[0].a:u8",
        "x:char[08]",
        "x:u8[0]",
        "x:u8[01]",
        "x:u8[-1]",
        "x:u8[1][2]",
        "x:u8[²]",
        "x:u8 x:u8",
        "x:u8 y:u8 x:u8",
        "x:u8 x.y:u8",
        "x.y:u8 x:u8",
        "x.y:u8 z:u8 x.w:u8",
        "x.y:u8 x[0]:u8",
        "x[0]:u8 x[1]:u8",
        "x[1]:char[3]",
        "x[0]:char[3] x[2]:char[3]",
        "x[1]:char[3] x[0]:char[3]",
        "x[0]:char[3] x[1]:char[4]",
        "x[0]:char[3] x[0]:char[3]",
        "x[0].a:u8 x[1].b:u8",
        "x[0].a:u8 x[1].a:u8 x[1].b:u8",
        "[0]:u8",
        "[0].x:u8",
        ".x:u8",
        "x.:u8",
        "x..y:u8",
        "x.[0]:u8",
        "x[0]y:char[3]",
        "x[0:u8",
        "x[99999].y:u8",
        "__init__:u8",
        "_x:u8",
        "x.__class__:u8",
        "encode_:u8",
        "class_:u8",
        "0:u8",
        "größe:u8",
        "x y:u8",
        "x=print():u8",
        "x:u8=0",
        "x:Scalar",
        "x:" + "u" * 100,
        "a" + ".a" * 16 + ":u8",
        "a" + "[0]" * 16 + ":char[1]",
        " ".join(f"m{i}.f{i}:u8" for i in range(66)),
        "x:u8 " * SCHEMA_MAX,
    ],
)
def test_odd_schemas_are_refused(schema: str) -> None:
    with pytest.raises(MessageError):
        message_type("Odd", schema)


@pytest.mark.parametrize("name", ["", "0", "a b", "class", "größe", "x" * 65, "A\n", "A.B"])
def test_odd_names_are_refused(name: str) -> None:
    with pytest.raises(MessageError, match="is not a valid name of a message class"):
        message_type(name, "x:u8")


@given(st.text(alphabet="abx01 .:[]u8f3char_", max_size=40))
def test_any_text_is_a_schema_or_an_error(schema: str) -> None:
    try:
        cls = message_type("Any", schema)
    except MessageError:
        return
    assert layout(cls).schema == schema


def test_the_largest_ones_are_read() -> None:
    many = " ".join(f"f{i}:u8" for i in range(2000))
    assert layout(message_type("Many", many)).size == 2000
    deep = "a" + ".a" * 15 + ":u8"
    assert layout(message_type("Deep", deep)).schema == deep
