"""Which values a parameter takes, and what the error says of those that it refuses."""

from __future__ import annotations

import enum
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

import r2p
from r2p.codecs.parameters import ParameterKind
from r2p.parameters.definition import ParameterDefinition, define_parameter


class Mode(enum.Enum):
    AUTO = 1
    MANUAL = 2


class Gear(enum.IntEnum):
    LOW = 1
    HIGH = 2


def defined(default: object, **options: object) -> ParameterDefinition:
    known = {"min": None, "max": None, "unit": "", "doc": "", "check": None, "read_only": False}
    return define_parameter("PC1/speed", "kp", default, **(known | options))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("default", "value", "converted"),
    [
        (0.5, 2, 2.0),
        (0.5, math.inf, math.inf),
        (1, -(1 << 63), -(1 << 63)),
        (False, True, True),
        ("a", "ä" * 64, "ä" * 64),
        (Mode.AUTO, "MANUAL", Mode.MANUAL),
        (Mode.AUTO, Mode.MANUAL, Mode.MANUAL),
        (Gear.LOW, "HIGH", Gear.HIGH),
        ((0.0, 0.0), [1, 2.5], (1.0, 2.5)),
        ((0, 0), (1, 2), (1, 2)),
    ],
)
def test_converts_to_the_type_of_the_default(default: object, value: object, converted: object) -> None:
    result = defined(default).convert(value)
    assert (result, type(result)) == (converted, type(converted))


@pytest.mark.parametrize(
    ("default", "value", "text"),
    [
        (0.5, True, "PC1/speed.kp = True: it takes a float, not a bool"),
        (0.5, "1", "PC1/speed.kp = '1': it takes a float, not a str"),
        (0.5, math.nan, "PC1/speed.kp = nan: it takes a number, not NaN"),
        (0.5, 10**400, "it takes a float of 64 bits"),
        (1, True, "PC1/speed.kp = True: it takes an int, not a bool"),
        (1, 1.0, "PC1/speed.kp = 1.0: it takes an int, not a float"),
        (1, 1 << 63, "it takes an int of 64 bits"),
        (True, 1, "PC1/speed.kp = 1: it takes true or false, not a int"),
        ("a", 1, "PC1/speed.kp = 1: it takes a str, not a int"),
        ("a", "ä" * 65, "it takes a text of 128 bytes of UTF-8 at most, not 130"),
        ("a", "\udc80", "a text with a character that UTF-8 does not have"),
        (Mode.AUTO, "auto", "PC1/speed.kp = 'auto': it takes one of AUTO, MANUAL"),
        (Mode.AUTO, Gear.LOW, "PC1/speed.kp = 'LOW': it takes one of AUTO, MANUAL"),
        (Gear.LOW, 1, "PC1/speed.kp = 1: it takes one of LOW, HIGH"),
        ((0.0, 0.0), (1.0,), "PC1/speed.kp = (1.0,): it takes 2 numbers, not 1"),
        ((0.0, 0.0), 1.0, "PC1/speed.kp = 1.0: it takes 2 numbers, not a float"),
        ((0.0, 0.0), (1.0, math.nan), "it takes a number, not NaN"),
    ],
)
def test_refuses_what_does_not_fit(default: object, value: object, text: str) -> None:
    with pytest.raises(r2p.ParameterError) as raised:
        defined(default).convert(value)
    assert text in str(raised.value)


@pytest.mark.parametrize(("default", "value"), [(0.5, -0.1), (0.5, 10.1), ((1.0, 1.0), (1.0, 11.0)), (1, 11)])
def test_limits_are_named_with_their_unit(default: object, value: object) -> None:
    with pytest.raises(r2p.ParameterError, match=r"PC1/speed.kp = .*: it takes (0|10)(\.0)? V or (more|less)"):
        defined(default, min=0, max=10, unit="V").convert(value)


@pytest.mark.parametrize(
    ("default", "options", "text"),
    [
        ([1.0], {}, "write a tuple"),
        ((), {}, "has no type of parameter"),
        (None, {}, "has no type of parameter"),
        ((1, 2.0), {}, "mixes int and float"),
        ((1.0, "a"), {}, "all int or all float"),
        ((0.0,) * 17, {}, "at most 16 numbers, not 17"),
        (math.nan, {}, "NaN"),
        (11.0, {"max": 10}, "it takes 10.0 or less"),
        (1.0, {"min": 2, "max": 1}, "min 2 is above max 1"),
        (1, {"min": 0.5}, "a limit of 0.5: it takes an int, not a float"),
        ("a", {"min": 1}, "a str has neither min nor max"),
        (True, {"max": 1}, "a bool has neither min nor max"),
        (1.0, {"unit": "V" * 17}, "its unit has 17 bytes"),
        (1.0, {"doc": "d" * 121}, "its doc has 121 bytes"),
        (1.0, {"check": lambda value: value > 0}, "its check returned True"),
        (1.0, {"check": lambda _value: "never"}, "PC1/speed.kp = 1.0: never"),
    ],
)
def test_a_definition_that_makes_no_sense_is_refused(default: object, options: dict[str, object], text: str) -> None:
    def declare() -> None:
        definition = defined(default, **options)
        definition.verify(definition.default, {})

    with pytest.raises(r2p.ParameterError) as raised:
        declare()
    assert text in str(raised.value)
    assert "PC1/speed.kp" in str(raised.value)


@pytest.mark.parametrize("name", ["", "a.", ".a", "a..b", "a b", "ä", "a" * 65])
def test_names_of_parameters(name: str) -> None:
    with pytest.raises(r2p.InvalidName, match="parameter name"):
        define_parameter("PC1/speed", name, 1, min=None, max=None, unit="", doc="", check=None, read_only=False)


@pytest.mark.parametrize(
    ("default", "text", "value"),
    [
        (0.5, "7e-1", 0.7),
        (1, "0x10", 16),
        (True, "off", False),
        ("a", "1", "1"),
        (Mode.AUTO, "MANUAL", Mode.MANUAL),
        ((0, 0), "1,2", (1, 2)),
        ((0.0, 0.0), "[1, 2.5]", (1.0, 2.5)),
        ((0.0,), "(1.5,)", (1.5,)),
    ],
)
def test_texts_of_the_command_line(default: object, text: str, value: object) -> None:
    assert defined(default).parse(text) == value


@pytest.mark.parametrize(("default", "text"), [(0.5, "fast"), (1, "1.5"), (True, "maybe"), ((0, 0), "1,,2"), (1, "")])
def test_texts_that_mean_nothing(default: object, text: str) -> None:
    with pytest.raises(r2p.ParameterError, match=r"PC1/speed.kp = "):
        defined(default).parse(text)


anything = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text() | st.binary() | st.sampled_from([*Mode, *Gear]),
    lambda each: st.lists(each, max_size=3) | st.tuples(each, each) | st.dictionaries(st.text(), each, max_size=2),
    max_leaves=4,
)


@given(st.sampled_from([True, 1, 0.5, "a", Mode.AUTO, Gear.LOW, (1, 2), (1.0, 2.0)]), anything)
def test_whatever_comes_is_converted_or_refused(default: object, value: object) -> None:
    definition = defined(default)
    try:
        converted = definition.convert(value)
    except r2p.ParameterError:
        return
    assert type(converted) is type(default)
    assert definition.convert(converted) == converted


def test_kinds_have_the_names_that_users_read() -> None:
    assert [each.text for each in ParameterKind] == ["bool", "int", "float", "str", "enum", "ints", "floats"]
