"""The part of each message that `r2p topic echo` and `r2p bag echo` print, and their common options."""

from typing import Annotated, Any, TypeAlias

import msgspec
import typer

import r2p
from r2p.messages.values import META, Form, flatten, pick, to_plain
from r2p.tools.output import Output, notify
from r2p.tools.session import UsageError
from r2p.tools.topic.filter import Filter, FilterError

_HEX = "data"  # the field of a message of unknown type

Content: TypeAlias = r2p.Message | dict[str, Any]
"""A message, or, if its type is unknown, a record with its bytes in hex."""

Fields = Annotated[
    list[str] | None,
    typer.Option("--field", metavar="PATH", help="Only this field: x, stamp.sec, value[0] (repeatable)."),
]
FilterText = Annotated[
    str | None,
    typer.Option("--filter", metavar="EXPR", help="Only messages for which it is true: 'x > 3 and abs(w) < 0.1'."),
]
Full = Annotated[bool, typer.Option("--full", help="Print long arrays and texts whole at a terminal, too.")]
Meta = Annotated[bool, typer.Option("--meta", help="Add topic, stamp, source and sequence, under `_`.")]


def form_of(output: Output, *, full: bool) -> Form:
    """Return how much of a message is printed."""
    return "cells" if output.format == "csv" else "whole" if full or output.format == "json" else "short"


def as_hex(data: bytes) -> dict[str, Any]:
    """Return a message of unknown type as a record."""
    return {_HEX: data.hex()}


class Selection(msgspec.Struct):
    """The printed part of a message: the `fields` that the user chose, in a `form`, and where it comes from.

    A content of unknown type is a record with its bytes in hex. Of several `topics` only one needs to have a field:
    `lacking` are the topics without it, by field.
    """

    topics: list[str]
    fields: list[str]
    meta: bool
    form: Form
    lacking: dict[str, set[str]] = {}

    @property
    def labelled(self) -> bool:
        """True if a column names the topic of each row: CSV has one header for all topics."""
        return self.form == "cells" and len(self.topics) > 1

    def of(self, topic: str, content: Content, sample: r2p.Sample | None) -> dict[str, Any]:
        """Return the record to print. Raises UsageError for a field that no topic has."""
        if self.fields:
            record = self._chosen(topic, content)
        else:
            record = to_plain(content, self.form) if isinstance(content, r2p.Message) else content
        return self.label(topic, record, sample)

    def label(self, topic: str, row: dict[str, Any], sample: r2p.Sample | None) -> dict[str, Any]:
        """Return a row with the topic, and with what else --meta adds."""
        if self.labelled:
            row = {"topic": topic} | {"topic_" if name == "topic" else name: value for name, value in row.items()}
        if self.meta or (len(self.topics) > 1 and self.form != "cells"):
            row[META] = origin(topic, sample)
        return row

    def columns(self, topic: str, cls: type[r2p.Message] | None) -> list[str]:
        """Return the columns of CSV that the messages of a topic will have, as far as their type is known."""
        if cls is None:  # they are in hex, or have these fields once their type is known
            return list(flatten(self.label(topic, dict.fromkeys(self.fields or [_HEX], ""), None)))
        return list(flatten(self.of(topic, r2p.layout(cls).zero, None)))

    def _chosen(self, topic: str, content: Content) -> dict[str, Any]:
        row = {}
        for path in self.fields:
            lacking = self.lacking.setdefault(path, set())
            try:
                row[path] = self._pick(content, path)
                lacking.discard(topic)  # its type was not known before
            except KeyError as error:
                self._note_lacking(topic, path, lacking, error.args[0])
        return row

    def _pick(self, content: Content, path: str) -> Any:
        if isinstance(content, r2p.Message):
            return pick(content, path, self.form)
        if path not in content:
            raise KeyError(f"there is no field {path}; the fields are {', '.join(content)}")
        return content[path]

    def _note_lacking(self, topic: str, path: str, lacking: set[str], problem: str) -> None:
        """Report once that a topic lacks a field. Raises UsageError if none of them has it."""
        is_new = topic not in lacking
        lacking.add(topic)
        if len(lacking) == len(self.topics):
            raise UsageError(problem if len(lacking) == 1 else f"no topic has a field {path}; of {topic}: {problem}")
        if is_new:
            notify(f"{topic} has no field {path}: left out there")


def filter_for(text: str | None, cls: type[r2p.Message] | None) -> Filter | None:
    """Return the filter of one topic, for its type if that is stated. Raises UsageError."""
    if text is None:
        return None
    try:
        made = Filter(text)
        if cls is not None:
            made.bind(cls)
    except FilterError as error:
        raise UsageError(str(error)) from error
    return made


def origin(topic: str, sample: r2p.Sample | None) -> dict[str, Any]:
    """Return where a message comes from; without a sample, only the keys."""
    if sample is None:
        return dict.fromkeys(("topic", "stamp", "stamp_from", "source", "sequence"))
    meta = {
        "topic": topic,
        "stamp": sample.stamp,
        "stamp_from": "sender" if sample.stamped else "reception",
        "source": str(sample.source),
        "sequence": sample.sequence or None,
    }
    if sample.clock is not None:
        meta["clock"] = msgspec.to_builtins(sample.clock)
    return meta
