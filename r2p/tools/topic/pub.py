"""`r2p topic pub`: publish from the shell."""

import asyncio
import contextlib
import json
import logging
import os
import re
import sys
from collections.abc import AsyncIterator, Mapping
from typing import Annotated, Any, TextIO

import msgspec
import typer

import r2p
from r2p.bridge import ClassOf
from r2p.messages import SIZE_MAX
from r2p.messages.values import parse, parse_line, to_plain
from r2p.names import topic_name
from r2p.tools.options import Count, Once, Rate, class_choice, time_option
from r2p.tools.output import notify, wait_ready, waitable
from r2p.tools.session import REPORT_WAITING_AFTER, Session, TimedOut, UsageError, counts_without_end, wait_until
from r2p.tools.topic.watching import (
    AnyPublisher,
    Topic,
    TypeName,
    hint,
    is_subscribed,
    subscriber_names,
    suggest_topics,
    wait_until_passed_on,
    while_subscribers_fit,
)
from r2p.tools.types import find

STDIN = "-"
DEFAULT_RATE = 1.0

_CHUNK = 65536  # bytes
_LINE_MAX = 2 * SIZE_MAX  # bytes: the longest message in base64, with room for its other fields

_YAML_BLOCK = re.compile(r"[A-Za-z_]\w*:(\s|$)")  # its first line
_YAML_END = "---"

_EXCERPT = 120  # characters of a message that are shown
_NAMED = 0.5  # seconds in which subscribers announce the names of their nodes

logger = logging.getLogger("r2p.pub")


