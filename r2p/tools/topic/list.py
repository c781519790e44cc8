"""`r2p topic list`, `info` and `find`: what is known about topics."""

import asyncio
import re
from collections.abc import Iterable
from typing import Annotated, Any

import typer

import r2p
from r2p.codecs.services import is_of_service
from r2p.names import BUS_LOAD, BUS_SLOTS, chosen_alias, topic_name
from r2p.tools.completion import complete_type
from r2p.tools.options import CLASS_NAMES, Format, Wait
from r2p.tools.output import Output, notify
from r2p.tools.session import Session, alias_or_none, wait_until
from r2p.tools.topic.watching import Topic, suggest_topics
from r2p.tools.types import Types, of_size, put_sizes, size_text

AllTopics = Annotated[
    bool, typer.Option("--all", "-a", help="Include the two topics of each service, NAME_q and NAME_r.")
]

_ROUND = 5.0  # seconds in which firmware announces all that it has, one item each half second
_COLUMNS = ["topic", "type", "size", "varies", "publishers", "subscribers"]


async def list_(session: Session, *, all: AllTopics = False, wait: Wait = None, format: Format = None) -> None:
    """List topics, types, publishers and subscribers.

    With -v also the alias of each long name, which travels on RTCAN and debug lines.
    """
    output = Output(format)
    await session.settle(wait)
    known, types = session.module.network.topics(), Types(session.settings)
    views = [view for name, view in known.items() if all or not is_of_service(name, known)]
    await types.learn_all(session, views)
    rows = [_row(session, view, types) for view in views]
    await put_sizes(output, rows, session.columns(*_COLUMNS))
    if not rows and known:
        notify(f"no topics yet on {session.network_name}, except for those of services; use --all to include these")
    elif not rows:
        session.report_none("topics")


async def info(session: Session, topic: Topic, *, wait: Wait = None, format: Format = None) -> None:
    """Show everything about a topic.

    Its type, its publishers and subscribers by node, and what the links guarantee;
    with -v also the fields of the type, the alias of a long name, and the time since it was last announced.
    """
    output = Output(format)
    await session.settle(wait)
    name = topic_name(topic)
    if wait is None and session.settings.via and _find(session, name) is None:
        await _look_for(session, name)
    view, collisions = _find(session, name), _collisions(session, name)
    if view is None:
        raise r2p.Error(_unknown_text(session, name, collisions))
    for text in dict.fromkeys(collisions.values()):
        notify(text)
    if view.mismatch:
        notify(f"{topic} has different types: some of these nodes can't exchange messages")
    details = await _details(session, view, collisions)
    if session.verbose:
        age = None if view.age is None else round(view.age, 3)
        details["age"] = f"{age} s" if output.format == "text" else age
        details |= _alias(session, view)
    if output.format == "text" and details["size"] is not None:
        details |= {"size": size_text(details["size"], varies=details["varies"])}
    await output.put(details)


async def find(
    session: Session,
    what: Annotated[
        str,
        typer.Argument(
            metavar="TYPE|FINGERPRINT|SIZE",
            autocompletion=complete_type,
            help="sensor_msgs/LaserScan, 16 hex digits, or bytes.",
        ),
    ],
    *,
    wait: Wait = None,
    format: Format = None,
) -> None:
    """Find the topics of a type.

    Firmware does not announce the fingerprint of a type: then only the size is compared, and the match is "size". The
    size of a topic whose messages vary in length is that of the longest one, and matches nothing.
    """
    output = Output(format)
    types = Types(session.settings)
    size, fingerprint = _wanted(what, types)
    await session.settle(wait)
    views = session.module.network.topics().values()
    found = [(view, match) for view in views if (match := _match(view, size, fingerprint)) is not None]
    await types.learn_all(session, (view for view, _ in found))
    rows = [_row(session, view, types) | {"match": match} for view, match in found]
    await put_sizes(output, rows, session.columns(*_COLUMNS, "match"))
    if not rows:
        raise r2p.Error(session.none_yet(f"topics of type {what}"))


def _find(session: Session, name: str) -> r2p.TopicView | None:
    """Return the topic of this name or alias, if it is known."""
    views = session.module.network.topics()
    view = views.get(name) or _with_alias(session, name, views.values())
    if view is None and _collisions(session, name):  # without its name, which is not believed, it is known as the alias
        view = views.get(chosen_alias(name, session.settings.aliases))
    return view


async def _look_for(session: Session, name: str) -> None:
    """Wait until a topic is known, or can be said to be missing: firmware may not have come to it, others be busy."""

    def is_known() -> bool:
        return _find(session, name) is not None

    loop = asyncio.get_running_loop()
    end = loop.time() + _ROUND
    with session.waiting(f"topic {name}"):
        if not await session.look_for(is_known) and session.announcements.have_firmware():
            await wait_until(is_known, end - loop.time())
    view = _find(session, name)
    if view is not None and view.fingerprint is not None:  # an r2p module's, which announces more at the same time
        await session.announcements.settled()


