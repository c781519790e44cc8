"""Recordings of ROS 1: `.bag` files, by rosbags. Messages of ROS 1 have the bytes that r2p packs."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rosbags.rosbag1 import Reader, Writer

from r2p.errors import BagError
from r2p.recording.convert.ros_messages import records_of, schema_or_loss
from r2p.recording.convert.stream import ConversionOptions, ConvertedRecord, Losses, RecordSink
from r2p.units import SECOND

_LATEST = 1 << 32  # seconds since 1970, from which on ROS 1 has no times


def read(path: Path, options: ConversionOptions, losses: Losses) -> Iterator[ConvertedRecord]:
    """Iterate over the messages. A publisher is the node of ROS that its connection names."""
    try:
        with Reader(path) as reader:
            yield from records_of(reader, 1, options, losses)
    except Exception as error:  # rosbags, and what it uses, have errors of many kinds
        if isinstance(error, BagError) or (isinstance(error, OSError) and error.errno):
            raise
        raise BagError(f"{path} is damaged, or was not finished: {error}; `rosbag reindex` may help") from error


def open_sink(path: Path, options: ConversionOptions, losses: Losses) -> "Rosbag1Sink":
    """Begin a file."""
    return Rosbag1Sink(path, losses)


class Rosbag1Sink(RecordSink):
    """Writes a `.bag` file, with a connection for each topic, type and publisher.

    It is not compressed: of what rosbags compresses, ROS 1 reads bz2 only, which is slow (`rosbag compress` does that).
    """

    def __init__(self, path: Path, losses: Losses) -> None:
        super().__init__(losses)
        self._writer = Writer(path)
        self._writer.open()
        self._connections: dict[object, Any] = {}

    def put(self, record: ConvertedRecord) -> bool:
        sample = record.sample
        key = record.topic, record.cls, sample.source.module, sample.source.node
        if key not in self._connections:
            self._connections[key] = self._connect(record)
        connection = self._connections[key]
        if isinstance(connection, str):
            return self.lose(connection)
        if not 0 < record.log_time < _LATEST * SECOND:
            return self.lose(f"messages of {record.topic} from before 1970 or after 2106")
        self._writer.write(connection, record.log_time, sample.data)
        self.count_context(sample)
        return True

    def finish(self) -> None:
        self._writer.close()

    def close(self) -> None:
        if self._writer.bio is not None:  # after an error
            self._writer.bio.close()

    def _connect(self, record: ConvertedRecord) -> Any:
        """Return the connection of a message; without one, the description of its loss."""
        schema = schema_or_loss(record, 1)
        if isinstance(schema, str):
            return schema
        names = [each for each in (record.sample.source.module, record.sample.source.node) if each]
        return self._writer.add_connection(
            f"/{record.topic}",
            schema.name,
            msgdef=schema.definition,
            md5sum=schema.checksum,
            callerid="/" + "/".join(names or ["r2p"]),
            latching=0,
        )
