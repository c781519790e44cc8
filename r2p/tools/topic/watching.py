"""Code of all topic commands: arguments with completion, and waiting for messages, publishers and subscribers.

A command reports what it waits for, and suggests other topics where the name may be wrong.
"""

import asyncio
import contextlib
import difflib
from collections.abc import AsyncIterator, Callable, Iterable, Iterator, Mapping
from typing import Annotated, Any

import typer

import r2p
from r2p.codecs.management import ROLE_PUBLISHES, ROLE_SUBSCRIBES
from r2p.tools.completion import complete_topic, complete_type
from r2p.tools.options import valid_topic
from r2p.tools.output import notify
from r2p.tools.session import Session, Settings, call_after, wait_until
from r2p.tools.types import Types, describe_other

Topic = Annotated[
    str, typer.Argument(metavar="TOPIC", autocompletion=complete_topic, parser=valid_topic, show_default=False)
]
Topics = Annotated[
    list[str],
    typer.Argument(metavar="TOPIC", autocompletion=complete_topic, parser=valid_topic, show_default=False),
]
TypeName = Annotated[
    str | None,
    typer.Option(
        "--type",
        metavar="TYPE",
        autocompletion=complete_type,
        help="sensor_msgs/LaserScan, a name in r2p.msg, package.module:Class or FILE.py:Class; "
        "default: from r2p.toml or the peer.",
    ),
]


def check_type(settings: Settings, given: Mapping[str, Any]) -> None:
    """Raise UsageError if --type names no message class."""
    if given["type"]:
        Types(settings).load(given["type"])


AnyPublisher = r2p.Publisher[Any] | r2p.SporadicPublisher[Any] | r2p.PeriodicPublisher[Any]

HINT_AFTER = 2.0
"""Seconds without a peer after which a command suggests other topics."""

_POLL = 0.5  # seconds between two checks whether there is still a publisher
_POLL_TYPES = 0.4  # seconds between two checks whether there are only peers of another type
_GRACE = 0.05  # seconds in which firmware acts on a response
_SECOND_ROUND = 2.0  # seconds in which all advertisements of this module have been repeated, and answered


async def received_samples(
    session: Session, subscriber: r2p.Subscriber[Any], *, typed: bool = True
) -> AsyncIterator[r2p.Sample]:
    """Yield the samples of a subscription, and report what it waits for until the first one.

    Without a type (`typed`), firmware that advertises nothing can't be asked for the topic: that is reported, too.
    """
    topic = subscriber.topic

    def awaited() -> str:
        return f"{'the first message' if subscriber.publishers else 'a publisher'} of {topic}"

    def report_unadvertised() -> None:
        view = session.module.network.topics().get(topic)
        if not typed and session.announcements.may_have_firmware() and not (view and is_published(view)):
            notify(f"{topic} has not been advertised: if its firmware announces nothing, give --type")

    samples = subscriber.samples()
    waiting, hints = session.waiting(awaited), hint(session, f"{topic} has no publisher", topic, is_published)
    with waiting, hints, call_after(HINT_AFTER, report_unadvertised):
        first = await anext(samples, None)
    if first is not None:
        yield first
    with _reporting_departure(session, subscriber):
        async for sample in samples:
            yield sample


@contextlib.asynccontextmanager
async def while_publishers_fit(
    session: Session, subscriber: r2p.Subscriber[Any], cls: type[r2p.Message] | None
) -> AsyncIterator[None]:
    """Raise r2p.Error in the block when all publishers have another type than `cls`: nothing would ever arrive."""
    topic = subscriber.topic
    async with _while_types_fit(lambda: subscriber.publishers > 0, session, topic, cls, ROLE_PUBLISHES):
        yield


@contextlib.asynccontextmanager
async def while_subscribers_fit(session: Session, publisher: AnyPublisher) -> AsyncIterator[None]:
    """Raise r2p.Error in the block when all subscribers have another type than the publisher."""
    topic, cls = publisher.topic, publisher.type
    async with _while_types_fit(lambda: publisher.subscribers > 0, session, topic, cls, ROLE_SUBSCRIBES):
        yield


@contextlib.asynccontextmanager
async def _while_types_fit(
    is_connected: Callable[[], bool], session: Session, topic: str, cls: type[r2p.Message] | None, role: int
) -> AsyncIterator[None]:
    if cls is None:
        yield
        return

    async def watch(cls: type[r2p.Message]) -> None:
        other: str | None = None
        while True:
            await asyncio.sleep(_POLL_TYPES)
            before, other = other, None if is_connected() else _other_type(session, topic, cls, role)
            if before and other:  # twice in a row, as a peer of the right type may need a moment to answer
                raise r2p.Error(other)

    async with asyncio.TaskGroup() as tasks:
        watching = tasks.create_task(watch(cls))
        yield
        watching.cancel()


