"""The middleware under a ROS link: TCPROS of ROS 1, rmw_zenoh's messages, or DDS.

A link decides what to publish, subscribe to and serve, in which types, and under the names of which ROS nodes. A
`Middleware` registers that, moves the serialised messages, and reports to its `MiddlewareUser`, the link. It knows
nothing of r2p's topics, and the link nothing of sockets. Names are ROS's full names, `/robot1/odometry`; messages are
as ROS serialises them: packed in ROS 1, CDR behind its header of 4 bytes in ROS 2.
"""

import abc
from collections import Counter
from collections.abc import Awaitable, Callable
from typing import ClassVar, Protocol

import msgspec


class Qos(msgspec.Struct, frozen=True):
    """The quality of service of an endpoint. ROS 1 knows `transient_local`, which it calls latching, and `depth`.

    `depth` 0 keeps all. `deadline` and `lifespan` are in ns, 0: none.
    """

    reliable: bool = True
    transient_local: bool = False
    depth: int = 10
    deadline: int = 0
    lifespan: int = 0


class RosType(msgspec.Struct, frozen=True):
    """A type as the ends of a connection compare it: `name` (`sensor_msgs/Imu`), and `checksum`: md5 or RIHS01.

    The name of a part of an action has its kind in the middle: `test_msgs/action/Fibonacci_FeedbackMessage`.

    `definition` is the text of the type and of those in it, as in the header of a connection of ROS 1.
    """

    name: str
    checksum: str
    definition: str = ""


class RosService(msgspec.Struct, frozen=True):
    """The type of a service: `name` (`std_srvs/SetBool`), and `checksum`: md5 or RIHS01.

    The name of a service of an action has its kind in the middle: `test_msgs/action/Fibonacci_SendGoal`.
    """

    name: str
    checksum: str


class RosEndpoint(msgspec.Struct, frozen=True):
    """A publisher or subscriber of one of the link's ROS nodes (`node`, a full name)."""

    node: str
    topic: str
    type: RosType
    qos: Qos = Qos()


class RosServer(msgspec.Struct, frozen=True):
    """A server of one of the link's ROS nodes."""

    node: str
    service: str
    type: RosService


class RosPeerEndpoint(msgspec.Struct, frozen=True):
    """A publisher or subscriber of another ROS node, as the graph shows it; what is not known is empty.

    Two publishers of one node on a topic are told apart by `gid`, where the middleware has one.
    """

    node: str
    topic: str
    type: str = ""
    checksum: str = ""
    qos: Qos | None = None
    gid: bytes = b""


class RosPeerServer(msgspec.Struct, frozen=True):
    """A server of another ROS node."""

    node: str
    service: str
    type: str = ""
    checksum: str = ""


class RosGraph(msgspec.Struct, frozen=True):
    """What other ROS nodes have; the link's own nodes are left out."""

    nodes: frozenset[str] = frozenset()
    publishers: frozenset[RosPeerEndpoint] = frozenset()
    subscribers: frozenset[RosPeerEndpoint] = frozenset()
    servers: frozenset[RosPeerServer] = frozenset()


class RosArrival(msgspec.Struct, gc=False):
    """A received message: the ROS topic, encoded, its bytes, and the publisher's node (empty: not known).

    `sequence` counts the messages of one publisher (`gid`), 0: not known; `stamp` is the publisher's (ns), 0: none.
    """

    topic: bytes
    data: bytes
    node: str = ""
    sequence: int = 0
    stamp: int = 0
    gid: bytes = b""


Answer = Callable[[bytes], None]
"""Answers a request, with the serialised response."""
Refuse = Callable[[str], None]
"""Answers a request with the text of an error."""
Cancel = Callable[[], None]
"""Cancels a request whose caller is gone; does nothing once it is answered."""


def nothing_to_cancel() -> None:
    """Do nothing: the `Cancel` of a request that is answered already, or can't be stopped."""


