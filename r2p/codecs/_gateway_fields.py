"""The messages of gateways (PROTOCOL.md 9), and their fields: parts, counts and serials, acknowledgements, neighbours.

`r2p.codecs.management` has their bytes, and exports all of this.
"""

import struct
from collections.abc import Iterable

import msgspec

BRIDGE_ACKS = 2  # acks in a Bridge
LEAF_ACKS = 3  # acks in a Leaf
MESH_HEARD = 3  # entries in Mesh.heard
PARTS_MAX = 16
"""Parts of a Name or a Mesh: the number of a part has four bits."""

_PART_BITS = 4
_SERIALS = 0x10000  # counts of Bridge and Leaf, and serials of Mesh, start again at 0 after this many
_ACK = struct.Struct("<IH")
_HEARD = struct.Struct("<BIB")


class Bridge(msgspec.Struct, frozen=True, gc=False):
    """A gateway lives: `count` numbers its messages, `agreement` is the hash of the mesh as the gateway sees it.

    `root` is the lowest gateway of its mesh. `acks` are 2 times the sender (u32) and `count` (u16) of the last BRIDGE
    or LEAF that it received on this network.
    """

    gateway: int
    port: int
    count: int
    agreement: int
    root: int
    acks: bytes


class Mesh(msgspec.Struct, frozen=True, gc=False):
    """The gateways that a gateway hears at its ports, again with a new `serial` when they change.

    `part` has the number of this part and of the last one: see `make_part`. `heard` is 3 times the own port (u8), the
    other gateway (u32) and its port (u8).
    """

    gateway: int
    serial: int
    part: int
    heard: bytes


class Leaf(msgspec.Struct, frozen=True, gc=False):
    """A module that is not a gateway has links to several networks with gateways: `module` is its instance.

    `count` numbers its messages; `acks` are 3 times the gateway (u32) and `count` (u16) of the last BRIDGE that it
    received on this network.
    """

    module: int
    port: int
    count: int
    acks: bytes


def make_part(number: int, last: int) -> int:
    """Return the `part` of a Name or a Mesh: the number of this part, and of the last one."""
    return number << _PART_BITS | last


def split_part(part: int) -> tuple[int, int]:
    """Return the number of this part, from 0, and of the last one."""
    return part >> _PART_BITS, part & PARTS_MAX - 1


def next_serial(serial: int) -> int:
    """Return the next count of a Bridge or a Leaf, or the next serial of a Mesh."""
    return (serial + 1) % _SERIALS


def is_newer_serial(serial: int, last: int) -> bool:
    """Return whether `serial` comes after `last`: at most half the range ahead of it."""
    return 0 < (serial - last) % _SERIALS < _SERIALS // 2


def leaf_port(number: int) -> int:
    """Return the `port` of a Leaf for the link with this number: its low byte, as the field has one byte."""
    return number & 0xFF


def encode_acks(acks: Iterable[tuple[int, int]], places: int) -> bytes:
    """Return the `acks` of a Bridge (BRIDGE_ACKS places) or a Leaf (LEAF_ACKS): senders and counts."""
    return b"".join(_ACK.pack(*ack) for ack in acks).ljust(places * _ACK.size, b"\0")


def decode_acks(acks: bytes) -> list[tuple[int, int]]:
    """Return senders and counts in the `acks` of a Bridge or a Leaf; the sender of a free place is 0."""
    return list(_ACK.iter_unpack(acks))


def encode_heard(heard: Iterable[tuple[int, int, int]]) -> bytes:
    """Return the `heard` of a Mesh: own port, other gateway, and its port."""
    return b"".join(_HEARD.pack(*each) for each in heard).ljust(MESH_HEARD * _HEARD.size, b"\0")


def decode_heard(heard: bytes) -> list[tuple[int, int, int]]:
    """Return own port, other gateway and its port in the `heard` of a Mesh, free places left out."""
    return [each for each in _HEARD.iter_unpack(heard) if each[1]]
