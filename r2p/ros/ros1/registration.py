"""The registrations of this process's ROS nodes with a master that may come and go (skeleton: signatures are final)."""

from collections import Counter
from collections.abc import Callable

from r2p.ros.middleware import MiddlewareUser
from r2p.ros.ros1.environment import RosAddress
from r2p.ros.ros1.master import MasterClient
from r2p.ros.ros1.slave import SlaveUser
from r2p.ros.ros1.xmlrpc import XmlRpcClient


class MasterSession:
    """Keeps nodes, their topics and services registered, and reports the graph; each node has a slave server.

    Everything can be declared before `run` and while the master is gone. It calls `middleware_up`, `_down` and
    `_waits`, `graph_changed`, `parameter_changed`, `notice` and `shut_down` of the MiddlewareUser itself.
    """

    address: RosAddress
    client: XmlRpcClient
    """For calls of other nodes: `slave.request_topic`."""
    master: MasterClient

    def __init__(self, address: RosAddress, slaves: SlaveUser, lost: Counter[str]) -> None: ...

    async def run(self, user: MiddlewareUser, opened: Callable[[], object]) -> None:
        """Stay registered until cancelled; then unregister everything, and close the slave servers."""
        raise NotImplementedError

    def add_node(self, node: str) -> None:
        """Give a node its slave server. Nothing for one that exists."""

    def remove_node(self, node: str) -> None:
        """Unregister everything that a node still has, and end its slave server."""

    def advertise(self, node: str, topic: str, type_name: str) -> None:
        """Register a publisher."""

    def withdraw(self, node: str, topic: str) -> None:
        """Unregister a publisher."""

    def subscribe(self, node: str, topic: str, type_name: str) -> None:
        """Register a subscriber (type `*`: any); `SlaveUser.publishers_changed` follows, at once or later."""

    def unsubscribe(self, node: str, topic: str) -> None:
        """Unregister a subscriber."""

    def serve(self, node: str, service: str, port: int) -> None:
        """Register a service that listens at a port of this computer."""

    def unserve(self, node: str, service: str) -> None:
        """Unregister a service."""

    def slave_uri(self, node: str) -> str:
        """Return the URI of a node's slave API."""
        raise NotImplementedError

    async def find_service(self, node: str, service: str, timeout: float) -> tuple[str, int]:
        """Return the host and port of a service. Raises NoServer, and TimeoutError if the master does not answer."""
        raise NotImplementedError
