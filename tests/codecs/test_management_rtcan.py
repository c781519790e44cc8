"""The management types of the RTCAN bus itself, byte by byte."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from r2p.codecs import UnknownType
from r2p.codecs import management as m
from r2p.errors import MessageError

LAYOUTS = [
    (
        m.Network(10, 5, 0x01020304, 0x1122334455, 60, 166_000, -2, 250),
        bytes([1, 10, 5, 4, 3, 2, 1, 0x55, 0x44, 0x33, 0x22, 0x11, 0, 0, 0, 60, 0x70, 0x88, 2, 0])
        + bytes([0xFE, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 250, 0]),
        0x40,
    ),
    (
        m.Claim(10, 0x1122334455667788, 5, m.CLAIM_FIXED | m.CLAIM_ELECTING),
        bytes([1, 10, 0x88, 0x77, 0x66, 0x55, 0x44, 0x33, 0x22, 0x11, 5, 3]),
        0x41,
    ),
    (
        m.Reserve(0x020A, 7, 2, 6, flags=m.RESERVE_ROUND_DOWN),
        bytes([1, 0x0A, 2, 7, 2, 6, 0, 0, 0, 0xFF, 0xFF, 0xFF, 0xFF, 1]),
        0x42,
    ),
    (
        m.Grant(0x020A, 7, 2, 6, 3, 0x1122334455, 9, 3000),
        bytes(
            [1, 0x0A, 2, 7, 2, 6, 0, 0, 0, 3, 0, 0, 0, 0x55, 0x44, 0x33, 0x22, 0x11, 0, 0, 0, 9, 0, 0, 0, 0xB8, 0x0B]
        ),
        0x43,
    ),
    (
        m.Refuse(0x020A, 7, 2, 1, 12, 20, 0x030B),
        bytes([1, 0x0A, 2, 7, 2, 1, 12, 0, 0, 0, 20, 0, 0, 0, 0x0B, 3]),
        0x44,
    ),
    (m.Release(0x020A), bytes([1, 0x0A, 2]), 0x45),
    (m.Renew(7, bytes(range(2, 26))), bytes([1, 7, *range(2, 26)]), 0x46),
    (m.Renewed(10, 7, 3000, bytes(range(2, 26))), bytes([1, 10, 7, 0xB8, 0x0B, *range(2, 26)]), 0x47),
]


@pytest.mark.parametrize(("message", "body", "code"), LAYOUTS, ids=lambda value: type(value).__name__)
def test_layouts(message: m.Management, body: bytes, code: int) -> None:
    data = body.ljust(31, b"\0") + bytes([code])
    assert m.encode(message) == data
    assert m.decode(data) == message
    assert code in m.RTCAN_TYPES


@pytest.mark.parametrize("code", [code for _, _, code in LAYOUTS])
@pytest.mark.parametrize("version", [0, 2])
def test_other_versions_are_ignored(code: int, version: int) -> None:
    with pytest.raises(UnknownType, match="version"):
        m.decode(bytes([version]).ljust(31, b"\0") + bytes([code]))


def test_what_fits_no_field_names_it() -> None:
    with pytest.raises(MessageError, match=r"Claim\.number"):
        m.encode(m.Claim(1, 1 << 64))
    with pytest.raises(MessageError, match=r"Network\.utc_error"):
        m.encode(m.Network(1, 1, 1, 1, 60, 166_000, 0, 0x10000))


u8, u16, u32, u64 = (st.integers(0, (1 << bits) - 1) for bits in (8, 16, 32, 64))
messages: st.SearchStrategy[m.Management] = st.one_of(
    st.builds(m.Network, u8, u8, u32, u64, u8, u32, st.integers(-(1 << 63), (1 << 63) - 1), u16),
    st.builds(m.Claim, u8, u64, u8, u8),
    st.builds(m.Reserve, u16, u8, u8, u32, u32, u8),
    st.builds(m.Grant, u16, u8, u8, u32, u32, u64, u32, u16),
    st.builds(m.Refuse, u16, u8, u8, u8, u32, u32, u16),
    st.builds(m.Release, u16),
    st.builds(m.Renew, u8, st.binary(min_size=24, max_size=24)),
    st.builds(m.Renewed, u8, u8, u16, st.binary(min_size=24, max_size=24)),
)


@given(messages)
def test_what_is_encoded_decodes(message: m.Management) -> None:
    data = m.encode(message)
    assert len(data) == m.SIZE
    assert m.decode(data) == message


def test_params_name_the_message_id() -> None:
    params = m.rtcan_params(0x1828)
    assert params == bytes.fromhex("28180000000000000000")
    assert m.rtcan_message_id(params) == 0x1828
