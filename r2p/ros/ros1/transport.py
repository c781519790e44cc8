"""`ros1:`: a link to a ROS 1 network, with its topics and services, and the parameter server."""

import asyncio
from collections.abc import Callable, Mapping

from r2p.ros.link import RosLink
from r2p.ros.options import RosOptions
from r2p.ros.ros1.environment import RosAddress
from r2p.ros.ros1.middleware import Ros1Middleware
from r2p.ros.ros1.parameters import ParameterMirror, node_names
from r2p.ros.transport import RosTransport
from r2p.transports.link import Hub


class Ros1Transport(RosTransport):
    """Opens the link, and keeps the parameters of its nodes on the parameter server.

    When another node takes the name of the only one, a program that has no other link ends, as one of rospy does.
    """

    def __init__(
        self,
        name: str,
        address: RosAddress,
        options: RosOptions | None = None,
        parameters: Mapping[str, object] | None = None,
    ) -> None:
        """`parameters` are values for the parameters of this program's nodes, by name."""
        super().__init__(name, lambda _hub: Ros1Middleware(address), options)
        self._parameters = parameters or {}

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
