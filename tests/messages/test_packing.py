"""Messages to bytes and back: exact, or refused with the field's name."""

import math
import struct
from collections.abc import Callable
from enum import IntEnum
from typing import Annotated, Any

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from r2p.errors import DecodeError, MessageError
from r2p.messages import Field, Len, Message, Timestamp, f32, i64, layout, u8, u64
from r2p.messages.packing import check
from r2p.messages.shapes import HINTS
from r2p.msg import Led, Speed3, StampedIMURaw9, StampedVelocity3, Text, Velocity3
from r2p.tools.types import standard_types
from tests.messages.classes import Derived, Keywords, Numbers, Redefined, Robot, Wheel, define
from tests.messages.strategies import messages

STANDARD = standard_types()
ALL: list[type[Message]] = [*STANDARD, Numbers, Robot, Keywords, Derived, Redefined]
FIXED = [each for each in ALL if not layout(each).varies]  # test_variable.py has bytes of others
BASE = Robot()


def one(kind: str) -> type[Any]:
    """A message class with one field of that scalar kind."""
    return define("One", [("x", HINTS[kind])])  # type: ignore[no-any-return]


@settings(max_examples=30)  # of each class
@given(st.data())
@pytest.mark.parametrize("cls", ALL)
def test_round_trip(cls: type[Message], data: st.DataObject) -> None:
    message = data.draw(messages(layout(cls)))
    packed = message.encode()
    assert layout(cls).size_min <= len(packed) <= layout(cls).size
    assert cls.decode(packed) == message
    assert cls.decode(packed).encode() == packed


@settings(max_examples=30)  # of each class
@given(st.data())
@pytest.mark.parametrize("cls", FIXED)
def test_any_bytes_are_a_message_or_a_decode_error(cls: type[Message], data: st.DataObject) -> None:
    size = layout(cls).size
    raw = data.draw(st.binary(min_size=size, max_size=size))
    try:
        message = cls.decode(raw)
    except DecodeError:
        assert max(raw) > 127
    else:
        assert len(message.encode()) == size


def test_golden_bytes() -> None:
    values = Numbers(1, 2, 3, 4, -1, -2, -3, -4, 1.0, -2.0, True)
    assert values.encode().hex() == (
        "010200030000000400000000000000fffefffdfffffffcffffffffffffff0000803f00000000000000c001"
    )
    robot = Robot(
        Timestamp(1, 2), (Wheel(1.0, True, "abcd"), Wheel()), ((1, 2, 3), (4, 5, 6)), ("x", "yz"), (True, False)
    )
    assert robot.encode().hex() == (
        "01000000020000000000803f0161626364000000000000000000010203040506780000797a000100" + "00" * 25
    )


def test_keyword_only_fields_keep_their_place() -> None:
    derived = Derived(a=1, b=Timestamp(2, 3), c=4)
    assert derived.encode().hex() == "0102000000030000000400"
    assert Derived.decode(derived.encode()) == derived


def test_any_buffer_decodes() -> None:
    decode: Any = layout(Led).decode
    packed = Led(2, 1).encode()
    assert decode(bytearray(packed)) == decode(memoryview(packed)) == Led(2, 1)


@pytest.mark.parametrize("kind", [kind for kind in HINTS if kind[0] in "ui"])
def test_integers_at_their_limits(kind: str) -> None:
    cls = one(kind)
    bits = int(kind[1:])
    least, greatest = (0, 2**bits - 1) if kind[0] == "u" else (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)
    for value in (least, greatest):
        assert cls.decode(cls(value).encode()).x == value
    for value in (least - 1, greatest + 1, 10**5000):
        with pytest.raises(MessageError, match=rf"^One.x \({kind}\) takes an integer from {least} to {greatest}, not "):
            cls(value).encode()


@pytest.mark.parametrize("kind", [kind for kind in HINTS if kind[0] in "uif"])
@pytest.mark.parametrize("value", [None, "1", b"1", 1j, (1,), Led()])
def test_no_number(kind: str, value: object) -> None:
    with pytest.raises(MessageError, match=rf"^One.x \({kind}\) takes an? (integer|number)"):
        one(kind)(value).encode()


