"""The graph of other ROS nodes, from what DDS's discovery reports: endpoints, and which nodes they belong to.

DDS knows participants, of which a program has one, and their endpoints. The names of nodes are in messages that each
participant publishes in `ros_discovery_info`. A program without these is shown by its endpoints, without a name.
"""

from collections.abc import Iterable, Mapping
from typing import Annotated

import msgspec

from r2p.errors import DecodeError
from r2p.messages import Len, Max, Message
from r2p.protocols.discovery.directory import TABLE_MAX
from r2p.ros.cdr import cdr
from r2p.ros.dds.names import join_node, ros_topic, ros_type, split_node
from r2p.ros.middleware import Qos, RosGraph, RosPeerEndpoint

MESSAGE_MAX = 1 << 20
"""Bytes of the message with the nodes of a participant: a thousand nodes with all their endpoints have half of that."""

ENTRIES_MAX = 131_072
"""Nodes and endpoints that all participants may announce together."""

_NAMES_MAX = 256  # bytes of a name, as in ROS's definition of these messages


class Gid(Message, name="rmw_dds_common/Gid"):
    """The GUID of a participant or an endpoint."""

    data: Annotated[bytes, Len(16)] = bytes(16)


class NodeEntitiesInfo(Message, name="rmw_dds_common/NodeEntitiesInfo"):
    """A node and its endpoints."""

    node_namespace: Annotated[str, Max(_NAMES_MAX)] = ""
    node_name: Annotated[str, Max(_NAMES_MAX)] = ""
    reader_gid_seq: Annotated[tuple[Gid, ...], Max(TABLE_MAX)] = ()
    writer_gid_seq: Annotated[tuple[Gid, ...], Max(TABLE_MAX)] = ()


class ParticipantEntitiesInfo(Message, name="rmw_dds_common/ParticipantEntitiesInfo"):
    """The nodes of a participant."""

    gid: Gid = Gid()
    node_entities_info_seq: Annotated[tuple[NodeEntitiesInfo, ...], Max(TABLE_MAX)] = ()


_CODEC = cdr(ParticipantEntitiesInfo)


class DdsEndpoint(msgspec.Struct, frozen=True):
    """A writer or reader of another participant. `gid` is its GUID, `handle` what samples name their writer by."""

    gid: bytes
    participant: bytes
    handle: int
    topic: str
    type: str
    checksum: str
    qos: Qos


class OwnNode(msgspec.Struct):
    """A node of this participant, and the GUIDs of its endpoints."""

    readers: list[bytes] = msgspec.field(default_factory=list)
    writers: list[bytes] = msgspec.field(default_factory=list)


def announce(participant: bytes, nodes: Mapping[str, OwnNode]) -> bytes:
    """Return the message with the names of this participant's nodes."""
    infos = tuple(
        NodeEntitiesInfo(*split_node(name), _gids(node.readers), _gids(node.writers)) for name, node in nodes.items()
    )
    return _CODEC.encode(ParticipantEntitiesInfo(Gid(participant), infos))


def _gids(guids: list[bytes]) -> tuple[Gid, ...]:
    return tuple(map(Gid, guids))


class DdsGraph:
    """What is known of other participants."""

    def __init__(self) -> None:
        self.writers: dict[bytes, DdsEndpoint] = {}
        self.readers: dict[bytes, DdsEndpoint] = {}
        self._nodes: dict[bytes, dict[str, frozenset[bytes]]] = {}
        self._entries = 0  # in `_nodes`
        self._owners: dict[bytes, str] = {}
        self._by_handle: dict[int, DdsEndpoint] = {}

    def add(self, endpoint: DdsEndpoint, *, writes: bool) -> None:
        """Note an endpoint. Those beyond the number that a directory holds are left out."""
        table = self.writers if writes else self.readers
        if len(table) < TABLE_MAX or endpoint.gid in table:
            table[endpoint.gid] = endpoint
            self._by_handle[endpoint.handle] = endpoint

    def remove(self, gid: bytes) -> None:
        """Forget an endpoint."""
        for table in (self.writers, self.readers):
            endpoint = table.pop(gid, None)
            if endpoint is not None:
                self._by_handle.pop(endpoint.handle, None)

    def remove_participant(self, gid: bytes) -> None:
        """Forget the nodes of a participant that is gone; DDS reports the end of its endpoints itself."""
        nodes = self._nodes.pop(gid, {})
        self._entries -= _entries(nodes)
        for gids in nodes.values():
            for each in gids:
                self._owners.pop(each, None)

    def announced(self, data: bytes) -> bool:
        """Note the nodes of a participant, from its message; return whether that could be read, and had room."""
        try:
            info = _CODEC.decode(data) if len(data) <= MESSAGE_MAX else None
        except DecodeError:
            info = None
        if info is None:
            return False
        self.remove_participant(info.gid.data)
        nodes = {
            join_node(node.node_namespace, node.node_name): frozenset(
                gid.data for gid in (*node.reader_gid_seq, *node.writer_gid_seq)
            )
            for node in info.node_entities_info_seq
        }
        if not self._has_room(nodes):
            self._forget_made_up()
            if not self._has_room(nodes):
                return False
        self._nodes[info.gid.data] = nodes
        self._entries += _entries(nodes)
        self._owners |= {gid: name for name, gids in nodes.items() for gid in gids}
        return True

    def _has_room(self, nodes: Mapping[str, frozenset[bytes]]) -> bool:
        return len(self._nodes) < TABLE_MAX and self._entries + _entries(nodes) <= ENTRIES_MAX

    def _forget_made_up(self) -> None:
        """Forget participants without any endpoint: messages may name some that have never been there."""
        real = {each.participant for table in (self.writers, self.readers) for each in table.values()}
        for gid in self._nodes.keys() - real:
            self.remove_participant(gid)

    def writer_of(self, handle: int) -> tuple[str, bytes]:
        """Return the node and the GUID of the writer of a sample, empty where it is not known."""
        endpoint = self._by_handle.get(handle)
        return ("", b"") if endpoint is None else (self._owners.get(endpoint.gid, ""), endpoint.gid)

    def ros_graph(self) -> RosGraph:
        """Return what other ROS nodes have."""
        return RosGraph(
            nodes=frozenset(name for nodes in self._nodes.values() for name in nodes),
            publishers=self._seen(self.writers.values()),
            subscribers=self._seen(self.readers.values()),
        )

    def _seen(self, endpoints: Iterable[DdsEndpoint]) -> frozenset[RosPeerEndpoint]:
        return frozenset(
            RosPeerEndpoint(
                self._owners.get(each.gid, ""), topic, ros_type(each.type), each.checksum, each.qos, each.gid
            )
            for each in endpoints
            if (topic := ros_topic(each.topic))
        )


def _entries(nodes: Mapping[str, frozenset[bytes]]) -> int:
    """Return the number of nodes and endpoints."""
    return len(nodes) + sum(map(len, nodes.values()))
