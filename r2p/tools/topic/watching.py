"""Arguments and options that the topic commands share."""

import asyncio
import contextlib
import difflib
from collections.abc import AsyncIterator, Callable, Iterator
from typing import Annotated, Any

import msgspec
import typer

import r2p
from r2p.tools.session import Session, TimedOut, later, seconds, settings
from r2p.tools.types import complete_type

CLASS_NAMES = {
    r2p.PublisherClass.NON_REAL_TIME: "nrt",
    r2p.PublisherClass.SPORADIC: "sporadic",
    r2p.PublisherClass.PERIODIC: "periodic",
}
"""The three classes as --class names them."""


class ClassChoice(msgspec.Struct, frozen=True):
    """A publisher class, and its period or deadline in seconds."""

    publisher_class: r2p.PublisherClass
    time: float = 0.0


def class_choice(text: str) -> ClassChoice:
    """`nrt`, `periodic:10ms` or `sporadic:20ms`."""
    name, _, time = text.partition(":")
    by_name = {name: publisher_class for publisher_class, name in CLASS_NAMES.items()}
    if name not in by_name or (name == "nrt") == bool(time):
        raise typer.BadParameter(f"{text!r}: write nrt, periodic:10ms or sporadic:20ms")
    return ClassChoice(by_name[name], seconds(time) if time else 0.0)


def hertz(text: str) -> float:
    """A rate of more than 0 Hz."""
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value < float("inf"):
        raise typer.BadParameter(f"{text!r}: a rate is a number of more than 0 Hz")
    return value


def _complete_topic(incomplete: str) -> list[str]:
    return [name for name in settings().types if name.startswith(incomplete)]


Topic = Annotated[str, typer.Argument(metavar="TOPIC", autocompletion=_complete_topic, show_default=False)]
Topics = Annotated[list[str], typer.Argument(metavar="TOPIC...", autocompletion=_complete_topic, show_default=False)]
TypeName = Annotated[
    str | None,
    typer.Option(
        "--type",
        metavar="TYPE",
        autocompletion=complete_type,
        help="package.module:Class, FILE.py:Class, or a name in r2p.msg; default: r2p.toml, then what the peer tells.",
    ),
]
Count = Annotated[int | None, typer.Option("--count", "-n", min=1, metavar="N", help="End after so many.")]
Once = Annotated[bool, typer.Option("--once", help="End after one.")]
Rate: Any = Annotated[
    float | None, typer.Option("--rate", "-r", parser=hertz, metavar="HZ", help="Messages a second; default: 1.")
]


# How tools wait for messages: they say what they wait for, and may give up.


_LOOK = 0.5  # seconds between two looks whether there is a publisher

_GRACE = 0.05  # seconds that firmware takes to see to a response
_SECOND_ROUND = 2.0  # seconds in which all that we advertise has been repeated, and answered

HINT_AFTER = 2.0
"""Seconds without anybody at the other end after which a tool names topics that the user may have meant."""


async def watched(
    session: Session, subscriber: r2p.Subscriber[Any], *, typed: bool = True
) -> AsyncIterator[r2p.Sample]:
    """The samples of a subscription; says what it waits for until there is a first one.

    Where its type is not known (`typed`), firmware that advertises nothing can't be asked for it: that is said, too.
    """

    def missing() -> str:
        return ("the first message" if subscriber.publishers else "a publisher") + f" of {subscriber.topic}"

    def unadvertised() -> None:
        if not typed:
            _tell_unadvertised(session, subscriber.topic)

    samples = subscriber.samples()
    nobody = f"nobody publishes {subscriber.topic}"
    waiting, hints = session.waiting(missing), hint(session, nobody, subscriber.topic, published)
    with waiting, hints, later(HINT_AFTER, unadvertised):
        first = await anext(samples, None)
    if first is not None:
        yield first
    with _departures(session, subscriber):
        async for sample in samples:
            yield sample


def _tell_unadvertised(session: Session, topic: str) -> None:
    view = session.module.network.topics().get(topic)
    if session.may_have_firmware() and not (view and published(view)):
        session.say(f"nothing has advertised {topic}: firmware may announce nothing, then give --type to subscribe it")


def meant(session: Session, topic: str, fits: Callable[[r2p.TopicView], bool]) -> str:
    """Which topics that fit have names much like this one, for the end of a sentence; empty: none.

    A name may also be right but for its namespace.
    """
    known = [name for name, view in session.module.network.topics().items() if fits(view) and name != topic]
    close = difflib.get_close_matches(topic, known)
    bare = topic.rpartition("/")[2]
    close += [name for name in known if name.rpartition("/")[2] == bare and name not in close]
    return f": is it one of {', '.join(close)}?" if close else ""


def published(view: r2p.TopicView) -> bool:
    return bool(view.publishers or view.published_on)


def subscribed(view: r2p.TopicView) -> bool:
    return bool(view.subscribers or view.subscribed_on)


@contextlib.contextmanager
def hint(session: Session, text: str, topic: str, fits: Callable[[r2p.TopicView], bool]) -> Iterator[None]:
    """If the block waits long: say the text once, and which that fit may have been meant; not if this one fits."""

    def tell() -> None:
        others = session.module.network.topics().get(topic)
        question = meant(session, topic, fits)
        if question and not (others and fits(others)):
            session.say(f"{text}{question}")

    with later(HINT_AFTER, tell):
        yield


async def passed_on(session: Session, topic: str) -> None:
    """Wait until messages of a topic that firmware subscribes at the end of a line get through.

    What is there may be a gateway of firmware, which passes them on only after a second request (PROTOCOL.md 4).
    """
    lines = [link for link in session.module.links if link.point_to_point and link.up and not _is_r2p(link)]
    asked = {link: _requested_at(link, topic) for link in lines}
    end = asyncio.get_running_loop().time() + _SECOND_ROUND
    while any(at is not None and link.up and _requested_at(link, topic) == at for link, at in asked.items()):
        if asyncio.get_running_loop().time() >= end:
            return  # firmware of a build that repeats nothing, or its answer is lost
        await asyncio.sleep(_GRACE)
    if any(at is not None for at in asked.values()):
        await asyncio.sleep(_GRACE)


def _requested_at(link: Any, topic: str) -> int | None:
    info = link.discovery.topics.get(topic)
    return None if info is None else info.requested_at


def _is_r2p(link: Any) -> bool:
    return any(info.r2p and not info.hops for info in link.discovery.modules.values())


@contextlib.contextmanager
def _departures(session: Session, subscriber: r2p.Subscriber[Any]) -> Iterator[None]:
    """While the block runs: say when the last publisher has left."""

    async def watch() -> None:
        there = True
        while True:
            await asyncio.sleep(_LOOK)
            was_there, there = there, subscriber.publishers > 0
            if was_there and not there:
                session.say(f"nobody publishes {subscriber.topic} any more")

    watching = asyncio.create_task(watch())
    try:
        yield
    finally:
        watching.cancel()


@contextlib.asynccontextmanager
async def patience(what: str, timeout: float | None) -> AsyncIterator[Callable[[], None]]:
    """Raise TimedOut in the block when the function that it gets has not been called for `timeout` seconds."""
    loop = asyncio.get_running_loop()
    try:
        async with asyncio.timeout(timeout) as limit:

            def heard() -> None:
                if timeout is not None and not limit.expired():
                    limit.reschedule(loop.time() + timeout)

            yield heard
    except TimeoutError:
        raise TimedOut(f"nothing on {what} for {timeout:g} s") from None