def test_a_float_is_no_integer() -> None:
    for value in (1.0, 1.5, math.nan):
        with pytest.raises(MessageError, match=rf"takes an integer from 0 to 255, not {value}"):
            one("u8")(value).encode()


class Colour(IntEnum):
    RED = 7


def test_what_counts_as_a_number() -> None:
    assert one("u8")(True).encode() == b"\x01"
    assert one("u8")(Colour.RED).encode() == b"\x07"
    assert one("f32")(3).encode() == struct.pack("<f", 3.0)


@pytest.mark.parametrize("value", [math.inf, -math.inf, math.nan, -0.0])
@pytest.mark.parametrize("kind", ["f32", "f64"])
def test_special_floats_pass(kind: str, value: float) -> None:
    cls = one(kind)
    assert repr(cls.decode(cls(value).encode()).x) == repr(value)


@pytest.mark.parametrize(
    ("kind", "value", "allowed"),
    [
        ("f32", 1e39, "±3.402823e38"),
        ("f32", -1e39, "±3.402823e38"),
        ("f32", 10**400, "±3.4"),
        ("f64", 10**400, "±1.797693e308"),
    ],
)
def test_floats_that_are_too_large(kind: str, value: float, allowed: str) -> None:
    with pytest.raises(MessageError, match=rf"^One.x \({kind}\) takes a number up to {allowed}"):
        one(kind)(value).encode()


@pytest.mark.parametrize("value", [1, 0, None, "", (), 1.0])
def test_a_bool_is_a_bool(value: object) -> None:
    with pytest.raises(MessageError, match=r"^One.x \(bool\) takes True or False, not "):
        one("bool")(value).encode()


def test_any_byte_but_zero_is_true() -> None:
    assert one("bool").decode(b"\x00").x is False
    assert one("bool").decode(b"\x80").x is True


@pytest.mark.parametrize("value", ["x" * 65, "größe", "a\0b", "\0", "x\0", None, b"bytes", 5, Led()])
def test_texts_that_do_not_fit(value: Any) -> None:
    with pytest.raises(
        MessageError, match=r"^Text.text \(char\[64\]\) takes at most 64 ASCII characters without a NUL"
    ):
        Text(value).encode()


def test_texts_are_padded_and_end_at_the_first_nul() -> None:
    assert Text("abc").encode() == b"abc" + bytes(61)
    assert Text("x" * 64).encode() == b"x" * 64
    assert Text.decode(b"abc\0\xff\xfe" + b"rubbish" + bytes(51)) == Text("abc")
    with pytest.raises(DecodeError, match=r"^Text: 'ascii' codec can't decode byte 0xc3"):
        Text.decode(b"gr\xc3\xb6\xc3\x9fe" + bytes(57))


@pytest.mark.parametrize("value", [(), (1.0, 2.0), (1.0, 2.0, 3.0, 4.0), [1.0, 2.0, 3.0], None, 1.0, "abc", {1, 2, 3}])
def test_arrays_are_tuples_of_their_length(value: Any) -> None:
    with pytest.raises(MessageError, match=r"^Speed3.value \(f32\[3\]\) takes a tuple of 3, not "):
        Speed3(value).encode()


