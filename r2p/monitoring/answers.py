"""The answers of one module, one after the other: where only numbers have changed, nothing else is read.

A module is asked for its statistics each second, and almost always answers with the same names, so each number has the
place that it had in the answer before. `KnownAnswer` keeps these places and the bytes in between. It reads an answer
that differs in numbers only by one `struct.Struct` for each kind of entries, into a column for each number. Any other
answer has to be decoded as a message, and makes the next `KnownAnswer`.
"""

import struct
from collections.abc import Sequence
from typing import Any

import msgspec

from r2p.errors import DecodeError
from r2p.messages import Message, layout
from r2p.messages.shapes import COUNT_SIZE, VariableText, format_of
from r2p.modules.statistics import (
    ForwardedTopic,
    LinkStatistics,
    ModuleStatistics,
    NodeStatistics,
    PublisherStatistics,
    ServiceStatistics,
    SubscriberStatistics,
    TopicOnLink,
)

Columns = tuple[tuple[Any, ...], ...]
"""The numbers of some entries: a column of one number for each, in the order of their fields."""

_TIMES = struct.Struct("<dd")  # `uptime` and `cpu`, with which an answer begins
_NUMBERS: dict[type[Message], int] = {
    NodeStatistics: 0,
    PublisherStatistics: 3,
    SubscriberStatistics: 6,
    TopicOnLink: 2,
    ForwardedTopic: 2,
}
"""The last fields of entries, so many of them, are numbers that change; the others say what is counted."""

_BEFORE_SERVICES = bytes(_TIMES.size + 3 * COUNT_SIZE)
_BEHIND_LINKS = bytes(2 * COUNT_SIZE)
"""An answer without entries, but for services and links in between: these are few, and are always decoded."""


class AnswerNumbers(msgspec.Struct):
    """The numbers of an answer, and its services and links.

    Columns are the same objects as those of the last answer, if the answer has the same numbers.
    """

    uptime: float
    cpu: float
    publishers: Columns
    """Sent, missed, late."""
    subscribers: Columns
    """Waiting, lost, undecodable, too long, stale, timeouts."""
    services: tuple[ServiceStatistics, ...]
    links: tuple[LinkStatistics, ...]
    topics: Columns
    """Lost, least laxity."""
    forwarded: Columns
    """Forwarded, dropped."""


class KnownAnswer:
    """Reads answers that differ in numbers only from `part`, which was decoded as `statistics`."""

    def __init__(self, statistics: ModuleStatistics, part: bytes) -> None:
        topics, forwarded = _packing(TopicOnLink, statistics.topics), _packing(ForwardedTopic, statistics.forwarded)
        behind_links = len(part) - topics.size - forwarded.size
        self._size = len(part)
        self._nodes = _Section(_packing(NodeStatistics, statistics.nodes), NodeStatistics, part, _TIMES.size)
        publishers = _packing(PublisherStatistics, statistics.publishers)
        self._publishers = _Section(publishers, PublisherStatistics, part, self._nodes.end)
        subscribers = _packing(SubscriberStatistics, statistics.subscribers)
        self._subscribers = _Section(subscribers, SubscriberStatistics, part, self._publishers.end)
        self._topics = _Section(topics, TopicOnLink, part, behind_links)
        self._forwarded = _Section(forwarded, ForwardedTopic, part, self._topics.end)
        self._names = _names(statistics)

    def read(self, part: bytes) -> AnswerNumbers | None:
        """Return the numbers of an answer; None where more than numbers is different, or the bytes are damaged."""
        if len(part) != self._size or self._nodes.columns(part) is None:
            return None
        publishers, subscribers = self._publishers.columns(part), self._subscribers.columns(part)
        topics, forwarded = self._topics.columns(part), self._forwarded.columns(part)
        if publishers is None or subscribers is None or topics is None or forwarded is None:
            return None
        others = _services_and_links(part[self._subscribers.end : self._topics.start])
        if others is None or _names(others) != self._names:
            return None
        uptime, cpu = _TIMES.unpack_from(part)
        return AnswerNumbers(uptime, cpu, publishers, subscribers, others.services, others.links, topics, forwarded)


class _Section:
    """The entries of one kind, from `start` to `end` in an answer: their count, then each of them."""

    def __init__(self, packing: struct.Struct, cls: type[Message], part: bytes, start: int) -> None:
        self.start, self.end = start, start + packing.size
        self._unpack = packing.unpack
        self._width = 1 + _NUMBERS[cls]
        self._data = part[self.start : self.end]
        values = self._unpack(self._data)
        self._said = values[0], values[1 :: self._width]
        self._columns = self._columns_of(values)

    def columns(self, part: bytes) -> Columns | None:
        """Return the numbers of an answer; None if anything else of the entries is not as in the first one."""
        data = part[self.start : self.end]
        if data != self._data:
            values = self._unpack(data)
            if (values[0], values[1 :: self._width]) != self._said:
                return None
            self._data, self._columns = data, self._columns_of(values)
        return self._columns

    def _columns_of(self, values: tuple[Any, ...]) -> Columns:
        return tuple(values[1 + i :: self._width] for i in range(1, self._width))


def _packing(cls: type[Message], entries: Sequence[Message]) -> struct.Struct:
    """Return the struct of a count and these entries: each has its names and flags as bytes, then its numbers."""
    fields = layout(cls).fields
    first = len(fields) - _NUMBERS[cls]
    numbers = "".join(format_of(field.shape) for field in fields[first:])
    texts = [field.name for field in fields[:first] if isinstance(field.shape, VariableText)]
    fixed = sum(COUNT_SIZE if field.name in texts else field.shape.size for field in fields[:first])
    sizes = (fixed + sum(len(getattr(each, name).encode()) for name in texts) for each in entries)
    return struct.Struct(f"<{COUNT_SIZE}s" + "".join([f"{size}s{numbers}" for size in sizes]))


def _services_and_links(data: bytes) -> ModuleStatistics | None:
    """Decode the bytes of services and links; None if they are something else."""
    try:
        found = layout(ModuleStatistics).decode(_BEFORE_SERVICES + data + _BEHIND_LINKS)
    except DecodeError:
        return None
    return None if found.topics or found.forwarded else found


def _names(statistics: ModuleStatistics) -> tuple[list[tuple[str, str]], list[str]]:
    """Return what the services and links of an answer are called."""
    services = [(each.service, each.node) for each in statistics.services]
    return services, [each.link for each in statistics.links]
