"""The header of requests and responses, and the texts of errors."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from r2p.codecs import UnknownType, services
from r2p.codecs.services import HEADER_SIZE, TEXT_MIN, Kind, ServiceHeader
from r2p.errors import DecodeError

U32 = st.integers(0, (1 << 32) - 1)
HEADERS = st.builds(ServiceHeader, U32, st.integers(0, 0xFFFF), st.sampled_from(Kind), U32)


def test_the_bytes_of_a_request() -> None:
    header = ServiceHeader(0x12345678, 258, Kind.REQUEST, 0x9ABCDEF0)
    assert services.encode(header, b"\x01\x02").hex(" ", -4) == "78563412 02010001 f0debc9a 0102"


@given(HEADERS, st.binary(max_size=40), st.integers(0, 64))
def test_what_is_encoded_is_decoded(header: ServiceHeader, body: bytes, size: int) -> None:
    data = services.encode(header, body, size and max(size, HEADER_SIZE))
    assert services.decode(data) == header
    assert not size or len(data) == max(size, HEADER_SIZE)


@given(st.binary(max_size=64))
def test_any_bytes_are_a_header_or_a_decode_error(data: bytes) -> None:
    try:
        header = services.decode(data)
    except DecodeError:
        return
    assert services.encode(header, data[HEADER_SIZE:]) == data


@pytest.mark.parametrize("data", [bytes(6) + b"\0\x02" + bytes(4), bytes(6) + b"\x06\x01" + bytes(4)])
def test_another_version_or_kind_is_unknown(data: bytes) -> None:
    with pytest.raises(UnknownType):
        services.decode(data)


@given(st.text(), st.integers(0, 300))
def test_a_text_fits_or_is_cut(text: str, room: int) -> None:
    data = services.encode_text(text, room)
    assert len(data) <= room
    shown = services.decode_text(data.ljust(room, b"\0"))
    if room < TEXT_MIN:
        assert not shown
    else:
        plain = text.replace("\0", "?").encode(errors="replace").decode()
        assert shown == plain or (shown.endswith("...") and plain.startswith(shown[:-3]))
