"""Parquet: a table for each topic, in a file, or in a folder of files named by their topics.

Fields have the types of Apache Arrow: nested messages are structs, arrays are lists, and the times in the columns of
`tables.CONTEXT` are timestamps in UTC. The type of the messages is in the metadata of the file.
"""

import contextlib
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import pyarrow as pa
from pyarrow import parquet as pq

from r2p.errors import BagError, MessageError
from r2p.messages import Chars, FixedArray, Message, Nested, Scalar, Shape, VariableArray, VariableText, layout
from r2p.messages.values import from_plain, is_octets
from r2p.recording.convert.stream import ConversionOptions, ConvertedRecord, Losses
from r2p.recording.convert.tables import (
    CONTEXT,
    DATA,
    SEQUENCE,
    TIMES,
    Table,
    TablePaths,
    TableSink,
    by_time,
    context_of,
    record_of,
    tables,
)
from r2p.recording.format import ChannelInfo
from r2p.recording.types import type_of
from r2p.ros.ros2_schemas import schema_of

_SUFFIX = ".parquet"
_ROWS = 8192  # of a group, which are held in memory, if they have less than _HELD_MAX
_HELD_MAX = 32 << 20  # bytes of messages
_READ_ROWS = 1024
_TYPE, _SCHEMA, _DEFINITION = b"r2p.type", b"r2p.schema", b"r2p.definition"
_TIME = pa.timestamp("ns", tz="UTC")
_LATEST = (1 << 63) - 1  # ns since 1970 that it can hold
_CONTEXT = [(name, _TIME if name in TIMES else pa.uint64() if name == SEQUENCE else pa.string()) for name in CONTEXT]
_SCALARS = {
    "bool": pa.bool_(),
    "f32": pa.float32(),
    "f64": pa.float64(),
    **{f"i{bits}": getattr(pa, f"int{bits}")() for bits in (8, 16, 32, 64)},
    **{f"u{bits}": getattr(pa, f"uint{bits}")() for bits in (8, 16, 32, 64)},
}


def read(path: Path, options: ConversionOptions, losses: Losses) -> Iterator[ConvertedRecord]:
    """Iterate over the messages. Raises BagError."""
    found = tables(path, _SUFFIX, options)
    return by_time([_read_table(topic, file, options) for topic, file in found.items()])


def _read_table(topic: str, path: Path, options: ConversionOptions) -> Iterator[ConvertedRecord]:
    try:
        with pq.ParquetFile(path) as file:
            cls = _class(topic, file.schema_arrow.metadata or {}) or options.type_of(topic)
            pack = _packer(topic, path, file.schema_arrow.names, cls)
            for row in _rows(file):
                record = record_of(topic, row, pack(row), cls)
                if options.covers(record.log_time):
                    yield record
    except (pa.ArrowException, OSError, ValueError, MessageError) as error:  # OSError: damaged, too
        raise BagError(f"{path}: {error}") from None


def _rows(file: Any) -> Iterator[dict[str, Any]]:
    """Iterate over the rows, with times in ns."""
    for batch in file.iter_batches(_READ_ROWS):
        columns = [each.cast(pa.int64()) if pa.types.is_timestamp(each.type) else each for each in batch.columns]
        yield from pa.RecordBatch.from_arrays(columns, names=batch.schema.names).to_pylist()


def _class(topic: str, metadata: Mapping[bytes, bytes]) -> type[Message] | None:
    parts = (metadata.get(each, b"").decode("utf-8", "replace") for each in (_TYPE, _SCHEMA, _DEFINITION))
    name, schema, definition = parts
    found = type_of(ChannelInfo(topic, type=name, schema=schema), definition)
    return None if found is None else found.cls


def _packer(
    topic: str, path: Path, names: list[str], cls: type[Message] | None
) -> Callable[[Mapping[str, Any]], bytes]:
    """Return what packs the message of a row."""
    if cls is not None:
        fields = {each.wire_name for each in layout(cls).fields}
        return lambda row: from_plain(cls, {name: row[name] for name in names if name in fields}).encode()
    if [each for each in names if each not in CONTEXT] != [DATA]:
        raise BagError(f"{path} does not say which type its messages have: --type {topic}=TYPE states it")
    return lambda row: bytes(row[DATA] or b"")