class MiddlewareUser(Protocol):
    """The link, as its middleware sees it. All is called in the event loop, and never raises."""

    def middleware_up(self) -> None:
        """Note that the network works (again): the master answers, the router is connected."""

    def middleware_down(self, reason: str) -> None:
        """Note that the network is gone, and why; the middleware goes on trying.

        Subscribers, publishers and the graph count as gone with it, and are reported again after `middleware_up`.
        """

    def middleware_waits(self, reason: str) -> None:
        """Note that the network can't be reached yet, and why."""

    def graph_changed(self, graph: RosGraph) -> None:
        """Note what other ROS nodes have now."""

    def subscriber_joined(self, topic: str) -> None:
        """Note that another node's subscriber of a topic is connected, so that messages reach it."""

    def subscribers_gone(self, topic: str) -> None:
        """Note that the topic's last remote subscriber is gone."""

    def publisher_found(self, topic: str, node: str, type_name: str, definition: str, *, latched: bool = False) -> None:
        """Note that messages of this publisher arrive from now on; the definition is empty where it is unknown.

        `latched`: its last message is sent to each new subscriber.
        """

    def publisher_gone(self, topic: str, node: str) -> None:
        """Note that no more messages of a topic come from this node: its last publisher is gone."""

    def received(self, messages: list[RosArrival]) -> None:
        """Deliver messages that arrived, in order."""

    def requested(self, service: str, caller: str, request: bytes, answer: Answer, refuse: Refuse) -> Cancel:
        """Handle a request for a server of the link; `caller` is the other node, or empty.

        One of `answer` and `refuse` is called, once, perhaps before this returns; neither after the returned function
        was, which cancels the request: its caller is gone.
        """

    def made_room(self) -> None:
        """Resume sending: `Middleware.full` has become false again."""

    def notice(self, kind: str, text: str, *, trouble: bool) -> None:
        """Report something to the user, in words that say what to do. A text of one `kind` is reported once."""

    def shut_down(self, node: str, reason: str) -> None:
        """Note that another node has taken the name of one of the link's nodes, or that the master wants its end."""


class Middleware(abc.ABC):
    """One connection of a link to a ROS network.

    What is declared before the network is up, or while it is down, is registered when it is up; nothing here raises for
    a fault of the network. Received bytes never raise: what can't be used is counted in `lost` by reason, and dropped.
    """

    version: int
    """1 or 2."""
    has_services: ClassVar[bool] = True
    """Whether services can be served and called; else there are topics only."""
    lost: Counter[str]
    """The link's counter of losses, by reason."""

    @abc.abstractmethod
    async def run(self, user: MiddlewareUser, opened: Callable[[], object]) -> None:
        """Connect and stay connected until cancelled; then unregister everything, and close. `opened`: see Transport.

        Raises TransportError for a permanent fault.
        """

    def set_sim_time(self) -> None:
        """Let ROS nodes that start from now on follow `/clock`, as long as this runs, if the network can say that."""

    @abc.abstractmethod
    def add_node(self, node: str) -> None:
        """Show a ROS node. Its publishers, subscribers and servers come after it."""

    @abc.abstractmethod
    def remove_node(self, node: str) -> None:
        """Remove a ROS node with everything it still has."""

    @abc.abstractmethod
    def advertise(self, endpoint: RosEndpoint) -> None:
        """Register a publisher of a topic. Several nodes may publish one topic; `publish` names the node."""

    @abc.abstractmethod
    def withdraw(self, endpoint: RosEndpoint) -> None:
        """Unregister a publisher."""

    @abc.abstractmethod
    def publish(self, node: str, topic: str, data: bytes, stamp: int) -> None:
        """Send a message to all subscribers of a topic (`stamp`: UTC in ns); kept for later ones if transient local.

        `data` may be a view of a buffer that does not change. Without room for a subscriber the oldest message that
        waits for it is dropped and counted.
        """

    @property
    @abc.abstractmethod
    def full(self) -> bool:
        """Return whether a subscriber has no room that is likely to have some soon; `made_room` follows."""

    @abc.abstractmethod
    def subscribe(self, endpoint: RosEndpoint) -> None:
        """Register a subscriber, connect to all publishers of other nodes, and receive their messages.

        Those of the link's own nodes never come. In ROS 1 the checksum may be `*`: any type of this name will do.
        """

    @abc.abstractmethod
    def unsubscribe(self, endpoint: RosEndpoint) -> None:
        """Unregister a subscriber."""

    async def describe(self, endpoint: RosPeerEndpoint) -> str:
        """Return the definition of the type of another node's endpoint, as in RosType; empty if it can't be had."""
        return ""

    @abc.abstractmethod
    def pause(self) -> None:
        """Stop reading messages of topics, if possible: those received are still being delivered."""

    @abc.abstractmethod
    def resume(self) -> None:
        """Go on reading."""

    @abc.abstractmethod
    def serve(self, server: RosServer) -> None:
        """Register a server: `MiddlewareUser.requested` is called with each request."""

    @abc.abstractmethod
    def unserve(self, server: RosServer) -> None:
        """Unregister a server; requests that wait are refused."""

    @abc.abstractmethod
    def call(self, node: str, service: str, type: RosService, request: bytes, timeout: float) -> Awaitable[bytes]:
        """Call a service as one of the link's nodes; return the serialised response. Within `timeout` seconds it raises
        NoServer if there is none, ServiceError with the text of the server's error, or TimeoutError.
        """
