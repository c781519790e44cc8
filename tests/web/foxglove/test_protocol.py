"""The codec of Foxglove's protocol: whatever a client sends is a message, or a DecodeError."""

from __future__ import annotations

import contextlib
import json
import struct
from typing import Any

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from r2p.errors import DecodeError
from r2p.web.foxglove import protocol

OPERATIONS = [
    "subscribe",
    "unsubscribe",
    "advertise",
    "unadvertise",
    "getParameters",
    "setParameters",
    "subscribeParameterUpdates",
    "fetchAsset",
]
KEYS = ["subscriptions", "channels", "id", "channelId", "topic", "encoding", "parameterNames", "parameters", "value"]
ANYTHING = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from(KEYS), inner, max_size=4),
    max_leaves=10,
)


@given(st.binary(max_size=40))
@example(b"\x02" + b"\xff" * 12)
@example(struct.pack("<BIII", 2, 1, 1, 2) + b"\xff\xff")
def test_no_bytes_raise_anything_else(data: bytes) -> None:
    with contextlib.suppress(DecodeError):
        protocol.decode(data)


@settings(max_examples=50)
@given(st.sampled_from(OPERATIONS), st.dictionaries(st.sampled_from(KEYS), ANYTHING, max_size=4))
def test_no_operation_raises_anything_else(op: str, values: dict[str, Any]) -> None:
    with contextlib.suppress(DecodeError):
        protocol.decode(json.dumps({"op": op, **values}))


@pytest.mark.parametrize(
    ("message", "text"),
    [
        ("xx", "malformed"),
        ("[]", "Expected `object`"),
        ('{"op":"nope"}', "'nope'"),
        ('{"op":"subscribe"}', "`subscriptions`"),
        ('{"op":"unsubscribe","subscriptionIds":[4294967296]}', "<= 4294967295"),
        ('{"op":"subscribe","subscriptions":' + "[" * 100_000, "invalid message"),
        ('{"op":"setParameters","parameters":[{"name":"a","value":' + "[" * 100_000, "invalid message"),
        ('{"op":"' + "x" * 5000 + '"}', "invalid message"),
        (b"", "it is empty"),
        (b"\x09", "opcode 9"),
        (b"\x01\x00", "of 2 bytes"),
        (struct.pack("<BIII", 2, 1, 1, 400) + b"json", "400 bytes with 4 bytes behind it"),
    ],
)
def test_an_error_says_what_is_wrong_in_few_words(message: str | bytes, text: str) -> None:
    with pytest.raises(DecodeError) as error:
        protocol.decode(message)
    assert text in str(error.value)
    assert len(str(error.value)) < 1100


def test_a_request_is_cut_where_its_encoding_ends() -> None:
    data = struct.pack("<BIII", 2, 7, 8, 4) + b"json{}"
    assert protocol.decode(data) == protocol.ServiceCall(7, 8, "json", b"{}")
    assert protocol.response(7, 8, "json", b"{}") == b"\x03" + data[1:]
