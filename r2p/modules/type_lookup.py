"""Types that this module has no class for: another module gives the fields of a type, as found by its fingerprint.

Modules that publish or subscribe to a topic of the type are asked first, by r2p's own services, on any link and through
gateways; then zenoh, for modules of before. An answer is believed if its schema has the fingerprint.
"""

from collections.abc import Iterable, Iterator
from typing import Any

from r2p.codecs import schemas
from r2p.codecs.management import ANY_TYPE, ROLE_PUBLISHES
from r2p.codecs.own_services import Operation
from r2p.errors import DecodeError, MessageError, ServiceError
from r2p.messages import Layout, Message, layout, message_type
from r2p.modules.own_services import OwnServices, may_answer
from r2p.protocols.discovery.events import ModuleInfo
from r2p.runtime.topic import TopicSpace
from r2p.transports.link import Link

_ASKED_MAX = 4
"""Modules that are asked for one type: the nearest publishers of its topics, then subscribers, then others."""


def schema(space: TopicSpace, links: Iterable[Link], asked: bytes) -> bytes:
    """Return the full name and the schema of a type of this module's topics, or that links know of theirs.

    `asked` is its fingerprint, and behind it the name of a topic, or nothing: of several types with this fingerprint,
    that of the topic. Raises LookupError if there is none.
    """
    fingerprint, topic = asked[: len(ANY_TYPE)], asked[len(ANY_TYPE) :].decode("ascii", "replace")
    found: Layout[Any] | None = None
    for each in space.topics.values():
        if each.layout is not None and each.layout.fingerprint == fingerprint:
            found = each.layout if found is None or _is_same_topic(each.name, topic) else found
    if found is None:
        known = (layout(cls) for link in links for cls in link.known_types())
        found = next((each for each in known if each.fingerprint == fingerprint), None)
    if found is None:
        raise LookupError("no topic of this module has the type")
    return schemas.encode(found.name, found.schema)


def _is_same_topic(name: str, other: str) -> bool:
    """Return whether two names can be those of one topic, on links with and without a prefix."""
    return name == other or name.endswith(f"/{other}") or other.endswith(f"/{name}")


async def find_type(
    links: list[Link], services: OwnServices, fingerprint: bytes, topic: str = ""
) -> type[Message] | None:
    """Ask other modules for a message class of this layout: that of a topic, where several have it.

    None if none of them has it.
    """
    for link, info in _holders(links, fingerprint, topic)[:_ASKED_MAX]:
        found = await _ask(link, info, services, fingerprint, topic)
        if found is not None:
            return found
    for link in list(links):
        found = await link.message_type(fingerprint) if link.up else None
        if found is not None:
            return found
    return None


async def _ask(
    link: Link, info: ModuleInfo, services: OwnServices, fingerprint: bytes, topic: str
) -> type[Message] | None:
    for asked in (fingerprint + topic.encode(), fingerprint) if topic else (fingerprint,):
        try:
            answer = await services.fetch(info.instance or 0, Operation.SCHEMA, asked)
            return message_type(*schemas.decode(answer, fingerprint))
        except ServiceError:
            continue  # perhaps a module of before, which knows no topic here
        except TimeoutError:
            return None
        except (DecodeError, MessageError):
            link.stats.lost["wrong schema"] += 1
            return None
    return None


def _holders(links: list[Link], fingerprint: bytes, topic: str) -> list[tuple[Link, ModuleInfo]]:
    """Return the modules that may have the type, the likeliest first, each with a link on which it is known."""
    ranked = sorted(
        (each for link in links if link.up for each in _holders_on(link, fingerprint, topic)), key=lambda each: each[:2]
    )
    return list({info.instance: (link, info) for *_, link, info in reversed(ranked)}.values())[::-1]


def _holders_on(link: Link, fingerprint: bytes, topic: str) -> Iterator[tuple[int, int, Link, ModuleInfo]]:
    """Yield rank, hops, the link and each module that may have the type."""
    topics = {info.name for info in link.discovery.topics.values() if info.fingerprint == fingerprint}
    if topic:
        topics = {name for name in topics if _is_same_topic(name, topic)} or topics
    if topic and not topics:  # a publisher that has returned with another type, while the one of before is remembered
        topics = {name for name in link.discovery.topics if _is_same_topic(name, topic)}
    if not topics:
        return
    roles: dict[int, int] = {}
    for endpoint in link.discovery.endpoints.values():
        if endpoint.topic in topics:
            roles[endpoint.instance] = min(endpoint.role, roles.get(endpoint.instance, endpoint.role))
    for info in link.discovery.modules.values():
        if may_answer(link, info):
            role = roles.get(info.instance or 0)
            rank = 2 if role is None else 0 if role == ROLE_PUBLISHES else 1
            yield rank, info.hops, link, info
