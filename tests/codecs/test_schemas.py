"""Answers to the question for a type."""

import pytest

from r2p.codecs import schemas
from r2p.errors import DecodeError
from r2p.messages import layout
from r2p.msg import Led

LED = layout(Led)


def test_an_answer_is_read_back() -> None:
    data = schemas.encode("Led", LED.schema)
    assert data == b"Led\nled:u32 value:u8"
    assert schemas.decode(data, LED.fingerprint) == ("Led", LED.schema)


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"Led",
        b"Led\nled:u32 value:u16",
        b"Led\nled:u32 value:u8 ",
        b"\xff\nled:u32 value:u8",
        b"x" * 50_000,
    ],
)
def test_an_answer_with_another_schema(data: bytes) -> None:
    with pytest.raises(DecodeError):
        schemas.decode(data, LED.fingerprint)