def _other_type(session: Session, topic: str, cls: type[r2p.Message], role: int) -> str | None:
    """Describe the type that the peers in a role have, if it is another one."""
    for link in session.module.links:
        info = link.discovery.topics.get(topic)
        theirs = info.type_of(role) if info is not None and info.mismatch and link.up else None
        if theirs is not None:
            verb = "carries" if role == ROLE_PUBLISHES else "is subscribed as"
            what = f"{topic} {verb}"
            return describe_other(session.settings, what, cls, theirs.size, theirs.fingerprint, varies=theirs.varies)
    return None


def subscriber_names(session: Session, topic: str) -> tuple[list[str], bool]:
    """Return the subscribers of a topic as `MODULE/NODE`, and whether their modules are all known.

    Firmware does not say which of its nodes subscribes (`?`), and announces its name now and then only.
    """
    view = session.module.network.topics().get(topic, r2p.TopicView(topic))
    known = [f"{each.module or '?'}/{each.node}" for each in view.subscribers]
    rest = session.unannounced(view.subscribers, view.subscribed_on).items()
    names = known + [f"a module on {link}" if module == "?" else f"{module}/?" for link, module in rest]
    complete = all(each.module for each in view.subscribers) and all(module != "?" for _, module in rest)
    return names, bool(names) and complete


def suggest_topics(session: Session, topic: str, fits: Callable[[r2p.TopicView], bool]) -> str:
    """Return a question with the topics that fit and have a similar name, for the end of a sentence; empty: none.

    A name that is the same except for its namespace counts as similar.
    """
    known = sorted(name for name, view in session.module.network.topics().items() if fits(view) and name != topic)
    close = difflib.get_close_matches(topic, known)
    bare = topic.rpartition("/")[2]
    close += [name for name in known if name.rpartition("/")[2] == bare and name not in close]
    return f"; did you mean {' or '.join(close)}?" if close else ""


def is_published(view: r2p.TopicView) -> bool:
    return bool(view.publishers or view.published_on)


def is_subscribed(view: r2p.TopicView) -> bool:
    return bool(view.subscribers or view.subscribed_on)


@contextlib.contextmanager
def hint(session: Session, text: str, topic: str, fits: Callable[[r2p.TopicView], bool]) -> Iterator[None]:
    """Report `text` and suggest other topics once, if the block waits long and this topic does not fit."""

    def report() -> None:
        view = session.module.network.topics().get(topic)
        question = suggest_topics(session, topic, fits)
        if question and not (view and fits(view)):
            notify(f"{text}{question}")

    with call_after(HINT_AFTER, report):
        yield


def advice(session: Session, topics: Iterable[str], timeout: float | None) -> Callable[[], str]:
    """Return a function that suggests other topics, for those that are not published when the time is up.

    With more time, `hint` has done so by then.
    """

    def suggest() -> str:
        views = session.module.network.topics()
        unknown = [name for name in topics if not (name in views and is_published(views[name]))]
        texts = (suggest_topics(session, name, is_published) for name in unknown)
        return "" if (timeout or 0.0) > HINT_AFTER else next(filter(None, texts), "")

    return suggest


async def wait_until_passed_on(session: Session, topic: str) -> None:
    """Wait until firmware at the end of a line, which subscribes to the topic, receives its messages.

    It may be a gateway of firmware, which forwards messages only after a second request (PROTOCOL.md 4).
    """
    lines = [link for link in session.module.links if link.point_to_point and link.up and not _is_r2p(link)]
    asked = {link: at for link in lines if (at := _requested_at(link, topic)) is not None}

    def repeated() -> bool:
        return not any(link.up and _requested_at(link, topic) == at for link, at in asked.items())

    # In vain for a build of the firmware that repeats nothing, or if its answer was lost.
    if asked and await wait_until(repeated, _SECOND_ROUND):
        await asyncio.sleep(_GRACE)


def _requested_at(link: Any, topic: str) -> int | None:
    info = link.discovery.topics.get(topic)
    return None if info is None else info.requested_at


def _is_r2p(link: Any) -> bool:
    return any(info.r2p and not info.hops for info in link.discovery.modules.values())


@contextlib.contextmanager
def _reporting_departure(session: Session, subscriber: r2p.Subscriber[Any]) -> Iterator[None]:
    """Report in the block when the last publisher is gone."""

    async def watch() -> None:
        present = True
        while True:
            await asyncio.sleep(_POLL)
            before, present = present, subscriber.publishers > 0
            if before and not present:
                notify(f"{subscriber.topic} has no publisher any more")

    watching = asyncio.create_task(watch())
    try:
        yield
    finally:
        watching.cancel()
