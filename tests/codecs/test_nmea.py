"""NMEA sentences there and back, the examples of manuals, and lines that are none."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from r2p.codecs.nmea import SENTENCE_MAX, Gga, NmeaReader, Rmc, Sentence, Vtg, checksum, encode

GGA = b"$GPGGA,123519,4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,*47\r\n"
RMC = b"$GPRMC,123519,A,4807.038,N,01131.000,E,022.4,084.4,230394,003.1,W*6A\r\n"
VTG = b"$GPVTG,054.7,T,034.4,M,005.5,N,010.2,K*48\r\n"
"""From the usual manuals; RMC and VTG are of a version without a mode."""
NOON = (12 * 3600 + 35 * 60 + 19) * 1_000_000_000


def one(line: bytes) -> Sentence:
    reader = NmeaReader()
    (sentence,) = reader.feed(line)
    assert not reader.drops
    return sentence


def test_examples_of_manuals() -> None:
    degrees = {"latitude": 48 + 7.038 / 60, "longitude": 11 + 31 / 60}
    fix = Gga(time=NOON, **degrees, quality=1, satellites=8, hdop=0.9, altitude=545.4, geoid=46.9)
    assert one(GGA) == fix
    knot = 1852 / 3600
    assert one(RMC) == Rmc(time=NOON, date=(1994, 3, 23), valid=True, **degrees, speed=22.4 * knot, course=84.4)
    assert one(VTG) == Vtg(course=54.7, speed=5.5 * knot)


def test_lines_that_it_writes() -> None:
    fix = Gga(
        time=NOON,
        latitude=-45.5,
        longitude=-9.25,
        quality=2,
        satellites=9,
        hdop=0.94,
        altitude=120.04,
        geoid=48.0,
    )
    assert encode(fix) == b"$GPGGA,123519.00,4530.00000,S,00915.00000,W,2,09,0.9,120.0,M,48.0,M,,*6D\r\n"
    rmc = Rmc(time=NOON, date=(2026, 11, 3), valid=True, latitude=1.0, longitude=2.0, speed=1.0, course=359.0)
    assert encode(rmc, "GN") == b"$GNRMC,123519.00,A,0100.00000,N,00200.00000,E,1.944,359.00,031126,,,A*7E\r\n"
    assert encode(Vtg(course=90.0, speed=1.0)) == b"$GPVTG,90.00,T,,M,1.944,N,3.600,K,A*09\r\n"


@pytest.mark.parametrize("sentence", [Gga(), Rmc(), Vtg()])
def test_without_a_fix_fields_are_empty(sentence: Sentence) -> None:
    assert one(encode(sentence)) == sentence


times = st.integers(0, 8_639_999).map(lambda hundredths: hundredths * 10_000_000)
latitudes, longitudes = st.floats(-90, 90), st.floats(-180, 180)


@given(times, latitudes, longitudes, st.floats(0, 200), st.floats(0, 359.99))
def test_what_is_written_is_read(time: int, latitude: float, longitude: float, speed: float, course: float) -> None:
    """Positions to 1/100000 minute, 2 cm; speed to 1/1000 knot."""
    fix = one(encode(Gga(time=time, latitude=latitude, longitude=longitude, quality=1)))
    assert isinstance(fix, Gga)
    assert fix.time == time
    assert (fix.latitude, fix.longitude) == pytest.approx((latitude, longitude), abs=1e-7)
    rmc = one(encode(Rmc(time=time, latitude=latitude, longitude=longitude, speed=speed, course=course)))
    assert isinstance(rmc, Rmc)
    assert (rmc.speed, rmc.course) == pytest.approx((speed, course), abs=6e-3)


def test_sixty_minutes_are_a_degree() -> None:
    assert b",4600.00000,N," in encode(Gga(latitude=45.999999999))


@given(st.lists(st.integers(1, 40), max_size=40))
def test_a_stream_in_any_pieces_is_the_same(pieces: list[int]) -> None:
    stream = b"noise\r\n" + GGA + RMC[:-9] + VTG + GGA
    reader, sentences = NmeaReader(), []
    for size in [*pieces, len(stream)]:
        sentences += reader.feed(stream[:size])
        stream = stream[size:]
    assert [type(each) for each in sentences] == [Gga, Vtg, Gga]
    assert reader.drops == {"garbage": 1, "cut short": 1}


def with_sum(text: bytes) -> bytes:
    return b"$%b*%02X\r\n" % (text, checksum(text))


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        (b"hello\r\n", "garbage"),
        (b"\xff\xfe$" + GGA[1:-4] + b"\r\n", "cut short"),
        (GGA.replace(b"545.4", b"545.5"), "checksum"),
        (GGA.replace(b"*47", b"*4x"), "bad field"),
        (GGA[:-5] + b"\r\n", "cut short"),
        (b"$" + b"A" * 200 + b"\r\n", "too long"),
        (b"A" * 200 + b"\r\n", "garbage"),
        (with_sum(b"GPGSV,3,1,11"), "other sentence"),
        (with_sum(b"GPGGA,123519"), "bad field"),
        (with_sum(b"GPGGA,256199,4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,"), "bad field"),
        (with_sum(b"GPGGA,123519,9107.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,"), "bad field"),
        (with_sum(b"GPGGA,123519,4867.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,"), "bad field"),
        (with_sum(b"GPGGA,123519,4807.038,X,01131.000,E,1,08,0.9,545.4,M,46.9,M,,"), "bad field"),
        (with_sum(b"GPGGA,123519,4807.038,,01131.000,E,1,08,0.9,545.4,M,46.9,M,,"), "bad field"),
        (with_sum(b"GPGGA,123519,4807.038,N,01131.000,E,1,08,nan,545.4,M,46.9,M,,"), "bad field"),
        (with_sum(b"GPGGA,123519,4807.038,N,01131.000,E,1,08,1e9,545.4,M,46.9,M,,"), "bad field"),
        (with_sum(b"GPRMC,123519,A,4807.038,N,01131.000,E,022.4,084.4,330394,,"), "bad field"),
        (with_sum(b"GPRMC,123519,B,4807.038,N,01131.000,E,022.4,084.4,230394,,"), "bad field"),
    ],
)
def test_what_is_no_sentence_is_counted_and_the_next_one_is_read(line: bytes, reason: str) -> None:
    reader = NmeaReader()
    assert [type(each) for each in reader.feed(line + VTG)] == [Vtg]
    assert reader.drops.pop(reason) == 1
    assert not reader.drops or reader.drops == {"garbage": 1}


@given(st.binary(max_size=400))
def test_it_never_fails_and_holds_little(data: bytes) -> None:
    reader = NmeaReader()
    reader.feed(data)
    assert len(reader._held) <= SENTENCE_MAX
    reader.feed(b"\r\n")
    assert isinstance(reader.feed(GGA)[0], Gga)
