"""The time of a ROS network, `/clock`, for programs under virtual time.

A program whose virtual time has a speed (`r2p.sim.run(main, speed=10)`) publishes it 100 times a second, so that ROS
nodes with `use_sim_time` live in its time. One that follows (`r2p.sim.run(main, follow=True)`) takes its time from
`/clock` instead. Other programs have real time, as has ROS without /clock.
"""

import asyncio
import contextlib
from collections.abc import AsyncIterator

from r2p.clock import SteeredClock, Ticker
from r2p.messages import Message, Timestamp
from r2p.names import NODE_MAX
from r2p.runtime.node import Node
from r2p.runtime.topic import TopicSpace
from r2p.units import MILLISECOND

TOPIC = "clock"
PERIOD = 10 * MILLISECOND
"""Ns of virtual time between two messages: as `rosbag play --clock` has it."""


class RosClock(Message, name="rosgraph_msgs/Clock"):
    """The time of a ROS network."""

    clock: Timestamp = Timestamp()


def publishes_clock(space: TopicSpace) -> bool:
    """Return whether this program's time is that of the network: virtual time with a speed."""
    return getattr(space.clock, "paced", False) and not isinstance(space.clock, SteeredClock)


@contextlib.asynccontextmanager
async def ros_time(space: TopicSpace) -> AsyncIterator[None]:
    """Publish the time of a module under virtual time, or let it follow `/clock`; of several links to ROS, one does."""
    clock, known = space.clock, space.topics.get(TOPIC)
    if known is not None and (known.publishers or known.queues):
        yield
    elif isinstance(clock, SteeredClock):
        with contextlib.closing(_node(space)) as node:
            following = asyncio.create_task(_follow(node, clock))
            try:
                yield
            finally:
                following.cancel()
    elif publishes_clock(space):
        with contextlib.closing(_node(space)) as node, contextlib.closing(_ticker(node, space)):
            yield
    else:
        yield


def _node(space: TopicSpace) -> Node:
    """Return the node that has the topic: its name has that of the module, as that of a ROS node exists once."""
    return Node(f"{space.module}_{TOPIC}"[-NODE_MAX:], space)


async def _follow(node: Node, clock: SteeredClock) -> None:
    times = node.subscribe(TOPIC, RosClock, queue=1, lossy=True)
    async for time in times:
        clock.follow(time.clock.ns, lambda: times.publishers > 0)


def _ticker(node: Node, space: TopicSpace) -> Ticker:
    publisher = node.advertise(TOPIC, RosClock)

    def publish(scheduled: int, late: int, skipped: int) -> None:
        publisher.publish_nowait(RosClock(Timestamp.from_ns(space.clock.now())))

    ticker = Ticker(space.loop, PERIOD, publish, background=True)
    ticker.start()
    return ticker
