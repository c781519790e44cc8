"""The log of a recording up to an instant: the newest records of a level, found from there backwards.

A recorder's own log has the records of all modules. Where there is none, it is that of ROS, and of the topic `log`.
"""

import itertools
from functools import partial
from typing import Any, Final

from r2p.errors import DecodeError
from r2p.names import LOG
from r2p.recording.bag import Bag
from r2p.recording.channels import BagChannel
from r2p.recording.mcap_reader import MessageRecord
from r2p.recording.messages import LOGS, LogRecord
from r2p.ros.cdr import cdr
from r2p.web.dash.recorded.messages import message_of
from r2p.web.dash.recorded.reader import ChunkTable, RecordingReader

RECORDS_MAX: Final = 1000
"""Records that a page is sent at once."""

_CHUNKS_MAX = 4000  # that are looked into for one answer: enough for half an hour without a record


class RecordedLog:
    """Finds log records."""

    def __init__(self, reader: RecordingReader) -> None:
        self._reader = reader
        self._table: ChunkTable | None = None

    async def before(self, time: int, level: int, after: int = -1) -> list[dict[str, Any]]:
        """Return the newest records up to `time` (ns) and after `after`, oldest first."""
        bag = await self._reader.bag()
        if self._table is None:
            is_log = _is_own if any(each.name == LOGS for each in bag.channels) else _is_other
            self._table = await self._reader.run(lambda: ChunkTable(bag, is_log))
        found: list[dict[str, Any]] = []
        for number, chunk in itertools.islice(self._table.back_from(time, after + 1), _CHUNKS_MAX):
            wanted = self._table.ids[number]
            records = await self._reader.run(partial(self._reader.records, bag, number, chunk, wanted))
            span = [each for each in records if after < each[0] <= time]
            found += await self._reader.run(partial(_shown, bag, number, span, level))
            if len(found) >= RECORDS_MAX:
                break
        found.sort(key=lambda each: int(each["time"]))
        return found[-RECORDS_MAX:]


def _is_own(channel: BagChannel) -> bool:
    return channel.name == LOGS


def _is_other(channel: BagChannel) -> bool:
    if channel.kind != "samples" or channel.info is None:
        return False
    topic = channel.info.topic
    is_ours = channel.type_name == "r2p_msgs/Log" and topic.rpartition("/")[2] == LOG
    return is_ours or channel.type_name == "rcl_interfaces/Log"


def _shown(bag: Bag, number: int, records: list[MessageRecord], level: int) -> list[dict[str, Any]]:
    """Return the records of a level, the newest first, as pages have them. Those that can't be read are left out."""
    found = []
    for record in reversed(records[-RECORDS_MAX * 4 :]):
        try:
            row = _row(bag.files[number].channels[record[1]], record)
        except DecodeError:
            continue
        if row["level"] >= level:
            found.append(row)
    return found


def _row(channel: BagChannel, record: MessageRecord) -> dict[str, Any]:
    """Return a record as pages have it. Raises DecodeError."""
    message: Any = cdr(LogRecord).decode(record[4]) if channel.name == LOGS else message_of(channel, record[4])
    try:
        if channel.type_name == "r2p_msgs/Log":
            module, node, text = message.module, message.node, message.text
        else:
            module, _, node = message.name.rpartition("/")
            text = message.msg
        return {"time": record[0], "level": int(message.level), "module": module, "node": node, "text": text}
    except (AttributeError, TypeError, ValueError) as error:  # another type of this name
        raise DecodeError(f"{channel.name} has no log records") from error
