"""Announcements of topics that came together, worked out once for all modules of this process that receive them.

On a network in memory, the same messages reach a hundred modules. To most of them, the topics are new and of no further
interest, so each of these modules enters copies of the same entries. Without that, every message would be handled again
by every module.
"""

import functools
from collections import Counter
from collections.abc import Mapping, Sequence

from r2p.codecs import UnknownType, management
from r2p.codecs.management import ROLE_GONE, ROLE_PUBLISHES, ROLE_SUBSCRIBES, TOPIC_TYPES
from r2p.errors import DecodeError
from r2p.protocols.discovery.directory import Directory, EndpointInfo, EndpointKey, TopicInfo, TopicRole
from r2p.protocols.discovery.events import TopicType
from r2p.protocols.timers import KeyedTimers


class TopicBatch:
    """Decoded messages, and what they make of topics and endpoints that were not known before."""

    def __init__(self, messages: tuple[management.Management, ...]) -> None:
        self.messages = messages
        self.topics: dict[str, TopicInfo] = {}
        """The entries of topics, as of instant 0."""
        self.about: dict[str, list[management.Management]] = {}
        """The messages about each of these topics."""
        self.instance = 0
        """The module with the endpoints."""
        self.endpoints: list[management.Endpoint] = []
        self.ends: list[TopicRole] = []
        """The topic and the role of each endpoint."""
        self.rest = messages
        """Messages to handle one by one: all of them, if any says more than that a topic or an endpoint is there."""
        self._entries: dict[EndpointKey, EndpointInfo] = {}
        self._module = ""
        self._work_out()

    def enter_new(
        self, now: int, directory: Directory, own: Mapping[int, Mapping[str, object]]
    ) -> Sequence[management.Management]:
        """Enter what is new, and return the other messages: those about known topics, and about this module's `own`.

        `own` are its topics by role (ROLE_...), `now` is in monotonic ns.
        """
        rest = list(self.rest)
        topics, published, subscribed = directory.topics, own[ROLE_PUBLISHES], own[ROLE_SUBSCRIBES]
        room = len(self.topics) <= directory.most - len(topics)
        for name, entry in self.topics.items():
            if name in topics or name in published or name in subscribed or not room:
                rest += self.about[name]
            else:
                topics[name] = entry.as_of(now)
        if self.endpoints and not directory.enter_endpoints(self.instance, self.ends, self.endpoint_entries):
            rest += self.endpoints
        return rest

    def endpoint_entries(self, module: str) -> dict[EndpointKey, EndpointInfo]:
        """Return the entries of the endpoints, given the name of their module."""
        if module != self._module:
            infos = [
                EndpointInfo(module, each.instance, each.node, each.topic, each.role, each.publisher_class)
                for each in self.endpoints
            ]
            self._module = module
            self._entries = {(each.instance, each.node, each.topic, each.role): each for each in infos}
        return self._entries

    def _work_out(self) -> None:
        tables = Directory(KeyedTimers(), Counter())
        about: dict[str, list[management.Management]] = {}
        endpoints: list[management.Endpoint] = []
        for message in self.messages:
            match message:
                case management.TypeInfo(role, topic, fingerprint, size):
                    tables.add_type(0, topic, role, TopicType.announced(size, fingerprint))
                case management.Advertise(topic, size):
                    tables.add_size(0, topic, ROLE_PUBLISHES, size).advertised_at = 0
                case management.SubscribeRequest(topic, size):
                    tables.add_size(0, topic, ROLE_SUBSCRIBES, size).requested_at = 0
                case management.Endpoint(role) if not role & ROLE_GONE:
                    endpoints.append(message)
                    continue
                case _:
                    return
            about.setdefault(topic, []).append(message)
        instances = {each.instance for each in endpoints}
        if len(instances) <= 1:
            self.topics, self.about, self.endpoints, self.rest = tables.topics, about, endpoints, ()
            self.instance = next(iter(instances), 0)
            self.ends = [(each.topic, each.role) for each in endpoints]


@functools.lru_cache(maxsize=1024)
def split_topics(messages: tuple[bytes, ...]) -> tuple[tuple[bytes, ...], TopicBatch | None]:
    """Split messages that came together into the first ones, and those about topics that follow; None without any."""
    first = next((n for n, data in enumerate(messages) if management.type_of(data) in TOPIC_TYPES), len(messages))
    if first == len(messages) or not all(management.type_of(data) in TOPIC_TYPES for data in messages[first:]):
        return messages, None
    try:
        return messages[:first], TopicBatch(tuple(map(management.decode, messages[first:])))
    except (DecodeError, UnknownType):
        return messages, None
