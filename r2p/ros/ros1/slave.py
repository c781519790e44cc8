"""The slave API: what the master and other nodes ask of one ROS node (skeleton: signatures are final)."""

from collections.abc import Iterable
from typing import Literal, Protocol

import msgspec

from r2p.ros.ros1.xmlrpc import XmlRpcClient


class BusConnection(msgspec.Struct, frozen=True):
    """A TCPROS connection of a topic, as `rosnode info` shows it; services have none.

    `number` is unique within the node. `peer` is a node's name for a subscriber of ours ("o"), and the URI of the slave
    API of a publisher that is received ("i"). `payload` are bytes, and `text` says where the connection is.
    """

    number: int
    topic: str
    peer: str
    direction: Literal["i", "o"]
    connected: bool
    payload: int
    messages: int
    text: str = ""


class SlaveUser(Protocol):
    """What moves the messages of the nodes: TCPROS."""

    def publishers_changed(self, node: str, topic: str, publishers: list[str]) -> None:
        """Note the slave URIs of all publishers of a topic that the node subscribes: new ones are to be connected to,
        connections to those not in it are to be closed. The node's own URI is left out if it publishes the topic, too.
        """

    def tcpros_address(self, node: str, topic: str) -> tuple[str, int] | None:
        """Return the host and port where the node's publisher of a topic accepts connections; None: it has none."""

    def connections(self, node: str) -> Iterable[BusConnection]:
        """Return all connections of topics that a node has."""


async def request_topic(client: XmlRpcClient, uri: str, node: str, topic: str, timeout: float) -> tuple[str, int]:
    """Ask a publisher (its slave URI) for the TCPROS address of a topic, as `node`.

    Raises XmlRpcError with a text for users if it refuses, OSError, and TimeoutError after `timeout` seconds.
    """
    raise NotImplementedError
