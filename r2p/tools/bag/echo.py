"""`r2p bag echo`: print the messages of a recording."""

import asyncio
import difflib
import heapq
import itertools
from collections.abc import Iterable, Iterator
from fnmatch import fnmatchcase
from operator import itemgetter
from typing import TYPE_CHECKING, Annotated, Any, TypeAlias

import typer

import r2p
from r2p.messages.values import META
from r2p.tools.bag.files import File, opened
from r2p.tools.bag.times import End, Start, span
from r2p.tools.options import Count, Format, Once
from r2p.tools.output import Output, notify
from r2p.tools.session import UsageError, settings
from r2p.tools.topic.filter import FilterError
from r2p.tools.topic.selection import Content, Fields, FilterText, Full, Meta, Selection, as_hex, filter_for, form_of
from r2p.tools.topic.watching import TypeName
from r2p.tools.types import Types

if TYPE_CHECKING:
    from r2p.recording.bag import Bag, RecordedMessage, RecordedSample
    from r2p.recording.channels import BagChannel

Class: TypeAlias = type[r2p.Message]

_Record: TypeAlias = "tuple[int, _EchoedChannel, Content, r2p.Sample]"

_PIECE = 64  # messages after which the event loop looks for Ctrl-C


async def echo(
    file: File,
    topics: Annotated[
        list[str] | None,
        typer.Argument(metavar="TOPIC", help="Names and patterns, also of other channels: /r2p/events. Default: all."),
    ] = None,
    *,
    type: TypeName = None,
    field: Fields = None,
    filter: FilterText = None,
    full: Full = False,
    meta: Meta = False,
    start: Start = None,
    end: End = None,
    count: Count = None,
    once: Once = False,
    format: Format = None,
) -> None:
    """Print the messages of a recording, as r2p topic echo does.

    They come in the order in which they were received. With --meta also when that was (received).
    """
    output = Output(format)
    if once and count not in (None, 1):
        raise UsageError(f"--once is -n 1, not -n {count}: leave out one of them")
    left = 1 if once else count
    printed = 0
    with opened(file) as bag:
        names = _names(bag, topics)
        types = Types(settings(None))
        channels = _channels(bag)
        sources = {each: _EchoedChannel(each, channels[each], types, type, filter) for each in names}
        selection = Selection(names, field or [], meta=meta, form=form_of(output, full=full))
        records = _records(bag, sources, *span((bag.start, bag.end), start, end))
        async with output.while_read():
            await _print_header(output, sources, selection)
            for log_time, source, content, sample in itertools.islice(records, left):
                row = selection.of(source.name, content, sample)
                if meta:
                    row[META]["received"] = log_time
                await output.put(row)
                printed += 1
                if printed % _PIECE == 0:
                    await asyncio.sleep(0)
        for each in sources.values():
            each.report()
        if bag.undecodable:
            notify(f"{bag.undecodable.total()} messages could not be read: {', '.join(bag.undecodable)}")
    if not printed:
        missing = "no message passed the filter" if filter else "there is no message"
        raise r2p.Error(f"{missing} of {', '.join(names) or 'any topic'} in this part of the recording")


async def _print_header(output: Output, sources: "dict[str, _EchoedChannel]", selection: Selection) -> None:
    """Print the header of CSV with several topics, and check that one of them has each field. Raises UsageError."""
    if selection.labelled:
        received = [f"{META}.received"] if selection.meta else []
        await output.header(
            [path for each in sources.values() for path in selection.columns(each.name, each.cls)] + received
        )
    for each in sources.values():
        if each.cls is not None:
            selection.of(each.name, r2p.layout(each.cls).zero, None)


