"""DDS, the default network of ROS 2, as a transport: topics with programs that use Fast DDS or Cyclone DDS.

In the order to read it:

    names       names of topics and types in DDS, and what endpoints say of themselves in their user data
    graph       the graph of other ROS nodes, from the endpoints and the names of nodes that DDS's discovery reports
    cyclone     Cyclone DDS: a participant, its endpoints, which send and receive bytes, and the thread that waits
    middleware  all of it for a ROS link

Services, and what is made of them, are not offered over DDS: its implementations disagree about how a request and its
answer belong together. Cyclone DDS is imported when a link is opened, not before.
"""

import os
import socket
from collections.abc import Mapping
from typing import TYPE_CHECKING

from r2p.errors import TransportError
from r2p.ros.middleware import Middleware
from r2p.ros.options import URL_OPTIONS, domain, domain_of, from_parsed
from r2p.ros.transport import RosTransport
from r2p.transports.url import Url

if TYPE_CHECKING:
    from r2p.transports.link import Hub


def from_url(url: Url) -> RosTransport:
    """`dds:[?domain=0&interface=lo]`. Raises TransportError.

    Without these options, ROS_DOMAIN_ID and ROS_LOCALHOST_ONLY count, as for any program of ROS 2.
    """
    if url.address:
        raise TransportError(f"{url}: DDS finds the others by itself: write dds:, or dds:?domain=3&interface=eth0")
    parsed = url.parsed({**URL_OPTIONS, "domain": domain, "interface": _interface})
    options = from_parsed(parsed)
    number = domain_of(url, parsed, os.environ)
    interface = parsed.get("interface", _interface_of_environment(os.environ))
    name = f"dds:?domain={number}" if number else "dds:"

    def make(_hub: "Hub") -> Middleware:
        try:
            from r2p.ros.dds.middleware import DdsMiddleware
        except ImportError as error:
            if (error.name or "").partition(".")[0] != "cyclonedds":
                raise
            raise TransportError("dds: cyclonedds is missing: pip install 'r2p[dds]'") from error
        return DdsMiddleware(number, interface)

    return RosTransport(name, make, options)


def _interface(text: str) -> str:
    names = [name for _, name in socket.if_nameindex()]
    if text not in names:
        raise ValueError(f"this computer has no such network interface; it has {', '.join(names)}")
    return text


def _interface_of_environment(environment: Mapping[str, str]) -> str:
    local = environment.get("ROS_LOCALHOST_ONLY") == "1"
    return "lo" if local or environment.get("ROS_AUTOMATIC_DISCOVERY_RANGE") == "LOCALHOST" else ""