async def pub(
    session: Session,
    topic: Topic,
    message: Annotated[
        list[str] | None,
        typer.Argument(metavar="MESSAGE", help="'{x: 1.5}', x=1.5 w=0.25, or - for JSON lines from stdin."),
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
    timeout: Annotated[
        float | None, time_option("--timeout", "Give up (exit code 3) without a subscriber for this long: 2, 500ms.")
    ] = None,
) -> None:
    """Publish a message, by default once a second.

    Fields that are left out are zero, so without MESSAGE all are. With --once, -n or stdin it first waits for a
    subscriber, at most --timeout. Ctrl-C ends it.
    """
    topic = topic_name(topic)
    choice = choice or ClassOf(r2p.PublisherClass.NON_REAL_TIME)
    periodic = choice.publisher_class is r2p.PublisherClass.PERIODIC
    from_stdin = message == [STDIN]
    if timeout is not None and not (once or count or from_stdin):
        raise UsageError("--timeout limits the wait for a subscriber: add --once, -n or -, which wait for one")
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


def goes_on(given: Mapping[str, Any]) -> bool:
    """Return whether `pub` with these arguments and options publishes until a signal ends it; stdin has an end."""
    return counts_without_end(given) and given["message"] != [STDIN]


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
        async with self._reporting(publisher, message, rate):
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
        async with self._reporting(publisher, message, 1 / self.choice.time):
            ready = True
            await done.wait()

    async def publish_lines(self, rate: float | None) -> None:
        """Publish the messages on stdin."""
        publisher = self._advertise()
        await self._wait_subscriber(publisher)
        await self._publish_lines(publisher, rate)
        await self._report_sent(publisher)

    async def _publish_lines(
        self, publisher: r2p.Publisher[Any] | r2p.SporadicPublisher[Any], rate: float | None
    ) -> None:
        ticks = None if rate is None else self.session.node.every(1 / rate)
        async for number, text in split_messages(read_lines()):
            try:
                message = parse_line(self.message_class, text)
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

    async def _wait_subscriber(self, publisher: AnyPublisher) -> None:
        missing = f"{self.topic} has no subscriber"
        waiting = self.session.waiting(f"a subscriber of {self.topic}")
        with waiting, hint(self.session, missing, self.topic, is_subscribed):
            try:
                async with asyncio.timeout(self.timeout), while_subscribers_fit(self.session, publisher):
                    await publisher.wait_subscriber()
                    await wait_until_passed_on(self.session, publisher.topic)
            except TimeoutError:
                raise TimedOut(f"{self.topic} had no subscriber for {self.timeout:g} s") from None

    # What the user sees of it

    @contextlib.asynccontextmanager
    async def _reporting(self, publisher: AnyPublisher, message: r2p.Message, rate: float) -> AsyncIterator[None]:
        """Report what the block publishes, and its subscribers: a number of messages at the end, else at the start.

        A number of messages first waits for a subscriber.
        """
        if self.count is not None:
            await self._wait_subscriber(publisher)
            yield
            await self._report_sent(publisher)
            return
        async with asyncio.TaskGroup() as tasks:
            reporting = tasks.create_task(self._report_start(publisher, message, rate))
            yield
            reporting.cancel()

    async def _report_start(self, publisher: AnyPublisher, message: r2p.Message, rate: float) -> None:
        """Report what is published, and the subscribers as soon as there is one."""
        what = f"publishing {self.topic} {_excerpt(message)} at {rate:g} Hz"
        if await wait_until(lambda: publisher.subscribers > 0, REPORT_WAITING_AFTER):
            logger.info("%s to %s", what, await self._subscribers())
            return
        logger.info("%s", what)
        question = suggest_topics(self.session, self.topic, is_subscribed)
        notify(f"{self.topic} has no subscriber yet, publishing anyway{question}")
        await publisher.wait_subscriber()
        logger.info("publishing %s to %s", self.topic, await self._subscribers())

    async def _report_sent(self, publisher: AnyPublisher) -> None:
        """Report how many messages were sent, and to which subscribers."""
        to = f" to {await self._subscribers()}" if publisher.subscribers else ", but no subscriber is left"
        logger.info(
            "%d %s of %s sent%s", publisher.sent, "message" if publisher.sent == 1 else "messages", self.topic, to
        )

    async def _subscribers(self) -> str:
        """Return the names of the subscribers; a module announces its nodes a little later than its subscriptions."""
        await wait_until(lambda: subscriber_names(self.session, self.topic)[1], _NAMED)
        names, _ = subscriber_names(self.session, self.topic)
        return ", ".join(names) or "a subscriber that is not announced"


def _excerpt(message: r2p.Message) -> str:
    text = json.dumps(to_plain(message, "short"))
    return text if len(text) <= _EXCERPT else f"{text[:_EXCERPT]}..."


async def read_lines(stream: TextIO | None = None) -> AsyncIterator[str]:
    """Yield the lines of stdin (or of `stream`), without their ends, and without blocking the event loop.

    Bytes that are not UTF-8 become U+FFFD. Raises MessageError for a line longer than 128 MiB.
    """
    rest: list[bytes] = []
    size = 0
    async for data in _chunks(stream or sys.stdin):
        *complete, last = data.split(b"\n")
        for line in complete:
            yield _decode(b"".join([*rest, line]))
            rest.clear()
            size = 0
        rest.append(last)
        size += len(last)
        if size > _LINE_MAX:
            break
    if size:
        yield _decode(b"".join(rest))


async def split_messages(lines: AsyncIterator[str]) -> AsyncIterator[tuple[int, str]]:
    """Split what is on stdin into messages, each with the number of its first line: one line of JSON, or of `x=1.5`
    pairs, or the lines of YAML up to `---`.
    """
    yaml: list[str] = []
    number = size = 0
    async for line in lines:
        number += 1
        if line.rstrip() == _YAML_END:
            if yaml:
                yield number - len(yaml), "\n".join(yaml)
            yaml, size = [], 0
        elif yaml or _YAML_BLOCK.match(line):
            yaml.append(line)
            size += len(line)
            if size > _LINE_MAX:
                raise r2p.MessageError(f"line {number}: a message on stdin is longer than 128 MiB")
        elif line.strip():
            yield number, line
    if yaml:
        yield number + 1 - len(yaml), "\n".join(yaml)


def _decode(line: bytes) -> str:
    if len(line) > _LINE_MAX:
        raise r2p.MessageError("a line on stdin is longer than 128 MiB")
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