def _unknown_text(session: Session, name: str, collisions: dict[str, str]) -> str:
    if name in (BUS_LOAD, BUS_SLOTS):
        return f"{name} is published only while it has a subscriber, by a module on a CAN bus: r2p topic echo {name}"
    question = suggest_topics(session, name, lambda view: True)
    known = question or f"; known topics: {', '.join(session.module.network.topics()) or 'none'}"
    reason = next((f"; {text}" for text in collisions.values()), known)
    if session.announcements.have_firmware():
        advice = "firmware announces one item every 0.5 s, so listen longer with --wait 10"
        return f"{name} has not been announced{reason}; {advice}"
    return f"{name} has no publisher and no subscriber{reason}"


def _collisions(session: Session, name: str) -> dict[str, str]:
    """Return the links on which another topic has the same alias as this one, and what to do about it."""
    alias = chosen_alias(name, session.settings.aliases)
    collisions = {}
    for link in session.module.links:
        names = link.discovery.topics_with_alias(alias)
        names |= {name} if name != alias and names else set()
        if len(names) > 1:
            one, other, *_ = sorted(names)
            collisions[link.name] = (
                f"topics {one} and {other} have one alias, {alias}: choose another one for either, in [alias] of "
                "r2p.toml, or with aliases= of Module"
            )
    return collisions


def _alias(session: Session, view: r2p.TopicView) -> dict[str, Any]:
    return {"alias": alias_or_none(view.name, lambda name: chosen_alias(name, session.settings.aliases))}


def _with_alias(session: Session, alias: str, views: Iterable[r2p.TopicView]) -> r2p.TopicView | None:
    """Return the topic with this alias, if there is one."""
    return next((view for view in views if chosen_alias(view.name, session.settings.aliases) == alias), None)


def _wanted(what: str, types: Types) -> tuple[int, bytes | None]:
    """Return the size (0: any) and the fingerprint (None: any) to find."""
    if re.fullmatch(r"[0-9a-fA-F]{16}", what):
        return 0, bytes.fromhex(what)
    if what.isdecimal():
        return int(what), None
    layout = r2p.layout(types.load(what))
    return layout.exact_size, layout.fingerprint


def _match(view: r2p.TopicView, size: int, fingerprint: bytes | None) -> str | None:
    if fingerprint is not None and view.fingerprint is not None:
        return "type" if view.fingerprint == fingerprint else None
    return "size" if size and view.size == size and not view.varies else None


def _row(session: Session, view: r2p.TopicView, types: Types) -> dict[str, Any]:
    return (
        types.describe(view)
        | _alias(session, view)
        | {
            "publishers": [each["node"] for each in endpoints_of(session, view.publishers, view.published_on)],
            "subscribers": [each["node"] for each in endpoints_of(session, view.subscribers, view.subscribed_on)],
        }
    )


def endpoints_of(session: Session, known: list[r2p.Endpoint], links: list[str]) -> list[dict[str, Any]]:
    """Return the known endpoints, and for each other link the only module there, or `?`."""
    found = [
        {
            "node": f"{each.module or '?'}/{each.node}",
            "class": None if each.publisher_class is None else CLASS_NAMES[each.publisher_class],
            "link": each.link,
        }
        for each in known
    ]
    rest = session.unannounced(known, links).items()
    return found + [{"node": f"{module}/?", "class": None, "link": link} for link, module in rest]


async def _details(session: Session, view: r2p.TopicView, collisions: dict[str, str]) -> dict[str, Any]:
    types = Types(session.settings)
    cls = await types.learn(session, view)
    publishers = endpoints_of(session, view.publishers, view.published_on)
    subscribers = endpoints_of(session, view.subscribers, view.subscribed_on)
    details = types.describe(view) | {
        "fingerprint": None if view.fingerprint is None else view.fingerprint.hex(),
        "publishers": publishers,
        "subscribers": [{key: each[key] for key in ("node", "link")} for each in subscribers],
        "guarantees": _guarantees(session, view, collisions),
    }
    if session.verbose:
        details |= _fields(cls, view)
    return details


def _fields(cls: type[r2p.Message] | None, view: r2p.TopicView) -> dict[str, Any]:
    """Return the kind of each field by its path; for an unknown type, the names of the types of its size."""
    if cls is not None:
        pairs = (field.rpartition(":") for field in r2p.layout(cls).schema.split())
        return {"fields": {path: kind for path, _, kind in pairs}}
    return {"fields": None, "maybe": [] if view.varies else of_size(view.size)}


def _guarantees(session: Session, view: r2p.TopicView, collisions: dict[str, str]) -> dict[str, str]:
    """Return what each link guarantees to the classes of the publishers, as far as they are known."""
    classes = {each.publisher_class for each in view.publishers if each.publisher_class is not None}
    guarantees = {}
    for link in session.module.links:
        for publisher_class in sorted(classes or {r2p.PublisherClass.NON_REAL_TIME}):
            guarantee = _carried(
                link.refusal(view.size, varies=view.varies), link.guarantee(view.name, publisher_class), view
            )
            if link.name in collisions:
                guarantee = "carried for one of the topics with its alias, or for none"
            guarantees[f"{link.name} {CLASS_NAMES[publisher_class]}"] = guarantee
    return guarantees


def _carried(refusal: str | None, guarantee: str, view: r2p.TopicView) -> str:
    """Return a link's guarantee, and why it does not carry the topic, or not all of its messages."""
    if refusal is None:
        return guarantee
    return f"{guarantee}; its longest messages are not carried: {refusal}" if view.varies else f"not carried: {refusal}"
