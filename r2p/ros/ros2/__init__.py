"""ROS 2 over zenoh, as rmw_zenoh does it: no ROS is needed here, and only zenoh's router on the network.

In the order to read it:

    options     the URL and the environment; zenoh's configuration
    middleware  opens a session, keeps it, and matches this link's publishers and subscribers with those of the graph
    graph       the nodes that liveliness tokens show, and why two of them are not connected
    topics      publishers and subscribers; services: servers and clients
    session     what all of them share: one zenoh session, its tokens and ids
    keys        keys, tokens, gids and attachments; qos: the quality of service in tokens

zenoh itself is imported when a session is opened, not before.
"""

from r2p.ros.middleware import Middleware
from r2p.ros.parameters import ParameterTransport
from r2p.ros.ros2.options import parse_options
from r2p.transports.link import Hub
from r2p.transports.url import Url


def from_url(url: Url) -> ParameterTransport:
    """`ros2:[ENDPOINT]`; `options` has the options. Raises TransportError."""
    options = parse_options(url)

    def make(hub: Hub) -> Middleware:
        try:
            from r2p.ros.ros2.middleware import Ros2Middleware
        except ImportError as error:
            missing = (error.name or "").partition(".")[0]
            if missing not in ("zenoh", "xxhash"):
                raise
            raise options.error(f"{missing} is missing: pip install 'r2p[ros]'") from error
        return Ros2Middleware(options, hub.space.clock, hub.random, observer=hub.observer)

    return ParameterTransport(options.name, make, options.ros)
