"""The transport of links to ROS networks: makes a middleware and its link, and runs both.

What one kind of network has beside topics and services is added by its own transport, in `run_link`.
"""

import asyncio
from collections.abc import Callable

from r2p.clock import REAL_TIME
from r2p.errors import TransportError
from r2p.ros.clock import publishes_clock, ros_time
from r2p.ros.library import load_definitions
from r2p.ros.link import RosLink
from r2p.ros.middleware import Middleware
from r2p.ros.options import RosOptions, merged
from r2p.transports.link import Hub, Transport
from r2p.transports.url import open_transport

MakeMiddleware = Callable[[Hub], Middleware]


class RosTransport(Transport):
    """Makes the middleware of a ROS network, and one link with this `name`, such as `ros2:`."""

    def __init__(self, name: str, make_middleware: MakeMiddleware, options: RosOptions | None = None) -> None:
        self.options = options or RosOptions()
        self._name = name
        self._make_middleware = make_middleware

    async def run(self, hub: Hub, opened: Callable[[], object]) -> None:
        middleware = self._make_middleware(hub)
        if not hub.space.clock.virtual:  # now, and not while messages flow
            await asyncio.to_thread(load_definitions, middleware.version)
        link = RosLink(self._name, hub, middleware, self.options)
        hub.attach(link)
        try:
            if publishes_clock(hub.space):
                middleware.set_sim_time()
            async with ros_time(hub.space):
                REAL_TIME.set(True)  # in this task, and in what it starts
                await self.run_link(hub, link, opened)
        finally:
            link.close()
            hub.detach(link)

    async def run_link(self, hub: Hub, link: RosLink, opened: Callable[[], object]) -> None:
        """Run the middleware of a link, and what a network has beside topics and services."""
        await link.middleware.run(link, opened)


def ros_transport(transport: Transport | str, options: RosOptions) -> RosTransport:
    """Return a transport of ROS, or that of a URL, with these options added to its own.

    Raises TransportError for any other transport, and for an invalid URL.
    """
    opened = open_transport(transport) if isinstance(transport, str) else transport
    if not isinstance(opened, RosTransport):
        raise TransportError(f"{transport} is not a link to ROS: write ros1:, ros2: or dds:")
    opened.options = merged(opened.options, options)
    return opened
