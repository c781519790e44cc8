"""What tools print: text for people at a terminal, JSON lines in a pipe, or the --format that was asked for.

Texts from other modules are escaped here, for each format in its way: what is printed never moves a terminal's cursor,
and a record stays on its lines.

Output never stops the event loop: a tool that did would not read its links, and so make a robot wait for somebody's
pager. Where the reader of a pipe is slow, `put` waits, the tool's lossy queues overflow, and that is counted.
"""

import asyncio
import contextlib
import csv
import functools
import io
import itertools
import json
import os
import select
import shutil
import stat
import sys
import textwrap
from collections.abc import AsyncIterator, Callable, Iterable, Iterator, Mapping
from typing import Any, Literal, TextIO

from r2p.log_lines import printable

Record = Mapping[str, Any]

_NONE: Mapping[str, str] = {}

_ATOMIC = 4096  # bytes that a pipe takes without blocking once it says that it takes some (POSIX: at least 512)


class PipeClosed(Exception):
    """Nobody reads our output any more: the end, exit code 0."""


class Unwritable(Exception):
    """The output can't be written, to a full disk for example: exit code 1."""


class Output:
    """Writes records to stdout, each as soon as it is there.

    `format` None: "text" at a terminal, else "json". Records hold numbers, texts, lists and nested records.
    """

    def __init__(self, format: Literal["yaml", "json", "csv"] | None = None, stream: TextIO | None = None) -> None:
        self._stream = stream or sys.stdout
        self.format = format or ("text" if self._stream.isatty() else "json")
        """"text", "yaml", "json" or "csv"."""
        self._columns: list[str] | None = None
        self._lock = asyncio.Lock()

    @contextlib.asynccontextmanager
    async def while_read(self) -> AsyncIterator[None]:
        """End the block with PipeClosed as soon as nobody reads the pipe any more, also while there is no output."""
        fd = waitable(self._stream)
        if fd is None or not stat.S_ISFIFO(os.fstat(fd).st_mode):
            yield
            return
        loop, task, gone = asyncio.get_running_loop(), asyncio.current_task(), False

        def hang_up() -> None:  # a pipe's writing end has nothing to read but this
            nonlocal gone
            gone = True
            loop.remove_reader(fd)
            if task is not None:
                task.cancel()

        loop.add_reader(fd, hang_up)
        try:
            yield
        except asyncio.CancelledError:
            if not gone or task is None:
                raise
            task.uncancel()
            raise PipeClosed from None
        finally:
            loop.remove_reader(fd)

    async def put(self, record: Record, text: str | None = None) -> None:
        """Write one record of a stream; `text` is its form for people, default: YAML. Raises PipeClosed."""
        async with self._lock:
            await self._write(self._record(record, text))

    async def table(self, rows: Iterable[Record], columns: list[str], *, units: Mapping[str, str] = _NONE) -> None:
        """Write a list of records with the same keys; for people in aligned columns, numbers with the unit of theirs.

        Raises PipeClosed.
        """
        rows = list(rows)
        match self.format:
            case "text":
                rows = [{**row, **{name: f"{row[name]} {unit}" for name, unit in units.items()}} for row in rows]
                text = aligned(rows, columns, shutil.get_terminal_size().columns)
            case "csv":
                text = _csv(columns) + "".join(_csv([_cell(row[name]) for name in columns]) for row in rows)
            case _:
                text = "".join(self._record({name: row[name] for name in columns}, None) for row in rows)
        async with self._lock:
            await self._write(text)

    async def remark(self, text: str, *, over: int = 0) -> None:
        """Write a line for people, over the last `over` lines; other formats are without. Raises PipeClosed."""
        if self.format == "text":
            up = f"\x1b[{over}F\x1b[J" if over else ""
            async with self._lock:
                await self._write(up + printable(text, "\n") + "\n")

    def _record(self, record: Record, text: str | None) -> str:
        match self.format:
            case "json":
                return json.dumps(record, allow_nan=False).replace("\x7f", "\\u007f") + "\n"
            case "csv":
                return self._row(record)
            case "text" if text is not None:
                return printable(text, "\n") + "\n"
            case _:
                return to_yaml(record) + "---\n"

    def _row(self, record: Record) -> str:
        leaves = flatten(record)
        if self._columns is None:
            self._columns = list(leaves)
            return _csv(self._columns) + self._row(record)
        return _csv([leaves.get(name, "") for name in self._columns])

    async def _write(self, text: str) -> None:
        fd = waitable(self._stream)
        try:
            if fd is None:
                self._stream.write(text)
                self._stream.flush()
                return
            data = memoryview(text.encode())
            while data:
                await _room(fd)
                data = data[os.write(fd, data[:_ATOMIC]) :]
        except BrokenPipeError as error:
            raise PipeClosed from error
        except OSError as error:
            raise Unwritable(f"can't write the output: {error.strerror}") from error


