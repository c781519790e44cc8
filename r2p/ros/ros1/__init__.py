"""ROS 1 without ROS: `ros1:[http://MASTER:11311]`.

In the order to read it:

    transport      the link, and beside it parameters, on the parameter server
    middleware     the link's nodes on a ROS 1 network; it joins the two halves below
    names, environment    full names, remappings, and where the master and this computer are
    xmlrpc         calls between nodes, with xmlrpc_codec for their bytes
    registration   keeps nodes registered with the master; master: its calls; slave: what each node answers
    tcpros         the bytes of topics and services
    connections    TCPROS on asyncio; publishers, subscribers and services are the four things a connection may be for
"""

import os
import sys
from typing import TYPE_CHECKING, Any

from r2p.errors import TransportError
from r2p.ros.options import URL_OPTIONS, from_parsed
from r2p.ros.ros1.environment import find_address
from r2p.ros.ros1.names import arguments
from r2p.ros.ros1.transport import Ros1Transport
from r2p.startup import is_command
from r2p.transports.url import Url

if TYPE_CHECKING:
    from collections.abc import Callable


def from_url(url: Url) -> Ros1Transport:
    """`ros1:[http://MASTER:11311]`; without a master, the one that `ROS_MASTER_URI` names. Raises TransportError.

    Options: those of `r2p.ros.options`, and `host`: the address by which other computers reach this one, in place of
    `ROS_HOSTNAME` and `ROS_IP`. A program of its own, other than the command `r2p`, also takes what roslaunch adds to
    its command line: `__name:=left`, `__ns:=/robot1`, `chatter:=/talk`, `_kp:=0.7`.
    """
    known: dict[str, Callable[[str], Any]] = {**URL_OPTIONS, "host": str}
    parsed = url.parsed(known)
    given = {"hostname": host} if (host := parsed.pop("host", "")) else {}
    try:
        said, _ = arguments([] if is_command() else sys.argv[1:])
        options = said.options(from_parsed(parsed), os.environ.get("ROS_NAMESPACE", ""))
    except ValueError as error:  # also InvalidName
        raise TransportError(f"{url}: {error}") from error
    address = find_address(url.address, os.environ, {**said.special, **given})
    return Ros1Transport(f"ros1:{url.address}", address, options, said.parameters)
