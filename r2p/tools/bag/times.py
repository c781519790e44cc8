"""Instants of a recording on the command line: `--start`, `--end`, and how they are shown.

12.5, 90s, 1m30s   after the start of the recording
-10s               before its end
14:03, 14:03:05.2  a time of day, by the clock of this computer, on the day of the recording
2026-11-23T14:03Z  ISO 8601; without a zone by the clock of this computer
1763906585.25      seconds since 1970, as candump has it, or nanoseconds, as `stamp` in the output of echo
"""

import datetime
import re
from decimal import Decimal
from typing import Annotated, Any, Final

import msgspec
import typer

from r2p.tools.config import UsageError
from r2p.units import SECOND

_EPOCH: Final = datetime.datetime(1970, 1, 1, tzinfo=datetime.UTC)
_PART: Final = r"(?:\d+(?:\.\d*)?|\.\d+)"
_NUMBER: Final = re.compile(rf"-?{_PART}", re.ASCII)
_DURATION: Final = re.compile(rf"(-?)(?:({_PART})h)?(?:({_PART})m)?(?:({_PART})s)?(?:({_PART})ms)?", re.ASCII)
_SECONDS: Final = (Decimal(3600), Decimal(60), Decimal(1), Decimal("0.001"))
_TIME_OF_DAY: Final = re.compile(r"(\d{1,2}):(\d\d)(?::(\d\d)(\.\d{1,9})?)?", re.ASCII)
_ISO: Final = re.compile(r"(\d{4}-\d\d-\d\d[T ]\d\d:?\d\d(?::?\d\d)?)(\.\d{1,9})?\s*(Z|[+-]\d\d:?\d\d)?", re.ASCII)
_SINCE_1970: Final = 10**9  # seconds from which a number is no longer that of a recording's length
_IN_NS: Final = 10**15  # ... and from which it is in ns
_DIGITS: Final = 30

FORMS: Final = "12.5, 1m30s, -10s (before the end), 14:03, 14:03:05 or 2026-11-23T14:03:05Z"


class Moment(msgspec.Struct, frozen=True):
    """An instant as it was written: `offset` ns after the start, or before the end if negative; a time of day (ns since
    midnight); or `utc` (ns since 1970).
    """

    text: str
    offset: int | None = None
    time_of_day: int | None = None
    utc: int = 0
    from_end: bool = False

    def instant(self, start: int, end: int) -> int:
        """Return the instant (UTC, ns) in a recording from `start` to `end`."""
        if self.offset is not None:
            return end + self.offset if self.from_end else start + self.offset
        if self.time_of_day is not None:
            return _nearest(self.time_of_day, start, end)
        return self.utc


def moment(text: str) -> Moment:
    """Parse an instant of a recording."""
    stripped = text.strip()
    try:
        found = _number(stripped) or _duration(stripped) or _on_a_day(stripped) or _iso(stripped)
    except (ValueError, OverflowError, OSError):
        found = None
    if found is None:
        raise typer.BadParameter(f"{text[:40]!r} is not an instant of a recording: write {FORMS}")
    return found


def moment_option(name: str, help: str) -> Any:
    """Return an option with an instant of a recording."""
    return typer.Option(name, parser=moment, metavar="WHEN", help=help)


Start = Annotated[Any, moment_option("--start", "Begin here: 12.5, 1m30s, -10s (before the end), 14:03, ISO 8601.")]
End = Annotated[Any, moment_option("--end", "End here, as --start.")]


def span(recorded: tuple[int, int], start: Moment | None, end: Moment | None) -> tuple[int | None, int | None]:
    """Return the instants of two options in a recording whose first and last message are at `recorded` (UTC, ns).

    Raises UsageError if nothing of the recording is between them.
    """
    first = None if start is None else start.instant(*recorded)
    last = None if end is None else end.instant(*recorded)
    between = f"the recording is from {shown(recorded[0])} to {shown(recorded[1])}"
    if start is not None and first is not None and first > recorded[1]:
        raise UsageError(f"--start {start.text} is after the end: {between}")
    if end is not None and last is not None and last <= recorded[0]:
        raise UsageError(f"--end {end.text} is before the start: {between}")
    if start is not None and end is not None and first is not None and last is not None and first >= last:
        raise UsageError(f"--end {end.text} is not after --start {start.text}: {between}")
    return first, last


