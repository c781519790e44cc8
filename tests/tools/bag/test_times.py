"""Instants of a recording are written as people say them."""

import time
from collections.abc import Iterator

import pytest
import typer

from r2p.tools.bag.times import iso, length, moment, shown, span
from r2p.tools.config import UsageError
from r2p.units import SECOND

START = 1_700_000_000_250_000_000  # 2023-11-14T22:13:20.25Z
END = START + 2 * 3600 * SECOND  # after midnight


@pytest.fixture(autouse=True)
def utc(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    with monkeypatch.context() as patch:
        patch.setenv("TZ", "UTC")
        time.tzset()
        yield
    time.tzset()


@pytest.mark.parametrize(
    ("text", "instant"),
    [
        ("0", START),
        ("12.5", START + 12_500_000_000),
        ("90s", START + 90 * SECOND),
        ("1m30s", START + 90 * SECOND),
        ("1h", START + 3600 * SECOND),
        ("20ms", START + 20_000_000),
        ("-10", END - 10 * SECOND),
        ("-1m", END - 60 * SECOND),
        ("22:30", 1_700_001_000_000_000_000),
        ("22:30:00.5", 1_700_001_000_500_000_000),
        ("00:00:01", 1_700_006_401_000_000_000),  # on the next day
        ("22:00", 1_699_999_200_000_000_000),  # a little before the start
        ("0:30", 1_700_008_200_000_000_000),  # a little after the end
        ("2023-11-14T22:30:00Z", 1_700_001_000_000_000_000),
        ("2023-11-14 22:30", 1_700_001_000_000_000_000),
        ("2023-11-14T23:30:00.123456789+01:00", 1_700_001_000_123_456_789),
        ("1700001000.123456", 1_700_001_000_123_456_000),
        ("1700001000123456789", 1_700_001_000_123_456_789),
    ],
)
def test_instants(text: str, instant: int) -> None:
    assert moment(text).instant(START, END) == instant


@pytest.mark.parametrize("text", ["", "soon", "25:00", "1m5", "--1", "2023-13-01T00:00", "s", "1e9", "9" * 40, "٣"])
def test_other_texts_are_refused_with_examples(text: str) -> None:
    with pytest.raises(typer.BadParameter, match=r"write 12\.5, 1m30s"):
        moment(text)


def test_a_span_is_in_the_recording() -> None:
    assert span((START, END), None, None) == (None, None)
    assert span((START, END), moment("1"), moment("22:30")) == (START + SECOND, 1_700_001_000_000_000_000)
    with pytest.raises(
        UsageError, match=r"--start 3h is after the end: the recording is from 2023-11-14 22:13:20\.250"
    ):
        span((START, END), moment("3h"), None)
    with pytest.raises(UsageError, match="--end 22:00 is before the start"):
        span((START, END), None, moment("22:00"))
    with pytest.raises(UsageError, match="--end 5 is not after --start 6"):
        span((START, END), moment("6"), moment("5"))


def test_instants_and_durations_are_shown() -> None:
    assert shown(START) == "2023-11-14 22:13:20.250"
    assert shown(START, date=False) == "22:13:20.250"
    assert shown((1 << 64) - 1) == "2554-07-21 23:34:33.709"
    assert iso(START + 1) == "2023-11-14T22:13:20.250000001Z"
    assert [
        length(each) for each in (0, 312_000_000, 12_500_000_000, 185 * SECOND, 3723 * SECOND, 76 * 3600 * SECOND)
    ] == [
        "0 ms",
        "312 ms",
        "12.5 s",
        "3 min 05 s",
        "1 h 02 min 03 s",
        "3 d 4 h",
    ]
