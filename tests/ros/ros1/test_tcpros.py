"""The codec of TCPROS: what goes in comes out, in any pieces, and no bytes raise."""

from __future__ import annotations

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from r2p.errors import DecodeError
from r2p.ros.middleware import RosService, RosType
from r2p.ros.ros1 import tcpros
from r2p.ros.ros1.tcpros import FrameReader, ResponseReader, TcprosResponse

NAMES = st.text(st.characters(exclude_characters="=", codec="utf-8"), min_size=1, max_size=20)
HEADERS = st.dictionaries(NAMES, st.text(max_size=50), max_size=6)
STRING = RosType("std_msgs/String", "992ce8a1687cec8c8bd883ec73ca41d1", "string data\n")
SET_BOOL = RosService("std_srvs/SetBool", "09fb03525b03e7ea1fd3992bafd87e16")


def pieces(data: bytes, cuts: list[int]) -> list[bytes]:
    places = [0, *sorted(cut % (len(data) + 1) for cut in cuts), len(data)]
    return [data[a:b] for a, b in itertools.pairwise(places)]


@given(HEADERS, st.lists(st.binary(max_size=200)), st.lists(st.integers(0, 5000)))
def test_a_header_and_the_messages_behind_it_in_any_pieces(
    fields: dict[str, str], messages: list[bytes], cuts: list[int]
) -> None:
    data = tcpros.encode_header(fields) + b"".join(map(tcpros.frame, messages))
    reader, block, found = FrameReader(), None, list[bytes]()
    for piece in pieces(data, cuts):
        if block is None:
            block = reader.first(piece)
            found += reader.feed(b"") if block is not None else []
        else:
            found += reader.feed(piece)
    assert block is not None
    assert tcpros.decode_header(block) == fields
    assert (found, reader.broken) == (messages, "")


@given(st.lists(st.tuples(st.booleans(), st.text(max_size=60)), max_size=5), st.lists(st.integers(0, 5000)))
def test_responses_in_any_pieces(responses: list[tuple[bool, str]], cuts: list[int]) -> None:
    data = b"".join(
        tcpros.encode_response(text.encode()) if ok else tcpros.encode_failure(text) for ok, text in responses
    )
    reader = ResponseReader()
    found = [response for piece in pieces(data, cuts) for response in reader.feed(piece)]
    assert found == [TcprosResponse(ok, text.encode()) for ok, text in responses]


@given(st.lists(st.binary(max_size=60), max_size=5), st.integers(0, 80))
def test_any_bytes_end_in_frames_or_a_reason_and_hold_no_more_than_came(received: list[bytes], limit: int) -> None:
    reader, responses = FrameReader(limit), ResponseReader()
    first = reader.first(b"".join(received[:1]))
    frames = [frame for data in received[1:] for frame in reader.feed(data)]
    for each in [first or b"", *frames]:
        assert len(each) <= limit
    for data in received:
        responses.feed(data)
    assert sum(map(len, frames)) + len(first or b"") <= sum(map(len, received))
    if reader.broken:
        assert reader.feed(b"\0\0\0\0") == []
        assert reader.first(b"\0\0\0\0") is None


@given(st.binary(max_size=100))
def test_any_block_is_a_header_or_a_decode_error(block: bytes) -> None:
    try:
        fields = tcpros.decode_header(block)
    except DecodeError:
        return
    assert all(name and isinstance(value, str) for name, value in fields.items())


def test_a_field_is_split_at_its_first_equals_sign_and_the_last_of_two_counts() -> None:
    block = b"".join(map(tcpros.frame, (b"cookie=a=b", b"topic=/a", b"topic=/b")))
    assert tcpros.decode_header(block) == {"cookie": "a=b", "topic": "/b"}


@pytest.mark.parametrize(
    ("reader", "data"),
    [
        (FrameReader(), b"GET / HTTP/1.0\r\n"),
        (ResponseReader(), b"HTTP/1.1 400"),
        (ResponseReader(), b"\1\xff\xff\xff\xff"),
    ],
    ids=["a browser", "a web server", "4 GiB"],
)
def test_what_is_not_tcpros_is_named(reader: FrameReader | ResponseReader, data: bytes) -> None:
    assert reader.feed(data) == []
    assert reader.broken


def test_a_wrong_type_is_said_in_words_that_name_both_sides() -> None:
    theirs = {"callerid": "/wrong", "type": "std_msgs/Int32", "md5sum": "da5909fbe378aeaf85e547e830cc1bb7"}
    assert tcpros.refuse_subscriber(theirs, "/talker", "/chat", STRING) == (
        "[/wrong] wants [/chat] as std_msgs/Int32 (md5 da5909fbe378aeaf85e547e830cc1bb7), but [/talker] publishes "
        "std_msgs/String (md5 992ce8a1687cec8c8bd883ec73ca41d1): use the same definition of the type on both sides"
    )
    assert "but here it is std_msgs/String" in tcpros.refuse_publisher(theirs, "/chat", STRING)
    assert "but [/server] serves std_srvs/SetBool" in tcpros.refuse_caller(theirs, "/server", "/set", SET_BOOL)
    assert "but here it is std_srvs/SetBool" in tcpros.refuse_server(theirs, "/set", SET_BOOL)


@pytest.mark.parametrize("checksum", ["*", STRING.checksum])
def test_any_type_fits_an_asterisk(checksum: str) -> None:
    fields = {"callerid": "/x", "type": "*", "md5sum": checksum}
    assert tcpros.refuse_subscriber(fields, "/talker", "/chat", STRING) == ""
    assert tcpros.refuse_publisher(fields, "/chat", STRING) == ""
    assert tcpros.refuse_publisher(fields | {"md5sum": "0"}, "/chat", RosType("*", "*")) == ""