def test_lengths_do_not_make_up_for_each_other() -> None:
    """Two arrays whose lengths are wrong, but right together, would pack into each other's places."""
    cls: Any = define("Two", [("a", tuple[u8, u8]), ("b", tuple[u8, u8])])
    with pytest.raises(MessageError, match=r"^Two.a \(u8\[2\]\) takes a tuple of 2, not \(1, 2, 3\)"):
        cls((1, 2, 3), (4,)).encode()


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"stamp": Timestamp(-1)}, "Robot.stamp.sec (u32) takes an integer from 0 to 4294967295, not -1"),
        ({"stamp": Led()}, "Robot.stamp (Timestamp) takes a Timestamp, not Led(led=0, value=0)"),
        ({"stamp": None}, "Robot.stamp (Timestamp) takes a Timestamp, not None"),
        ({"wheels": (Wheel(), Wheel(ok=1))}, "Robot.wheels[1].ok (bool) takes True or False, not 1"),  # type: ignore[arg-type]
        ({"wheels": (Wheel(), 5)}, "Robot.wheels[1] (Wheel) takes a Wheel, not 5"),
        ({"grid": ((0, 0, 0), (0, 0))}, "Robot.grid[1] (u8[3]) takes a tuple of 3, not (0, 0)"),
        ({"grid": ((0, 0, 0), (0, 0, 256))}, "Robot.grid[1][2] (u8) takes an integer from 0 to 255, not 256"),
        (
            {"names": ("abc", "abcd")},
            "Robot.names[1] (char[3]) takes at most 3 ASCII characters without a NUL, not 'abcd'",
        ),
        ({"flags": (True, 1)}, "Robot.flags[1] (bool) takes True or False, not 1"),
        ({"serial": (0,) * 15 + (1.5,)}, "Robot.serial[15] (u8) takes an integer from 0 to 255, not 1.5"),
    ],
)
def test_the_error_names_the_part(changes: dict[str, Any], text: str) -> None:
    with pytest.raises(MessageError) as caught:
        msgspec.structs.replace(BASE, **changes).encode()
    assert str(caught.value) == text
    assert caught.value.__cause__ is None


def test_a_long_value_is_cut_in_the_error() -> None:
    with pytest.raises(MessageError) as caught:
        Text("x" * 10_000).encode()
    assert len(str(caught.value)) < 200


def test_only_the_very_class_packs() -> None:
    """A class with more fields, or another one with the same names, would lose what the layout does not know."""

    class Velocity4(Velocity3):
        z: f32 = 0.0

    encode: Any = layout(Velocity3).encode
    for other in (Velocity4(), StampedVelocity3(), Led(), None, 5):
        with pytest.raises(MessageError, match=r"is not a Velocity3$"):
            encode(other)


@pytest.mark.parametrize("size", [0, 1, 4, 6, 255])
def test_bytes_of_another_size(size: int) -> None:
    with pytest.raises(DecodeError, match=rf"^Led: takes 5 bytes, not {size}$"):
        Led.decode(bytes(size))


def test_a_class_may_refuse_what_it_reads() -> None:
    class Even(Message):
        x: u8 = 0

        def __post_init__(self) -> None:
            if self.x % 2:
                raise ValueError("odd")

    assert Even.decode(b"\x02") == Even(2)
    with pytest.raises(DecodeError, match=r"^Even: odd$"):
        Even.decode(b"\x03")


ODD = st.one_of(
    st.none(),
    st.integers(),
    st.floats(),
    st.booleans(),
    st.text(max_size=5),
    st.tuples(st.integers(), st.integers()),
    st.tuples(st.booleans(), st.booleans()),
    st.builds(Timestamp, st.integers(), st.integers()),
    st.binary(max_size=3),
)


def outcome(call: Callable[[], object]) -> str:
    """The error's text; empty if there is none."""
    try:
        call()
    except MessageError as error:
        return str(error)
    return ""


@given(st.sampled_from(layout(Robot).fields), ODD)
def test_packing_and_explaining_agree(field: Field, value: Any) -> None:
    """The generated code and the walk that explains hold the same values for right."""
    message = msgspec.structs.replace(BASE, **{field.name: value})
    assert outcome(message.encode) == outcome(lambda: check(field.shape, value, f"Robot.{field.name}"))


def test_nothing_is_hidden_when_no_field_is_wrong() -> None:
    class Moody:
        asked = 0

        def __index__(self) -> int:
            self.asked += 1
            if self.asked == 1:
                raise TypeError("not now")
            return 5

    with pytest.raises(MessageError, match=r"^One\(x=.*can't be packed"):
        one("u8")(Moody()).encode()


def test_stamped_imu_packs_in_definition_order() -> None:
    message = StampedIMURaw9(Timestamp(1, 2), *range(-4, 5))
    assert message.encode() == struct.pack("<II9h", 1, 2, *range(-4, 5))


def test_large_arrays() -> None:
    hints = [("a", Annotated[tuple[Timestamp, ...], Len(120)]), ("b", u64), ("c", i64)]
    cls: Any = define("Large", hints)
    message = cls(tuple(Timestamp(i, i + 1) for i in range(120)), 2**64 - 1, -(2**63))
    assert cls.decode(message.encode()) == message
