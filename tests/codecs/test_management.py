"""The management messages against the recordings, and against what only peers of another kind or time send."""

from collections.abc import Callable
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from r2p.codecs import UnknownType
from r2p.codecs import management as m
from r2p.codecs.debug import Reader
from r2p.errors import DecodeError, MessageError
from tests.vectors import Case, cases

TYPES: dict[str, Callable[..., m.Management]] = {
    "ALIVE": m.Alive,
    "STOP": m.Stop,
    "REBOOT": m.Reboot,
    "BOOTLOAD": m.Bootload,
    "ADVERTISE": m.Advertise,
    "SUBSCRIBE_REQUEST": m.SubscribeRequest,
    "SUBSCRIBE_RESPONSE": m.SubscribeResponse,
}


def recorded(case: Case) -> list[tuple[bytes, dict[str, Any]]]:
    entries = [entry for entry in case.transcript if entry.decoded.get("topic") == "R2P"]
    return [(Reader().feed(entry.data)[0].data, entry.decoded) for entry in entries]


def expected(decoded: dict[str, Any]) -> m.Management:
    cls = TYPES[decoded["type"]]
    if cls is m.Alive:
        return m.Alive(decoded["name"], decoded["flags"])
    if cls in (m.Stop, m.Reboot, m.Bootload):
        return cls(decoded["name"])
    params = bytes.fromhex(decoded["raw_params"])
    return cls(decoded["name"], decoded["payload_size"], decoded["queue_length"], params)


def padded(body: bytes, code: int) -> bytes:
    return body.ljust(31, b"\0") + bytes((code,))


@pytest.mark.golden
@pytest.mark.parametrize("case", [case for case in cases() if recorded(case)], ids=str)
def test_recorded_messages(case: Case) -> None:
    for data, decoded in recorded(case):
        message = m.decode(data)
        assert message == expected(decoded)
        if not (isinstance(message, m.SubscribeRequest) and message.queue == 0):
            assert m.encode(message) == data


def test_all_recorded_types_are_met() -> None:
    assert {decoded["type"] for case in cases() for _, decoded in recorded(case)} == set(TYPES)


LAYOUTS = [
    (m.Alive("IMU1", m.FLAG_REBOOTED | m.FLAG_BOOT), padded(b"IMU1\0\0\0\0\x06", 0x11)),
    (m.Path("IMUGW12", "ledpub12", "leds567890123456"), b"IMUGW12ledpub12leds567890123456\x31"),
    (m.Path("IMU1", "", "leds"), padded(b"IMU1\0\0\0" + bytes(8) + b"leds", 0x31)),
    (
        m.Hello("PC1", 0x12345678, m.HELLO_QUERY | m.HELLO_TOOL, 2, 5000),
        padded(b"\x01PC1\0\0\0\0\x78\x56\x34\x12\x03\x02\x88\x13", 0x50),
    ),
    (
        m.Hello("PC1", 0x12345678, 0, 0, 5000, 1, "12.34.56.dev78"),
        b"\x01PC1\0\0\0\0\x78\x56\x34\x12\0\0\x88\x13\x0112.34.56.dev78\x50",
    ),
    (
        m.TypeInfo(m.ROLE_SUBSCRIBES, "leds567890123456", b"ABCDEFGH", 5),
        padded(b"\x01\x02leds567890123456ABCDEFGH\x05\0", 0x51),
    ),
    (m.Unsubscribe("leds", 1), padded(b"\x01leds" + bytes(12) + b"\x01\0\0\0", 0x52)),
    (
        m.Endpoint(m.ROLE_PUBLISHES + m.ROLE_GONE, 7, "ledpub", "leds567890123456", m.CLASS_HRT),
        b"\x01\x81\x07\0\0\0ledpub\0\0leds567890123456\x03\x53",
    ),
    (m.Conflict("IMU1", 1, 2), padded(b"\x01IMU1\0\0\0\x01\0\0\0\x02\0\0\0", 0x54)),
    (m.Denied("GW", "IMU1", 0x13, m.DENIED_CONTROL), padded(b"\x01GW\0\0\0\0\0IMU1\0\0\0\x13\x01", 0x55)),
]


