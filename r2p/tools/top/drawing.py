"""Numbers, bars and sparklines in the few characters that a cell of `r2p top` has. None, what is not known, is "-"."""

import math
from collections.abc import Sequence

UNKNOWN = "-"

_PREFIXES = "kMGT"
_BLOCKS = "▁▂▃▄▅▆▇█"
_UNITS = ((86400.0, "d"), (3600.0, "h"), (60.0, "min"))


def number(value: float | None) -> str:
    """Return a number with three digits or so: "0.25", "200.0", "1.23k"."""
    if value is None or not math.isfinite(value):
        return UNKNOWN
    size = abs(value)
    if size < 9.995:
        return f"{value:.2f}"
    if size < 999.95:
        return f"{value:.1f}"
    return _scaled(value)


def count(value: int | None) -> str:
    """Return a counter: whole up to 9999."""
    if value is None:
        return UNKNOWN
    return str(value) if abs(value) < 10_000 else _scaled(value)


def _scaled(value: float) -> str:
    power = min(len(_PREFIXES), max(1, int(math.log10(abs(value) * 1.0005) / 3)))
    value /= 1000**power
    digits = 2 if abs(value) < 9.995 else 1 if abs(value) < 99.95 else 0
    return f"{value:.{digits}f}{_PREFIXES[power - 1]}"


def milliseconds(value: float | None) -> str:
    """Return a time in seconds as milliseconds, without the unit."""
    return UNKNOWN if value is None else number(value * 1e3)


def percent(value: float | None) -> str:
    """Return a share as per cent, without the unit."""
    return UNKNOWN if value is None or not math.isfinite(value) else f"{100 * value:.1f}"


def age(value: float | None) -> str:
    """Return a time in seconds in the unit that suits it: "0.4 s", "3.0 min"."""
    if value is None or not math.isfinite(value):
        return UNKNOWN
    return next((f"{value / length:.1f} {unit}" for length, unit in _UNITS if value >= length), f"{value:.1f} s")


def answer(value: bool | None) -> str:
    """Return yes or no."""
    return UNKNOWN if value is None else "yes" if value else "no"


def text(value: str | None) -> str:
    """Return a text; an empty one is unknown."""
    return value or UNKNOWN


def shortened(name: str, width: int) -> str:
    """Return a name in so many characters. Its middle is left out: the end of a path says most, then its beginning."""
    if len(name) <= width:
        return name
    if width < 3:
        return name[:width]
    head = (width - 1) // 3
    return f"{name[:head]}…{name[len(name) - (width - 1 - head) :]}"


def sparkline(values: Sequence[float], width: int) -> str:
    """Return the newest values as blocks between the smallest and the largest one; NaN is a blank."""
    shown = values[-width:] if width > 0 else ()
    finite = [value for value in shown if math.isfinite(value)]
    if not finite:
        return " " * len(shown)
    low, high = min(finite), max(finite)
    return "".join(_block(value, low, high) for value in shown)


def _block(value: float, low: float, high: float) -> str:
    if not math.isfinite(value):
        return " "
    if high == low:
        return _BLOCKS[0]
    share = value / 2 - low / 2, high / 2 - low / 2  # halves: the difference of two large numbers may be infinite
    return _BLOCKS[min(len(_BLOCKS) - 1, int(share[0] / share[1] * len(_BLOCKS)))]


def bar(used: float | None, reserved: float | None, width: int) -> str:
    """Return a share as a bar: what is used is full, and what is reserved beyond that is shaded."""
    full = _cells(used, width)
    shaded = max(full, _cells(reserved, width))
    return "█" * full + "▒" * (shaded - full) + "·" * (width - shaded)


def _cells(share: float | None, width: int) -> int:
    return round(max(0.0, min(share, 1.0)) * width) if share is not None and math.isfinite(share) else 0
