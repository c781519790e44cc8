"""NMEA 0183, the text of GPS receivers on a serial line: the three sentences that have position and speed.

    $GPGGA,hhmmss.ss,4530.00000,N,00915.00000,E,1,09,0.9,120.0,M,48.0,M,,*hh    position, quality
    $GPRMC,hhmmss.ss,A,4530.00000,N,00915.00000,E,1.94,90.0,231126,,,A*hh       date, speed (knots), course
    $GPVTG,90.0,T,,M,1.94,N,3.60,K,A*hh                                         course, speed

A sentence ends with CR LF. `hh` is the exclusive or of the characters between `$` and `*`. Angles are degrees times 100
plus minutes. A receiver without a fix leaves fields empty. The talker, here GP, is any two letters.
"""

import functools
import math
import operator
import re
from collections.abc import Callable

import msgspec

SENTENCE_MAX = 128
"""Characters of a sentence. The standard has 82; receivers with more digits exceed it."""

_KNOT, _KMH = 1852 / 3600, 1 / 3.6  # m/s
_START, _END = ord("$"), ord("\n")
_WHOLE = re.compile(rb"\$([A-Z]{2})([A-Z]{3}),([ -~]*)\*([0-9A-Fa-f]{2})\Z")
_TIME = re.compile(r"([01]\d|2[0-3])([0-5]\d)([0-5]\d)(?:\.(\d{1,9}))?\Z", re.ASCII)
_DATE = re.compile(r"(0[1-9]|[12]\d|3[01])(0[1-9]|1[0-2])(\d\d)\Z", re.ASCII)
_ANGLE = re.compile(r"(\d{2,3})([0-5]\d(?:\.\d{1,9})?)\Z", re.ASCII)
_NUMBER = re.compile(r"-?\d{1,9}(?:\.\d{1,9})?\Z", re.ASCII)


class Gga(msgspec.Struct, frozen=True, kw_only=True):
    """A fix: where, when, and how good."""

    time: int | None = None
    """Of the measurement, ns since midnight, UTC."""
    latitude: float | None = None
    """Degrees, north is positive."""
    longitude: float | None = None
    """Degrees, east is positive."""
    quality: int = 0
    """0 none, 1 GPS, 2 differential, 4 RTK, 5 float RTK."""
    satellites: int = 0
    """In use."""
    hdop: float | None = None
    """Horizontal dilution of precision."""
    altitude: float | None = None
    """Above mean sea level, m."""
    geoid: float | None = None
    """Mean sea level above the ellipsoid, m."""


class Rmc(msgspec.Struct, frozen=True, kw_only=True):
    """The least that navigation needs."""

    time: int | None = None
    """Of the measurement, ns since midnight, UTC."""
    date: tuple[int, int, int] | None = None
    """Year, month and day."""
    valid: bool = False
    latitude: float | None = None
    """Degrees, north is positive."""
    longitude: float | None = None
    """Degrees, east is positive."""
    speed: float | None = None
    """Over ground, m/s."""
    course: float | None = None
    """Over ground, degrees clockwise from true north."""


class Vtg(msgspec.Struct, frozen=True, kw_only=True):
    """Course and speed over ground."""

    course: float | None = None
    """Degrees clockwise from true north."""
    speed: float | None = None
    """m/s."""


Sentence = Gga | Rmc | Vtg


def checksum(characters: bytes) -> int:
    """Return the sum of the characters between `$` and `*`."""
    return functools.reduce(operator.xor, characters, 0)


def encode(sentence: Sentence, talker: str = "GP") -> bytes:
    """Return a sentence as a line. Values that are None are empty fields."""
    match sentence:
        case Gga():
            kind, fields = "GGA", _gga_fields(sentence)
        case Rmc():
            kind, fields = "RMC", _rmc_fields(sentence)
        case Vtg():
            kind, fields = "VTG", _vtg_fields(sentence)
    text = f"{talker}{kind},{','.join(fields)}".encode("ascii")
    return b"$%b*%02X\r\n" % (text, checksum(text))


class NmeaReader:
    """Turns a stream into sentences. It never fails: anything else is counted by reason in `drops`.

    | reason | received |
    | --- | --- |
    | garbage | anything between sentences, once for each line |
    | cut short | a `$` or a line end inside a sentence, before its checksum |
    | too long | more than 128 characters without a line end |
    | checksum | a wrong sum |
    | bad field | a right sum, and a field that has another form, or is missing |
    | other sentence | not GGA, RMC or VTG: receivers also send satellites in view, and text |

    The reader holds at most one unfinished sentence.
    """

    def __init__(self, drops: dict[str, int] | None = None) -> None:
        """`drops` is the counter to use, if several readers share one."""
        self.drops: dict[str, int] = {} if drops is None else drops
        self._held = bytearray()
        self._skips = False  # the rest of the line is counted already

    def feed(self, data: bytes) -> list[Sentence]:
        """Return the sentences that these bytes complete, in order."""
        sentences = []
        for byte in data:
            if byte == _END:
                sentence = self._line_end()
                if sentence is not None:
                    sentences.append(sentence)
            elif byte == _START:
                if self._held:
                    self._drop("cut short" if self._held[0] == _START else "garbage")
                self._held[:] = b"$"
                self._skips = False
            elif not self._skips:
                self._held.append(byte)
                if len(self._held) > SENTENCE_MAX:
                    self._drop("too long" if self._held[0] == _START else "garbage")
                    self._held.clear()
                    self._skips = True
        return sentences

    def _line_end(self) -> Sentence | None:
        line = bytes(self._held.rstrip(b"\r"))
        self._held.clear()
        self._skips = False
        if not line:
            return None
        whole = _WHOLE.match(line)
        if whole is None:
            if line[0] != _START:
                self._drop("garbage")
            else:
                self._drop("cut short" if b"*" not in line[-3:-2] else "bad field")
            return None
        if checksum(line[1:-3]) != int(whole[4], 16):
            self._drop("checksum")
            return None
        decode = _DECODERS.get(whole[2])
        if decode is None:
            self._drop("other sentence")
            return None
        try:
            return decode(whole[3].decode("ascii").split(","))
        except (ValueError, IndexError):
            self._drop("bad field")
            return None

    def _drop(self, reason: str) -> None:
        self.drops[reason] = self.drops.get(reason, 0) + 1


