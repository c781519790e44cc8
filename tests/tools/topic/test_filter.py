"""Filter expressions: what they mean, what they may not do, and what their errors say."""

from __future__ import annotations

import contextlib
from typing import Annotated

import pytest
from hypothesis import given
from hypothesis import strategies as st

import r2p
from r2p.msg import Header, Image, JointState, LaserScan, StampedPose3, Text, Velocity3
from r2p.tools.topic.filter import BITS_MAX, LENGTH_MAX, Filter, FilterError


class Mixed(r2p.Message):
    """Fields of all kinds."""

    n: r2p.i32 = 0
    x: r2p.f64 = 0.0
    f: r2p.f32 = 0.0
    flag: bool = False
    name: Annotated[str, r2p.Len(8)] = ""
    value: tuple[r2p.f32, r2p.f32, r2p.f32] = (0.0, 0.0, 0.0)
    poses: tuple[Velocity3, Velocity3] = (Velocity3(), Velocity3())
    stamp: r2p.Timestamp = r2p.Timestamp()
    true: r2p.u8 = 7


SAMPLE = Mixed.decode(
    Mixed(
        n=-5,
        x=2.5,
        f=0.1,
        flag=True,
        name="left",
        value=(0.1, float("nan"), float("-inf")),
        poses=(Velocity3(), Velocity3(w=0.25)),
        stamp=r2p.Timestamp(11, 5),
    ).encode()
)


@pytest.mark.parametrize(
    "text",
    [
        "n == -5 and x > 2 and not x > 3",
        " 2 < x <= 2.5 != 3 ",
        "f == 0.1",  # the value that is printed, not the nearest f32
        "value[0] == 0.1 and min(value[0:1]) == 0.1",
        "isnan(value[1]) and value[2] == -inf and x < inf",
        "value[n + 5] in (0.1, 0.2)",
        "stamp.sec % 2 == 1 and stamp.nsec // 2 == 2",
        "poses[1].w == 0.25 and len(poses) == 2",
        "flag and flag == True and flag != false",
        "true == 7",  # a field of that name wins
        "name == 'left' and 'ef' in name and name not in ['right'] and name < 'right' and len(name) == 4",
        "abs(n) == 5 and round(x * 1.01, 1) == 2.5 and max(n, x) == 2.5 and sum(value[:1]) == 0.1",
        "hypot(3, 4) == sqrt(25) == 5",
        "n & 1 == 1 and n & 1 != 0 and 1 << 3 == 8 and 2 ** 10 == 1024 and ~0 == -1 and n ^ n == 0",
        "x",
        "name == '' or n",
    ],
)
def test_what_passes(text: str) -> None:
    made = Filter(text)
    made.bind(Mixed)
    assert made.passes(SAMPLE)
    assert not Filter(f"not ({text.strip()})").passes(SAMPLE)


_NUMBERS: st.SearchStrategy[str] = st.deferred(
    lambda: st.one_of(
        st.sampled_from(["n", "x", "flag", "stamp.sec", "poses[1].w", "value[0]", "len(value)", "sum(value)"]),
        st.integers(0, 9).map(str),
        st.floats(0, 9).map(str),
        st.builds("({} {} {})".format, _NUMBERS, st.sampled_from(["+", "-", "*", "/", "//", "%"]), _NUMBERS),
        st.builds("({} ** {})".format, _NUMBERS, st.integers(0, 3)),
        st.builds("-{}".format, _NUMBERS),
        st.builds("{}({}, {})".format, st.sampled_from(["min", "max"]), _NUMBERS, _NUMBERS),
        st.builds("abs({})".format, _NUMBERS),
        st.builds("round({}, {})".format, _NUMBERS, st.integers(-3, 3)),
    )
)
_CONDITIONS: st.SearchStrategy[str] = st.deferred(
    lambda: st.one_of(
        st.builds("{} {} {}".format, _NUMBERS, st.sampled_from(["<", "<=", ">", ">=", "==", "!="]), _NUMBERS),
        st.builds("{} in ({}, {})".format, _NUMBERS, _NUMBERS, _NUMBERS),
        st.builds("({}) {} ({})".format, _CONDITIONS, st.sampled_from(["and", "or"]), _CONDITIONS),
        st.builds("not ({})".format, _CONDITIONS),
    )
)


@given(_CONDITIONS.filter(lambda text: len(text) <= LENGTH_MAX), st.integers(-9, 9), st.floats(width=32))
def test_an_expression_means_what_it_means_in_python(text: str, n: int, x: float) -> None:
    message = Mixed(n=n, x=x, flag=n > 0, value=(0.5, 1.5, -2.0), poses=(Velocity3(), Velocity3(w=0.5)))
    fields = {name: getattr(message, name) for name in message.__struct_fields__}
    made = Filter(text)
    passed = made.passes(message)
    expected, reason = False, ""
    try:
        expected = eval(text, {}, fields)
    except (ArithmeticError, ValueError) as error:
        reason = str(error)
    assert (passed, made.reason) == (expected, reason) or "128 bits" in made.reason


@given(st.text(alphabet="nxf.()[]0123456789 +-*/%<>=!&|~^,:'\"\\{}lambdtruefisgo", max_size=60))
def test_any_text_is_a_filter_or_an_error(text: str) -> None:
    with contextlib.suppress(FilterError):
        Filter(text).passes(SAMPLE)


