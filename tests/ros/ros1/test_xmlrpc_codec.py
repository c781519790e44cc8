"""XMLRPC's XML: what goes through, what is changed on the way, and bytes of any kind."""

from __future__ import annotations

import contextlib
import xmlrpc.client
from typing import Any

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from r2p.errors import DecodeError
from r2p.ros.ros1.xmlrpc_codec import (
    DEPTH_MAX,
    XmlCall,
    XmlFault,
    XmlParser,
    XmlResult,
    encode_call,
    encode_fault,
    encode_result,
)

TEXT = st.text(st.characters(codec="utf-8", exclude_categories=("Cc", "Cs"), exclude_characters="\ufffe\uffff"))
VALUES: st.SearchStrategy[Any] = st.recursive(
    st.booleans() | st.integers(-(2**31), 2**31 - 1) | st.floats(allow_nan=False) | TEXT | st.binary(max_size=20),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(TEXT, inner, max_size=4),
    max_leaves=12,
)


def parsed(data: bytes, piece: int = 1 << 20) -> XmlParser:
    parser = XmlParser()
    for start in range(0, len(data), piece):
        parser.feed(data[start : start + piece])
    return parser


@given(VALUES, st.integers(1, 50))
def test_values_go_through_and_mean_the_same_to_python(value: Any, piece: int) -> None:
    data = encode_result(value)
    assert parsed(data, piece).answer() == XmlResult(value)
    assert xmlrpc.client.loads(data.decode(), use_builtin_types=True)[0] == (value,)
    assert parsed(encode_call("getPid", ("/me", value))).call() == XmlCall("getPid", ["/me", value])


@pytest.mark.parametrize(
    ("value", "carried"),
    [
        (2**31, float(2**31)),
        (-(2**40), float(-(2**40))),
        ("a\x00b\x1b\ufffe", "a\ufffdb\ufffd\ufffd"),
        ({1: (2, 3)}, {"1": [2, 3]}),
    ],
)
def test_what_xmlrpc_does_not_have_becomes_what_is_nearest(value: object, carried: object) -> None:
    assert parsed(encode_result(value)).answer() == XmlResult(carried)  # type: ignore[arg-type]


def test_faults() -> None:
    assert parsed(encode_fault(-1, "no\x07")).answer() == XmlFault(-1, "no\ufffd")


def test_values_without_a_type_are_texts() -> None:
    """As roscpp writes them."""
    data = b"<methodCall><methodName>f</methodName><params><param><value>/me</value></param></params></methodCall>"
    assert parsed(data).call() == XmlCall("f", ["/me"])


def test_times_and_large_decimals_are_kept_as_text_and_double() -> None:
    data = b"""<methodResponse><params><param><value><array><data><value><dateTime.iso8601>20260101T00:00:00
        </dateTime.iso8601></value><value><bigdecimal>1.5</bigdecimal></value></data></array></value></param></params>
        </methodResponse>"""
    match parsed(data).answer():
        case XmlResult([text, number]):
            assert (str(text).strip(), number) == ("20260101T00:00:00", 1.5)


CALL = encode_call("f", ({"a": [1, 2.5, True, "x", b"y"]},))
FRAGMENTS = st.sampled_from(
    [
        *(f"<{slash}{tag}>".encode() for slash in ("", "/") for tag in ("params", "param", "value", "array", "struct")),
        *(f"<{slash}{tag}>".encode() for slash in ("", "/") for tag in ("data", "member", "name", "fault", "int")),
        *(f"<{slash}{tag}>".encode() for slash in ("", "/") for tag in ("methodCall", "methodName", "methodResponse")),
        b"<!DOCTYPE a [<!ENTITY b 'c'>]>",
        b"<boolean>2</boolean>",
        b"<int>x</int>",
        b"<nil/>",
        b"<i8>99999999999999999999</i8>",
        b"<base64>!</base64>",
        b"<?xml version='1.0' encoding='utf-16'?>",
        b"\xff\xfe<\x00",
    ]
)


@given(st.lists(FRAGMENTS | st.binary(max_size=8), max_size=24).map(b"".join), st.booleans())
@example(CALL.replace(b"</struct>", b"</struct></array>"), False)
@example(b"<methodResponse><fault><value><int>1</int></value></fault></methodResponse>", True)
@example(b"<methodResponse><fault><value><struct></struct></value></fault></methodResponse>", True)
@example(b"<params/>", True)
def test_any_bytes_are_parsed_or_refused(data: bytes, answers: bool) -> None:
    try:
        parser = parsed(data, 7)
        assert isinstance(parser.answer() if answers else parser.call(), XmlResult | XmlFault | XmlCall)
    except DecodeError:
        pass


@given(st.integers(0, len(CALL) - 1), st.binary(min_size=1, max_size=3))
def test_damaged_calls(at: int, damage: bytes) -> None:
    with contextlib.suppress(DecodeError):
        parsed(CALL[:at] + damage + CALL[at + len(damage) :]).call()


def test_what_would_grow_is_refused() -> None:
    entities = b"<!DOCTYPE x [<!ENTITY a 'aaaaaaaaaa'><!ENTITY b '&a;&a;&a;&a;'>]><methodCall>&b;</methodCall>"
    with pytest.raises(DecodeError, match="a document type"):
        parsed(entities)
    with pytest.raises(DecodeError, match=f"more than {DEPTH_MAX} tags deep"):
        parsed(b"<value>" * (DEPTH_MAX + 1))
    deep: Any = 1
    for _ in range(60):
        deep = {"a": deep}
    assert parsed(encode_result(deep)).answer() == XmlResult(deep)
