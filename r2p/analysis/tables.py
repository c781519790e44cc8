"""Message sets as text: CSV with a row for each message, and TOML with a table for each.

CSV has the columns `name` and `bytes`, and may have `node`, `id`, `period_ms`, `deadline_ms`, `jitter_ms`, `class`
(`hrt`, `srt`, `nrt` on RTCAN; else empty or `can`), `extended` and `bits`; others are ignored. TOML has the same
without `_ms`, as texts with a unit, and may have the bus:

    [bus]
    bitrate = 1_000_000
    slots = 60
    cycle = "10ms"

    [[message]]
    name = "bumper"
    bytes = 8
    class = "srt"
    period = "20ms"
    deadline = "5ms"

A deadline that is missing is the period. Identifiers are numbers, also as 0x123, of 29 bits if they have more than 11;
without any, the messages have priority in the order of the file.
"""

import csv
import io
import tomllib
from collections.abc import Iterable, Mapping
from typing import Any

import msgspec

from r2p.analysis.messages import BusMessage, MessageClass, check_message
from r2p.clock import duration
from r2p.codecs.can_bits import STANDARD_BITS
from r2p.errors import MessageError
from r2p.units import MILLISECOND, SECOND

_LONGEST = 1e9  # s; above it surely a typing error
_COLUMNS = ("name", "node", "id", "bytes", "period_ms", "deadline_ms", "jitter_ms", "class", "extended")
_YES = {"1", "true", "yes"}


class MessageSet(msgspec.Struct):
    """Messages, and what their file says of the bus: bit/s, slots in a cycle, nominal length (ns); None: nothing."""

    messages: list[BusMessage]
    bitrate: int | None = None
    slots: int | None = None
    cycle: int | None = None


def read_csv(text: str) -> MessageSet:
    """Return the messages of a CSV file. Raises `MessageError` if the text is not a valid one."""
    lines = [line for line in text.splitlines() if line.strip() and not line.startswith("#")]
    rows = list(csv.DictReader(lines))
    if not rows or not {"name", "bytes"} <= rows[0].keys():
        raise MessageError("a CSV file of messages begins with the names of its columns: name,bytes,period_ms,...")
    return MessageSet(_numbered([_message(_without_unit(row)) for row in rows]))


def read_toml(text: str) -> MessageSet:
    """Return the messages of a TOML file, and its bus. Raises `MessageError` if the text is not a valid one."""
    try:
        tables = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise MessageError(f"not TOML: {error}") from error
    bus, messages = tables.get("bus", {}), tables.get("message", [])
    tidy = isinstance(bus, dict) and isinstance(messages, list) and all(isinstance(each, dict) for each in messages)
    if not (tidy and messages):
        raise MessageError("a TOML file of messages has a table [[message]] for each of them")
    found = MessageSet(_numbered([_message(each) for each in messages]))
    found.bitrate, found.slots = _number(bus, "bitrate"), _number(bus, "slots")
    found.cycle = _time(bus, "cycle")
    return found


def write_csv(messages: Iterable[BusMessage]) -> str:
    """Return messages as CSV, as `read_csv` takes it."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(_COLUMNS)
    for each in messages:
        times = [None if time is None else f"{time / MILLISECOND:.9g}" for time in (each.period, each.deadline)]
        kind = each.message_class.value
        writer.writerow(
            [each.name, each.node, each.id, each.size, *times, f"{each.jitter / MILLISECOND:.9g}", kind, each.extended]
        )
    return text.getvalue()


def _without_unit(row: Mapping[str, Any]) -> dict[str, Any]:
    """Return a row of CSV with the names and units of TOML, without empty cells."""
    found: dict[str, Any] = {}
    for name, value in row.items():
        if isinstance(value, str) and value.strip():
            plain = name.removesuffix("_ms")
            found[plain] = value.strip() + ("ms" if plain != name else "")
    return found


def _message(table: Mapping[str, Any]) -> BusMessage:
    if "name" not in table or "bytes" not in table:
        raise MessageError("each message has a name and bytes")
    size, identifier, kind = _number(table, "bytes"), _number(table, "id"), _class_of(table)
    period = _time(table, "period")
    deadline = _time(table, "deadline") or (period if kind is not MessageClass.NRT else None)
    wide = (identifier or 0) >> STANDARD_BITS > 0 and kind is MessageClass.PLAIN
    message = BusMessage(
        name=str(table["name"]),
        size=-1 if size is None else size,
        period=period,
        deadline=deadline,
        jitter=_time(table, "jitter") or 0,
        node=str(table.get("node", "")),
        id=-1 if identifier is None else identifier,
        extended=wide or str(table.get("extended", "")).lower() in _YES,
        message_class=kind,
        bits=_number(table, "bits"),
    )
    check_message(msgspec.structs.replace(message, id=max(message.id, 0)))
    return message


def _numbered(messages: list[BusMessage]) -> list[BusMessage]:
    """Give messages without identifiers those of their order."""
    without = [each.name for each in messages if each.id < 0]
    if not without:
        return messages
    if len(without) < len(messages):
        raise MessageError(f"{without[0]} has no id: give all messages one, or none, if they are in order of priority")
    wide = len(messages) >> STANDARD_BITS > 0
    return [
        msgspec.structs.replace(each, id=number, extended=each.extended or wide)
        for number, each in enumerate(messages, start=1)
    ]


def _class_of(table: Mapping[str, Any]) -> MessageClass:
    text = str(table.get("class", "can"))
    try:
        return MessageClass(text.lower())
    except ValueError as error:
        names = ", ".join(each.value for each in MessageClass)
        raise MessageError(f"{table['name']}: the class {text!r} is none of {names}") from error


def _number(table: Mapping[str, Any], key: str) -> int | None:
    value = table.get(key)
    if value is None:
        return None
    try:
        return int(value, 0) if isinstance(value, str) else int(value)
    except (TypeError, ValueError) as error:
        raise MessageError(f"{table.get('name', 'bus')}: {key} is {value!r}: write a whole number") from error


def _time(table: Mapping[str, Any], key: str) -> int | None:
    """Return a time in ns."""
    value = table.get(key)
    if value is None:
        return None
    try:
        seconds = duration(str(value))
    except ValueError:
        seconds = -1.0
    if not 0 <= seconds <= _LONGEST:
        raise MessageError(f"{table.get('name', 'bus')}: {key} is {value!r}: write a time, such as 5ms")
    return round(seconds * SECOND)
