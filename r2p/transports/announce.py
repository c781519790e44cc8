"""What the other ends of a link are told of this module's topics, and the difference to what they should be told."""

import msgspec

from r2p.codecs.management import CLASS_LATCHES, NO_PARAMS, QUEUE, ROLE_PUBLISHES, ROLE_SUBSCRIBES
from r2p.protocols.door import Door
from r2p.protocols.events import Event, Shape
from r2p.topic import Topic


class Told(msgspec.Struct, frozen=True):
    """What the other ends have been told of a topic; `asked` is the type in which it is subscribed.

    `queue`: how many messages a publisher keeps, or has on the way, for this module; that has nothing to do with the
    queues of its own subscribers.
    """

    publishes: bool = False
    subscribes: bool = False
    size: int = 0
    fingerprint: bytes = bytes(8)
    asked: Shape = Shape()
    queue: int = QUEUE
    params: bytes = NO_PARAMS
    endpoints: dict[tuple[str, int], int] = {}  # node and role -> publisher class


NOTHING = Told()


def wish_of(topic: Topic) -> Told:
    """What the other ends should know of a topic."""
    publishers: dict[tuple[str, int], int] = {}
    for each in topic.publishers:
        key = each.node.name, ROLE_PUBLISHES
        publisher_class = int(each.publisher_class) | (CLASS_LATCHES if each.latch else 0)
        publishers[key] = max(publisher_class, publishers.get(key, 0))  # a node may have several, of several classes
    subscribers = {(each.owner, ROLE_SUBSCRIBES): 0 for each in topic.queues}
    shape = Shape() if topic.layout is None else Shape(topic.layout.size, topic.layout.fingerprint)
    return Told(
        publishes=bool(publishers),
        subscribes=bool(subscribers),
        size=shape.size,
        fingerprint=shape.fingerprint,
        asked=shape,
        endpoints=publishers | subscribers,
    )


def announce(discovery: Door, now: int, topic: str, told: Told, wish: Told) -> list[Event]:
    events: list[Event] = []
    retyped = (wish.size, wish.fingerprint) != (told.size, told.fingerprint)
    if wish.publishes and (retyped or not told.publishes or wish.params != told.params):
        events += discovery.advertise(now, topic, wish.size, wish.fingerprint, wish.params)
    elif told.publishes and not wish.publishes:
        events += discovery.withdraw(now, topic)
    if wish.subscribes and ((wish.asked, wish.queue) != (told.asked, told.queue) or not told.subscribes):
        events += discovery.subscribe(now, topic, wish.asked.size, wish.queue, wish.asked.fingerprint)
    elif told.subscribes and not wish.subscribes:
        events += discovery.unsubscribe(now, topic)
    for (node, role), publisher_class in wish.endpoints.items():
        if told.endpoints.get((node, role)) != publisher_class:
            events += discovery.endpoint(now, node, topic, role, publisher_class)
    for node, role in told.endpoints.keys() - wish.endpoints.keys():
        events += discovery.endpoint_gone(now, node, topic, role)
    return events
