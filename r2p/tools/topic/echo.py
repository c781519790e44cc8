"""`r2p topic echo`: print messages as they come."""

import asyncio
from collections.abc import AsyncIterator, Callable
from typing import Annotated, Any

import msgspec
import typer

import r2p
from r2p.names import topic_name
from r2p.tools.output import Output
from r2p.tools.session import Format, Session, Timeout, Usage
from r2p.tools.topic.watching import Count, Once, Topics, TypeName, patience, watched
from r2p.tools.types import Types, suggestion
from r2p.tools.values import META, pick, to_plain

QUEUE = 1024
"""Messages that wait for a slow terminal or pipe before the oldest are lost, counted."""

_SECOND = 1_000_000_000


async def echo(
    session: Session,
    topics: Topics,
    *,
    type: TypeName = None,
    field: Annotated[
        list[str] | None, typer.Option("--field", metavar="PATH", help="Only this field: x, stamp.sec, value[0].")
    ] = None,
    meta: Annotated[bool, typer.Option("--meta", help="Add topic, stamp, source and sequence, under `_`.")] = False,
    count: Count = None,
    once: Once = False,
    timeout: Timeout = None,
    format: Format = None,
) -> None:
    """Print the messages of topics.

    A topic whose type is unknown is printed as bytes in hex. Ctrl-C ends it.
    """
    output = Output(format)
    names = list(dict.fromkeys(map(topic_name, topics)))
    if output.format == "csv" and len(names) > 1:
        raise Usage("csv has one header, so it takes one topic")
    types = Types(session.settings)
    readers = [_TopicReader(session, name, types, type) for name in names]
    echoing = _Echo(output, 1 if once else count, field or [], meta=meta or len(names) > 1)
    try:
        async with output.while_read():
            await echoing.run(readers, timeout)
    finally:
        for reader in readers:
            reader.tell_losses()


class _Echo:
    """Prints what the readers bring, until `count` messages have been printed."""

    def __init__(self, output: Output, count: int | None, fields: list[str], *, meta: bool) -> None:
        self._output = output
        self._left = count
        self._fields = fields
        self._meta = meta

    async def run(self, readers: list["_TopicReader"], timeout: float | None) -> None:
        topics = ", ".join(reader.topic for reader in readers)
        async with patience(topics, timeout) as heard, asyncio.TaskGroup() as tasks:
            self._tasks = [tasks.create_task(self._print(reader, heard)) for reader in readers]

    async def _print(self, reader: "_TopicReader", heard: Callable[[], None]) -> None:
        async for record, sample in reader.records():
            heard()
            if self._left == 0:
                return
            if self._left is not None:
                self._left -= 1
            await self._output.put(self._chosen(record) | (_meta(reader.topic, sample) if self._meta else {}))
            if self._left == 0:
                for task in self._tasks:
                    task.cancel()

    def _chosen(self, record: dict[str, Any]) -> dict[str, Any]:
        if not self._fields:
            return record
        try:
            return {path: pick(record, path) for path in self._fields}
        except KeyError as error:
            raise Usage(error.args[0]) from error


class _TopicReader:
    """One topic, decoded by the type that is stated or told; else in hex."""

    def __init__(self, session: Session, topic: str, types: Types, given: str | None) -> None:
        self.topic = topic
        self._session = session
        self._types = types
        self._cls = types.stated(topic, given)
        self._subscriber: r2p.Subscriber[Any] = session.node.subscribe(topic, self._cls, queue=QUEUE, lossy=True)
        self._look_at = 0
        self._told = False

    async def records(self) -> AsyncIterator[tuple[dict[str, Any], r2p.Sample]]:
        """Each message as a record, with its sample."""
        async for sample in watched(self._session, self._subscriber, typed=self._cls is not None):
            yield await self._record(sample), sample

    def tell_losses(self) -> None:
        """Say what is missing in the output."""
        if self._subscriber.lost:
            self._session.say(f"{self._subscriber.lost} messages of {self.topic} lost: the output was too slow")
        if self._subscriber.undecodable:
            self._session.say(f"{self._subscriber.undecodable} messages of {self.topic} are of another type")

    async def _record(self, sample: r2p.Sample) -> dict[str, Any]:
        record = self._decoded(sample)
        if record is None:
            await self._look(sample)
            record = self._decoded(sample)
        return {"data": sample.data.hex()} if record is None else record

    def _decoded(self, sample: r2p.Sample) -> dict[str, Any] | None:
        if self._cls is None:
            return None
        try:
            return to_plain(self._cls.decode(sample.data))
        except r2p.DecodeError:  # its publisher has come back with another type
            self._cls, self._look_at = None, 0
            return None

    async def _look(self, sample: r2p.Sample) -> None:
        """Look for the type that the peer tells, at most once a second."""
        now = self._session.node.now()
        if now < self._look_at:
            return
        self._look_at = now + _SECOND
        view = self._session.module.network.topics().get(self.topic, r2p.TopicView(self.topic))
        self._cls = await self._types.learn(self._session, view)
        if self._cls is None and not self._told:
            self._told = True
            size = len(sample.data)
            self._session.say(f"the type of {self.topic} is unknown: bytes in hex; give --type{suggestion(size)}")


def _meta(topic: str, sample: r2p.Sample) -> dict[str, Any]:
    meta = {
        "topic": topic,
        "stamp": sample.stamp,
        "stamp_from": "sender" if sample.stamped else "reception",
        "source": str(sample.source),
        "sequence": sample.sequence or None,
    }
    if sample.clock is not None:
        meta["clock"] = msgspec.to_builtins(sample.clock)
    return {META: meta}