def open_sink(path: Path, options: ConversionOptions, losses: Losses) -> TableSink:
    """Begin a file, or a folder of files."""
    return TableSink(TablePaths(path, _SUFFIX, options), ArrowTable, losses)


class ArrowTable(Table):
    """The file of one topic, and the rows that are not written yet."""

    def __init__(self, path: Path, cls: type[Message] | None) -> None:
        super().__init__(cls)
        shape = None if cls is None else layout(cls)
        self._fields = [] if shape is None else [each for each in shape.fields if _has_columns(each.shape)]
        own = [(DATA, pa.binary())] if cls is None else [(each.wire_name, _type(each.shape)) for each in self._fields]
        self._schema = pa.schema([*_CONTEXT, *own], metadata=_metadata(cls))
        self._writer = pq.ParquetWriter(path, self._schema)
        self._columns: list[list[Any]] = [[] for _ in self._schema]
        self._held = 0  # bytes of the messages in them

    def add(self, record: ConvertedRecord, message: Message | None) -> str:
        context = context_of(record)
        if any(each is not None and each > _LATEST for each in context[: len(TIMES)]):
            return f"messages of {record.topic} from after the year 2262"
        values = [_value(each.shape, getattr(message, each.name)) for each in self._fields]
        if message is None:
            values = [record.sample.data]
        for column, value in zip(self._columns, [*context, *values], strict=True):
            column.append(value)
        self._held += len(record.sample.data)
        if len(self._columns[0]) >= _ROWS or self._held >= _HELD_MAX:
            self.finish()
        return ""

    def finish(self) -> None:
        """Write the rows so far as a group."""
        arrays = [pa.array(column, each.type) for column, each in zip(self._columns, self._schema, strict=True)]
        self._writer.write_batch(pa.RecordBatch.from_arrays(arrays, schema=self._schema))
        self._columns = [[] for _ in self._schema]
        self._held = 0

    def close(self) -> None:
        self._writer.close()


def _metadata(cls: type[Message] | None) -> dict[bytes, bytes]:
    if cls is None:
        return {}
    shape = layout(cls)
    values = {_TYPE: shape.name.encode(), _SCHEMA: shape.schema.encode()}
    with contextlib.suppress(MessageError):  # ROS 2 can't define it: the schema is enough
        values[_DEFINITION] = schema_of(cls).text.encode()
    return values


def _has_columns(shape: Shape) -> bool:
    """Return whether a value has a place: Parquet has no structs without fields."""
    match shape:
        case Nested(inner):
            return any(_has_columns(each.shape) for each in inner.fields)
        case FixedArray(item) | VariableArray(item):
            return _has_columns(item)
        case _:
            return True


def _type(shape: Shape) -> Any:
    match shape:
        case Nested(inner):
            return pa.struct([(each.wire_name, _type(each.shape)) for each in inner.fields if _has_columns(each.shape)])
        case FixedArray(item, count):
            return pa.binary(count) if is_octets(shape) else pa.list_(_type(item), count)
        case VariableArray(item):
            return pa.binary() if is_octets(shape) else pa.list_(_type(item))
        case Scalar(kind):
            return _SCALARS[kind]
        case Chars() | VariableText():
            return pa.string()


def _value(shape: Shape, value: Any) -> Any:
    """Return a value as Arrow takes it."""
    match shape:
        case Nested(inner):
            return {
                each.wire_name: _value(each.shape, getattr(value, each.name))
                for each in inner.fields
                if _has_columns(each.shape)
            }
        case FixedArray() | VariableArray() if is_octets(shape):
            return bytes(value)
        case FixedArray(item) | VariableArray(item):
            return list(value) if isinstance(item, Scalar) else [_value(item, each) for each in value]
        case _:
            return value
