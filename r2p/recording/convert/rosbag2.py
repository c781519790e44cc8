"""Recordings of ROS 2: a folder with metadata.yaml, and files of MCAP or SQLite.

What is written is one of our recordings, whose messages and schemas are ROS 2's, and beside it the metadata that
`ros2 bag` looks for. So nothing is lost but what has no type of ROS. The metadata is of version 8, which ROS 2 reads
since Humble; the profiles of quality of service are left out, which means the usual one.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml
from mcap.reader import make_reader
from mcap.summary import Summary
from rosbags.rosbag2 import Reader

from r2p.errors import BagError, DecodeError
from r2p.messages import Message
from r2p.recording.bag_file import Attachment
from r2p.recording.convert import mcap_files
from r2p.recording.convert.ros_messages import records_of, schema_or_loss
from r2p.recording.convert.stream import ConversionOptions, ConvertedItem, ConvertedRecord, Losses, RecordSink
from r2p.recording.entries import MetadataEntry
from r2p.recording.messages import SampleMeta
from r2p.ros.library import ros2_hash
from r2p.ros.ros2_schemas import schema_of
from r2p.ros.transcoding import transcoder
from r2p.runtime.sample import Sample

_METADATA = "metadata.yaml"
_VERSION = 8


def read(path: Path, options: ConversionOptions, losses: Losses) -> Iterator[ConvertedItem]:
    """Iterate over the messages."""
    try:
        files = _plain_files(path)
        if files:
            yield from mcap_files.read_files(files, options, losses)
        else:
            with Reader(path) as reader:
                yield from records_of(reader, 2, options, losses)
    except Exception as error:  # rosbags, and what it uses, have errors of many kinds
        if isinstance(error, BagError) or (isinstance(error, OSError) and error.errno):
            raise
        raise BagError(f"{path} is damaged, or was not finished: {error}; `ros2 bag reindex` may help") from error


def _plain_files(path: Path) -> list[Path]:
    """Return the MCAP files of a recording if they are not compressed as a whole, or message by message."""
    if not path.is_dir():
        return []
    metadata = yaml.safe_load((path / _METADATA).read_text())
    match metadata:
        case {
            "rosbag2_bagfile_information": {"storage_identifier": "mcap", "relative_file_paths": list(names)} as info
        }:
            if info.get("compression_mode"):
                return []
            found = [path / Path(str(name)).name for name in names]
            if not all(map(Path.is_file, found)):
                raise BagError(f"{path} lacks one of the files that its {_METADATA} names")
            return found
        case _:
            return []


def open_sink(path: Path, options: ConversionOptions, losses: Losses) -> "Rosbag2Sink":
    """Begin a folder."""
    return Rosbag2Sink(path, losses)


class Rosbag2Sink(RecordSink):
    """Writes a folder with one of our recordings, and its metadata for ROS 2."""

    def __init__(self, path: Path, losses: Losses) -> None:
        super().__init__(losses)
        path.mkdir()
        self._folder = path
        self._file = path / f"{path.name}_0.mcap"
        self._bag = mcap_files.BagSink(self._file, losses)
        self._problems: dict[tuple[str, type[Message] | None], str] = {}
        self._hashes = {schema_of(SampleMeta).name: ros2_hash(SampleMeta)}

    def put(self, record: ConvertedRecord) -> bool:
        key = record.topic, record.cls
        problem = self._problems.get(key)
        if problem is None:
            problem = self._problems[key] = self._problem(record)
        if not problem and not _is_of(record.cls, record.sample):
            problem = f"messages of {record.topic} of another type than {record.type_name}"
        return self.lose(problem) if problem else self._bag.put(record)

    def attach(self, attachment: Attachment) -> None:
        self._bag.attach(attachment)

    def describe(self, metadata: MetadataEntry) -> None:
        self._bag.describe(metadata)

    def finish(self) -> None:
        self._bag.finish()
        self._bag.close()
        with self._file.open("rb") as file:
            summary = make_reader(file).get_summary()
        assert summary is not None
        (self._folder / _METADATA).write_text(yaml.safe_dump(self._metadata(summary), sort_keys=False))

    def close(self) -> None:
        self._bag.close()

    def _problem(self, record: ConvertedRecord) -> str:
        """Return why ROS 2 can't read messages like this one; empty if it can."""
        schema = schema_or_loss(record, 2)
        if isinstance(schema, str):
            return schema
        self._hashes[schema.name] = schema.checksum
        return ""

    def _metadata(self, summary: Summary) -> dict[str, Any]:
        statistics = summary.statistics
        assert statistics is not None
        topics: dict[str, dict[str, Any]] = {}
        for channel in summary.channels.values():
            count = statistics.channel_message_counts.get(channel.id, 0)
            entry = topics.setdefault(
                channel.topic, self._topic(channel.topic, summary.schemas[channel.schema_id].name)
            )
            entry["message_count"] += count
        first, last = statistics.message_start_time, statistics.message_end_time
        information = {
            "version": _VERSION,
            "storage_identifier": "mcap",
            **_extent(first, last, statistics.message_count),
            "topics_with_message_count": list(topics.values()),
            "compression_format": "",
            "compression_mode": "",
            "relative_file_paths": [self._file.name],
            "files": [{"path": self._file.name, **_extent(first, last, statistics.message_count)}],
            "custom_data": None,
            "ros_distro": "",
        }
        return {"rosbag2_bagfile_information": information}

    def _topic(self, name: str, type_name: str) -> dict[str, Any]:
        metadata = {
            "name": name,
            "type": type_name,
            "serialization_format": "cdr",
            "offered_qos_profiles": "",
            "type_description_hash": self._hashes[type_name],
        }
        return {"topic_metadata": metadata, "message_count": 0}


def _extent(first: int, last: int, count: int) -> dict[str, Any]:
    return {
        "duration": {"nanoseconds": last - first},
        "starting_time": {"nanoseconds_since_epoch": first},
        "message_count": count,
    }


def _is_of(cls: type[Message] | None, sample: Sample) -> bool:
    try:
        return cls is not None and bool(transcoder(cls).to_cdr(sample.data))
    except DecodeError:
        return False
