"""`r2p topic echo`: print messages as they arrive."""

import asyncio
from collections.abc import AsyncIterator
from typing import Annotated, Any

import msgspec
import typer

import r2p
from r2p.names import topic_name
from r2p.tools.options import Count, Format, Once, Timeout
from r2p.tools.output import Output, notify
from r2p.tools.session import Session, UsageError, patience
from r2p.tools.topic.watching import Topics, TypeName, received_samples
from r2p.tools.types import Types, suggestion
from r2p.tools.values import META, pick, to_plain
from r2p.units import SECOND

QUEUE = 1024
"""Messages that wait for a slow terminal or pipe; beyond that the oldest are lost, and counted."""


async def echo(
    session: Session,
    topics: Topics,
    *,
    type: TypeName = None,
    field: Annotated[
        list[str] | None,
        typer.Option("--field", metavar="PATH", help="Only this field: x, stamp.sec, value[0] (repeatable)."),
    ] = None,
    meta: Annotated[bool, typer.Option("--meta", help="Add topic, stamp, source and sequence, under `_`.")] = False,
    count: Count = None,
    once: Once = False,
    timeout: Timeout = None,
    format: Format = None,
) -> None:
    """Print the messages of topics.

    Messages of unknown type are printed as bytes in hex. Ctrl-C ends it.
    """
    output = Output(format)
    names = list(dict.fromkeys(map(topic_name, topics)))
    if output.format == "csv" and len(names) > 1:
        raise UsageError("--format csv has one header, so it allows only one topic")
    types = Types(session.settings)
    readers = [_TopicReader(session, name, types, type) for name in names]
    with_meta, left = meta or len(names) > 1, 1 if once else count

    async def print_all(reader: _TopicReader) -> None:
        nonlocal left
        async for record, sample in reader.records():
            received()
            if left == 0:
                return
            if left is not None:
                left -= 1
            await output.put(_chosen(record, field) | (_meta(reader.topic, sample) if with_meta else {}))
            if left == 0:
                for task in tasks:
                    task.cancel()

    try:
        async with output.while_read(), patience(", ".join(names), timeout) as received, asyncio.TaskGroup() as group:
            tasks = [group.create_task(print_all(reader)) for reader in readers]
    finally:
        for reader in readers:
            reader.report_losses()


def _chosen(record: dict[str, Any], fields: list[str] | None) -> dict[str, Any]:
    if not fields:
        return record
    try:
        return {path: pick(record, path) for path in fields}
    except KeyError as error:
        raise UsageError(error.args[0]) from error


class _TopicReader:
    """One topic, decoded with the type that the user or the peer gives; otherwise in hex."""

    def __init__(self, session: Session, topic: str, types: Types, given: str | None) -> None:
        self.topic = topic
        self._session = session
        self._types = types
        self._cls = types.stated(topic, given)
        self._subscriber: r2p.Subscriber[Any] = session.node.subscribe(topic, self._cls, queue=QUEUE, lossy=True)
        self._next_look_up = 0  # ns
        self._reported = False  # that the type is unknown

    async def records(self) -> AsyncIterator[tuple[dict[str, Any], r2p.Sample]]:
        """Yield each message as a record, with its sample."""
        async for sample in received_samples(self._session, self._subscriber, typed=self._cls is not None):
            record = self._decoded(sample)
            if record is None:
                await self._look_up_type(sample)
                record = self._decoded(sample)
            yield {"data": sample.data.hex()} if record is None else record, sample

    def report_losses(self) -> None:
        """Report what is missing in the output."""
        if self._subscriber.lost:
            notify(f"{self._subscriber.lost} messages of {self.topic} lost: the output was too slow")
        if self._subscriber.undecodable:
            notify(f"{self._subscriber.undecodable} messages of {self.topic} were of another type")

    def _decoded(self, sample: r2p.Sample) -> dict[str, Any] | None:
        if self._cls is None:
            return None
        try:
            return to_plain(self._cls.decode(sample.data))
        except r2p.DecodeError:  # its publisher has come back with another type
            self._cls, self._next_look_up = None, 0
            return None

    async def _look_up_type(self, sample: r2p.Sample) -> None:
        """Look up the type that the peer announces, at most once a second."""
        now = self._session.node.now()
        if now < self._next_look_up:
            return
        self._next_look_up = now + SECOND
        view = self._session.module.network.topics().get(self.topic, r2p.TopicView(self.topic))
        self._cls = await self._types.learn(self._session, view)
        if self._cls is None and not self._reported:
            self._reported = True
            size = len(sample.data)
            notify(f"the type of {self.topic} is unknown, so bytes are shown in hex; give --type{suggestion(size)}")


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