@pytest.mark.parametrize(("message", "data"), LAYOUTS, ids=lambda value: type(value).__name__)
def test_layouts_without_a_recording(message: m.Management, data: bytes) -> None:
    assert m.encode(message) == data
    assert m.decode(data) == message


@pytest.mark.parametrize("code", [0x12, 0x13, 0x14])
def test_a_tool_of_2013_leaves_the_reserved_byte_out(code: int) -> None:
    message = m.decode(padded(b"IMU1\0\0\0\x01", code))
    assert message in (m.Stop("IMU1"), m.Reboot("IMU1"), m.Bootload("IMU1"))


def test_what_stands_behind_a_name_means_nothing() -> None:
    data = b"leds\0garbage\xff\xff\xff\xff" + b"\x05\0" + b"\0\0" + b"\xcc" * 10 + b"\xaa" + b"\x21"
    assert m.decode(data) == m.Advertise("leds", 5, 0, b"\xcc" * 10)


@pytest.mark.parametrize(
    "data",
    [b"", bytes(31), bytes(33), padded(b"IMU\xff", 0x11), padded(b"\x1b[2J", 0x12), padded(b"\0IMU1", 0x11)],
    ids=["nothing", "short", "long", "not ASCII", "control characters", "no name"],
)
def test_bytes_that_are_no_message(data: bytes) -> None:
    with pytest.raises(DecodeError) as caught:
        m.decode(data)
    assert not isinstance(caught.value, UnknownType)


@pytest.mark.parametrize(
    "data",
    [padded(b"", 0x00), padded(b"x", 0x40), padded(b"x", 0xFF), padded(b"\x02PC1", 0x50), padded(b"\0PC1", 0x54)],
    ids=["RAW", "0x40", "0xFF", "version 2", "version 0"],
)
def test_messages_to_ignore(data: bytes) -> None:
    with pytest.raises(UnknownType):
        m.decode(data)


@pytest.mark.parametrize(
    ("message", "says"),
    [
        (m.SubscribeRequest("leds", 5, 0), "SubscribeRequest.queue = 0 halts firmware"),
        (m.Alive("IMU12345"), r"Alive.module = 'IMU12345': takes a name of 1 to 7"),
        (m.Alive(""), "Alive.module"),
        (m.Alive("gärtner"), "Alive.module"),
        (m.Alive("a\0b"), "Alive.module"),
        (m.Alive("IMU1", 256), "Alive.flags = 256: takes 1 unsigned bytes"),
        (m.Advertise("leds", 0x10000), "Advertise.size"),
        (m.Advertise("leds", 5, -1), "Advertise.queue"),
        (m.Advertise("leds", 5, 0, b"\0"), "Advertise.params = .* takes 10 bytes, not 1"),
        (m.TypeInfo(1, "leds", bytes(9), 5), "TypeInfo.fingerprint"),
        (m.Unsubscribe("leds", 1 << 32), "Unsubscribe.instance"),
    ],
    ids=lambda value: type(value).__name__ if isinstance(value, msgspec.Struct) else "",
)
def test_values_that_do_not_fit(message: m.Management, says: str) -> None:
    with pytest.raises(MessageError, match=says):
        m.encode(message)


@given(st.binary(min_size=31, max_size=31), st.sampled_from([*range(0x11, 0x15), *range(0x21, 0x24), 0x31, 0x40]))
def test_any_bytes_decode_or_raise_decode_error(body: bytes, code: int) -> None:
    try:
        message = m.decode(body + bytes((code,)))
    except DecodeError:
        return
    if not isinstance(message, m.SubscribeRequest) or message.queue:
        assert m.decode(m.encode(message)) == message


