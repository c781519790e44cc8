"""The GPS receiver: its errors are those of its data sheet, and its text arrives when the line can have sent it."""

import math
import random
import statistics
from collections.abc import Callable

import pytest

from r2p.codecs.nmea import Gga, NmeaReader, Rmc, Sentence, Vtg
from r2p.sim.physics.gps import GeoOrigin, GpsReceiver, GpsSpec, GpsTruth
from r2p.units import SECOND

START = 1_356_998_400 * SECOND  # 2013-01-01
DT = 0.002


class Sky:
    """A receiver that is stepped, and what it sends: when, and which sentences."""

    def __init__(self, truth: GpsTruth | None = None, seed: int = 1, **spec: float) -> None:
        self.now = START
        self.truth = truth or GpsTruth()
        self.receiver = GpsReceiver(
            GpsSpec(**spec),  # type: ignore[arg-type]  # all fields are numbers
            lambda: self.truth,
            lambda: self.now,
            random.Random(seed),
        )
        self.received: list[tuple[int, list[Sentence]]] = []
        self.reader = NmeaReader()
        self.receiver.on_data = lambda data: self.received.append((self.now, self.reader.feed(data)))

    def run(self, seconds: float, each: Callable[[], object] = lambda: None) -> None:
        for _ in range(round(seconds / DT)):
            self.now += round(DT * SECOND)
            self.receiver.step(DT)
            each()

    def sentences(self, kind: type[Sentence]) -> list[Sentence]:
        return [each for _, burst in self.received for each in burst if isinstance(each, kind)]


def test_it_sends_three_sentences_for_each_fix() -> None:
    sky = Sky()
    sky.run(2.1)
    assert [[type(each) for each in burst] for _, burst in sky.received] == [[Gga, Rmc, Vtg]] * 9
    fixes = sky.sentences(Gga)
    assert [fix.time for fix in fixes if isinstance(fix, Gga)] == [SECOND * each // 5 for each in range(1, 10)]
    (first, *_) = sky.sentences(Rmc)
    assert isinstance(first, Rmc)
    assert first.date == (2013, 1, 1)
    assert first.valid
    assert not sky.reader.drops


@pytest.mark.parametrize("rate", [1, 10])
def test_the_last_character_arrives_after_latency_and_line(rate: int) -> None:
    sky = Sky(rate=rate, latency=0.05, jitter=0.0, baud=57_600)
    sky.run(3.0)
    for at, (fix, *_) in sky.received:
        assert isinstance(fix, Gga)
        assert fix.time is not None
        late = at - START - fix.time
        assert 0.05 + 0.025 < late / SECOND < 0.05 + 0.04  # some 180 characters of 174 us


def test_jitter_is_within_its_bounds() -> None:
    sky = Sky(jitter=0.03)
    sky.run(20)
    lates = [(at - START - fix.time) / SECOND for at, (fix, *_) in sky.received if isinstance(fix, Gga) and fix.time]
    assert 0.02 < max(lates) - min(lates) < 0.03 + 0.005


def test_a_slow_line_delays_but_cuts_no_sentence() -> None:
    sky = Sky(rate=10, baud=9600)
    sky.run(5)
    assert 20 < len(sky.received) < 30
    assert not sky.reader.drops


def test_the_errors_are_those_of_the_data_sheet() -> None:
    """From fix to fix the noise; over an hour also what wanders, of which 37 % are left after its time."""
    sky = Sky(noise=0.5, wander=0.8, wander_time=3.0, rate=1)
    errors: list[tuple[float, float]] = []
    step = round(SECOND)
    for _ in range(3600):
        sky.now += step
        sky.receiver.step(1.0)
        assert sky.receiver.last is not None
        errors.append(sky.receiver.last)
    for axis in (0, 1):
        values = [each[axis] for each in errors]
        assert statistics.stdev(values) == pytest.approx(math.hypot(0.5, 0.8), rel=0.1)
        assert abs(statistics.mean(values)) < 0.15
        after = statistics.correlation(values[:-3], values[3:])
        assert after == pytest.approx(0.37 * 0.64 / 0.89, abs=0.1)


def test_sentences_have_the_position_in_degrees() -> None:
    sky = Sky(GpsTruth(x=100.0, y=-50.0, vx=0.0, vy=-2.0), noise=0.0, wander=0.0, speed_noise=0.0)
    sky.run(0.5)
    fix, course = sky.sentences(Gga)[0], sky.sentences(Vtg)[0]
    assert isinstance(fix, Gga)
    assert fix.latitude is not None
    assert fix.longitude is not None
    assert sky.receiver.origin.local(fix.latitude, fix.longitude) == pytest.approx((100.0, -50.0), abs=0.02)
    assert fix.latitude > GeoOrigin().latitude
    assert fix.longitude > GeoOrigin().longitude  # y is west, so -50 m is east
    assert isinstance(course, Vtg)
    assert course.course == pytest.approx(90.0)
    assert course.speed == pytest.approx(2.0, abs=1e-3)


def test_a_degree_is_as_long_as_on_wgs_84() -> None:
    """At 45 degrees: 111 132 m to the north and 78 847 m to the east, as in tables."""
    origin = GeoOrigin(latitude=45.0, longitude=0.0)
    assert origin.local(46.0, 1.0) == pytest.approx((111_132, -78_847), abs=1)


def test_without_sky_it_has_no_fix_and_without_a_plug_it_is_silent() -> None:
    sky = Sky()
    sky.run(1.1)
    sky.receiver.has_sky = False
    sky.run(1.0)
    before = len(sky.received)
    _, (gga, rmc, vtg) = sky.received[-1]
    assert isinstance(gga, Gga)
    assert (gga.quality, gga.latitude) == (0, None)
    assert isinstance(rmc, Rmc)
    assert not rmc.valid
    assert vtg == Vtg()
    sky.receiver.connected = False
    sky.run(1.0)
    assert len(sky.received) == before
    sky.receiver.connected = sky.receiver.has_sky = True
    sky.run(1.0)
    assert sky.received[-1][1][0] != gga


def test_the_same_seed_is_the_same_text() -> None:
    one, same, other = Sky(seed=1), Sky(seed=1), Sky(seed=2)
    for sky in (one, same, other):
        sky.run(3)
    assert one.received == same.received != other.received
