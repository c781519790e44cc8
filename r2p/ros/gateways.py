"""The messages between gateways, on a ROS topic of their own (PROTOCOL.md 11).

Without them, two gateways that join the same networks would not know of each other, and pass each message on for ever.
"""

from typing import Annotated

from r2p.clock import Clock
from r2p.codecs import UnknownType, management
from r2p.codecs.management import GATEWAY_TYPES, ROLE_PUBLISHES, ROLE_SUBSCRIBES
from r2p.errors import DecodeError
from r2p.messages import Len, Message, layout
from r2p.ros.cdr import cdr
from r2p.ros.discovery import GATEWAYS
from r2p.ros.middleware import Middleware, Qos, RosEndpoint
from r2p.ros.registrations import Registrations
from r2p.ros.topics import ros_type

_QOS = Qos(depth=100)


class GatewayMessage(Message, name="r2p_msgs/GatewayMessage"):
    """A message between gateways, which has the same bytes on all links."""

    data: Annotated[bytes, Len(management.SIZE)]


class GatewayExchange:
    """The part of a link in the exchange of gateways' messages, once it has joined."""

    def __init__(self, middleware: Middleware, registrations: Registrations, clock: Clock) -> None:
        self._middleware = middleware
        self._registrations = registrations
        self._clock = clock
        self._joined = False

    def join(self) -> None:
        """Take part from now on: the module is a gateway, or has other links."""
        if self._joined:
            return
        self._joined = True
        self._registrations.keep_module_node()
        kind = ros_type(GatewayMessage, self._middleware.version)
        endpoint = RosEndpoint(self._registrations.module_node, GATEWAYS, kind, _QOS)
        for role in (ROLE_PUBLISHES, ROLE_SUBSCRIBES):
            self._registrations.declare(GATEWAYS, role, {endpoint})

    def send(self, data: bytes) -> None:
        """Send a message between gateways; for other management messages ROS nodes have no use."""
        if self._joined and management.type_of(data) in GATEWAY_TYPES:
            message, now = GatewayMessage(data), self._clock.now()
            packed = message.encode() if self._middleware.version == 1 else cdr(GatewayMessage).encode(message)
            self._middleware.publish(self._registrations.module_node, GATEWAYS, packed, now)

    def decode(self, data: bytes) -> bytes:
        """Return the message in a ROS message. Raises DecodeError."""
        if self._middleware.version == 1:
            return layout(GatewayMessage).decode(data).data
        message: GatewayMessage = cdr(GatewayMessage).decode(data)
        return message.data


def sender_of(data: bytes) -> int | None:
    """Return the instance of the module that has sent a message between gateways; None for any other message."""
    try:
        message = management.decode(data)
    except (DecodeError, UnknownType):
        return None
    match message:
        case management.Bridge() | management.Mesh():
            return message.gateway
        case management.Leaf():
            return message.module
    return None
