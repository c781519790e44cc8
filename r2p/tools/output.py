"""The output of commands: records on stdout, messages for the user and log records on stderr.

stdout gets text at a terminal, JSON lines in a pipe, or what --format asks for. Texts from other modules are escaped
here, for each format in its way: output never moves a terminal's cursor, and a record stays on its lines.

Output never blocks the event loop: a command that did would not read its links, and the robot would wait for a pager.
Where the reader of a pipe is slow, `put` waits, the command's lossy queues overflow, and the losses are counted.
"""

import asyncio
import contextlib
import csv
import functools
import io
import itertools
import json
import logging
import os
import re
import select
import shutil
import stat
import sys
import textwrap
from collections.abc import AsyncIterator, Callable, Iterable, Iterator, Mapping
from pathlib import Path
from types import UnionType
from typing import Any, Literal, TextIO

from r2p.log_lines import StderrHandler, last_resort, printable, wrapped
from r2p.messages.values import flatten

Record = Mapping[str, Any]

_NONE: Mapping[str, str] = {}

_PART = re.compile(r"[^/?&,:]*[/?&,:]+|[^/?&,:]+")  # of a URL or a path, with the marks behind it

_ATOMIC = 4096  # bytes that a writable pipe accepts without blocking (POSIX: at least 512)


class PipeClosed(Exception):
    """The reader of the output has closed the pipe: the command ends with exit code 0."""


class Unwritable(Exception):
    """The output can't be written, for example to a full disk: exit code 1."""


class Output:
    """Writes records to stdout, each as soon as it arrives.

    `format` None: "text" at a terminal, else "json". Records contain numbers, texts, lists and nested records.
    """

    def __init__(
        self, format: Literal["text", "yaml", "json", "csv"] | None = None, stream: TextIO | None = None
    ) -> None:
        self._stream = stream or sys.stdout
        if isinstance(self._stream, io.TextIOWrapper):  # files as pipes, whatever the locale
            self._stream.reconfigure(encoding="utf-8")
        self.format = format or ("text" if self._stream.isatty() else "json")
        """"text", "yaml", "json" or "csv"."""
        self._columns: list[str] | None = None  # of CSV
        self._omitted = False  # values that have no column
        self._lock = asyncio.Lock()

    @property
    def width(self) -> int | None:
        """The columns of the terminal; None where the output is for programs."""
        return shutil.get_terminal_size().columns if self.format == "text" else None

    @contextlib.asynccontextmanager
    async def while_read(self) -> AsyncIterator[None]:
        """Raise PipeClosed in the block as soon as the reader closes the pipe, also while nothing is printed."""
        fd = waitable(self._stream)
        if fd is None or not stat.S_ISFIFO(os.fstat(fd).st_mode):
            yield
            return
        loop, task, closed = asyncio.get_running_loop(), asyncio.current_task(), False

        def close() -> None:  # the writing end of a pipe becomes readable only when the reader is gone
            nonlocal closed
            closed = True
            loop.remove_reader(fd)
            if task is not None:
                task.cancel()

        loop.add_reader(fd, close)
        try:
            yield
        except asyncio.CancelledError:
            if not closed:
                raise
            raise PipeClosed from None
        finally:
            loop.remove_reader(fd)
            if closed and task is not None:
                await _take_back(task)

    async def put(
        self, record: Record, text: str | None = None, *, colour: int | None = None, wrap: bool = False
    ) -> None:
        """Write one record of a stream; at a terminal as `text`, by default as YAML. Raises PipeClosed.

        `colour` is the SGR number of the text's colour; without effect where the environment has NO_COLOR. With `wrap`,
        a text that is wider than the terminal breaks between words; not for columns.
        """
        if text is not None and wrap:
            text = wrapped(text, self._stream)
        written = self._record(record, text)
        if colour is not None and self.format == "text" and not os.environ.get("NO_COLOR"):
            written = f"\x1b[{colour}m{written.rstrip()}\x1b[0m\n"
        async with self._lock:
            await self._write(written)

    async def header(self, columns: Iterable[str]) -> None:
        """Write the header of CSV, where records that differ follow; else that of the first record is written."""
        if self.format == "csv":
            self._columns = list(dict.fromkeys(columns))
            async with self._lock:
                await self._write(_csv(self._columns))

    async def table(self, rows: Iterable[Record], columns: list[str], *, units: Mapping[str, str] = _NONE) -> None:
        """Write records with the same keys; at a terminal in aligned columns, with `units`. Raises PipeClosed.

        A terminal gets no header without rows: the command reports that there is nothing, and why.
        """
        rows = list(rows)
        match self.format:
            case "text":
                rows = [{**row, **{name: f"{row[name]} {unit}" for name, unit in units.items()}} for row in rows]
                text = aligned(rows, columns, self.width) if rows else ""
            case "csv":
                text = _csv(columns) + "".join(_csv([_cell(row[name]) for name in columns]) for row in rows)
            case _:
                text = "".join(self._record({name: row[name] for name in columns}, None) for row in rows)
        async with self._lock:
            await self._write(text)

    async def raw(self, text: str) -> None:
        """Write a text as it is, in every format: a file in a language of its own. Raises PipeClosed."""
        async with self._lock:
            await self._write(text)

    async def remark(self, text: str, *, over: int = 0) -> None:
        """Write a line of text over the last `over` lines, in text format only. Raises PipeClosed."""
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
        if not (self._omitted or leaves.keys() <= set(self._columns)):
            self._omitted = True
            names = ", ".join(name for name in leaves if name not in self._columns)
            notify(f"the CSV has no column for {names}: these are left out")
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
                await wait_ready(fd, write=True)
                data = data[os.write(fd, data[:_ATOMIC]) :]
        except BrokenPipeError as error:
            raise PipeClosed from error
        except OSError as error:
            raise Unwritable(f"can't write the output: {error.strerror}") from error


