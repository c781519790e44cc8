"""`r2p topic echo`: print messages as they arrive."""

import asyncio
import logging
from collections.abc import AsyncIterator
from contextlib import AbstractAsyncContextManager
from typing import Annotated, Any, TypeAlias

import msgspec
import typer

import r2p
from r2p.messages.values import META, Form, flatten, pick, to_plain
from r2p.names import topic_name
from r2p.tools.options import Count, Format, Once, Timeout
from r2p.tools.output import Output, notify
from r2p.tools.session import REPORT_WAITING_AFTER, Session, UsageError, patience
from r2p.tools.topic.filter import Filter, FilterError
from r2p.tools.topic.watching import Topics, TypeName, advice, received_samples, while_publishers_fit
from r2p.tools.types import Types, suggestion
from r2p.units import SECOND

QUEUE = 1024
"""Messages that wait for a slow terminal or pipe; beyond that the oldest are lost, and counted."""

_HEX = "data"  # the field of a message of unknown type

_Content: TypeAlias = r2p.Message | dict[str, Any]

logger = logging.getLogger("r2p.echo")


async def echo(
    session: Session,
    topics: Topics,
    *,
    type: TypeName = None,
    field: Annotated[
        list[str] | None,
        typer.Option("--field", metavar="PATH", help="Only this field: x, stamp.sec, value[0] (repeatable)."),
    ] = None,
    filter: Annotated[
        str | None,
        typer.Option("--filter", metavar="EXPR", help="Only messages for which it is true: 'x > 3 and abs(w) < 0.1'."),
    ] = None,
    full: Annotated[bool, typer.Option("--full", help="Print long arrays and texts whole at a terminal, too.")] = False,
    meta: Annotated[bool, typer.Option("--meta", help="Add topic, stamp, source and sequence, under `_`.")] = False,
    count: Count = None,
    once: Once = False,
    timeout: Timeout = None,
    format: Format = None,
) -> None:
    """Print the messages of topics.

    Messages of unknown type are printed as bytes in hex. At a terminal and as YAML, long arrays are shortened, and
    bytes are counted; JSON and CSV have all of them. With --filter, messages that do not pass count neither for -n nor
    for --timeout. Ctrl-C ends it.
    """
    output = Output(format)
    names = list(dict.fromkeys(map(topic_name, topics)))
    types = Types(session.settings)
    readers = [_TopicReader(session, name, types, type, filter) for name in names]
    form: Form = "cells" if output.format == "csv" else "whole" if full or output.format == "json" else "short"
    selection = _Selection(names, field or [], meta=meta, form=form)
    left = 1 if once else count

    async def print_all(reader: _TopicReader) -> None:
        nonlocal left
        async with reader.while_type_fits():
            async for content, sample in reader.messages():
                received()
                if left == 0:
                    return
                if left is not None:
                    left -= 1
                await output.put(selection.of(reader.topic, content, sample))
                if left == 0:
                    for task in tasks:
                        task.cancel()

    missing = f"{'no message passed the filter' if filter else 'nothing received'} on {', '.join(names)}"
    try:
        suggest = advice(session, names, timeout)
        async with output.while_read(), patience(missing, timeout, suggest) as received, asyncio.TaskGroup() as group:
            if selection.labelled:
                await _print_header(session, output, readers, selection)
            for reader in readers:
                reader.check_fields(selection)
            tasks = [group.create_task(print_all(reader)) for reader in readers]
    finally:
        for reader in readers:
            reader.report()


async def _print_header(
    session: Session, output: Output, readers: "list[_TopicReader]", selection: "_Selection"
) -> None:
    """Print the header of CSV with several topics, whose types must be known as far as possible."""
    if not all(each.typed for each in readers):
        await session.settle()
    await output.header([path for each in readers for path in await each.columns(selection)])


class _Selection(msgspec.Struct):
    """The printed part of a message: the `fields` that the user chose, in a `form`, and where it comes from.

    A content of unknown type is a record with its bytes in hex. Of several `topics` only one needs to have a field:
    `lacking` are the topics without it, by field.
    """

    topics: list[str]
    fields: list[str]
    meta: bool
    form: Form
    lacking: dict[str, set[str]] = {}

    @property
    def labelled(self) -> bool:
        """True if a column names the topic of each row: CSV has one header for all topics."""
        return self.form == "cells" and len(self.topics) > 1

    def of(self, topic: str, content: _Content, sample: r2p.Sample | None) -> dict[str, Any]:
        """Return the record to print. Raises UsageError for a field that no topic has."""
        if self.fields:
            record = self._chosen(topic, content)
        else:
            record = to_plain(content, self.form) if isinstance(content, r2p.Message) else content
        return self.label(topic, record, sample)

    def label(self, topic: str, row: dict[str, Any], sample: r2p.Sample | None) -> dict[str, Any]:
        """Return a row with the topic, and with what else --meta adds."""
        if self.labelled:
            row = {"topic": topic} | {"topic_" if name == "topic" else name: value for name, value in row.items()}
        if self.meta or (len(self.topics) > 1 and self.form != "cells"):
            row[META] = _meta(topic, sample)
        return row

    def _chosen(self, topic: str, content: _Content) -> dict[str, Any]:
        row = {}
        for path in self.fields:
            lacking = self.lacking.setdefault(path, set())
            try:
                row[path] = self._pick(content, path)
                lacking.discard(topic)  # its type was not known before
            except KeyError as error:
                self._note_lacking(topic, path, lacking, error.args[0])
        return row

    def _pick(self, content: _Content, path: str) -> Any:
        if isinstance(content, r2p.Message):
            return pick(content, path, self.form)
        if path not in content:
            raise KeyError(f"there is no field {path}; the fields are {', '.join(content)}")
        return content[path]

    def _note_lacking(self, topic: str, path: str, lacking: set[str], problem: str) -> None:
        """Report once that a topic lacks a field. Raises UsageError if none of them has it."""
        is_new = topic not in lacking
        lacking.add(topic)
        if len(lacking) == len(self.topics):
            raise UsageError(problem if len(lacking) == 1 else f"no topic has a field {path}; of {topic}: {problem}")
        if is_new:
            notify(f"{topic} has no field {path}: left out there")


