"""Keys, liveliness tokens, gids and attachments of rmw_zenoh, the middleware of ROS 2 over zenoh.

Messages of a topic, and requests of a service, have the key

    DOMAIN/NAME/TYPE/HASH       0/robot1/scan/sensor_msgs::msg::dds_::LaserScan_/RIHS01_64c191...

Each node, publisher (MP), subscriber (MS), server (SS) and client (SC) declares a liveliness token. In its fields `/`
is written as `%`; an empty enclave or namespace is `%`. Fields behind the QoS are those of later versions:

    @ros2_lv/DOMAIN/SESSION/NODE_ID/NODE_ID/NN/ENCLAVE/NAMESPACE/NODE
    @ros2_lv/DOMAIN/SESSION/NODE_ID/ENTITY_ID/MP/ENCLAVE/NAMESPACE/NODE/NAME/TYPE/HASH/QOS

Each message, request and response has an attachment of 33 bytes, little-endian: the sequence number (i64), the time of
its publisher (i64, ns), 16 (u8), and the gid. That is the XXH3-128 of the token, so it names the endpoint in the graph.
A response has the number and the gid of its request.
"""

import re
import struct
from enum import StrEnum

import msgspec
import xxhash

from r2p.errors import DecodeError
from r2p.ros.middleware import Qos
from r2p.ros.ros2.qos import decode_qos, encode_qos
from r2p.ros.type_names import type_of_dds

TOKENS = "@ros2_lv"
"""The first part of the key of each liveliness token."""

NO_HASH = "TypeHashNotSupported"
"""What ROS 2 Humble has in place of a type's hash."""

GID_BYTES = 16
ATTACHMENT = struct.Struct("<qqB16s")
"""Sequence number, time in ns, GID_BYTES, and the gid."""

ATTACHMENT_MAX = 512
"""Bytes of an attachment; longer ones are not read."""

_START = struct.Struct("<qqB")
_TOKEN_MAX = 2048  # characters; names in ROS have at most 255
_NODE_FIELDS, _ENDPOINT_FIELDS = 9, 13
_NAME = re.compile(r"(?:/[A-Za-z_][A-Za-z0-9_]*)+")
_NUMBER = re.compile(r"[0-9]{1,19}")
_SESSION = re.compile(r"[0-9a-f]{1,32}")
_HASH = re.compile(r"RIHS[0-9]{2}_[0-9a-f]{64}")


class EntityKind(StrEnum):
    """What a token stands for."""

    NODE = "NN"
    PUBLISHER = "MP"
    SUBSCRIBER = "MS"
    SERVER = "SS"
    CLIENT = "SC"


_KINDS = frozenset(each.value for each in EntityKind)


class RmwToken(msgspec.Struct, frozen=True):
    """A liveliness token: a node, or one of its endpoints (`name` of the topic or service; `type` as in keys)."""

    domain: int
    session: str
    node_id: int
    entity_id: int
    kind: EntityKind
    node: str
    name: str = ""
    type: str = ""
    checksum: str = ""
    qos: Qos = Qos()
    enclave: str = ""

    @property
    def key(self) -> tuple[str, str, str]:
        """What two endpoints have in common whose messages reach each other."""
        return self.name, self.type, self.checksum


def is_full_name(name: str) -> bool:
    """Return whether ROS has topics, services and nodes of this name: `/robot1/scan`."""
    return _NAME.fullmatch(name) is not None


def data_key(domain: int, name: str, type: str, checksum: str) -> str:
    """Return the key of a topic's messages, or of a service's requests; `type` is that of `dds_type`."""
    return f"{domain}/{name.strip('/')}/{type}/{checksum}"


def gid_of(token: str) -> bytes:
    """Return the gid of the endpoint with this token."""
    return xxhash.xxh3_128_intdigest(token.encode()).to_bytes(GID_BYTES, "little")


def encode_token(token: RmwToken) -> str:
    """Return the key of a token."""
    namespace, _, node = token.node.rpartition("/")
    start = f"{TOKENS}/{token.domain}/{token.session}/{token.node_id}/{token.entity_id}/{token.kind}"
    fields = [start, _mangled(token.enclave), _mangled(namespace), node]
    if token.kind != EntityKind.NODE:
        fields += [_mangled(token.name), token.type, token.checksum, encode_qos(token.qos)]
    return "/".join(fields)


def decode_token(key: str) -> RmwToken:
    """Return the token with this key. Raises DecodeError for one that no node of ROS declares."""
    fields = key.split("/", _ENDPOINT_FIELDS) if len(key) <= _TOKEN_MAX else []
    if len(fields) < _NODE_FIELDS or fields[0] != TOKENS:
        raise DecodeError("a token that is too long, or without all its fields")
    _, domain, session, node_id, entity_id, kind, enclave, namespace, node = fields[:_NODE_FIELDS]
    if not (all(map(_NUMBER.fullmatch, (domain, node_id, entity_id))) and _SESSION.fullmatch(session)):
        raise DecodeError(f"a token of an unknown session {session[:40]!r}, or with ids that are not numbers")
    name = f"{_full(namespace).rstrip('/')}/{node}"
    if kind not in _KINDS or not is_full_name(name):
        raise DecodeError(f"a token of kind {kind[:10]!r}, of the node {name[:80]!r}")
    start = int(domain), session, int(node_id), int(entity_id), EntityKind(kind), name
    if kind == EntityKind.NODE:
        return RmwToken(*start, enclave=_plain(enclave))
    return RmwToken(*start, *_decode_endpoint(fields), enclave=_plain(enclave))


def _decode_endpoint(fields: list[str]) -> tuple[str, str, str, Qos]:
    if len(fields) < _ENDPOINT_FIELDS:
        raise DecodeError("a token of an endpoint without all its fields")
    name, dds_name, checksum, qos = fields[_NODE_FIELDS:_ENDPOINT_FIELDS]
    topic = _full(name)
    if not is_full_name(topic) or not (_HASH.fullmatch(checksum) or checksum == NO_HASH):
        raise DecodeError(f"a token of {topic[:80]!r} with the hash {checksum[:80]!r}")
    type_of_dds(dds_name)
    return topic, dds_name, checksum, decode_qos(qos)


def encode_attachment(sequence: int, stamp: int, gid: bytes) -> bytes:
    """Return the attachment of a message, a request or a response; `stamp` in ns."""
    return ATTACHMENT.pack(sequence, stamp, GID_BYTES, gid)


def decode_attachment(data: bytes) -> tuple[int, int, bytes]:
    """Return the sequence number, the time in ns, and the gid, which is short or empty from some clients. What follows
    it belongs to later versions. Raises DecodeError.
    """
    if len(data) == ATTACHMENT.size:  # of nearly every message
        sequence, stamp, size, gid = ATTACHMENT.unpack(data)
        if size == GID_BYTES:
            return sequence, stamp, gid
    if len(data) < _START.size:
        raise DecodeError(f"an attachment of {len(data)} bytes")
    sequence, stamp, size = _START.unpack_from(data)
    gid = data[_START.size : _START.size + size]
    if len(gid) != size:
        raise DecodeError(f"an attachment with {len(gid)} of {size} bytes of a gid")
    return sequence, stamp, gid


def _mangled(name: str) -> str:
    return name.replace("/", "%") or "%"


def _plain(field: str) -> str:
    return "" if field == "%" else field.replace("%", "/")


def _full(field: str) -> str:
    """Return a full name; some clients declare one without its first slash, which makes no difference to keys."""
    return "/" + _plain(field).removeprefix("/")