# Fields to text


def _gga_fields(fix: Gga) -> list[str]:
    return [
        _of_time(fix.time),
        *_of_angle(fix.latitude, 2, "NS"),
        *_of_angle(fix.longitude, 3, "EW"),
        str(fix.quality),
        f"{fix.satellites:02}",
        _of(fix.hdop, 1),
        *(_of(fix.altitude, 1), "M", _of(fix.geoid, 1), "M"),
        *("", ""),
    ]


def _rmc_fields(fix: Rmc) -> list[str]:
    date = "" if fix.date is None else f"{fix.date[2]:02}{fix.date[1]:02}{fix.date[0] % 100:02}"
    return [
        _of_time(fix.time),
        "A" if fix.valid else "V",
        *_of_angle(fix.latitude, 2, "NS"),
        *_of_angle(fix.longitude, 3, "EW"),
        _of(fix.speed, 3, _KNOT),
        _of(fix.course, 2),
        date,
        *("", ""),
        "A" if fix.valid else "N",
    ]


def _vtg_fields(fix: Vtg) -> list[str]:
    mode = "N" if fix.speed is None else "A"
    return [_of(fix.course, 2), "T", "", "M", _of(fix.speed, 3, _KNOT), "N", _of(fix.speed, 3, _KMH), "K", mode]


def _of(value: float | None, digits: int, unit: float = 1.0) -> str:
    return "" if value is None else f"{value / unit:.{digits}f}"


def _of_time(time: int | None) -> str:
    if time is None:
        return ""
    hundredths = time // 10_000_000
    seconds, rest = divmod(hundredths, 100)
    return f"{seconds // 3600:02}{seconds // 60 % 60:02}{seconds % 60:02}.{rest:02}"


def _of_angle(angle: float | None, digits: int, letters: str) -> tuple[str, str]:
    """Return degrees and minutes as a field, and the letter of the hemisphere as another."""
    if angle is None:
        return "", ""
    minutes = round(abs(angle) * 60 * 100_000)  # whole ones, so that 60 minutes are never written
    degrees, rest = divmod(minutes, 60 * 100_000)
    return f"{degrees:0{digits}}{rest // 100_000:02}.{rest % 100_000:05}", letters[angle < 0]


# Text to fields. Raise ValueError or IndexError for what is not one.


def _to_gga(fields: list[str]) -> Gga:
    return Gga(
        time=_to_time(fields[0]),
        latitude=_to_angle(fields[1], fields[2], "NS", 90),
        longitude=_to_angle(fields[3], fields[4], "EW", 180),
        quality=int(_required(fields[5])),
        satellites=int(_to(fields[6]) or 0),
        hdop=_to(fields[7]),
        altitude=_to(fields[8]),
        geoid=_to(fields[10]),
    )


def _to_rmc(fields: list[str]) -> Rmc:
    if fields[1] not in ("A", "V"):
        raise ValueError(fields[1])
    return Rmc(
        time=_to_time(fields[0]),
        date=_to_date(fields[8]),
        valid=fields[1] == "A",
        latitude=_to_angle(fields[2], fields[3], "NS", 90),
        longitude=_to_angle(fields[4], fields[5], "EW", 180),
        speed=_to(fields[6], _KNOT),
        course=_to(fields[7]),
    )


def _to_vtg(fields: list[str]) -> Vtg:
    return Vtg(course=_to(fields[0]), speed=_to(fields[4], _KNOT))


def _to(text: str, unit: float = 1.0) -> float | None:
    if not text:
        return None
    return _required(text) * unit


def _required(text: str) -> float:
    if not _NUMBER.match(text):
        raise ValueError(text)
    return float(text)


def _to_time(text: str) -> int | None:
    if not text:
        return None
    parts = _TIME.match(text)
    if parts is None:
        raise ValueError(text)
    hours, minutes, seconds = (int(parts[each]) for each in (1, 2, 3))
    return ((hours * 60 + minutes) * 60 + seconds) * 1_000_000_000 + int((parts[4] or "0").ljust(9, "0"))


def _to_date(text: str) -> tuple[int, int, int] | None:
    if not text:
        return None
    parts = _DATE.match(text)
    if parts is None:
        raise ValueError(text)
    day, month, year = (int(each) for each in parts.groups())
    return (1900 if year >= 80 else 2000) + year, month, day  # GPS began in 1980


def _to_angle(text: str, letter: str, letters: str, most: int) -> float | None:
    if not text:
        return None
    parts = _ANGLE.match(text)
    if parts is None or len(letter) != 1 or letter not in letters:
        raise ValueError(text)
    angle = int(parts[1]) + float(parts[2]) / 60
    if not angle <= most:
        raise ValueError(text)
    return math.copysign(angle, 1 if letter == letters[0] else -1)


_DECODERS: dict[bytes, Callable[[list[str]], Sentence]] = {b"GGA": _to_gga, b"RMC": _to_rmc, b"VTG": _to_vtg}
