"""Samples as records of a bag, and records as samples."""

import itertools
from collections.abc import Iterator

import msgspec

from r2p.errors import DecodeError, MessageError
from r2p.messages import ClockOffset, Message, layout
from r2p.recording.format import CDR, META_PREFIX, PACKED, ROS2MSG, SEQUENCE_MASK, ChannelInfo
from r2p.recording.messages import SampleMeta
from r2p.recording.types import schema_of
from r2p.recording.writer import BagWriter
from r2p.ros.cdr import cdr
from r2p.ros.transcoding import Transcoder, transcoder
from r2p.runtime.sample import Sample, Source

_DEFAULT = SampleMeta()


class SampleWriter:
    """Writes samples into a bag: makes the channels, and companions where a message has more than its bytes."""

    def __init__(self, writer: BagWriter) -> None:
        self._writer = writer
        self._channels: dict[tuple[ChannelInfo, type[Message] | None], _WrittenChannel] = {}
        self._companions: dict[ChannelInfo, int] = {}

    def write(self, topic: str, sample: Sample, cls: type[Message] | None, log_time: int) -> None:
        """Write a sample that was received at `log_time` (ns, UTC). Without a class, or if it is not a message of that
        class, it is written as packed bytes.
        """
        channel = self._channel(topic, sample, cls)
        data, rest = sample.data, b""
        if channel.transcoder is not None:
            try:
                data, rest = channel.transcoder.to_cdr(sample.data)
            except DecodeError:
                channel, data = self._channel(topic, sample, None), sample.data
        sequence = sample.sequence & SEQUENCE_MASK or next(channel.count)
        publish_time = sample.stamp if sample.stamped else log_time
        meta = _meta(sample, rest)
        if meta is not None:
            companion = self._companion(channel)
            self._writer.add(companion, log_time, publish_time, sequence, cdr(SampleMeta).encode(meta))
        self._writer.add(channel.id, log_time, publish_time, sequence, data)

    def _channel(self, topic: str, sample: Sample, cls: type[Message] | None) -> "_WrittenChannel":
        source = sample.source
        info = ChannelInfo(
            topic, source.module, source.node, sample.publisher_class, source.link, numbered=sample.sequence > 0
        )
        key = info, cls
        if key not in self._channels:
            self._channels[key] = self._add(info, cls)
        return self._channels[key]

    def _add(self, info: ChannelInfo, cls: type[Message] | None) -> "_WrittenChannel":
        if cls is not None:
            try:
                schema = schema_of(cls)
            except MessageError:
                return self._add(info, None)
            info = msgspec.structs.replace(info, type=layout(cls).name, schema=layout(cls).schema)
            text = schema.name, ROS2MSG, schema.text.encode()
            channel = self._writer.add_channel(f"/{info.topic}", CDR, info.metadata, text)
            return _WrittenChannel(channel, info, transcoder(cls))
        return _WrittenChannel(self._writer.add_channel(f"/{info.topic}", PACKED, info.metadata), info, None)

    def _companion(self, channel: "_WrittenChannel") -> int:
        info = channel.info
        if info not in self._companions:
            schema = schema_of(SampleMeta)
            text = schema.name, ROS2MSG, schema.text.encode()
            self._companions[info] = self._writer.add_channel(f"{META_PREFIX}{info.topic}", CDR, info.metadata, text)
        return self._companions[info]


class _WrittenChannel(msgspec.Struct, eq=False):
    id: int
    info: ChannelInfo
    transcoder: Transcoder | None
    count: Iterator[int] = msgspec.field(default_factory=lambda: itertools.count(1))


def _meta(sample: Sample, rest: bytes) -> SampleMeta | None:
    """Return what has to be recorded of a sample besides its bytes; None for nothing."""
    clock = sample.clock or ClockOffset(0, 0, -1)
    meta = SampleMeta(
        stamped=sample.stamped,
        drop_late=sample.drop_late,
        hops=sample.hops,
        deadline=sample.deadline,
        expires=sample.expires,
        clock_epoch=clock.epoch,
        clock_offset=clock.offset,
        clock_error=clock.error,
        number=sample.sequence if sample.sequence > SEQUENCE_MASK else 0,
        rest=rest,
    )
    return None if meta == _DEFAULT else meta


def sample_of(
    info: ChannelInfo,
    sequence: int,
    publish_time: int,
    data: bytes,
    meta: SampleMeta,
    *,
    is_cdr: bool,
    cls: type[Message] | None,
) -> Sample:
    """Return the sample that a record was made of; its message is not decoded. Raises DecodeError."""
    if is_cdr and cls is None:
        raise DecodeError(f"the type of /{info.topic} is unknown")
    packed = transcoder(cls).from_cdr(data, meta.rest) if is_cdr and cls is not None else data
    return Sample(
        packed,
        Source(info.module, info.node, info.link),
        publish_time,
        meta.deadline,
        meta.number or (sequence if info.numbered else 0),
        info.publisher_class,
        None,
        meta.stamped,
        meta.drop_late,
        meta.hops,
        ClockOffset(meta.clock_epoch, meta.clock_offset, meta.clock_error) if meta.clock_error >= 0 else None,
        meta.expires,
    )