def _names(bag: "Bag", given: list[str] | None) -> list[str]:
    """Return the topics and channels that are meant: channels by their name with a slash. Raises UsageError."""
    if not given:
        return list(bag.topics)
    channels = sorted({each.name for each in bag.channels if each.kind == "messages"})
    names: dict[str, None] = {}
    for text in given:
        found = [each for each in bag.topics if fnmatchcase(each, text.removeprefix("/"))]
        found += [each for each in channels if fnmatchcase(each, text)]
        if not found:
            known = [*bag.topics, *channels]
            close = difflib.get_close_matches(text, known, n=1)
            advice = f"did you mean {close[0]}?" if close else f"it has {', '.join(known) or 'no messages'}"
            raise UsageError(f"the recording has no topic or channel {text}; {advice}")
        names |= dict.fromkeys(found)
    return list(names)


def _channels(bag: "Bag") -> "dict[str, list[BagChannel]]":
    """Return the channels by the names of their topics, and by their own."""
    found: dict[str, list[BagChannel]] = {}
    for each in bag.channels:
        for name in {each.name, each.name if each.info is None else each.info.topic}:
            found.setdefault(name, []).append(each)
    return found


class _EchoedChannel:
    """One topic or channel: the type of its messages, as the user states it or as it was recorded, and their filter."""

    def __init__(
        self, name: str, channels: "list[BagChannel]", types: Types, given: str | None, filter: str | None
    ) -> None:
        self.name = name
        self.is_topic = any(each.info and each.info.topic == name and each.kind == "samples" for each in channels)
        self._in_hex = 0
        recorded = next((each.cls for each in channels if each.kind != "meta" and each.cls), None)
        self._given = types.stated(name, given) if self.is_topic and (given or recorded is None) else None
        for each in channels:
            if self._given is not None and each.kind == "samples" and (why := each.check(self._given)):
                raise UsageError(f"--type {given}: {why}")
        self.cls = self._given or recorded
        self._filter = filter_for(filter, self.cls)

    def content(self, data: bytes, recorded: "Class | None") -> Content | None:
        """Return the message of packed bytes, in hex if its type is unknown; None if it does not pass the filter."""
        cls = self._given or recorded
        try:
            content: Content = as_hex(data) if cls is None else cls.decode(data)
        except r2p.DecodeError:
            content = as_hex(data)
        self._in_hex += isinstance(content, dict)
        return content if self.passes(content) else None

    def passes(self, content: Content) -> bool:
        """Return whether a message passes the filter. Raises UsageError."""
        if self._filter is None:
            return True
        if isinstance(content, dict):
            raise UsageError(f"the type of {self.name} is unknown, so --filter can't look into it: give --type")
        try:
            return self._filter.passes(content)
        except FilterError as error:
            raise UsageError(str(error)) from error

    def report(self) -> None:
        """Report what is shown in hex."""
        if self._in_hex:
            advice = "" if self._given else ": give --type to decode them"
            notify(f"messages of {self.name} are shown in hex, as their type is unknown ({self._in_hex}){advice}")


def _records(bag: "Bag", sources: dict[str, _EchoedChannel], start: int | None, end: int | None) -> Iterator[_Record]:
    """Yield what passes, in the order of time: the log time, the source, the message and where it comes from."""
    topics = [each.name for each in sources.values() if each.is_topic]
    streams = [_of_topics(bag.records(topics, start=start, end=end), sources)] if topics else []
    others = [each for each in sources.values() if not each.is_topic]
    streams += [_of_channel(bag.messages(each.name, start=start, end=end), each) for each in others]
    return heapq.merge(*streams, key=itemgetter(0))


def _of_topics(records: "Iterable[RecordedSample]", sources: dict[str, _EchoedChannel]) -> Iterator[_Record]:
    for each in records:
        source = sources[each.topic]
        content = source.content(each.sample.data, each.cls)
        if content is not None:
            yield each.log_time, source, content, each.sample


def _of_channel(messages: "Iterable[RecordedMessage[Any]]", source: _EchoedChannel) -> Iterator[_Record]:
    for each in messages:
        if source.passes(each.message):
            yield each.log_time, source, each.message, r2p.Sample(b"", r2p.Source(), each.publish_time)