def waitable(stream: TextIO) -> int | None:
    """The file descriptor, if it can be waited for; files never make anybody wait."""
    try:
        fd = stream.fileno()
    except (OSError, ValueError):  # none: a test's stream
        return None
    regular = stat.S_ISREG(os.fstat(fd).st_mode) or sys.platform == "win32"
    return None if regular else fd


async def _room(fd: int) -> None:
    """Wait until something can be written without blocking."""
    if select.select([], [fd], [], 0)[1]:
        return
    loop = asyncio.get_running_loop()
    room = asyncio.Event()
    loop.add_writer(fd, room.set)
    try:
        await room.wait()
    finally:
        loop.remove_writer(fd)


def flatten(record: Record) -> dict[str, Any]:
    """The leaves of a record by path: "stamp.sec", "value[0]"."""
    leaves: dict[str, Any] = {}

    def visit(path: str, value: Any) -> None:
        if isinstance(value, Mapping):
            for name, inner in value.items():
                visit(f"{path}.{name}" if path else name, inner)
        elif isinstance(value, list | tuple):
            for i, inner in enumerate(value):
                visit(f"{path}[{i}]", inner)
        else:
            leaves[path] = value

    visit("", record)
    return leaves


def to_yaml(record: Any) -> str:
    """A record as YAML: one line a field, and for a list of plain values. Only what is printable is not escaped."""
    text = _yaml_dumper()(record, True)
    return text if printable(text, "\n") == text else _yaml_dumper()(record, False)


@functools.cache
def _yaml_dumper() -> Callable[[Any, bool], str]:
    import yaml

    base: Any = getattr(yaml, "CSafeDumper", yaml.SafeDumper)

    dumper: Any = type("Dumper", (base,), {})  # of our own: what is added to it stays with us

    def represent(to: Any, items: Iterable[Any]) -> Any:
        """Lists of plain values on one line."""
        items = list(items)
        nested = any(isinstance(each, Mapping | list | tuple) for each in items)
        return to.represent_sequence("tag:yaml.org,2002:seq", items, flow_style=not nested)

    dumper.add_representer(list, represent)
    dumper.add_representer(tuple, represent)
    style: dict[str, Any] = {"Dumper": dumper, "sort_keys": False, "default_flow_style": False, "width": 1 << 20}
    return lambda record, allow_unicode: str(yaml.dump(record, allow_unicode=allow_unicode, **style))


def aligned(rows: Iterable[Record], columns: list[str], width: int | None = None) -> str:
    """A table for people: columns aligned, lists joined by blanks, nothing for None, each cell printable.

    Where it is wider than `width` characters, lists are folded between their items, onto lines of their own.
    """
    rows = list(rows)
    lines = [[printable(name.upper()) for name in columns], *([_cell(row[name]) for name in columns] for row in rows)]
    widths = [max(len(line[i]) for line in lines) for i in range(len(columns))]
    if width is not None and sum(widths) + 2 * (len(widths) - 1) > width:
        lists = [i for i, name in enumerate(columns) if any(isinstance(row[name], list | tuple) for row in rows)]
        widths = _narrowed(widths, lists, width - 2 * (len(widths) - 1))
        lines = [folded for line in lines for folded in _folded(line, lists, widths)]
        widths = [max(len(line[i]) for line in lines) for i in range(len(columns))]
    return "".join(
        "  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip() + "\n" for line in lines
    )


def _narrowed(widths: list[int], lists: list[int], room: int) -> list[int]:
    """These widths, with what the others leave of `room` shared by the columns of lists, the narrowest served first."""
    left = room - sum(width for i, width in enumerate(widths) if i not in lists)
    narrowed = list(widths)
    for served, i in enumerate(sorted(lists, key=widths.__getitem__)):
        narrowed[i] = max(1, min(widths[i], left // (len(lists) - served)))
        left -= narrowed[i]
    return narrowed


def _folded(line: list[str], lists: list[int], widths: list[int]) -> Iterator[list[str]]:
    """A line of a table as the lines that it takes; an item that is wider than its column is left whole."""
    cells = [_wrapped(cell, widths[i]) if i in lists else [cell] for i, cell in enumerate(line)]
    for each in itertools.zip_longest(*cells, fillvalue=""):
        yield list(each)


def _wrapped(text: str, width: int) -> list[str]:
    return textwrap.wrap(text, width, break_long_words=False, break_on_hyphens=False) or [""]


def _cell(value: Any) -> str:
    if value is None:
        return ""
    return printable(" ".join(map(str, value)) if isinstance(value, list | tuple) else str(value))


def _csv(cells: Iterable[Any]) -> str:
    line = io.StringIO()
    csv.writer(line, lineterminator="\n").writerow(printable(each) if isinstance(each, str) else each for each in cells)
    return line.getvalue()


def abandon_stdout() -> None:
    """Nobody reads standard output any more: let the interpreter flush what is left to nowhere."""
    try:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except (OSError, ValueError):  # no real file, or closed
        return
