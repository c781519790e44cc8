"""The messages of a recording as they were at an instant: the last one of a topic by then."""

import itertools
from functools import partial
from typing import Any, Final

from r2p.errors import DecodeError
from r2p.messages import Message
from r2p.messages.values import to_plain
from r2p.recording.channels import BagChannel
from r2p.recording.format import CDR
from r2p.recording.mcap_reader import MessageRecord
from r2p.web.dash.recorded.plots import wanted_channels
from r2p.web.dash.recorded.reader import ChunkTable, RecordingReader
from r2p.web.dash.source import raw_fields

_CHUNKS_MAX: Final = 4000  # that are looked into for one message; most files say which ones have the topic


def message_of(channel: BagChannel, data: bytes) -> Message:
    """Return the message of a record. Raises DecodeError, also for an unknown type."""
    if channel.cls is None:
        raise DecodeError(channel.problem)
    return channel.cls.decode(channel.from_cdr(data, b"") if channel.encoding == CDR else data)


class WatchedTopic:
    """A topic whose messages a page looks at."""

    def __init__(self, reader: RecordingReader, topic: str) -> None:
        self._reader = reader
        self._topic = topic
        self._shown: tuple[int, int, int] | None = None  # file, log time, sequence

    async def open(self) -> None:
        """Find the topic. Raises WebError if the recording does not have it."""
        bag = await self._reader.bag()
        wanted_channels(bag, self._topic)
        topic = self._topic
        self._table = await self._reader.run(
            lambda: ChunkTable(bag, lambda each: each.kind == "samples" and _topic(each) == topic)
        )

    async def news(self, time: int) -> dict[str, Any] | None:
        """Return the last message up to `time` (ns) as pages get it; None for the message of the last call."""
        bag = await self._reader.bag()
        last: tuple[int, MessageRecord] | None = None
        for number, chunk in itertools.islice(self._table.back_from(time), _CHUNKS_MAX):
            if last is not None and chunk.end < last[1][0]:
                continue
            wanted = self._table.ids[number]
            records = await self._reader.run(partial(self._reader.records, bag, number, chunk, wanted))
            found = next((each for each in reversed(records) if each[0] <= time), None)
            if found is not None and (last is None or found[0] >= last[1][0]):
                last = number, found
            elif last is not None:
                break
        if last is None:
            return self._nothing()
        number, record = last
        shown = number, record[0], record[2]
        if shown == self._shown:
            return None
        self._shown = shown
        return await self._reader.run(partial(self._news, bag.files[number].channels[record[1]], record))

    def _nothing(self) -> dict[str, Any] | None:
        """Return an empty message to replace the one on the page, or None if the page shows none."""
        if self._shown is None:
            return None
        self._shown = None
        return {"op": "message", "topic": self._topic, "time": None, "fields": {}}

    def _news(self, channel: BagChannel, record: MessageRecord) -> dict[str, Any]:
        info = channel.info
        return {
            "op": "message",
            "topic": self._topic,
            "time": record[0],
            "module": info.module if info else "",
            "node": info.node if info else "",
            "sequence": record[2],
            "fields": _fields(channel, record[4]),
        }


def _topic(channel: BagChannel) -> str:
    return channel.info.topic if channel.info is not None else ""


def _fields(channel: BagChannel, data: bytes) -> dict[str, Any]:
    """Return a message as plain values, long arrays shortened; its bytes in hex where its type is unknown."""
    try:
        return to_plain(message_of(channel, data), "short")
    except DecodeError:
        return raw_fields(data)
