"""What the other ends of a link know of this module's topics, and how discovery brings them up to date.

A link keeps the `Announcement` that it made of each topic. When a publisher or a subscriber comes or goes, it works out
the one that is wanted now, and `announce` makes the difference.
"""

import msgspec

from r2p.codecs.management import ANY_TYPE, CLASS_LATCHES, NO_PARAMS, QUEUE, ROLE_PUBLISHES, ROLE_SUBSCRIBES
from r2p.protocols.discovery.events import Event, TopicType
from r2p.protocols.discovery.session import DiscoveryProtocol
from r2p.runtime.topic import Topic


class Announcement(msgspec.Struct, frozen=True):
    """What the other ends know of a topic; `asked` is the type in which it is subscribed.

    `queue`: how many messages a publisher keeps, or has on the way, for this module; that has nothing to do with the
    queues of its own subscribers.
    """

    publishes: bool = False
    subscribes: bool = False
    size: int = 0
    fingerprint: bytes = ANY_TYPE
    asked: TopicType = TopicType()
    queue: int = QUEUE
    params: bytes = NO_PARAMS
    endpoints: dict[tuple[str, int], int] = {}  # node and role -> publisher class


NOTHING = Announcement()


def announcement_of(topic: Topic) -> Announcement:
    """What the other ends should know of a topic that only this module uses."""
    publishers: dict[tuple[str, int], int] = {}
    for each in topic.publishers:
        key = each.node.name, ROLE_PUBLISHES
        publisher_class = int(each.publisher_class) | (CLASS_LATCHES if each.latch else 0)
        publishers[key] = max(publisher_class, publishers.get(key, 0))  # a node may have several, of several classes
    subscribers = {(each.owner, ROLE_SUBSCRIBES): 0 for each in topic.queues}
    topic_type = TopicType() if topic.layout is None else TopicType(topic.layout.size, topic.layout.fingerprint)
    return Announcement(
        publishes=bool(publishers),
        subscribes=bool(subscribers),
        size=topic_type.size,
        fingerprint=topic_type.fingerprint,
        asked=topic_type,
        endpoints=publishers | subscribers,
    )


def announce(
    discovery: DiscoveryProtocol, now: int, topic: str, known: Announcement, desired: Announcement
) -> list[Event]:
    """Bring the other ends from what they know of a topic to what they should know; returns what that brings about."""
    events: list[Event] = []
    retyped = (desired.size, desired.fingerprint) != (known.size, known.fingerprint)
    if desired.publishes and (retyped or not known.publishes or desired.params != known.params):
        events += discovery.advertise(now, topic, desired.size, desired.fingerprint, desired.params)
    elif known.publishes and not desired.publishes:
        events += discovery.withdraw(now, topic)
    if desired.subscribes and ((desired.asked, desired.queue) != (known.asked, known.queue) or not known.subscribes):
        events += discovery.subscribe(now, topic, desired.asked.size, desired.queue, desired.asked.fingerprint)
    elif known.subscribes and not desired.subscribes:
        events += discovery.unsubscribe(now, topic)
    for (node, role), publisher_class in desired.endpoints.items():
        if known.endpoints.get((node, role)) != publisher_class:
            events += discovery.add_endpoint(now, node, topic, role, publisher_class)
    for node, role in known.endpoints.keys() - desired.endpoints.keys():
        events += discovery.remove_endpoint(now, node, topic, role)
    return events
