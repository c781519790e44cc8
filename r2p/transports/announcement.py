"""What a link announces of a topic of this module, and what a gateway changes of that."""

from typing import Any, Protocol

import msgspec

from r2p.codecs.management import ANY_TYPE, CLASS_LATCHES, NO_PARAMS, QUEUE, ROLE_PUBLISHES, ROLE_SUBSCRIBES
from r2p.messages import Layout
from r2p.protocols.discovery.directory import TopicInfo
from r2p.protocols.discovery.events import TopicType, describe_mismatch
from r2p.runtime.sample import Source
from r2p.runtime.topic import Topic


class Announcement(msgspec.Struct, frozen=True):
    """The other ends' view of a topic of this module; `asked` is the type in which it subscribes to the topic.

    `queue`: how many messages a publisher keeps, or has on the way, for this module; independent of its subscribers'
    queues.
    """

    publishes: bool = False
    subscribes: bool = False
    size: int = 0
    fingerprint: bytes = ANY_TYPE
    varies: bool = False
    asked: TopicType = TopicType()
    queue: int = QUEUE
    params: bytes = NO_PARAMS
    endpoints: dict[tuple[str, int], int] = {}  # node and role -> publisher class


NOTHING = Announcement()


class GatewayHooks(Protocol):
    """Decisions about one link: by its gateway, or by a module with several links to networks that gateways join."""

    def handle_management(self, data: bytes) -> bool:
        """Handle a management message before discovery does; return True if it concerns gateways only."""

    def desired_state(self, topic: Topic, own: Announcement) -> Announcement:
        """Return what the other ends should know of a topic: `own`, and the demand of other links."""

    @property
    def may_announce(self) -> bool:
        """Return whether discovery may send: of two links that lead to one network, only one announces."""

    @property
    def has_other_gateways(self) -> bool:
        """Return whether there are other gateways on the link's network."""

    def types_elsewhere(self, topic: str) -> tuple[TopicType, TopicType]:
        """Return the types in which a topic of the link is published, and subscribed, on the gateway's other links."""

    def source_name(self, source: Source) -> str:
        """Return the name of a message's module, as it is on the link's network."""

    def discovery_changed(self) -> None:
        """Adapt to changes in discovery."""


def type_of(topic: Topic) -> TopicType:
    """The size and fingerprint of a topic's messages, as far as this module knows them."""
    return topic.unnamed_type if topic.layout is None else _type_of_layout(topic.layout)


def _type_of_layout(layout: Layout[Any]) -> TopicType:
    return TopicType(layout.size, layout.fingerprint, layout.varies)


def refused_publishers(topic: Topic, info: TopicInfo | None) -> str | None:
    """Describe how the type of the publishers at the other end of a link differs from this module's, if it does."""
    ours, theirs = asked_type(topic), info.publisher_type if info is not None and info.mismatch else None
    return None if theirs is None or ours.fits(theirs) else describe_mismatch(ROLE_PUBLISHES, ours, theirs)


def asked_type(topic: Topic) -> TopicType:
    """The type in which this module subscribes to a topic; if it accepts several, unknown but for these."""
    if not topic.accepted:
        return type_of(topic)
    layouts = {each.fingerprint: each for accepted in topic.accepted for each in accepted.layouts}
    if topic.layout is not None:
        layouts[topic.layout.fingerprint] = topic.layout
    return TopicType(accepted=tuple(_type_of_layout(layouts[each]) for each in sorted(layouts)))


def announcement_of(topic: Topic) -> Announcement:
    """Return what the other ends should know of a topic that only this module uses."""
    publishers: dict[tuple[str, int], int] = {}
    for each in topic.publishers:
        key = each.node.name, ROLE_PUBLISHES
        publisher_class = int(each.publisher_class) | (CLASS_LATCHES if each.latch else 0)
        publishers[key] = max(publisher_class, publishers.get(key, 0))  # a node may have several, of several classes
    subscribers = {(each.owner, ROLE_SUBSCRIBES): 0 for each in topic.queues}
    topic_type = type_of(topic)
    return Announcement(
        publishes=bool(publishers),
        subscribes=bool(subscribers),
        size=topic_type.size,
        fingerprint=topic_type.fingerprint,
        varies=topic_type.varies,
        asked=asked_type(topic),
        endpoints=publishers | subscribers,
    )
