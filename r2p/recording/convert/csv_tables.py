"""CSV: a table for each topic, in a file, or in a folder of files named by their topics.

Behind the columns of `tables.CONTEXT` are the fields of a message, named as `r2p topic echo --format csv` does:
`stamp.sec`, `value[0]`, and an array of variable length as JSON in one cell. Bytes of a message of unknown type are in
hex.
"""

import csv
import json
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, TextIO

from r2p.errors import BagError, MessageError
from r2p.messages import FixedArray, Message, Nested, Shape, VariableArray, layout
from r2p.messages.shapes import SIZE_MAX
from r2p.messages.values import flatten, from_plain, is_octets, to_plain
from r2p.recording.convert.stream import ConversionOptions, ConvertedRecord, Losses
from r2p.recording.convert.tables import (
    CONTEXT,
    DATA,
    Table,
    TablePaths,
    TableSink,
    by_time,
    context_of,
    record_of,
    tables,
)

_SUFFIX = ".csv"
_LINE_MAX = 3 * SIZE_MAX  # characters
_CELL_MAX = 2 * SIZE_MAX  # characters of the longest cell, which is a message in hex


def read(path: Path, options: ConversionOptions, losses: Losses) -> Iterator[ConvertedRecord]:
    """Iterate over the messages. Raises BagError, which names the row, for a cell that has no place."""
    csv.field_size_limit(_CELL_MAX)
    found = tables(path, _SUFFIX, options)
    return by_time([_read_table(topic, file, options) for topic, file in found.items()])


def _read_table(topic: str, path: Path, options: ConversionOptions) -> Iterator[ConvertedRecord]:
    cls = options.type_of(topic)
    with path.open(newline="", encoding="utf-8-sig") as file:  # spreadsheets put a mark in front
        rows = csv.DictReader(_lines(file), strict=True)
        try:
            pack = _packer(topic, path, rows.fieldnames or (), cls)
            for row in rows:
                record = record_of(topic, row, pack(row), cls)
                if options.covers(record.log_time):
                    yield record
        except (csv.Error, ValueError, RecursionError, MessageError) as error:
            raise BagError(f"{path}, line {rows.line_num}: {error}") from None


def _lines(file: TextIO) -> Iterator[str]:
    while line := file.readline(_LINE_MAX):
        if len(line) == _LINE_MAX:
            raise ValueError("the line is too long to be one of a table")
        yield line


def _packer(topic: str, path: Path, columns: Any, cls: type[Message] | None) -> Callable[[Mapping[str, Any]], bytes]:
    """Return what packs the message of a row."""
    if cls is not None:
        shape = Nested(layout(cls))
        return lambda row: from_plain(cls, _value(shape, "", row)).encode()
    if [each for each in columns if each not in CONTEXT] != [DATA]:
        raise BagError(f"{path} does not say which type its messages have: --type {topic}=TYPE states it")
    return lambda row: bytes.fromhex(row[DATA] or "")


def _value(shape: Shape, path: str, row: Mapping[str, Any]) -> Any:
    """Return the value of a field as `from_plain` takes it, from the cells below its path; None without such cells."""
    match shape:
        case Nested(inner):
            prefix = f"{path}." if path else ""
            values = {each.wire_name: _value(each.shape, f"{prefix}{each.wire_name}", row) for each in inner.fields}
            return {name: value for name, value in values.items() if value is not None} or ({} if not path else None)
        case FixedArray(item, count):
            elements = [_value(item, f"{path}[{i}]", row) for i in range(count)]
            return None if None in elements else elements
        case VariableArray() if not is_octets(shape):
            cell = row.get(path)
            return None if cell is None else json.loads(cell)
        case _:
            return row.get(path)


def open_sink(path: Path, options: ConversionOptions, losses: Losses) -> TableSink:
    """Begin a file, or a folder of files."""
    return TableSink(TablePaths(path, _SUFFIX, options), CsvTable, losses)


class CsvTable(Table):
    """The file of one topic."""

    def __init__(self, path: Path, cls: type[Message] | None) -> None:
        super().__init__(cls)
        self._file: TextIO = path.open("x", newline="", encoding="utf-8")
        self._rows = csv.writer(self._file, lineterminator="\n")
        columns = [DATA] if cls is None else list(flatten(to_plain(layout(cls).zero, "cells")))
        self._rows.writerow([*CONTEXT, *columns])

    def add(self, record: ConvertedRecord, message: Message | None) -> str:
        values = [record.sample.data.hex()] if message is None else flatten(to_plain(message, "cells")).values()
        self._rows.writerow([*context_of(record), *values])
        return ""

    def close(self) -> None:
        self._file.close()
