"""Makes the records of a bag: messages in compressed chunks with an index, and what stands before them.

`BagWriter` writes them into a file at once, or, without one, leaves them in `ready` for the `RecordingFiles`. The
records of MCAP are those of the library `mcap`, except for messages and their index, of which there are too many.
"""

import sys
import zlib
from array import array
from collections import deque
from collections.abc import Mapping
from typing import BinaryIO, Final

import zstandard
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, McapRecord, Metadata, Schema

from r2p.errors import DecodeError, MessageError
from r2p.recording.format import FORMAT, MESSAGE, MESSAGE_RECORD, METADATA, PROFILE
from r2p.recording.mcap_writer import McapWriter, PackedChunk, message_index
from r2p.version import __version__

CHUNK_SIZE = 256 << 10
"""Bytes of messages that are compressed and indexed together."""

ABOUT: Final = {"format": f"{FORMAT}", "r2p": __version__}
"""What the metadata record `r2p` says."""

_FIXED = MESSAGE.size  # looked up for each message
_IDS_MAX = 0xFFFF


class BagWriter:
    """Writes a bag. It waits for the disk: a program with an event loop has it in a thread.

    `registered` is what each file of a recording begins with: schemas, channels, metadata and attachments so far.
    `ready` are the records and chunks that are not in a file yet: all, if there is no file.
    """

    def __init__(
        self,
        file: BinaryIO | None = None,
        *,
        chunk_size: int = CHUNK_SIZE,
        about: Mapping[str, str] = ABOUT,
        profile: str = PROFILE,
    ) -> None:
        """Begin the file. For a copy of another file, `about` is what its metadata record `r2p` says, if any."""
        self.registered: list[McapRecord] = []
        self.ready: deque[McapRecord | PackedChunk] = deque()
        self.channels: dict[int, Channel] = {}
        self._schemas: dict[int, Schema] = {}
        self._schema_ids: dict[tuple[str, str, bytes], int] = {}
        self._last_channel = 0
        self._chunk_size = chunk_size
        self._compressor = zstandard.ZstdCompressor()
        self._parts: list[bytes] = []
        self._indexes: dict[int, list[int]] = {}
        self._size = 0
        self._file = McapWriter(file, profile=profile) if file is not None else None
        if about:
            self.add_metadata(METADATA, about)

    def add_channel(
        self,
        topic: str,
        encoding: str,
        metadata: Mapping[str, str],
        schema: tuple[str, str, bytes] | None = None,
    ) -> int:
        """Begin a channel, and return its id. `schema`: its name, encoding and text; one that is known is shared.

        Raises MessageError for more channels than a file can have.
        """
        schema_id = 0 if schema is None else self._schema(*schema)
        channel = self._last_channel + 1
        if channel > _IDS_MAX:
            raise MessageError(f"a recording has at most {_IDS_MAX} channels: no room for {topic}")
        self._add_channel(Channel(channel, topic, encoding, dict(metadata), schema_id))
        return channel

    def _schema(self, name: str, encoding: str, text: bytes) -> int:
        key = name, encoding, text
        if key not in self._schema_ids:
            self._add_schema(Schema(max(self._schemas, default=0) + 1, text, encoding, name))
        return self._schema_ids[key]

    def _add_schema(self, schema: Schema) -> None:
        self._schemas[schema.id] = schema
        self._schema_ids.setdefault((schema.name, schema.encoding, schema.data), schema.id)
        self.register(schema)

    def _add_channel(self, channel: Channel) -> None:
        self.channels[channel.id] = channel
        self._last_channel = max(self._last_channel, channel.id)
        self._indexes[channel.id] = []
        self.register(channel)

    def copy_channel(self, channel: Channel, schema: Schema | None) -> None:
        """Begin a channel of another file under the id that it has there, for `copy_chunk`.

        Raises DecodeError if that id, or that of the schema, belongs to something else in this file.
        """
        if schema is not None and schema.id not in self._schemas:
            self._add_schema(schema)
        if schema is not None and self._schemas[schema.id] != schema:
            raise DecodeError(f"two schemas have the id {schema.id}")
        if channel.id not in self.channels:
            self._add_channel(channel)
        if self.channels[channel.id] != channel:
            raise DecodeError(f"two channels have the id {channel.id}")

    def add(self, channel: int, log_time: int, publish_time: int, sequence: int, data: bytes) -> None:
        """Write a message; times in ns since 1970."""
        head = MESSAGE_RECORD.pack(Opcode.MESSAGE, _FIXED + len(data), channel, sequence, log_time, publish_time)
        size = self._size
        self._indexes[channel] += (log_time, size)
        self._parts += (head, data)
        self._size = size = size + len(head) + len(data)
        if size >= self._chunk_size:
            self.end_chunk()

    def copy_chunk(self, chunk: Chunk, index: bytes) -> None:
        """Write a chunk of another file as it is, with the records of its index. Its channels are in this file.

        Raises DecodeError for an index that is damaged, or has another channel.
        """
        copied = PackedChunk.make(chunk, index)
        if unknown := copied.channels.keys() - self.channels.keys():
            raise DecodeError(f"a chunk has messages of the unknown channel {min(unknown)}")
        self.end_chunk()
        self._append(copied)

    def attach(self, name: str, media_type: str, data: bytes, time: int) -> None:
        """Write an attachment, such as r2p.toml."""
        self.register(Attachment(time, time, name, media_type, data))

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Write a metadata record."""
        self.register(Metadata(name, dict(values)))

    def register(self, record: McapRecord) -> None:
        """Write a record that each file of the recording has; of attachments and metadata of one name, the last."""
        if isinstance(record, Attachment | Metadata):
            self.registered = [each for each in self.registered if not _replaces(record, each)]
        self.registered.append(record)
        self._append(record)

    def _append(self, item: McapRecord | PackedChunk) -> None:
        self.ready.append(item)
        if self._file is not None:
            self._file.write(item)
            self.ready.popleft()

    def end_chunk(self) -> None:
        """Compress the messages since the last chunk, if there are any."""
        if not self._parts:
            return
        data = b"".join(self._parts)
        indexes = {channel: index for channel, index in self._indexes.items() if index}
        self._parts, self._size = [], 0
        self._indexes.update({channel: [] for channel in indexes})
        times = [time for index in indexes.values() for time in (min(index[::2]), max(index[::2]))]
        chunk = Chunk("zstd", self._compressor.compress(data), max(times), min(times), zlib.crc32(data), len(data))
        index = b"".join(message_index(channel, _pairs(index)) for channel, index in indexes.items())
        self._append(PackedChunk.make(chunk, index))

    def finish(self) -> None:
        """Write the summary and the end of the file, and leave it open."""
        self.end_chunk()
        if self._file is not None:
            self._file.finish()


def _replaces(new: Attachment | Metadata, old: McapRecord) -> bool:
    return isinstance(old, type(new)) and old.name == new.name


def _pairs(index: list[int]) -> bytes:
    pairs = array("Q", index)
    if sys.byteorder == "big":
        pairs.byteswap()
    return pairs.tobytes()