class _TopicReader:
    """One topic, decoded with the type that the user or the peer gives; otherwise in hex."""

    def __init__(self, session: Session, topic: str, types: Types, given: str | None, filter: str | None) -> None:
        self.topic = topic
        self._session = session
        self._types = types
        self._cls = types.stated(topic, given)
        self._filter = _filter(filter, self._cls)
        self._subscriber: r2p.Subscriber[Any] = session.node.subscribe(topic, self._cls, queue=QUEUE, lossy=True)
        self._next_look_up = 0  # ns
        self._reported = False  # that the type is unknown
        self._report_rejected_at = 0  # ns; 0: no message has arrived

    @property
    def typed(self) -> bool:
        return self._cls is not None

    async def messages(self) -> AsyncIterator[tuple[_Content, r2p.Sample]]:
        """Yield each message that passes the filter, with its sample. Raises UsageError."""
        async for sample in received_samples(self._session, self._subscriber, typed=self.typed):
            message = self._decoded(sample)
            if message is None:
                await self._look_up_type(sample)
                message = self._decoded(sample)
            if self._passes(message):
                yield {_HEX: sample.data.hex()} if message is None else message, sample

    def while_type_fits(self) -> AbstractAsyncContextManager[None]:
        """Raise r2p.Error in the block when all publishers have another type than the one stated."""
        return while_publishers_fit(self._session, self._subscriber, self._cls)

    async def columns(self, selection: _Selection) -> list[str]:
        """Return the columns of CSV that the messages will have, as far as their type is known by now."""
        if not self.typed:
            await self._learn()
        if self._cls is None:  # its messages are in hex, or have these fields once their type is known
            return list(flatten(selection.label(self.topic, dict.fromkeys(selection.fields or [_HEX], ""), None)))
        return list(flatten(selection.of(self.topic, r2p.layout(self._cls).zero, None)))

    def check_fields(self, selection: _Selection) -> None:
        """Raise UsageError for a field that no topic has, as far as their types are known by now."""
        if self._cls is not None:
            selection.of(self.topic, r2p.layout(self._cls).zero, None)

    def report(self) -> None:
        """Report what is missing in the output."""
        if self._subscriber.lost:
            notify(f"{self._subscriber.lost} messages of {self.topic} lost: the output was too slow")
        if self._subscriber.undecodable:
            notify(f"{self._subscriber.undecodable} messages of {self.topic} were of another type")
        if self._subscriber.too_long:
            notify(f"{self._subscriber.too_long} messages of {self.topic} were longer than the type here allows")
        if self._filter is not None and self._filter.seen:
            logger.info("%s", f"{self.topic}: {self._filter.summary}")

    def _passes(self, message: r2p.Message | None) -> bool:
        if self._filter is None:
            return True
        if message is None:
            raise UsageError(f"the type of {self.topic} is unknown, so --filter can't look into it: give --type")
        try:
            passed = self._filter.passes(message)
        except FilterError as error:
            raise UsageError(str(error)) from error
        if not self._filter.passed:
            self._report_rejected()
        return passed

    def _report_rejected(self) -> None:
        """Report once that messages arrive, but none of them passes."""
        now = self._session.node.now()
        if not self._report_rejected_at:
            self._report_rejected_at = now + round(REPORT_WAITING_AFTER * SECOND)
        elif 0 < self._report_rejected_at <= now:
            self._report_rejected_at = -1
            notify(f"messages of {self.topic} arrive, but none has passed the filter yet")

    def _decoded(self, sample: r2p.Sample) -> r2p.Message | None:
        if self._cls is None:
            return None
        try:
            return self._cls.decode(sample.data)
        except r2p.DecodeError:  # its publisher has come back with another type
            self._cls, self._next_look_up = None, 0
            return None

    async def _look_up_type(self, sample: r2p.Sample) -> None:
        """Look up the type that the peer announces, at most once a second."""
        now = self._session.node.now()
        if now < self._next_look_up:
            return
        self._next_look_up = now + SECOND
        await self._learn()
        if self._cls is None and not self._reported:
            self._reported = True
            size = len(sample.data)
            notify(f"the type of {self.topic} is unknown, so bytes are shown in hex; give --type{suggestion(size)}")

    async def _learn(self) -> None:
        view = self._session.module.network.topics().get(self.topic, r2p.TopicView(self.topic))
        self._cls = await self._types.learn(self._session, view)


def _filter(text: str | None, cls: type[r2p.Message] | None) -> Filter | None:
    """Return the filter of one topic, for its type if that is stated. Raises UsageError."""
    if text is None:
        return None
    try:
        made = Filter(text)
        if cls is not None:
            made.bind(cls)
    except FilterError as error:
        raise UsageError(str(error)) from error
    return made


def _meta(topic: str, sample: r2p.Sample | None) -> dict[str, Any]:
    """Return where a message comes from; without a sample, only the keys."""
    if sample is None:
        return dict.fromkeys(("topic", "stamp", "stamp_from", "source", "sequence"))
    meta = {
        "topic": topic,
        "stamp": sample.stamp,
        "stamp_from": "sender" if sample.stamped else "reception",
        "source": str(sample.source),
        "sequence": sample.sequence or None,
    }
    if sample.clock is not None:
        meta["clock"] = msgspec.to_builtins(sample.clock)
    return meta
