"""What tables of messages have in common: columns about each message, and a file for each topic."""

import abc
import heapq
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from r2p.codecs import PublisherClass
from r2p.errors import BagError, DecodeError, InvalidName
from r2p.messages import Message
from r2p.names import topic_name
from r2p.recording.convert.stream import ConversionOptions, ConvertedRecord, Losses, RecordSink
from r2p.recording.format import OWN_PREFIX
from r2p.runtime.sample import Sample, Source

LOG_TIME, STAMP, DEADLINE, SEQUENCE = "_.log_time", "_.stamp", "_.deadline", "_.sequence"
MODULE, NODE, LINK, CLASS = "_.module", "_.node", "_.link", "_.class"
TIMES = (LOG_TIME, STAMP, DEADLINE)
"""UTC in ns. A message without the stamp of a publisher, or without a deadline, has nothing there."""
CONTEXT = (*TIMES, SEQUENCE, MODULE, NODE, LINK, CLASS)
"""The first columns: when a message was recorded, and where it comes from."""

DATA = "data"
"""The column of messages of unknown type."""

_FILE_NAME_MAX = 200  # bytes of a file's name without its suffix


def context_of(record: ConvertedRecord) -> list[Any]:
    """Return the values of CONTEXT; None for each that a message lacks."""
    sample = record.sample
    source = sample.source
    return [
        record.log_time,
        sample.stamp if sample.stamped else None,
        sample.deadline or None,
        sample.sequence or None,
        source.module,
        source.node,
        source.link,
        sample.publisher_class.name.lower(),
    ]


def record_of(topic: str, row: Mapping[str, Any], data: bytes, cls: type[Message] | None) -> ConvertedRecord:
    """Return the message of a row. Raises ValueError for what can't be in one of CONTEXT."""
    times = {name: int(row.get(name) or 0) for name in (*TIMES, SEQUENCE)}
    log_time = times[LOG_TIME] or times[STAMP]
    if not (log_time and all(0 <= each < 1 << 63 for each in times.values())):
        raise ValueError(f"it needs the time when it was recorded in {LOG_TIME} (ns since 1970)")
    name = (row.get(CLASS) or PublisherClass.NON_REAL_TIME.name).upper()
    if name not in PublisherClass.__members__:
        raise ValueError(f"{CLASS} {name.lower()[:40]!r} is not a class of publishers")
    source = Source(*(row.get(each) or "" for each in (MODULE, NODE, LINK)))
    sample = Sample(
        data,
        source,
        times[STAMP] or log_time,
        times[DEADLINE],
        times[SEQUENCE],
        PublisherClass[name],
        stamped=times[STAMP] > 0,
    )
    return ConvertedRecord(topic, log_time, sample, cls)


def tables(path: Path, suffix: str, options: ConversionOptions) -> dict[str, Path]:
    """Return the files of tables by their topics, of those that the options ask for: one file, or all of a folder.

    Raises BagError for a file whose name can't be that of a topic.
    """
    files = sorted(path.rglob(f"*{suffix}")) if path.is_dir() else [path]
    found = {}
    for file in files:
        name = file.relative_to(path).with_suffix("").as_posix() if path.is_dir() else file.stem
        try:
            topic = topic_name(name)
        except InvalidName as error:
            raise BagError(f"{file}: its name is that of the topic: {error}") from None
        if options.wants(topic):
            found[topic] = file
    return found


def by_time(records: list[Iterator[ConvertedRecord]]) -> Iterator[ConvertedRecord]:
    """Merge the messages of several tables."""
    return heapq.merge(*records, key=lambda each: each.log_time)


class TablePaths:
    """The files that tables are written to: one, or a folder with one for each topic."""

    def __init__(self, path: Path, suffix: str, options: ConversionOptions) -> None:
        self._path = path
        self._suffix = suffix
        self._is_file = path.suffix == suffix
        self._options = options
        self._topic: str | None = None
        """That of the one file."""

    def find(self, record: ConvertedRecord) -> Path | str:
        """Return the file for messages of a topic, in a folder that exists; in words what is lost of one without.

        One file has a topic of the network, and what the recorder writes besides only if the user asks for that.
        Raises BagError for a second topic.
        """
        topic = record.topic
        if not self._is_file:
            parts = topic.split("/")
            if not all(map(_is_file_name, parts)):  # such as `..`, in a recording of another program
                return f"messages of {topic}, which can't be the name of a file"
            file = self._path.joinpath(*parts)
            file.parent.mkdir(parents=True, exist_ok=True)
            return file.with_name(f"{file.name}{self._suffix}")
        if f"/{topic}".startswith(OWN_PREFIX) and not self._options.names(topic):
            return f"messages of {topic}, which --topics {topic} converts"
        if self._topic not in (None, topic):
            raise BagError(
                f"{self._path.name} is one table, but there are messages of {self._topic} and of {topic}: choose one "
                f"with --topics, or name a folder and --to {self._suffix[1:]}"
            )
        self._topic = topic
        return self._path


def _is_file_name(part: str) -> bool:
    return (
        part not in ("", ".", "..")
        and part.isprintable()
        and "\\" not in part
        and len(part.encode(errors="replace")) <= _FILE_NAME_MAX
    )


class Table(abc.ABC):
    """The table of one topic while it is written, with the columns of one type."""

    def __init__(self, cls: type[Message] | None) -> None:
        self._cls = cls

    def write(self, record: ConvertedRecord) -> str:
        """Write a row. Return a description of the loss if the table has no place for it, else an empty text."""
        if record.cls is not self._cls:
            return f"messages of {record.topic} of another type than the first"
        try:
            return self.add(record, None if self._cls is None else self._cls.decode(record.sample.data))
        except DecodeError:
            return f"messages of {record.topic} of another type than {record.type_name}"

    @abc.abstractmethod
    def add(self, record: ConvertedRecord, message: Message | None) -> str:
        """Do what `write` does, with the message of the record; None if its type is unknown."""

    def finish(self) -> None:
        """Write what is left."""

    @abc.abstractmethod
    def close(self) -> None:
        """Close the file."""


class TableSink(RecordSink):
    """Writes a table for each topic; `begin` begins one."""

    def __init__(self, paths: TablePaths, begin: Callable[[Path, type[Message] | None], Table], losses: Losses) -> None:
        super().__init__(losses)
        self._paths = paths
        self._begin = begin
        self._tables: dict[str, Table | str] = {}

    def put(self, record: ConvertedRecord) -> bool:
        if record.topic not in self._tables:
            path = self._paths.find(record)
            self._tables[record.topic] = path if isinstance(path, str) else self._begin(path, record.cls)
        table = self._tables[record.topic]
        problem = table if isinstance(table, str) else table.write(record)
        return self.lose(problem) if problem else True

    def finish(self) -> None:
        for each in self._written():
            each.finish()

    def close(self) -> None:
        for each in self._written():
            each.close()

    def _written(self) -> list[Table]:
        return [each for each in self._tables.values() if isinstance(each, Table)]
