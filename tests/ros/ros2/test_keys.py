"""Keys, tokens, gids and attachments are those of rmw_zenoh, as two other implementations see them."""

from typing import Any

import pytest
import xxhash
from hypothesis import given
from hypothesis import strategies as st

import r2p
from r2p.ros.middleware import Qos
from r2p.ros.ros2.keys import (
    NO_HASH,
    EntityKind,
    RmwToken,
    data_key,
    decode_attachment,
    decode_token,
    encode_attachment,
    encode_token,
    gid_of,
    is_full_name,
)
from r2p.ros.type_names import dds_type, type_of_dds
from tests.ros.ros2.recorded import SESSION, SET_BOOL_HASH, STRING_HASH, qos_of, recorded, type_of

Case = dict[str, Any]

KINDS = {
    "publisher": EntityKind.PUBLISHER,
    "subscriber": EntityKind.SUBSCRIBER,
    "service_server": EntityKind.SERVER,
    "service_client": EntityKind.CLIENT,
}
TEXT_QOS = {"text_explicit", "text_full"}
"""Cases with defaults written out, which the encoder leaves empty: they are decoded only."""


def test_each_recorded_endpoint_has_these_keys_and_tokens() -> None:
    """Except where it isn't one of ROS: then r2p declares nothing, and accepts nothing."""
    for case in recorded()["endpoints"]:
        name = "/" + case["name"].removeprefix("/")
        own = case["node"] or case["tokens"][0].split("/")[8]  # the SDK invents a name for a node without one
        node = f"/{case['namespace'].strip('/')}/{own}".replace("//", "/")
        valid = is_full_name(name) and "/" not in own
        if "error" in case or not valid:
            assert not valid, case  # zenoh refuses some of these names, and ROS all of them
            for text in case.get("tokens", ()):
                if "/NN/" not in text:
                    with pytest.raises(r2p.DecodeError):
                        decode_token(text)
            continue
        assert data_key(case["domain"], name, type_of(case), case["type_hash"]) == case["key"]
        start = case["domain"], SESSION, case["node_id"]
        whole_qos = case["qos"] if isinstance(case["qos"], dict) else None
        expected = {RmwToken(*start, case["node_id"], EntityKind.NODE, node)}
        tokens = {decode_token(text) for text in case["tokens"]}
        (endpoint,) = tokens - expected
        assert tokens - {endpoint} == expected
        kind = KINDS[case["kind"]]
        qos = endpoint.qos if case["qos_name"] in TEXT_QOS else qos_of(whole_qos)
        assert endpoint == RmwToken(*start, case["entity_id"], kind, node, name, type_of(case), case["type_hash"], qos)
        if case["name"].startswith("/") and case["namespace"].startswith("/") and case["qos"] is None:
            assert {encode_token(each) for each in tokens} == set(case["tokens"])


def test_names() -> None:
    """A name that pamoja-ros2 refuses is refused here. The SDK makes keys of them, some of which zenoh refuses."""
    for case in recorded()["names"]:
        name = case["name"]
        assert is_full_name(name) == (case["pamoja_valid"] and case["pamoja_fully_qualified"]), case
        if is_full_name(name):
            topic = data_key(0, name, dds_type("std_msgs/String"), STRING_HASH)
            service = data_key(0, name, dds_type("std_srvs/SetBool", service=True), SET_BOOL_HASH)
            assert (topic, service) == (case["pamoja_key_topic"], case["pamoja_key_service"])
            assert (topic, service) == (case["sdk_key_topic"], case["sdk_key_service"])


def test_types() -> None:
    """`std_msgs/String` and `bad`, which the others leave as they are or refuse, are a short name here, and no name."""
    for case in recorded()["types"]:
        if case["pamoja_dds"] is None:
            with pytest.raises(r2p.DecodeError):
                type_of_dds(case["sdk_dds"])
            continue
        assert dds_type(case["type"]) == case["pamoja_dds"] == case["sdk_dds"]
        assert case["pamoja_key"].startswith(data_key(0, "/x", dds_type(case["type"]), "RIHS01_"))
        package, kind, name = case["type"].split("/")
        assert type_of_dds(case["sdk_dds"]) == (case["type"] if kind == "action" else f"{package}/{name}")
        assert case["sdk_back"] == case["type"]
    assert dds_type("std_msgs/String") == "std_msgs::msg::dds_::String_"
    assert dds_type("std_srvs/SetBool", service=True) == "std_srvs::srv::dds_::SetBool_"
    assert dds_type("test_msgs/Fibonacci_SendGoal", service=True) == "test_msgs::action::dds_::Fibonacci_SendGoal_"


