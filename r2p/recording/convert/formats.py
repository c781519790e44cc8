"""The formats of recordings, and the conversion of one to another.

A format is recognised by the suffix of a file, or by what is in a folder. To add one, write a module with the functions
of `FormatModule`, and enter it in FORMATS.
"""

import contextlib
import importlib
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Protocol, cast

import msgspec

from r2p.errors import BagError
from r2p.recording.bag import Bag
from r2p.recording.bag_file import Attachment
from r2p.recording.convert.retyping import Retyping
from r2p.recording.convert.stream import (
    ATTACHMENTS,
    METADATA_RECORDS,
    ConversionOptions,
    ConvertedItem,
    ConvertedRecord,
    Losses,
    RecordSink,
)
from r2p.recording.entries import MetadataEntry

_METADATA = "metadata.yaml"
_PARTIAL = ".partial-"
"""Before the name of the folder in which an output is made."""


class FormatModule(Protocol):
    """What the module of a format has."""

    def read(self, path: Path, options: ConversionOptions, losses: Losses) -> Iterator[ConvertedItem]:
        """Iterate over the messages that the options ask for, in the order of their times. Raises BagError."""

    def open_sink(self, path: Path, options: ConversionOptions, losses: Losses) -> RecordSink:
        """Begin an output. Raises BagError or OSError."""


class Format(msgspec.Struct, frozen=True):
    """A format. Its files have these `suffixes`; `is_folder` and `is_file` say what a recording may be.

    `module` has its code, which needs an `extra`; `version` is that of ROS whose types it has.
    """

    name: str
    suffixes: tuple[str, ...]
    module: str
    is_folder: bool = False
    is_file: bool = True
    version: int = 2
    extra: str = "bag"

    def load(self) -> FormatModule:
        """Import the module. Raises BagError, which says what to install."""
        try:
            return cast("FormatModule", importlib.import_module(self.module))
        except ImportError as error:
            raise BagError(f"{self.name} needs {error.name}: pip install 'r2p[{self.extra}]'") from error


_HERE = "r2p.recording.convert"
FORMATS = {
    each.name: each
    for each in (
        Format("mcap", (".mcap",), f"{_HERE}.mcap_files"),
        Format("rosbag1", (".bag",), f"{_HERE}.rosbag1", version=1, extra="ros"),
        Format("rosbag2", (".mcap", ".db3", ".yaml"), f"{_HERE}.rosbag2", is_folder=True, is_file=False, extra="ros"),
        Format("db3", (".db3",), f"{_HERE}.rosbag2", extra="ros"),
        Format("candump", (".log",), f"{_HERE}.candump"),
        Format("blf", (".blf",), f"{_HERE}.can_files", extra="can"),
        Format("asc", (".asc",), f"{_HERE}.can_files", extra="can"),
        Format("csv", (".csv",), f"{_HERE}.csv_tables", is_folder=True),
        Format("parquet", (".parquet",), f"{_HERE}.parquet", is_folder=True, extra="parquet"),
    )
}
"""All formats by name."""

_READ_ONLY = ("db3",)


class ConversionResult(msgspec.Struct, frozen=True):
    """What a conversion wrote: its formats, the number of messages by topic, and what the result lacks, in words."""

    source_format: str
    target_format: str
    messages: dict[str, int]
    losses: Losses


def convert(
    source: Path,
    target: Path,
    options: ConversionOptions | None = None,
    *,
    to: str | None = None,
    overwrite: bool = False,
    stopped: Callable[[], bool] = lambda: False,
) -> ConversionResult:
    """Convert a recording. The formats are those of the suffixes; `to` names the one of a target without.

    The target appears when it is complete. One that exists is replaced only with `overwrite`. `stopped` is asked for
    each message, and ends the conversion without a result. Raises BagError, and OSError of what is written.
    """
    options = options or ConversionOptions()
    read, write = source_format(source), target_format(target, to)
    _check_target(source, target, write, overwrite=overwrite)
    losses, messages = Losses(), dict[str, int]()
    retype = Retyping(options, write.version, losses)
    with _replacing(target) as path:
        records = _records(read, source, options, losses)
        with write.load().open_sink(path, options, losses) as sink:
            for each in records:
                if stopped():
                    raise BagError(f"{target} is not written: the conversion was stopped")
                if isinstance(each, Attachment):
                    sink.attach(each)
                    continue
                if isinstance(each, MetadataEntry):
                    sink.describe(each)
                    continue
                for record in retype(each):
                    if sink.put(record):
                        messages[record.topic] = messages.get(record.topic, 0) + 1
            if not messages:
                raise BagError(f"there is nothing to write into {target}: {_why(source, options, losses)}")
    return ConversionResult(read.name, write.name, messages, losses)


def _records(format: Format, source: Path, options: ConversionOptions, losses: Losses) -> Iterator[ConvertedItem]:
    """Iterate over what a recording has. Raises BagError, also for an error of the disk."""
    try:
        yield from format.load().read(source, options, losses)
    except OSError as error:
        raise BagError(f"can't read {error.filename or source}: {error.strerror or error}") from error


