"""The indexes of messages behind a chunk: when each channel has messages, and where they are in the chunk.

Where a few messages of a chunk are wanted, they are found by these without a look at the others; and when messages
came is known without unpacking the chunk. An index may be missing, or lie: then the chunk itself is read.
"""

import contextlib
import struct
from collections.abc import Iterable
from operator import itemgetter
from typing import Final

from mcap.opcode import Opcode

from r2p.errors import BagError
from r2p.recording.bag_file import BagFile
from r2p.recording.format import INDEX, INDEX_ENTRY, MESSAGE_RECORD, RECORD_HEAD
from r2p.recording.mcap_reader import TIME_MAX, ChunkRef, MessageRecord

ChunkIndex = dict[int, bytes]
"""The packed entries of each channel: `times` unpacks them."""

_SIZE_MAX: Final = 32 << 20  # bytes of the indexes of a chunk; those of a million messages have 16 MB
_ENTRY: Final = struct.Struct("<QQ")  # log time, offset in the chunk
_TIMES: Final = struct.Struct("<Q8x")


def read_index(file: BagFile, chunk: ChunkRef) -> ChunkIndex | None:
    """Return the indexes of a chunk; None for a chunk without them, or with wrong ones. Raises BagError.

    Offsets in it are not checked.
    """
    if not (chunk.real and 0 < chunk.index_length <= _SIZE_MAX):
        return None
    data = file.file.read(chunk.offset + chunk.length, chunk.index_length)
    found: ChunkIndex = {}
    at = 0
    while at + RECORD_HEAD.size + INDEX.size <= len(data):
        opcode, length = RECORD_HEAD.unpack_from(data, at)
        channel, entries = INDEX.unpack_from(data, at + RECORD_HEAD.size)
        begin = at + RECORD_HEAD.size + INDEX.size
        at += RECORD_HEAD.size + length
        if opcode != Opcode.MESSAGE_INDEX or at > len(data) or begin + entries > at or entries % INDEX_ENTRY:
            return None
        found[channel] = data[begin : begin + entries]
    return found


def times(entries: bytes) -> list[int]:
    """Return the log times of an index (ns), in its order, which is that of the chunk."""
    return [time for (time,) in _TIMES.iter_unpack(entries)]


def indexed(file: BagFile, chunk: ChunkRef, channels: Iterable[int], most: int | None = None) -> list[MessageRecord]:
    """Return the messages of a few channels of a chunk, in the order of their log times. Raises BagError.

    With `most` it is so many of each channel at most, from the first one on, if the chunk has indexes.
    """
    wanted = frozenset(channels)
    index = read_index(file, chunk)
    found: list[MessageRecord] | None = None
    if index is not None:
        entries = b"".join(_some(index.get(each, b""), most) for each in wanted)
        if not entries:
            return []
        with contextlib.suppress(ValueError):
            found = _at_offsets(file.file.chunk(chunk), entries, wanted)
    if found is None:
        found = file.messages(chunk, wanted, 0, TIME_MAX + 1)
    found.sort(key=itemgetter(0))
    return found


def _some(entries: bytes, most: int | None) -> bytes:
    """Return so many of the entries of an index, evenly spread; None: all."""
    count = len(entries) // INDEX_ENTRY
    if most is None or count <= most:
        return entries
    starts = (INDEX_ENTRY * (count * i // most) for i in range(most))
    return b"".join(entries[start : start + INDEX_ENTRY] for start in starts)


def _at_offsets(data: bytes, entries: bytes, wanted: frozenset[int]) -> list[MessageRecord]:
    """Return the messages at the offsets of an index. Raises ValueError where one is not there."""
    found: list[MessageRecord] = []
    offsets = dict.fromkeys(at for _, at in _ENTRY.iter_unpack(entries))
    if len(offsets) * _ENTRY.size != len(entries):  # it names one long message a million times
        raise ValueError("the index is wrong")
    left = len(data)
    for at in offsets:
        if at > len(data) - MESSAGE_RECORD.size:
            raise ValueError("the index is wrong")
        opcode, length, channel, sequence, log_time, publish_time = MESSAGE_RECORD.unpack_from(data, at)
        end = at + RECORD_HEAD.size + length
        left -= end - at
        if opcode != Opcode.MESSAGE or channel not in wanted or end > len(data) or left < 0:
            raise ValueError("the index is wrong")
        found.append((log_time, channel, sequence, publish_time, data[at + MESSAGE_RECORD.size : end]))
    return found


def chunk_times(file: BagFile, chunk: ChunkRef) -> dict[int, list[int]]:
    """Return the log times of the messages in a chunk by channel; of a damaged chunk none."""
    try:
        index = read_index(file, chunk)
    except BagError:
        return {}
    if index is not None:
        return {channel: times(entries) for channel, entries in index.items()}
    found: dict[int, list[int]] = {}
    for time, channel in file.times(chunk):
        found.setdefault(channel, []).append(time)
    return found
