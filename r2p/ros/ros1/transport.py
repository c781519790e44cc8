"""`ros1:`: a link to a ROS 1 network, with its topics and services, and the parameter server."""

import asyncio
import os
import sys
from collections.abc import Callable, Mapping
from typing import Any

from r2p.errors import TransportError
from r2p.ros.link import RosLink
from r2p.ros.options import URL_OPTIONS, RosOptions, from_parsed
from r2p.ros.ros1.environment import RosAddress, find_address
from r2p.ros.ros1.middleware import Ros1Middleware
from r2p.ros.ros1.names import arguments
from r2p.ros.ros1.parameters import ParameterMirror, node_names
from r2p.ros.transport import RosTransport
from r2p.startup import is_command
from r2p.transports.link import Hub
from r2p.transports.url import Url


def from_url(url: Url) -> "Ros1Transport":
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


class Ros1Transport(RosTransport):
    """Opens the link, and keeps the parameters of its nodes on the parameter server.

    When another node takes the name of the only one, a program that has no other link ends, as one of rospy does.
    """

    def __init__(self, name: str, address: RosAddress, options: RosOptions, parameters: Mapping[str, object]) -> None:
        """`parameters` are values for the parameters of this program's nodes, by name."""
        super().__init__(name, lambda _hub: Ros1Middleware(address), options)
        self._parameters = parameters

    async def run_link(self, hub: Hub, link: RosLink, opened: Callable[[], object]) -> None:
        assert isinstance(link.middleware, Ros1Middleware)
        space = hub.space
        link.middleware.session.ends_without_nodes = lambda: not link.discovery.is_gateway and space.links == [link]
        if hub.observer:  # a command has no parameters
            await super().run_link(hub, link, opened)
            return
        names = node_names(link.names, hub.space.module, ros_nodes=self.options.ros_nodes)
        mirror = ParameterMirror(hub, link, names, link.middleware.session, self._parameters)
        mirroring = asyncio.get_running_loop().create_task(mirror.run())
        try:
            await super().run_link(hub, link, opened)
        finally:
            mirroring.cancel()
            await asyncio.wait([mirroring])
