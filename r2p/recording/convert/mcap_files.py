"""MCAP files: our own recordings, and those of others with messages of ROS 1 or ROS 2."""

import heapq
import re
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import msgspec

from r2p.errors import DecodeError, InvalidName, MessageError
from r2p.names import topic_name
from r2p.recording.bag import Bag
from r2p.recording.bag_file import Attachment
from r2p.recording.channels import BagChannel
from r2p.recording.convert.ros_messages import RosDecoder, ros_decoder
from r2p.recording.convert.stream import ConversionOptions, ConvertedItem, ConvertedRecord, Losses, RecordSink
from r2p.recording.entries import MetadataEntry
from r2p.recording.format import CDR, OWN_PREFIX
from r2p.recording.samples import SampleWriter
from r2p.recording.writer import BagWriter
from r2p.ros.ros2_schemas import ROS2MSG, schema_of
from r2p.ros.transcoding import transcoder
from r2p.runtime.sample import Sample, Source

_FORBIDDEN = re.compile(r"[^A-Za-z0-9_/]")  # in names: /r2p/bus_load/rtcan:can0 has such
_VERSIONS = {("ros1", "ros1msg"): 1, (CDR, ROS2MSG): 2}
"""The version of ROS by the encodings of a channel and its schema."""


def read(path: Path, options: ConversionOptions, losses: Losses) -> Iterator[ConvertedItem]:
    """Iterate over attachments and metadata, then over messages. A file without an end is read as far as it goes."""
    return read_files([path], options, losses)


def read_files(paths: list[Path], options: ConversionOptions, losses: Losses) -> Iterator[ConvertedItem]:
    """Iterate over what is in the files of one recording."""
    with Bag(paths) as bag:
        yield from bag.attachments()
        yield from (MetadataEntry(name, values) for name, values in bag.metadata.items())
        yield from heapq.merge(_samples(bag, options), _others(bag, options, losses), key=lambda each: each.log_time)
        for topic, count in bag.undecodable.items():
            losses[f"messages of {topic} that can't be decoded"] += count
        if bag.damaged:
            losses["chunks of the file that can't be read, with the messages there"] += bag.damaged


def _samples(bag: Bag, options: ConversionOptions) -> Iterator[ConvertedRecord]:
    """Iterate over the messages of topics."""
    topics = [each for each in bag.topics if options.wants(each)]
    for each in bag.records(topics, start=options.start, end=options.end):
        yield ConvertedRecord(each.topic, each.log_time, each.sample, each.cls)


# Other messages: what the recorder writes besides topics, and topics of ROS 1


class _ReadChannel(msgspec.Struct, frozen=True):
    """How to read a channel; `metadata` as in ConvertedRecord."""

    topic: str
    decoder: RosDecoder
    metadata: Mapping[str, str] | None


def _others(bag: Bag, options: ConversionOptions, losses: Losses) -> Iterator[ConvertedRecord]:
    def wanted(channel: BagChannel) -> bool:
        return channel.kind == "messages" and options.wants(channel.name.removeprefix("/"))

    known: dict[int, _ReadChannel | str] = {}
    for record in bag.raw(wanted, start=options.start, end=options.end):
        key = id(record.channel)
        if key not in known:
            known[key] = _channel(record.channel)
        channel = known[key]
        if isinstance(channel, str):
            losses[channel] += 1
            continue
        try:
            data, own = channel.decoder(record.data)
        except DecodeError:
            losses[f"messages of {channel.topic} that can't be decoded"] += 1
            continue
        stamp = own if channel.metadata is None else record.publish_time
        sample = Sample(data, Source(), stamp or record.log_time, sequence=record.sequence, stamped=stamp > 0)
        yield ConvertedRecord(channel.topic, record.log_time, sample, channel.decoder.cls, channel.metadata)


def _channel(channel: BagChannel) -> _ReadChannel | str:
    """Return how to read a channel, or in words what is lost of it."""
    version = _VERSIONS.get((channel.encoding, channel.schema_encoding))
    if version is None:
        return f"messages of {channel.name}, encoded as {channel.encoding or 'nothing'}, not as cdr or ros1"
    try:
        name = channel.name
        topic = topic_name(_FORBIDDEN.sub("_", name) if name.startswith(OWN_PREFIX) else name)
        decoder = ros_decoder(channel.schema_name, version, channel.schema.decode("utf-8", "replace"))
    except (InvalidName, MessageError) as error:
        return f"messages of {channel.name}: {error}"
    return _ReadChannel(topic, decoder, channel.metadata if version > 1 else None)


# Writing


def open_sink(path: Path, options: ConversionOptions, losses: Losses) -> "BagSink":
    """Begin a recording."""
    return BagSink(path, losses)


class BagSink(RecordSink):
    """Writes a recording of ours, which has a place for everything."""

    def __init__(self, path: Path, losses: Losses) -> None:
        """Begin the file. Raises OSError."""
        super().__init__(losses)
        self._file = path.open("xb")
        self.writer = BagWriter(self._file)
        self._samples = SampleWriter(self.writer)
        self._others: dict[object, Callable[[ConvertedRecord], None]] = {}

    def put(self, record: ConvertedRecord) -> bool:
        if record.metadata is None:
            self._samples.write(record.topic, record.sample, record.cls, record.log_time)
            return True
        key = record.topic, record.cls, tuple(record.metadata.items())
        if key not in self._others:
            self._others[key] = self._besides_topics(record, record.metadata)
        self._others[key](record)
        return True

    def attach(self, attachment: Attachment) -> None:
        self.writer.attach(attachment.name, attachment.media_type, attachment.data, attachment.time)

    def describe(self, metadata: MetadataEntry) -> None:
        self.writer.add_metadata(metadata.name, metadata.values)

    def finish(self) -> None:
        self.writer.finish()

    def close(self) -> None:
        self._file.close()

    def _besides_topics(
        self, record: ConvertedRecord, metadata: Mapping[str, str]
    ) -> Callable[[ConvertedRecord], None]:
        """Return what writes messages of a channel that is not one of a topic."""
        assert record.cls is not None
        schema, to_cdr = schema_of(record.cls).record, transcoder(record.cls).to_cdr
        channel = self.writer.add_channel(f"/{record.topic}", CDR, metadata, schema)

        def write(record: ConvertedRecord) -> None:
            sample = record.sample
            self.writer.add(channel, record.log_time, sample.stamp, sample.sequence, to_cdr(sample.data)[0])

        return write