def test_graph() -> None:
    """The topics and services of recorded tokens are those that the SDK lists; it hides names that begin with `_`."""
    for case in recorded()["graph"]:
        topics: dict[str, set[str]] = {}
        services: dict[str, set[str]] = {}
        for text in case["tokens"]:
            try:
                token = decode_token(text)
            except r2p.DecodeError:
                assert case["note"] in ("twelve fields only", "unknown kind", "node id is not a number")
                continue
            if token.kind in (EntityKind.PUBLISHER, EntityKind.SUBSCRIBER):
                topics.setdefault(token.name, set()).add(type_of_dds(token.type).replace("/", "/msg/"))
            elif token.kind == EntityKind.SERVER:
                services.setdefault(token.name, set()).add(type_of_dds(token.type).replace("/", "/srv/"))
        assert topics == {name: {*types} for name, types in case["topics_hidden"]}, case["note"]
        assert services == {name: {*types} for name, types in case["services"]}, case["note"]


def test_token_of_a_later_version() -> None:
    """ROS 2 Lyrical lists buffer backends behind the QoS; Humble has no hash; an enclave is kept."""
    start = f"@ros2_lv/7/{SESSION}/3/9/MS/%sec%ure/%robot1/camera/%robot1%image/sensor_msgs::msg::dds_::Image_"
    token = decode_token(f"{start}/{NO_HASH}/2:1:,5:,:,:,,/shm;cuda/more")
    assert (token.node, token.name, token.enclave) == ("/robot1/camera", "/robot1/image", "/sec/ure")
    assert (token.checksum, token.qos) == (NO_HASH, Qos(reliable=False, transient_local=True, depth=5))
    assert encode_token(token) == f"{start}/{NO_HASH}/2:1:,5:,:,:,,"


def test_attachments() -> None:
    for case in recorded()["attachments"]:
        data = bytes.fromhex(case["bytes"])
        if "error" in case:
            with pytest.raises(r2p.DecodeError):
                decode_attachment(data)
            continue
        gid = bytes.fromhex(case["gid"])
        # The SDK's numbers are unsigned, those of rmw_zenoh signed.
        sequence = case["sequence"] - 2**64 * (case["sequence"] >= 2**63)
        assert decode_attachment(data) == (sequence, case["source_time"], gid)
        if len(gid) == 16:
            assert data.startswith(encode_attachment(sequence, case["source_time"], gid))  # more may follow


def test_publications() -> None:
    """All recorded messages have an attachment of 33 bytes with a number, the time, and the gid of their publisher.

    rmw_zenoh counts from 1, and its gid is that of the token; the SDK counts from 0, with a random gid.
    """
    for case in [*recorded()["publications"], *recorded()["client_requests"]]:
        attachment, stamp, gid = case["attachment"], 2**60, bytes(range(16))
        data = encode_attachment(attachment["sequence"], stamp, gid)
        shown = data.hex().replace(stamp.to_bytes(8, "little").hex(), "<TIME_NS:8>").replace(gid.hex(), "<GID:16>")
        assert (len(data), shown) == (attachment["size"], attachment["hex"])


def test_gid() -> None:
    token = encode_token(RmwToken(0, SESSION, 1, 2, EntityKind.CLIENT, "/a", "/set", "x", NO_HASH))
    low_half_first = xxhash.xxh3_128(token.encode()).digest()[::-1]
    assert gid_of(token) == low_half_first


keys = st.text() | st.lists(st.sampled_from(["@ros2_lv", "0", "a", "MP", "NN", "%", "%x", "::,10:", NO_HASH, ""])).map(
    "/".join
)


@given(keys)
def test_hostile_tokens(key: str) -> None:
    """A token is refused, or has names that ROS can have."""
    for text in (key, recorded()["endpoints"][0]["tokens"][0].replace("probe", key)):
        try:
            token = decode_token(text)
        except r2p.DecodeError:
            continue
        assert is_full_name(token.node)
        assert decode_token(encode_token(token)) == token


@given(st.binary(max_size=64))
def test_hostile_attachments(data: bytes) -> None:
    try:
        sequence, stamp, gid = decode_attachment(data)
    except r2p.DecodeError:
        return
    assert len(data) >= 17 + len(gid)
    if len(gid) == 16:
        assert data.startswith(encode_attachment(sequence, stamp, gid))
