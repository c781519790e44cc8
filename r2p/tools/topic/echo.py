"""`r2p topic echo`: print messages as they arrive."""

import asyncio
import logging
from collections.abc import AsyncIterator
from contextlib import AbstractAsyncContextManager
from typing import Any

import r2p
from r2p.names import topic_name
from r2p.tools.options import Count, Format, Once, Timeout
from r2p.tools.output import Output, notify
from r2p.tools.session import REPORT_WAITING_AFTER, Session, UsageError, patience
from r2p.tools.topic.filter import FilterError
from r2p.tools.topic.selection import Content, Fields, FilterText, Full, Meta, Selection, as_hex, filter_for, form_of
from r2p.tools.topic.watching import Topics, TypeName, advice, received_samples, while_publishers_fit
from r2p.tools.types import Types, announced, suggestion
from r2p.units import SECOND

QUEUE = 1024
"""Messages that wait for a slow terminal or pipe; beyond that the oldest are lost, and counted."""

logger = logging.getLogger("r2p.echo")


async def echo(
    session: Session,
    topics: Topics,
    *,
    type: TypeName = None,
    field: Fields = None,
    filter: FilterText = None,
    full: Full = False,
    meta: Meta = False,
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
    selection = Selection(names, field or [], meta=meta, form=form_of(output, full=full))
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


async def _print_header(session: Session, output: Output, readers: "list[_TopicReader]", selection: Selection) -> None:
    """Print the header of CSV with several topics, whose types must be known as far as possible."""
    if not all(each.typed for each in readers):
        await session.settle()
    await output.header([path for each in readers for path in await each.columns(selection)])


class _TopicReader:
    """One topic, decoded with the type that the user or the peer gives; otherwise in hex."""

    def __init__(self, session: Session, topic: str, types: Types, given: str | None, filter: str | None) -> None:
        self.topic = topic
        self._session = session
        self._types = types
        self._cls = types.stated(topic, given)
        self._filter = filter_for(filter, self._cls)
        self._subscriber: r2p.Subscriber[Any] = session.node.subscribe(topic, self._cls, queue=QUEUE, lossy=True)
        self._next_look_up = 0  # ns
        self._reported = False  # that the type is unknown
        self._report_rejected_at = 0  # ns; 0: no message has arrived

    @property
    def typed(self) -> bool:
        return self._cls is not None

    async def messages(self) -> AsyncIterator[tuple[Content, r2p.Sample]]:
        """Yield each message that passes the filter, with its sample. Raises UsageError."""
        async for sample in received_samples(self._session, self._subscriber, typed=self.typed):
            message = self._decoded(sample)
            if message is None:
                await self._look_up_type(sample)
                message = self._decoded(sample)
            if self._passes(message):
                yield as_hex(sample.data) if message is None else message, sample

    def while_type_fits(self) -> AbstractAsyncContextManager[None]:
        """Raise r2p.Error in the block when all publishers have another type than the one stated."""
        return while_publishers_fit(self._session, self._subscriber, self._cls)

    async def columns(self, selection: Selection) -> list[str]:
        """Return the columns of CSV that the messages will have, as far as their type is known by now."""
        if not self.typed:
            await self._learn()
        return selection.columns(self.topic, self._cls)

    def check_fields(self, selection: Selection) -> None:
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
        """Look up the type that the peer announces, at most once a second; modules other than firmware will do so."""
        now = self._session.node.now()
        if now < self._next_look_up:
            return
        if not (self._reported or self._session.announcements.may_have_firmware()):
            await announced(self._session, self.topic, lambda view: view.fingerprint is not None)
        self._next_look_up = now + SECOND
        await self._learn()
        if self._cls is None and not self._reported:
            self._reported = True
            size = len(sample.data)
            notify(f"the type of {self.topic} is unknown, so bytes are shown in hex; give --type{suggestion(size)}")

    async def _learn(self) -> None:
        view = self._session.module.network.topics().get(self.topic, r2p.TopicView(self.topic))
        self._cls = await self._types.learn(self._session, view)
