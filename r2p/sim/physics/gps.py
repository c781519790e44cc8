"""A GPS receiver: it measures at whole multiples of its period in UTC, and sends text on a serial line a little later.

Its position has two errors: noise from fix to fix, and one that wanders for half a minute, as that of the atmosphere
and of reflections does. Only the second one is left after averaging.
"""

import math
import random
from collections import deque
from collections.abc import Callable
from datetime import UTC, datetime

import msgspec

from r2p.codecs.nmea import Gga, Rmc, Vtg, encode
from r2p.units import SECOND

_DAY = 86_400 * SECOND
_BITS = 10  # of a character on the line, with its start and stop bits


class GpsSpec(msgspec.Struct, frozen=True, kw_only=True):
    """Data sheet. Default: an assumption, of about the error of a receiver with SBAS and a free view."""

    rate: int = 5
    """Fixes per second, 1 to 10."""
    noise: float = 0.5
    """Noise of a fix in each direction, one sigma, m."""
    wander: float = 0.5
    """Of the error that wanders, one sigma, m."""
    wander_time: float = 30.0
    """s, after which it has forgotten 63 % of what it was."""
    height: float = 2.0
    """The error of the height is as many times larger."""
    speed_noise: float = 0.05
    """Of the speed in each direction, one sigma, m/s."""
    latency: float = 0.08
    """From the measurement to the first character, s."""
    jitter: float = 0.01
    """Up to so much more, s."""
    baud: int = 38_400
    """Of the serial line: three sentences take 50 ms; at 9600 Baud 5 Hz would not fit."""
    hdop: float = 0.9
    satellites: int = 9


class GeoOrigin(msgspec.Struct, frozen=True):
    """Where the world's origin is on Earth: x points north there, and y west."""

    latitude: float = 45.478
    """Degrees."""
    longitude: float = 9.227
    altitude: float = 120.0
    """m."""

    def geographic(self, x: float, y: float) -> tuple[float, float]:
        """Return latitude and longitude of a point of the world (m)."""
        north, east = self._degree()
        return self.latitude + x / north, self.longitude - y / east

    def local(self, latitude: float, longitude: float) -> tuple[float, float]:
        """Return the point of the world (m): exact to a millimetre within some hundred metres."""
        north, east = self._degree()
        return (latitude - self.latitude) * north, (self.longitude - longitude) * east

    def _degree(self) -> tuple[float, float]:
        """Return the lengths of a degree to the north and to the east (m): the radii of WGS 84 times pi / 180."""
        axis, e2 = 6_378_137.0, 6.694379990e-3
        phi = math.radians(self.latitude)
        bend = 1 - e2 * math.sin(phi) ** 2
        meridian, normal = axis * (1 - e2) / bend**1.5, axis / math.sqrt(bend)
        return math.radians(meridian), math.radians(normal * math.cos(phi))


class GpsTruth(msgspec.Struct, frozen=True):
    """Where the antenna is, and how it moves: m, and m/s."""

    x: float = 0.0
    y: float = 0.0
    vx: float = 0.0
    vy: float = 0.0


class GpsReceiver:
    """The receiver; it is a part of a `Plant`. `on_data` gets what its serial line carries, as it arrives."""

    def __init__(
        self, spec: GpsSpec, truth: Callable[[], GpsTruth], now: Callable[[], int], noise: random.Random
    ) -> None:
        """`now` returns UTC in ns."""
        self.spec = spec
        self.origin = GeoOrigin()
        self.has_sky = True
        """False: it sees no satellite, and sends sentences without a fix."""
        self.connected = True
        """False: its plug is pulled."""
        self.on_data: Callable[[bytes], object] = lambda data: None
        self.last: tuple[float, float] | None = None
        """The last position that it measured, in the world (m)."""
        self._truth = truth
        self._now = now
        self._noise = noise
        self._wander = [noise.gauss(0, spec.wander) for _ in range(3)]
        self._period = SECOND // spec.rate
        self._fixes = now() // self._period
        self._sending: deque[tuple[int, bytes]] = deque()  # when the first character begins (ns), and the text

    def step(self, _dt: float) -> None:
        """Measure if it is time, and send what is due."""
        now = self._now()
        fixes = now // self._period
        if fixes != self._fixes:
            self._fixes = fixes
            self._measure(fixes * self._period)
        self._send(now)

    def _measure(self, time: int) -> None:
        spec = self.spec
        keep = math.exp(-1 / spec.rate / spec.wander_time)
        self._wander = [
            each * keep + self._noise.gauss(0, spec.wander * math.sqrt(1 - keep * keep)) for each in self._wander
        ]
        text = self._fix(time) if self.has_sky else _no_fix(time)
        late = spec.latency + self._noise.uniform(0, spec.jitter)
        begins = time + round(late * SECOND)
        if self._sending:  # the line is busy
            begun, before = self._sending[-1]
            begins = max(begins, begun + self.duration(len(before)))
        self._sending.append((begins, text))

    def _fix(self, time: int) -> bytes:
        spec, truth, gauss = self.spec, self._truth(), self._noise.gauss
        errors = [each + gauss(0, spec.noise) for each in self._wander]
        self.last = x, y = truth.x + errors[0], truth.y + errors[1]
        latitude, longitude = self.origin.geographic(x, y)
        vx, vy = truth.vx + gauss(0, spec.speed_noise), truth.vy + gauss(0, spec.speed_noise)
        speed, course = math.hypot(vx, vy), math.degrees(math.atan2(-vy, vx)) % 360
        gga = Gga(
            time=time % _DAY,
            latitude=latitude,
            longitude=longitude,
            quality=1,
            satellites=spec.satellites,
            hdop=spec.hdop,
            altitude=self.origin.altitude + spec.height * errors[2],
            geoid=48.0,
        )
        rmc = Rmc(
            time=time % _DAY,
            date=_date(time),
            valid=True,
            latitude=latitude,
            longitude=longitude,
            speed=speed,
            course=course,
        )
        return encode(gga) + encode(rmc) + encode(Vtg(course=course, speed=speed))

    def _send(self, now: int) -> None:
        """Hand over the text whose last character has arrived; a UART with DMA does so when the line gets idle."""
        while self._sending:
            begins, text = self._sending[0]
            if now < begins + self.duration(len(text)):
                return
            self._sending.popleft()
            if self.connected:
                self.on_data(text)

    def duration(self, characters: int) -> int:
        """Return how long so many characters take on the line, ns."""
        return characters * _BITS * SECOND // self.spec.baud


def _no_fix(time: int) -> bytes:
    midnight = time % _DAY
    return encode(Gga(time=midnight)) + encode(Rmc(time=midnight, date=_date(time))) + encode(Vtg())


def _date(time: int) -> tuple[int, int, int]:
    day = datetime.fromtimestamp(time // SECOND, UTC)
    return day.year, day.month, day.day
