"""The quality of service of this side's publishers and subscribers on a ROS network.

docs/how-to/ros2.md has the table. A publisher offers what fits most subscribers, and a subscriber asks for no more than
the ROS nodes offer that publish now; `QosChange` changes each of that.
"""

from collections.abc import Sequence

from r2p.codecs.management import QUEUE
from r2p.names import LOG
from r2p.ros.middleware import Qos, RosPeerEndpoint
from r2p.ros.options import QosChange
from r2p.runtime.publishers import PeriodicPublisher, SporadicPublisher
from r2p.runtime.topic import PublisherHandle, Topic
from r2p.units import SECOND

ROSOUT = Qos(transient_local=True, depth=1000, lifespan=10 * SECOND)

_DEPTH = 10


def publisher_qos(topic: Topic | None, *, latched: bool, change: QosChange | None) -> Qos:
    """Return what the publishers of a topic offer."""
    own = [] if topic is None else topic.publishers
    periods = [_period(each) for each in own]
    lifespans = [_lifespan(each) for each in own]
    qos = Qos(
        transient_local=latched,
        depth=1 if latched else _DEPTH,
        deadline=max(periods, default=0) if all(periods) else 0,
        lifespan=max(lifespans, default=0) if all(lifespans) else 0,
    )
    if topic is not None and topic.name == LOG:
        qos = ROSOUT
    return qos if change is None else change.apply(qos)


def _period(publisher: PublisherHandle) -> int:
    return round(publisher.period * SECOND) if isinstance(publisher, PeriodicPublisher) else 0


def _lifespan(publisher: PublisherHandle) -> int:
    return publisher.lifespan if isinstance(publisher, SporadicPublisher) else 0


def subscriber_qos(topic: Topic | None, publishers: Sequence[RosPeerEndpoint], change: QosChange | None) -> Qos:
    """Return what this side's subscribers ask for, so that messages of all these publishers arrive."""
    queues = [] if topic is None else topic.queues
    offered = [each.qos for each in publishers if each.qos is not None]
    lossy = bool(queues) and all(each.lossy for each in queues)
    qos = Qos(
        reliable=not lossy and all(each.reliable for each in offered),
        transient_local=bool(offered) and all(each.transient_local for each in offered),
        depth=max((each.places for each in queues), default=QUEUE),
    )
    return qos if change is None else change.apply(qos)