async def _take_back(task: asyncio.Task[Any]) -> None:
    """Take back a cancellation of this task, also one that is still to come: task groups put it off (Python 3.13)."""
    with contextlib.suppress(asyncio.CancelledError):
        await asyncio.sleep(0)
    task.uncancel()


def waitable(stream: TextIO) -> int | None:
    """Return the file descriptor if it can be waited for; regular files never block."""
    try:
        fd = stream.fileno()
    except (OSError, ValueError):  # a stream of a test has none
        return None
    regular = stat.S_ISREG(os.fstat(fd).st_mode) or sys.platform == "win32"
    return None if regular else fd


async def wait_ready(fd: int, *, write: bool = False) -> None:
    """Wait until reading from `fd`, or writing to it, does not block."""
    # What is ready already is found at once: a callback costs a turn of the event loop for each piece.
    if any(select.select([] if write else [fd], [fd] if write else [], [], 0)):
        return
    loop = asyncio.get_running_loop()
    add, remove = (loop.add_writer, loop.remove_writer) if write else (loop.add_reader, loop.remove_reader)
    ready = asyncio.Event()
    add(fd, ready.set)
    try:
        await ready.wait()
    finally:
        remove(fd)


def to_yaml(record: Any) -> str:
    """Return a record as YAML, with lists of plain values on one line, and with unprintable characters escaped."""
    text = _yaml_dumper()(record, True)
    return text if printable(text, "\n") == text else _yaml_dumper()(record, False)


@functools.cache
def _yaml_dumper() -> Callable[[Any, bool], str]:
    import yaml

    base: Any = getattr(yaml, "CSafeDumper", yaml.SafeDumper)
    dumper: Any = type("Dumper", (base,), {})  # because representers apply to all users of the class

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
    """Return a table with aligned columns: lists joined by blanks, None as an empty cell, all cells printable.

    Where it is wider than `width` characters, lists are folded between their items, and if that is not enough, all
    texts between words and inside of URLs.
    """
    rows = list(rows)
    lines = [[printable(name.upper()) for name in columns], *([_cell(row[name]) for name in columns] for row in rows)]
    whole, widths = lines, _widths(lines)
    room = sys.maxsize if width is None else width - 2 * (len(columns) - 1)
    lists, texts = _columns_of(rows, columns, list | tuple), _columns_of(rows, columns, str)
    for cut in ([], texts):
        if sum(widths) > room:
            chosen = sorted({*lists, *cut})
            narrowed = _narrowed(_widths(whole), chosen, room)
            lines = [folded for line in whole for folded in _folded(line, chosen, narrowed, cut)]
            widths = _widths(lines)
    return "".join(
        "  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip() + "\n" for line in lines
    )


