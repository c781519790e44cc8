"""Writes the records of a bag: MCAP in chunks, with an index."""

from collections.abc import Mapping
from typing import BinaryIO

from mcap.writer import CompressionType, Writer

from r2p.recording.format import FORMAT, METADATA, PROFILE
from r2p.version import __version__

CHUNK_SIZE = 256 << 10
"""Bytes of messages that are compressed and indexed together."""


class BagWriter:
    """Writes a bag into a binary file. It waits for the disk: a program with an event loop has it in a thread."""

    def __init__(self, file: BinaryIO, *, chunk_size: int = CHUNK_SIZE) -> None:
        """Begin the file."""
        self._writer = Writer(file, chunk_size=chunk_size, compression=CompressionType.ZSTD)
        self._writer.start(PROFILE, f"r2p {__version__}")
        self._writer.add_metadata(METADATA, {"format": f"{FORMAT}", "r2p": __version__})
        self._schemas: dict[tuple[str, str, bytes], int] = {}

    def add_channel(
        self,
        topic: str,
        encoding: str,
        metadata: Mapping[str, str],
        schema: tuple[str, str, bytes] | None = None,
    ) -> int:
        """Begin a channel, and return its id. `schema`: its name, encoding and text; one that is known is shared."""
        schema_id = 0
        if schema is not None and not (schema_id := self._schemas.get(schema, 0)):
            schema_id = self._schemas[schema] = self._writer.register_schema(*schema)
        return self._writer.register_channel(topic, encoding, schema_id, dict(metadata))

    def add(self, channel: int, log_time: int, publish_time: int, sequence: int, data: bytes) -> None:
        """Write a message; times in ns since 1970."""
        self._writer.add_message(channel, log_time, data, publish_time, sequence)

    def attach(self, name: str, media_type: str, data: bytes, time: int) -> None:
        """Write an attachment, such as r2p.toml."""
        self._writer.add_attachment(time, time, name, media_type, data)

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Write a metadata record."""
        self._writer.add_metadata(name, dict(values))

    def flush(self) -> None:
        """End the chunk, and hand all bytes to the operating system."""
        self._writer.flush()

    def finish(self) -> None:
        """Write the summary and the end of the file, and leave it open."""
        self._writer.finish()
