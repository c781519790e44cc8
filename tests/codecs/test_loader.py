"""The loader's messages against the recordings."""

import re
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from r2p.codecs import UnknownType, loader
from r2p.codecs.debug import Reader
from r2p.errors import DecodeError, MessageError
from tests.vectors import Case, cases

RENAMED = {("IHEX_RECORD", "kind"): "rectype", ("PARAM_REQUEST", "length"): "param_length"}
EMPTY: list[tuple[loader.Loader, int]] = [
    (loader.Nack(), 0),
    (loader.Ack(), 1),
    (loader.BeginLoader(), 2),
    (loader.EndLoader(), 3),
    (loader.RemoveLast(), 8),
    (loader.RemoveAll(), 9),
    (loader.BeginAppinfo(), 10),
    (loader.EndAppinfo(), 11),
    (loader.BeginSetparam(), 13),
    (loader.EndSetparam(), 14),
    (loader.BeginGetparam(), 15),
    (loader.EndGetparam(), 16),
]


def recorded(case: Case) -> list[tuple[bytes, dict[str, Any]]]:
    entries = [entry for entry in case.transcript if entry.decoded.get("topic") == "BOOT_IMU1"]
    return [(Reader().feed(entry.data)[0].data, entry.decoded) for entry in entries]


def as_recorded(value: Any) -> Any:
    """The recordings write addresses as 0x..., and bytes in hex."""
    if isinstance(value, str) and value.startswith("0x"):
        return int(value, 16)
    return value.hex() if isinstance(value, bytes) else value


@pytest.mark.golden
@pytest.mark.parametrize("case", cases("bootloader"), ids=str)
def test_recorded_messages(case: Case) -> None:
    for data, decoded in recorded(case):
        if decoded.get("type", "0x").startswith("0x"):
            continue  # damaged on purpose, see below
        message = loader.decode(data)
        type_name = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", type(message).__name__).upper()
        assert type_name == decoded["type"]
        fields = ["line"] if type_name == "NACK" else list(message.__struct_fields__)
        for field in fields:
            was = decoded[RENAMED.get((type_name, field), field)]
            assert as_recorded(getattr(message, field)) == as_recorded(was), (type_name, field)
        assert loader.encode(message) == data


@pytest.mark.golden
def test_all_types_are_recorded() -> None:
    met = {data[-1] for case in cases("bootloader") for data, _ in recorded(case)}
    assert met - {0x63} == set(range(19))


@pytest.mark.parametrize(("message", "code"), EMPTY, ids=lambda value: type(value).__name__)
def test_messages_without_content(message: loader.Loader, code: int) -> None:
    assert loader.encode(message) == bytes(30) + bytes((code,))
    assert loader.decode(bytes(30) + bytes((code,))) == message


def test_a_nack_that_firmware_never_filled() -> None:
    value = b"\x01\x02".ljust(24, b"\0")
    data = b"\x34\x12\x03\x05" + value + b"\0\0" + b"\0"
    message = loader.Nack(0x1234, loader.REASON_OUT_OF_RANGE, loader.VALUE_LENGTH, value)
    assert loader.decode(data) == message
    assert loader.encode(message) == data


def test_a_name_that_was_cut_by_a_power_cut_is_shown_as_far_as_it_goes() -> None:
    """An app must be seen to be removed."""
    data = bytes(16) + b"AP\xff\x07P" + bytes(9) + b"\x04"
    assert loader.decode(data) == loader.LinkingSetup(0, 0, 0, 0, "AP??P")


@pytest.mark.golden
def test_recorded_damage() -> None:
    (unknown,) = (data for case in cases(name="boot_mode_start") for data, _ in recorded(case) if data[-1] == 0x63)
    with pytest.raises(UnknownType, match="0x63"):
        loader.decode(unknown)
    (short,) = (data for case in cases(name="load_wrong_length_line") for data, _ in recorded(case) if len(data) == 30)
    with pytest.raises(DecodeError, match="30 bytes instead of 31"):
        loader.decode(short)
    (lie,) = (data for case in cases(name="load_record_count_lies") for data, _ in recorded(case) if data[0] == 20)
    assert loader.decode(lie) == loader.IhexRecord(20, 0xF450, 0, bytes(16), 168)


@pytest.mark.parametrize(
    ("message", "says"),
    [
        (loader.ParamChunk(b"short"), "ParamChunk.data = b'short': takes 16 bytes, not 5"),
        (loader.ParamRequest(0, "APPLICATION", 4), "ParamRequest.appname"),
        (loader.ParamRequest(0, "APP1", 256), "ParamRequest.length"),
        (loader.IhexRecord(16, 0x10000, 0, bytes(16), 0), "IhexRecord.offset"),
    ],
    ids=lambda value: type(value).__name__ if isinstance(value, msgspec.Struct) else "",
)
def test_values_that_do_not_fit(message: loader.Loader, says: str) -> None:
    with pytest.raises(MessageError, match=says):
        loader.encode(message)


@given(st.binary(min_size=30, max_size=30), st.integers(0, 20))
def test_any_bytes_decode_or_raise_decode_error(body: bytes, code: int) -> None:
    try:
        message = loader.decode(body + bytes((code,)))
    except DecodeError:
        return
    assert loader.decode(loader.encode(message)) == message
