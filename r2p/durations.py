"""Durations: numbers of seconds in programs, texts such as "10ms" in URLs, in files and on the command line."""

import math
import re

from r2p.errors import MessageError

SHORTEST = 1e-6
"""Seconds of the shortest period or deadline."""

LONGEST = 1e9
"""Seconds of the longest one."""

_UNITS = {"ns": 1e-9, "us": 1e-6, "ms": 1e-3, "s": 1.0, "": 1.0}


def duration(text: str) -> float:
    """Seconds from "10ms", "20us", "1.5s" or "1.5". Raises ValueError for what is none of these."""
    match = re.fullmatch(r"([0-9.eE+-]+)\s*(ns|us|ms|s|)", text.strip())
    if match is None:
        raise ValueError(f"{text!r} is no duration: use 10ms, 20us or seconds")
    value = float(match[1]) * _UNITS[match[2]]
    if not 0.0 <= value < math.inf:
        raise ValueError(f"{text!r} is no duration: it can't be negative or endless")
    return value


def seconds(what: str, value: object, *, least: float) -> None:
    """Raise MessageError for what is not a duration of `least` seconds or more that a clock can count."""
    if not _is_number(value) or not least <= value <= LONGEST:  # type: ignore[operator]
        raise MessageError(f"{what} is in seconds, {least:g} to {LONGEST:g}, not {value!r}{_hint(value)}")


def timeout_or_none(what: str, value: object) -> None:
    """Raise MessageError for what is neither None (for ever) nor a number of seconds; below 0 all is over already."""
    if value is not None and (not _is_number(value) or not value <= LONGEST):  # type: ignore[operator]
        raise MessageError(f"{what} is in seconds, or None to wait for ever, not {value!r}{_hint(value)}")


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _hint(value: object) -> str:
    """A text as in a URL has a meaning."""
    try:
        return f": write {duration(value):g}" if isinstance(value, str) else ""
    except ValueError:
        return ""
