"""`r2p topic pub`: publish from the shell."""

import asyncio
from typing import Annotated, Any

import typer

import r2p
from r2p.tools.session import PATIENCE, Session, TimedOut, Timeout, Usage
from r2p.tools.terminal import lines
from r2p.tools.topic.watching import (
    ClassChoice,
    Count,
    Once,
    Rate,
    Topic,
    TypeName,
    class_choice,
    hint,
    meant,
    passed_on,
    subscribed,
)
from r2p.tools.types import find
from r2p.tools.values import parse, parse_line

STDIN = "-"
DEFAULT_RATE = 1.0

_AnyPublisher = r2p.Publisher[Any] | r2p.SporadicPublisher[Any] | r2p.PeriodicPublisher[Any]


async def pub(
    session: Session,
    topic: Topic,
    message: Annotated[
        list[str] | None,
        typer.Argument(metavar="MESSAGE...", help="'{x: 1.5}', x=1.5 w=0.25, or - for JSON lines on stdin."),
    ] = None,
    *,
    type: TypeName = None,
    count: Count = None,
    once: Once = False,
    rate: Rate = None,
    klass: Annotated[
        ClassChoice | None,
        typer.Option(
            "--class",
            parser=class_choice,
            metavar="CLASS",
            help="nrt (non real-time, the default: waits for room), periodic:10ms or sporadic:20ms.",
        ),
    ] = None,
    timeout: Timeout = None,
) -> None:
    """Publish a message.

    Once a second unless told otherwise; fields that are left out are zero. With --once, -n or stdin it waits for a
    subscriber first, at most --timeout. Ctrl-C ends it.
    """
    klass = klass or ClassChoice(r2p.PublisherClass.NON_REAL_TIME)
    periodic = klass.publisher_class is r2p.PublisherClass.PERIODIC
    from_stdin = message == [STDIN]
    if periodic and (from_stdin or rate is not None):
        raise Usage("--class periodic:TIME says when to publish: it takes neither --rate nor stdin")
    cls = await find(session, topic, type)
    job = _Job(session, topic, cls, klass, 1 if once else count, timeout)
    if from_stdin:
        await job.publish_lines(rate)
        return
    try:
        value = parse(cls, message or [])
    except r2p.MessageError as error:
        raise Usage(str(error)) from error
    if periodic:
        await job.publish_periodically(value)
    else:
        await job.publish(value, DEFAULT_RATE if rate is None else rate)


class _Job:
    """Publishes on one topic."""

    def __init__(
        self,
        session: Session,
        topic: str,
        cls: type[r2p.Message],
        klass: ClassChoice,
        count: int | None,
        timeout: float | None,
    ) -> None:
        self._session = session
        self._topic = topic
        self._cls = cls
        self._klass = klass
        self._count = count
        self._timeout = timeout

    async def publish(self, message: r2p.Message, rate: float) -> None:
        """The same message again and again."""
        publisher = self._advertise()
        ticks = self._session.node.every(1 / rate)
        await self._found_subscriber(publisher, needed=self._count is not None)
        await publisher.publish(message)
        while publisher.sent != self._count:
            await anext(ticks)
            await publisher.publish(message)

    async def publish_periodically(self, message: r2p.Message) -> None:
        """The same message, timed by its publisher."""
        done = asyncio.Event()
        ready = self._count is None

        def fill() -> r2p.Message | None:
            if publisher.sent == self._count:
                done.set()
                return None
            return message if ready else None

        klass = r2p.Periodic(self._klass.time, fill)
        publisher = self._session.node.advertise(self._topic, self._cls, klass)
        await self._found_subscriber(publisher, needed=not ready)
        ready = True
        await done.wait()

    async def publish_lines(self, rate: float | None) -> None:
        """One message for each line on stdin."""
        publisher = self._advertise()
        await self._found_subscriber(publisher, needed=True)
        ticks = None if rate is None else self._session.node.every(1 / rate)
        number = 0
        async for line in lines():
            number += 1
            if not line.strip():
                continue
            try:
                message = parse_line(self._cls, line)
            except r2p.MessageError as error:
                raise r2p.MessageError(f"line {number}: {error}") from error
            await publisher.publish(message)
            if publisher.sent == self._count:
                return
            if ticks is not None:
                await anext(ticks)

    def _advertise(self) -> r2p.Publisher[Any] | r2p.SporadicPublisher[Any]:
        if self._klass.publisher_class is r2p.PublisherClass.SPORADIC:
            return self._session.node.advertise(self._topic, self._cls, r2p.Sporadic(self._klass.time))
        return self._session.node.advertise(self._topic, self._cls)

    async def _found_subscriber(self, publisher: _AnyPublisher, *, needed: bool) -> None:
        """Wait for a subscriber if one is needed; else only say that there is none, if so after a second."""
        if not needed:
            asyncio.get_running_loop().call_later(PATIENCE, self._note_subscribers, publisher)
            return
        nobody = f"nobody subscribes {self._topic}"
        waiting = self._session.waiting(f"a subscriber of {self._topic}")
        with waiting, hint(self._session, nobody, self._topic, subscribed):
            try:
                async with asyncio.timeout(self._timeout):
                    await publisher.wait_subscriber()
                    await passed_on(self._session, publisher.topic)
            except TimeoutError:
                raise TimedOut(f"nobody subscribed {self._topic} for {self._timeout:g} s") from None

    def _note_subscribers(self, publisher: _AnyPublisher) -> None:
        if not publisher.subscribers:
            question = meant(self._session, self._topic, subscribed)
            self._session.say(f"nobody subscribes {self._topic} yet; publishing all the same{question}")