@pytest.mark.parametrize(
    "text",
    [
        "__import__('os').system('true')",
        "n.__class__",
        "x.real",
        "stamp.ns",  # a property, not a field
        "stamp.from_ns(1)",
        "name.upper() == 'LEFT'",
        "min.__self__",
        "().__class__",
        "name.__len__",
        "eval('n')",
        "[y for y in value]",
        "lambda: 0",
        "f'{n}'",
        "(n := 3)",
        "n if flag else x",
        "n is x",
        "b'x' == name",
        "3j == n",
        "... == n",
        "{'a': n}",
        "max(*value)",
        "max(value, key=abs)",
        "name * 1000000000",
        "value * 1000000000",
        "'%1000000000d' % n",
        "(1, 2) + (3, 4)",
        f"n < {1 << BITS_MAX}",
        "x" + " + x" * 200,
        "-" * 500 + "x",
        "(" * 300 + "x" + ")" * 300,
        "x > 1" + " " * LENGTH_MAX,
        "x == '\0'",
    ],
)
def test_what_is_not_allowed(text: str) -> None:
    with pytest.raises(FilterError):
        Filter(text).bind(Mixed)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("9 ** 9 ** 9 ** 9 > n", "an exponent of more than 128"),
        ("(n + 99) ** 100 > 0", "an integer of more than 128 bits"),
        ("1 << 10 ** 9 > 0", "a shift that is not from 0 to 128"),
        ("round(n, -10 ** 9) > 0", "rounding to more than 20 digits"),
        ("10.0 ** 400 > x", "(34, 'Numerical result out of range')"),
        ("n ** 0.5 > 0", "root of a negative number"),
        ("1 / stamp.nsec > 0", "division by zero"),
        ("value[n] > 0", "tuple index out of range"),
        ("max(value[2:1]) > 0", "max() of no values"),
        ("min(name) > 'a'", "min() of no values"),
    ],
)
def test_without_a_value_a_message_does_not_pass(text: str, reason: str) -> None:
    made = Filter(text)
    assert not made.passes(Mixed(n=-5))
    assert made.reason == reason
    assert made.summary == f"0 of 1 messages passed the filter; it was undefined for 1: {reason}"


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("acc > 3", "Mixed has no field acc; the fields are n, x, f, flag, name, value, poses[0].x, "),
        ("stmp.sec > 3", "Mixed has no field stmp; did you mean stamp.sec?"),
        ("stamp.secs > 3", "Mixed has no field stamp.secs; did you mean stamp.sec?"),
        ("nsec > 3", "Mixed has no field nsec; did you mean stamp.nsec?"),
        ("stamp > 3", "stamp has fields: write stamp.sec or stamp.nsec"),
        ("x[0] > 3", "x is not an array"),
        ("value[3] > 3", "value[3]: value has 3 values, from 0 on"),
        ("x = 3", "filter 'x = 3': invalid syntax; write == to compare"),
        ("x > 3 && n < 2", "invalid syntax; write and, or, not"),
        ("!flag", "invalid syntax; write and, or, not"),
        ("x > 3 & n < 2 & flag", "join conditions with and, or, not, not with &, |, ^"),
        ("(x > 3) & (n < 2)", "& takes integers; join conditions with and, or, not"),
        ("name > 3", "filter 'name > 3': a text can't be compared with a number"),
        ("name == 3", "a text can't be compared with a number"),
        ("value > 3", "a list can't be compared with a number"),
        ("value + 1 > 3", "+ takes numbers, not a list and a number"),
        ("norm(value) > 3", "norm() is not allowed in a filter; the functions are abs, "),
        ("", "filter '': invalid syntax"),
    ],
)
def test_what_errors_say(text: str, error: str) -> None:
    with pytest.raises(FilterError) as caught:
        Filter(text).bind(Mixed)
    assert error in str(caught.value)


@pytest.mark.parametrize(
    "text",
    [
        "min(ranges) < 0.1 <= ranges[1]",
        "len(ranges) == 3 and 0.3 in ranges and 0.4 not in ranges",
        "ranges[-1] == 0.3 and ranges[1:] == (0.1, 0.3) and sum(ranges[:1]) == 0.05",
        "len(intensities) == 0 and intensities == () and ranges != ()",
        "header.frame_id == 'laser' and len(header.frame_id) == 5",
    ],
)
def test_arrays_of_variable_length(text: str) -> None:
    scan = LaserScan(Header(frame_id="laser"), ranges=r2p.Array([0.05, 0.1, 0.3]))
    made = Filter(text)
    assert made.passes(LaserScan.decode(scan.encode()))
    assert not made.passes(LaserScan())


def test_bytes_and_names_in_arrays() -> None:
    assert Filter("data[0] == 7 and 8 in data and len(data) == 2").passes(Image(data=r2p.Array(b"\7\10")))
    assert Filter("'left' in name and name[0] == 'left'").passes(JointState(name=("left", "right")))


def test_an_element_that_is_not_there() -> None:
    made = Filter("ranges[5] > 1")
    assert not made.passes(LaserScan(ranges=r2p.Array([1.0])))
    assert made.undefined == 1
    with pytest.raises(FilterError, match="ranges has at most 16384 values, from 0 on"):
        Filter("ranges[16384] > 1").bind(LaserScan)


def test_it_follows_the_type_of_the_messages_and_counts_them() -> None:
    made = Filter("x > 1")
    assert [made.passes(each) for each in (StampedPose3(x=2.0), Velocity3(x=2.0), Velocity3(x=1.0))] == [
        True,
        True,
        False,
    ]
    assert made.summary == "2 of 3 messages passed the filter"
    with pytest.raises(FilterError, match="Text has no field x"):
        made.passes(Text())


def test_a_misfit_in_a_branch_is_found_when_it_is_come_to() -> None:
    made = Filter("n == 0 or name > 3")
    made.bind(Mixed)
    assert made.passes(Mixed())
    with pytest.raises(FilterError, match="can't be compared"):
        made.passes(Mixed(n=1))