def shown(instant: int, *, date: bool = True) -> str:
    """Return an instant (UTC, ns) by the clock of this computer: 2026-11-23 14:03:05.250."""
    local = _datetime(instant).astimezone()
    text = f"{local:%H:%M:%S}.{instant // 1_000_000 % 1000:03}"
    return f"{local:%Y-%m-%d} {text}" if date else text


def iso(instant: int) -> str:
    """Return an instant (UTC, ns) as ISO 8601 in UTC, with all digits."""
    return f"{_datetime(instant):%Y-%m-%dT%H:%M:%S}.{instant % SECOND:09}Z"


def length(ns: int) -> str:
    """Return a duration in words: 312 ms, 12.5 s, 3 min 05 s, 1 h 02 min 03 s, 3 d 4 h."""
    seconds = ns / SECOND
    if seconds < 1:
        return f"{seconds * 1000:.0f} ms"
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    if hours >= 48:
        return f"{hours // 24} d {hours % 24} h"
    return f"{hours} h {minutes:02} min {rest:02} s" if hours else f"{minutes} min {rest:02} s"


def _number(text: str) -> Moment | None:
    if not _NUMBER.fullmatch(text) or len(text) > _DIGITS:
        return None
    value = Decimal(text)
    if value >= _IN_NS:
        return Moment(text, utc=int(value))
    if value >= _SINCE_1970:
        return Moment(text, utc=int(value * SECOND))
    return Moment(text, int(value * SECOND), from_end=text.startswith("-"))


def _duration(text: str) -> Moment | None:
    match = _DURATION.fullmatch(text)
    if match is None or not any(match.groups()[1:]) or len(text) > _DIGITS:
        return None
    parts = zip(match.groups()[1:], _SECONDS, strict=True)
    total = sum((Decimal(value) * unit for value, unit in parts if value), Decimal(0))
    return Moment(text, int(total * SECOND) * (-1 if match[1] else 1), from_end=bool(match[1]))


def _on_a_day(text: str) -> Moment | None:
    match = _TIME_OF_DAY.fullmatch(text)
    if match is None:
        return None
    hours, minutes, seconds = int(match[1]), int(match[2]), int(match[3] or 0)
    datetime.time(hours, minutes, seconds)  # raises ValueError
    return Moment(text, time_of_day=(hours * 3600 + minutes * 60 + seconds) * SECOND + _fraction(match[4]))


def _iso(text: str) -> Moment | None:
    match = _ISO.fullmatch(text)
    if match is None:
        return None
    parsed = datetime.datetime.fromisoformat(match[1].replace(" ", "T") + (match[3] or "").replace("Z", "+00:00"))
    since = parsed.astimezone(datetime.UTC) - _EPOCH
    return Moment(text, utc=(since.days * 86_400 + since.seconds) * SECOND + _fraction(match[2]))


def _fraction(text: str | None) -> int:
    return int(Decimal(text or 0) * SECOND)


def _nearest(time_of_day: int, start: int, end: int) -> int:
    """Return the instant with this time of day in the recording, or the one that is nearest to it."""
    first, last = _datetime(start).astimezone().date(), _datetime(end).astimezone().date()
    day = datetime.timedelta(days=1)
    days = {first - day, first, first + day, last, last + day}
    seconds, rest = divmod(time_of_day, SECOND)
    clock = datetime.time(seconds // 3600, seconds // 60 % 60, seconds % 60)
    since = (datetime.datetime.combine(each, clock).astimezone(datetime.UTC) - _EPOCH for each in sorted(days))
    instants = [(each.days * 86_400 + each.seconds) * SECOND + rest for each in since]
    return min(instants, key=lambda each: max(start - each, each - end, 0))


def _datetime(instant: int) -> datetime.datetime:
    return _EPOCH + datetime.timedelta(microseconds=instant // 1000)
