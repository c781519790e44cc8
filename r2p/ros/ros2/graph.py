"""The ROS nodes that zenoh's liveliness tokens show, with their publishers, subscribers and servers."""

from collections.abc import Iterable
from typing import Any

from r2p.errors import DecodeError
from r2p.ros.middleware import RosGraph, RosPeerEndpoint, RosPeerServer
from r2p.ros.ros2.keys import NO_HASH, EntityKind, RmwToken, decode_token, gid_of
from r2p.ros.type_names import type_of_dds
from r2p.transports.stats import LoggedCounter

TOKENS_MAX = 65_536
"""Tokens of other nodes, at most."""

_WORDS = {
    EntityKind.PUBLISHER: ("publishes", "topic"),
    EntityKind.SUBSCRIBER: ("subscribes to", "topic"),
    EntityKind.SERVER: ("serves", "service"),
    EntityKind.CLIENT: ("calls", "service"),
}


class TokenGraph:
    """The tokens of other sessions."""

    def __init__(self, session: str, lost: LoggedCounter) -> None:
        """`session` is this one, whose own tokens are left out."""
        self.version = 0
        """Counts changes."""
        self._session = session
        self._lost = lost
        self._tokens: dict[str, RmwToken] = {}
        self._peers: dict[EntityKind, dict[str, Any]] = {kind: {} for kind in EntityKind}
        """What the graph has of each token, by its key."""
        self._by_name: dict[tuple[EntityKind, str], dict[str, RmwToken]] = {}
        self._by_gid: dict[bytes, RmwToken] = {}

    def __len__(self) -> int:
        return len(self._tokens)

    def add(self, key: str) -> RmwToken | None:
        """Note a token, and return it; None for one that is known, this session's, or of no use, which is counted."""
        if key in self._tokens:
            return None
        try:
            token = decode_token(key)
        except DecodeError:
            self._lost["wrong token"] += 1
            return None
        if token.session == self._session:
            return None
        if len(self._tokens) >= TOKENS_MAX:
            self._lost["too many tokens"] += 1
            return None
        self._tokens[key] = token
        self._peers[token.kind][key] = _peer(key, token)
        self.version += 1
        if token.kind != EntityKind.NODE:
            self._by_name.setdefault((token.kind, token.name), {})[key] = token
            self._by_gid[gid_of(key)] = token
        return token

    def remove(self, key: str) -> RmwToken | None:
        """Forget a token, and return it; None for an unknown one."""
        self.version += 1
        token = self._tokens.pop(key, None)
        if token is None:
            return None
        del self._peers[token.kind][key]
        if token.kind == EntityKind.NODE:
            return token
        self._by_gid.pop(gid_of(key), None)  # it may be gone: made-up tokens may have one gid
        index = token.kind, token.name
        self._by_name[index].pop(key)
        if not self._by_name[index]:
            del self._by_name[index]
        return token

    def clear(self) -> None:
        """Forget all tokens."""
        self.version += 1
        self._tokens.clear()
        self._by_name.clear()
        self._by_gid.clear()
        for each in self._peers.values():
            each.clear()

    def endpoints(self, kind: EntityKind, name: str) -> Iterable[RmwToken]:
        """Return the endpoints of this kind on a topic, or for a service."""
        return self._by_name.get((kind, name), {}).values()

    def node_of(self, gid: bytes, kind: EntityKind, name: str) -> str:
        """Return the node of an endpoint: that with this gid, else the only one of its kind; empty if unknown.

        rmw_zenoh's gids are those of tokens; other implementations have gids of their own.
        """
        token = self._by_gid.get(gid)
        if token is not None:
            return token.node
        nodes = {each.node for each in self.endpoints(kind, name)}
        return nodes.pop() if len(nodes) == 1 else ""

    def snapshot(self) -> RosGraph:
        """Return the graph."""
        nodes = frozenset([each.node for each in self._tokens.values()])
        kinds = EntityKind.PUBLISHER, EntityKind.SUBSCRIBER, EntityKind.SERVER
        return RosGraph(nodes, *[frozenset(self._peers[kind].values()) for kind in kinds])


def _peer(key: str, token: RmwToken) -> Any:
    """Return what the graph has of a token."""
    match token.kind:
        case EntityKind.PUBLISHER | EntityKind.SUBSCRIBER:
            name = type_of_dds(token.type)
            return RosPeerEndpoint(token.node, token.name, name, token.checksum, token.qos, gid_of(key))
        case EntityKind.SERVER:
            return RosPeerServer(token.node, token.name, type_of_dds(token.type), token.checksum)
        case _:
            return None


def explain_mismatch(own: RmwToken, other: RmwToken) -> str:
    """Return why messages or requests do not get from one endpoint to the other, and what to change; empty if they do.

    Their keys differ, so zenoh does not connect them, and says nothing.
    """
    if own.key == other.key:
        return ""
    verb, what = _WORDS[other.kind]
    start = f"node {other.node} {verb} the {what} {other.name}"
    theirs, ours = type_of_dds(other.type), type_of_dds(own.type)
    if theirs != ours:
        return f"{start} as {theirs}, and {own.node} has it as {ours}: give both one type (--ros-type), or another name"
    if other.checksum == NO_HASH:
        return (
            f"{start} from ROS 2 Humble, which has no type hashes, so its {what}s do not match those of later "
            f"versions: run {other.node} with ROS 2 Jazzy or later"
        )
    shown = other.type.replace("::dds_::", "/").replace("::", "/").removesuffix("_")
    return (
        f"{start} with another definition of {theirs} ({other.checksum[:15]}..., here {own.checksum[:15]}...): compare "
        f"`ros2 interface show {shown}` there with `r2p msg show {theirs}` here, and use one of them at both"
    )