def _why(source: Path, options: ConversionOptions, losses: Losses) -> str:
    """Return why no message was written."""
    extras = {ATTACHMENTS, METADATA_RECORDS}
    found = lost_in_words(Losses({what: count for what, count in losses.items() if what not in extras}))
    if found:
        return f"{source} has {'; '.join(found)}"
    wanted = f" of {', '.join(options.topics)}" if options.topics else ""
    then = " at that time" if options.start is not None or options.end is not None else ""
    return f"{source} has no messages{wanted}{then}"


def lost_in_words(losses: Losses) -> list[str]:
    """Return a line for each kind of loss: 1 deadline, 5 stamps of publishers."""
    lines = []
    for what, count in losses.items():
        kind, space, rest = what.partition(" ")
        lines.append(f"{count} {kind.removesuffix('s') if count == 1 else kind}{space}{rest}")
    return lines


def extent(path: Path) -> tuple[int, int]:
    """Return the times of the first and the last message of a recording (UTC, ns). Raises BagError."""
    found = source_format(path)
    if found.name == "mcap":
        with Bag(path) as bag:
            return bag.start, bag.end
    records = _records(found, path, ConversionOptions(), Losses())
    times = [each.log_time for each in records if isinstance(each, ConvertedRecord)]
    return min(times, default=0), max(times, default=0)


def writable_formats() -> list[str]:
    """Return the names of the formats that can be written."""
    return [each for each in FORMATS if each not in _READ_ONLY]


def source_format(path: Path) -> Format:
    """Return the format of a recording. Raises BagError."""
    if not path.is_dir():
        found = _of_suffix(path)
        if found.name != "mcap" and not path.exists():  # a recording of ours may have parts with other names
            raise BagError(f"there is no file {path}")
        return found
    if (path / _METADATA).exists():
        return FORMATS["rosbag2"]
    for each in FORMATS.values():
        if each.is_file and any(path.rglob(f"*{each.suffixes[0]}")):
            return each
    raise BagError(f"{path} is not a recording: it has no {_METADATA}, and no files of {_suffixes()}")


def target_format(path: Path, to: str | None = None) -> Format:
    """Return the format of an output, of its suffix or the one that `to` names. Raises BagError."""
    if to is not None and to not in writable_formats():
        raise BagError(f"{to} is not a format to convert to; these are: {', '.join(writable_formats())}")
    if to is not None:
        found = FORMATS[to]
        if path.suffix not in found.suffixes and not found.is_folder:
            raise BagError(f"a file of {to} ends in {' or '.join(found.suffixes)}, and {path} does not")
        return found
    found = _of_suffix(path) if path.suffix else FORMATS["rosbag2"]
    if found.name in _READ_ONLY:
        raise BagError(f"{path}: {found.name} can be read only; a folder, as in {path.stem}/, is for rosbag2")
    return found


def _of_suffix(path: Path) -> Format:
    found = next((each for each in FORMATS.values() if each.is_file and path.suffix.lower() in each.suffixes), None)
    if found is None:
        raise BagError(f"{path}: a file's suffix says what it is, one of {_suffixes()}; rosbag2 is a folder")
    return found


def _suffixes() -> str:
    return ", ".join(suffix for each in FORMATS.values() if each.is_file for suffix in each.suffixes)


def _check_target(source: Path, target: Path, format: Format, *, overwrite: bool) -> None:
    """Raise BagError for an output that can't be replaced."""
    if not target.exists():
        if not target.parent.is_dir():
            raise BagError(f"there is no folder {target.parent} for {target.name}")
        return
    if target.resolve() == source.resolve():
        raise BagError(f"{target} is what is to be converted: choose another name for the result")
    if target.resolve() in source.resolve().parents:
        raise BagError(f"{target} has {source.name}, which is to be converted: choose another name for the result")
    if target.is_dir() and not any(target.iterdir()):
        return
    if not overwrite:
        raise BagError(f"{target} exists: choose another name, or replace it with --overwrite")
    if target.is_dir():
        foreign = next(
            (each for each in target.rglob("*") if not each.is_dir() and not _may_replace(each, format)), None
        )
        if foreign is not None:
            raise BagError(f"{target} is not replaced: it also has {foreign.name}, which is not {format.name}")
        if format.name == "rosbag2" and not (target / _METADATA).exists():  # a folder of recordings
            raise BagError(f"{target} is not replaced: it has no {_METADATA}, so it is not a recording of ROS 2")


def _may_replace(file: Path, format: Format) -> bool:
    return format.is_folder and file.suffix in format.suffixes


@contextlib.contextmanager
def _replacing(target: Path) -> Iterator[Path]:
    """Give the path of an output that takes the place of `target` at the end, and is removed after an error."""
    folder = target.with_name(f"{_PARTIAL}{target.name}")
    _remove(folder)
    folder.mkdir()
    try:
        yield folder / target.name
        if target.is_dir():
            _remove(target)
        (folder / target.name).replace(target)
    finally:
        _remove(folder)


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