def _columns_of(rows: list[Record], columns: list[str], kind: UnionType | type) -> list[int]:
    return [i for i, name in enumerate(columns) if any(isinstance(row[name], kind) for row in rows)]


def _widths(lines: list[list[str]]) -> list[int]:
    return [max(map(len, column)) for column in zip(*lines, strict=True)]


def _narrowed(widths: list[int], chosen: list[int], room: int) -> list[int]:
    """Return widths such that the chosen columns share what the others leave, the narrowest served first."""
    left = room - sum(width for i, width in enumerate(widths) if i not in chosen)
    narrowed = list(widths)
    for served, i in enumerate(sorted(chosen, key=widths.__getitem__)):
        narrowed[i] = max(1, min(widths[i], left // (len(chosen) - served)))
        left -= narrowed[i]
    return narrowed


def _folded(line: list[str], chosen: list[int], widths: list[int], cut: list[int]) -> Iterator[list[str]]:
    """Yield the lines of a row with the chosen columns folded. A word wider than its column stays whole, except where
    it may be `cut` after a mark.
    """
    wrap = functools.partial(textwrap.wrap, break_long_words=False, break_on_hyphens=False)
    cells = [[cell] for cell in line]
    for i in chosen:
        words = (_cut(word, widths[i]) if i in cut else word for word in line[i].split(" "))
        cells[i] = wrap(" ".join(words), widths[i]) or [""]
    for each in itertools.zip_longest(*cells, fillvalue=""):
        yield list(each)


def _cut(word: str, width: int) -> str:
    """Put blanks into a word that is wider than `width`, after the marks of URLs and paths."""
    if len(word) <= width:
        return word
    pieces = [""]
    for part in _PART.findall(word):
        if pieces[-1] and len(pieces[-1]) + len(part) > width:
            pieces.append("")
        pieces[-1] += part
    return " ".join(pieces)


def _cell(value: Any) -> str:
    if value is None:
        return ""
    return printable(" ".join(map(str, value)) if isinstance(value, list | tuple) else str(value))


def _csv(cells: Iterable[Any]) -> str:
    line = io.StringIO()
    csv.writer(line, lineterminator="\n").writerow(printable(each) if isinstance(each, str) else each for each in cells)
    return line.getvalue()


def abandon_stdout() -> None:
    """Redirect standard output to /dev/null, so that the interpreter can flush the rest without an error."""
    try:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except (OSError, ValueError):  # no real file, or closed
        return


def notify(text: str) -> None:
    """Print a message for the user on stderr."""
    with contextlib.suppress(OSError):  # stderr is closed
        line = wrapped(printable(f"r2p: {text}", "\n\t"), sys.stderr)
        print(line, file=sys.stderr, flush=True)  # noqa: T201 - the one place


_HANDLER = StderrHandler()


@contextlib.contextmanager
def log_to_stderr(level: int) -> Iterator[None]:
    """Log to stderr in the block: INFO and up, and each -v or -q moves that by one level.

    Of other libraries, and of the nodes of `r2p run`, come the records that Python would print bare: WARNING and up.
    """
    logger = logging.getLogger("r2p")
    propagate, before = logger.propagate, logger.level
    logger.addHandler(_HANDLER)
    logger.propagate = False
    logger.setLevel(max(logging.DEBUG, min(logging.INFO - 10 * level, logging.CRITICAL)))
    try:
        with last_resort(_HANDLER):
            yield
    finally:
        logger.removeHandler(_HANDLER)
        logger.propagate = propagate
        logger.setLevel(before)


def program() -> str:
    """Return what to type for this program in another terminal in the same folder."""
    typed = sys.argv[0]
    if Path(typed).name == "__main__.py":
        return f"{sys.orig_argv[0]} -m r2p"
    if Path(typed).name != "r2p" or not os.access(typed, os.X_OK):  # not started as a command
        return "r2p"
    found = shutil.which("r2p")
    return "r2p" if found and Path(found).samefile(typed) else typed
