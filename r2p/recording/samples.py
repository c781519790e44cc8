"""Samples as records of a bag, and records as samples."""

import contextlib
import itertools
from collections.abc import Callable, Iterator

import msgspec

from r2p.errors import DecodeError, MessageError
from r2p.messages import ClockOffset, Message, layout
from r2p.recording.format import CDR, META_PREFIX, PACKED, SEQUENCE_MASK, ChannelInfo
from r2p.recording.messages import REST_MAX, SampleMeta
from r2p.recording.types import type_of
from r2p.recording.writer import BagWriter
from r2p.ros.cdr import cdr
from r2p.ros.ros2_schemas import Ros2Schema, schema_of
from r2p.ros.transcoding import transcoder
from r2p.runtime.sample import PublisherClass, Sample, Source

_encode = cdr(SampleMeta).encode
_UNSTAMPED = _encode(SampleMeta(stamped=False))  # made once: each message on a debug line has it

_TIME_MASK = (1 << 64) - 1  # times in a file are not negative, those of a module may be


class SampleWriter:
    """Writes samples into a bag: makes the channels, and companions where a message has more than its bytes."""

    def __init__(self, writer: BagWriter) -> None:
        self._writer = writer
        self._channels: dict[_ChannelKey, _SampleChannel] = {}

    def write(self, topic: str, sample: Sample, cls: type[Message] | None, log_time: int) -> None:
        """Write a sample that was received at `log_time` (ns, UTC).

        It is written as packed bytes without a class, if it is not a message of that class, and if the class is one
        that ROS can't define. Raises MessageError if the file can't have one more channel.
        """
        data, rest, number, due = sample.data, b"", sample.sequence, sample.deadline or sample.expires
        key = (topic, sample.source, sample.publisher_class, number > 0, cls)
        channel = self._channels.get(key) or self._add(key)
        if channel.to_cdr is not None:
            try:
                data, rest = channel.to_cdr(data)
            except DecodeError:
                channel = self._untyped(key)
            if len(rest) > REST_MAX:
                channel, data, rest = self._untyped(key), sample.data, b""
        publish_time = sample.stamp & _TIME_MASK if sample.stamped else log_time
        sequence = number & SEQUENCE_MASK if number else next(channel.count) & SEQUENCE_MASK
        plain = sample.drop_late and sample.clock is None and not (due or sample.hops or rest or number > SEQUENCE_MASK)
        if not (plain and sample.stamped):
            meta = _UNSTAMPED if plain else _encode(_meta(sample, rest))
            self._writer.add(self._companion(channel), log_time, publish_time, sequence, meta)
        self._writer.add(channel.id, log_time, publish_time, sequence, data)

    def _untyped(self, key: "_ChannelKey") -> "_SampleChannel":
        key = (*key[:-1], None)
        return self._channels.get(key) or self._add(key)

    def _add(self, key: "_ChannelKey") -> "_SampleChannel":
        topic, source, publisher_class, numbered, cls = key
        info = ChannelInfo(topic, source.module, source.node, publisher_class, source.link, numbered=numbered)
        schema = None
        if cls is not None:
            info, schema = _typed(info, cls)
        encoding, text = (PACKED, None) if schema is None else (CDR, schema.record)
        number = self._writer.add_channel(f"/{topic}", encoding, info.metadata, text)
        to_cdr = transcoder(cls).to_cdr if schema is not None and cls is not None else None
        self._channels[key] = made = _SampleChannel(number, info, to_cdr)
        return made

    def _companion(self, channel: "_SampleChannel") -> int:
        if not channel.companion:
            name, schema = f"{META_PREFIX}{channel.info.topic}", schema_of(SampleMeta).record
            channel.companion = self._writer.add_channel(name, CDR, channel.info.metadata, schema)
        return channel.companion


_ChannelKey = tuple[str, Source, PublisherClass, bool, type[Message] | None]
"""What the messages of a channel have in common: topic, source, class, whether they have numbers, and their type."""


class _SampleChannel(msgspec.Struct, eq=False):
    id: int
    info: ChannelInfo
    to_cdr: Callable[[bytes], tuple[bytes, bytes]] | None
    companion: int = 0
    count: Iterator[int] = msgspec.field(default_factory=lambda: itertools.count(1))


def _typed(info: ChannelInfo, cls: type[Message]) -> tuple[ChannelInfo, Ros2Schema | None]:
    """Return the channel's metadata with its type, and its schema; None for messages that are written packed.

    These are messages of classes that ROS can't define, and of those that can't be made again of what the file says of
    them. If not even the layout says it, as it is too long, the type is unknown.
    """
    typed = msgspec.structs.replace(info, type=layout(cls).name, schema=layout(cls).schema)
    with contextlib.suppress(MessageError):
        schema, zero = schema_of(cls), layout(cls).zero.encode()
        found = type_of(typed, schema.text)
        other = None if found is None else found.cdr_cls
        if other is not None and transcoder(other).to_cdr(zero) == transcoder(cls).to_cdr(zero):
            return typed, schema
    return (info if type_of(typed) is None else typed), None


def _meta(sample: Sample, rest: bytes) -> SampleMeta:
    """Return what has to be recorded of a sample besides its bytes."""
    clock = sample.clock or ClockOffset(0, 0, -1)
    return SampleMeta(
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


def sample_of(
    info: ChannelInfo,
    sequence: int,
    publish_time: int,
    data: bytes,
    meta: SampleMeta,
    *,
    from_cdr: Callable[[bytes, bytes], bytes] | None,
) -> Sample:
    """Return the sample that a record was made of; its message is not decoded. Raises DecodeError.

    `from_cdr` makes packed messages of its CDR (`Transcoder.from_cdr`); None where it is packed.
    """
    return Sample(
        data if from_cdr is None else from_cdr(data, meta.rest),
        Source(info.module, info.node, info.link),
        publish_time - (publish_time >> 63 << 64),
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