names = st.text(st.characters(min_codepoint=33, max_codepoint=126), min_size=1, max_size=7)
u8, u16, u32 = (st.integers(0, (1 << bits) - 1) for bits in (8, 16, 32))
roles = st.sampled_from([m.ROLE_PUBLISHES, m.ROLE_SUBSCRIBES])
messages: st.SearchStrategy[m.Management] = st.one_of(
    st.builds(m.Alive, names, u8),
    st.builds(m.SubscribeRequest, names, u16, st.integers(1, 0xFFFF), st.binary(min_size=10, max_size=10)),
    st.builds(m.Hello, names, u32, u8, u8, u16, u8, names),
    st.builds(m.TypeInfo, roles, names, st.binary(min_size=8, max_size=8), u16),
    st.builds(m.Endpoint, roles | roles.map(lambda role: role | m.ROLE_GONE), u32, st.just("") | names, names, u8),
    st.builds(m.Conflict, names, u32, u32),
)


@given(messages)
def test_what_is_encoded_decodes(message: m.Management) -> None:
    data = m.encode(message)
    assert len(data) == m.SIZE
    assert m.decode(data) == message


@pytest.mark.parametrize("role", [0, 3, 4, 127, 128, 131, 255])
def test_roles_to_ignore(role: int) -> None:
    for message in (m.Endpoint(role, 7, "n", "leds"), m.TypeInfo(role, "leds", m.ANY_TYPE, 5)):
        with pytest.raises(UnknownType, match=f"role {role} of"):
            m.decode(m.encode(message))


def test_an_endpoint_that_is_gone_has_its_role() -> None:
    message = m.Endpoint(m.ROLE_SUBSCRIBES | m.ROLE_GONE, 7, "n", "leds")
    assert m.decode(m.encode(message)) == message
    with pytest.raises(UnknownType):
        m.decode(m.encode(m.TypeInfo(m.ROLE_SUBSCRIBES | m.ROLE_GONE, "leds", m.ANY_TYPE, 5)))


def test_acks_and_what_gateways_hear_fill_their_fields() -> None:
    acks = m.encode_acks([(9, 1)], m.BRIDGE_ACKS)
    assert acks == b"\x09\0\0\0\x01\0" + bytes(6)
    assert m.decode_acks(acks) == [(9, 1), (0, 0)]
    heard = m.encode_heard([(1, 9, 2)])
    assert heard == b"\x01\x09\0\0\0\x02" + bytes(12)
    assert m.decode_heard(heard) == [(1, 9, 2)]


@pytest.mark.parametrize("order", [m.Stop("PC1"), m.Reboot("PC1"), m.Bootload("PC1")])
def test_an_order_has_the_type_of_its_bytes(order: m.Order) -> None:
    assert m.order_type(order) == m.type_of(m.encode(order))
    assert m.order_type(order) in m.ORDER_TYPES


@given(st.integers(0, m.PARTS_MAX - 1), st.integers(0, m.PARTS_MAX - 1))
def test_a_part_says_its_number_and_the_last_one(number: int, last: int) -> None:
    part = m.make_part(number, last)
    for message in (m.Mesh(9, 1, part, bytes(18)), m.Name("alias", part, "piece")):
        decoded = m.decode(m.encode(message))
        assert isinstance(decoded, m.Mesh | m.Name)
        assert m.split_part(decoded.part) == (number, last)


@given(st.integers(0, 0xFFFF), st.integers(1, 0x7FFF))
def test_serials_start_again_and_keep_their_order(serial: int, steps: int) -> None:
    later = (serial + steps) % 0x10000
    assert m.is_newer_serial(later, serial)
    assert not m.is_newer_serial(serial, later)
    assert not m.is_newer_serial(serial, serial)
    assert m.next_serial(0xFFFF) == 0


def test_a_leaf_names_its_link_by_one_byte() -> None:
    assert m.leaf_port(0x1FE) == 0xFE
    assert m.encode(m.Leaf(7, m.leaf_port(0x1FE), 1, bytes(18)))


def test_a_hello_of_before_has_no_versions() -> None:
    of_before = bytes.fromhex("01 50433100000000 78563412 01 00 8813") + bytes(15) + b"\x50"
    assert m.decode(of_before) == m.Hello("PC1", 0x12345678, m.HELLO_QUERY)
    assert m.encode(m.Hello("PC1", 0x12345678, m.HELLO_QUERY)) == of_before


def test_a_hello_carries_the_longest_lease() -> None:
    message = m.Hello("PC1", 7, lease_ms=m.LEASE_MS_MAX)
    assert m.decode(m.encode(message)) == message
