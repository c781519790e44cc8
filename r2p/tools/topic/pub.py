"""`r2p topic pub`: publish from the shell."""

import asyncio
import os
import sys
from collections.abc import AsyncIterator
from typing import Annotated, Any, TextIO

import msgspec
import typer

import r2p
from r2p.bridge import ClassOf
from r2p.tools.options import Count, Once, Rate, Timeout, class_choice
from r2p.tools.output import notify, wait_ready, waitable
from r2p.tools.session import REPORT_WAITING_AFTER, Session, TimedOut, UsageError
from r2p.tools.topic.watching import Topic, TypeName, hint, is_subscribed, suggest_topics, wait_until_passed_on
from r2p.tools.types import find
from r2p.tools.values import parse, parse_line

STDIN = "-"
DEFAULT_RATE = 1.0

_CHUNK = 65536  # bytes
_LINE_MAX = 1 << 20  # bytes

_AnyPublisher = r2p.Publisher[Any] | r2p.SporadicPublisher[Any] | r2p.PeriodicPublisher[Any]


async def pub(
    session: Session,
    topic: Topic,
    message: Annotated[
        list[str] | None,
        typer.Argument(metavar="MESSAGE...", help="'{x: 1.5}', x=1.5 w=0.25, or - for JSON lines from stdin."),
    ] = None,
    *,
    type: TypeName = None,
    count: Count = None,
    once: Once = False,
    rate: Rate = None,
    choice: Annotated[
        ClassOf | None,
        typer.Option(
            "--class",
            parser=class_choice,
            metavar="CLASS",
            help="nrt (non real-time, the default), periodic:10ms or sporadic:20ms.",
        ),
    ] = None,
    timeout: Timeout = None,
) -> None:
    """Publish a message, by default once a second.

    Fields that are left out are zero. With --once, -n or stdin it first waits for a subscriber, at most --timeout.
    Ctrl-C ends it.
    """
    choice = choice or ClassOf(r2p.PublisherClass.NON_REAL_TIME)
    periodic = choice.publisher_class is r2p.PublisherClass.PERIODIC
    from_stdin = message == [STDIN]
    if periodic and (from_stdin or rate is not None):
        raise UsageError("--class periodic:TIME sets when to publish: leave out --rate, and don't read from stdin")
    message_class = await find(session, topic, type)
    publication = _Publication(session, topic, message_class, choice, 1 if once else count, timeout)
    if from_stdin:
        await publication.publish_lines(rate)
        return
    try:
        value = parse(message_class, message or [])
    except r2p.MessageError as error:
        raise UsageError(str(error)) from error
    if periodic:
        await publication.publish_periodically(value)
    else:
        await publication.publish(value, DEFAULT_RATE if rate is None else rate)


class _Publication(msgspec.Struct):
    """Publishes messages of one topic. `count`: how many; `timeout`: seconds to wait for a subscriber."""

    session: Session
    topic: str
    message_class: type[r2p.Message]
    choice: ClassOf
    count: int | None
    timeout: float | None

    async def publish(self, message: r2p.Message, rate: float) -> None:
        """Publish the same message over and over."""
        publisher = self._advertise()
        ticks = self.session.node.every(1 / rate)
        await self._wait_subscriber(publisher, needed=self.count is not None)
        await publisher.publish(message)
        while publisher.sent != self.count:
            await anext(ticks)
            await publisher.publish(message)

    async def publish_periodically(self, message: r2p.Message) -> None:
        """Publish the same message over and over, timed by a periodic publisher."""
        done = asyncio.Event()
        ready = self.count is None

        def fill() -> r2p.Message | None:
            if publisher.sent == self.count:
                done.set()
                return None
            return message if ready else None

        periodic = r2p.Periodic(self.choice.time, fill)
        publisher = self.session.node.advertise(self.topic, self.message_class, periodic)
        await self._wait_subscriber(publisher, needed=not ready)
        ready = True
        await done.wait()

    async def publish_lines(self, rate: float | None) -> None:
        """Publish one message for each line of stdin."""
        publisher = self._advertise()
        await self._wait_subscriber(publisher, needed=True)
        ticks = None if rate is None else self.session.node.every(1 / rate)
        number = 0
        async for line in read_lines():
            number += 1
            if not line.strip():
                continue
            try:
                message = parse_line(self.message_class, line)
            except r2p.MessageError as error:
                raise r2p.MessageError(f"line {number}: {error}") from error
            await publisher.publish(message)
            if publisher.sent == self.count:
                return
            if ticks is not None:
                await anext(ticks)

    def _advertise(self) -> r2p.Publisher[Any] | r2p.SporadicPublisher[Any]:
        if self.choice.publisher_class is r2p.PublisherClass.SPORADIC:
            return self.session.node.advertise(self.topic, self.message_class, r2p.Sporadic(self.choice.time))
        return self.session.node.advertise(self.topic, self.message_class)

    async def _wait_subscriber(self, publisher: _AnyPublisher, *, needed: bool) -> None:
        """Wait for a subscriber if one is needed; otherwise only report after a second that there is none."""
        if not needed:
            asyncio.get_running_loop().call_later(REPORT_WAITING_AFTER, self._report_no_subscriber, publisher)
            return
        missing = f"{self.topic} has no subscriber"
        waiting = self.session.waiting(f"a subscriber of {self.topic}")
        with waiting, hint(self.session, missing, self.topic, is_subscribed):
            try:
                async with asyncio.timeout(self.timeout):
                    await publisher.wait_subscriber()
                    await wait_until_passed_on(self.session, publisher.topic)
            except TimeoutError:
                raise TimedOut(f"{self.topic} had no subscriber for {self.timeout:g} s") from None

    def _report_no_subscriber(self, publisher: _AnyPublisher) -> None:
        if not publisher.subscribers:
            question = suggest_topics(self.session, self.topic, is_subscribed)
            notify(f"{self.topic} has no subscriber yet, publishing anyway{question}")


async def read_lines(stream: TextIO | None = None) -> AsyncIterator[str]:
    """Yield the lines of stdin (or of `stream`), without their ends, and without blocking the event loop.

    Bytes that are not UTF-8 become U+FFFD. Raises MessageError for a line longer than 1 MB.
    """
    rest = b""
    async for data in _chunks(stream or sys.stdin):
        *complete, rest = (rest + data).split(b"\n")
        for line in complete:
            yield _decode(line)
        if len(rest) > _LINE_MAX:
            break
    if rest:
        yield _decode(rest)


def _decode(line: bytes) -> str:
    if len(line) > _LINE_MAX:
        raise r2p.MessageError("a line on stdin is longer than 1 MB")
    return line.removesuffix(b"\r").decode(errors="replace")


async def _chunks(stream: TextIO) -> AsyncIterator[bytes]:
    fd = waitable(stream)
    if fd is not None:
        await wait_ready(fd)
        while data := os.read(fd, _CHUNK):
            yield data
            await wait_ready(fd)
    elif (binary := getattr(stream, "buffer", None)) is not None:  # a regular file, which never blocks
        while data := binary.read1(_CHUNK):
            yield data
    else:  # text in memory
        while text := stream.read(_CHUNK):
            yield text.encode(errors="replace")
