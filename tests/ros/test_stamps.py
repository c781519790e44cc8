"""Which stamp a message has in ROS."""

from collections import Counter
from typing import Annotated, Any

import pytest

import r2p
from r2p.messages import ClockOffset
from r2p.msg import Header, LaserScan, Led, Log, StampedEncoder, StampedIMU, Timestamp
from r2p.ros.stamps import STAMP_OF_RECEPTION, StampSource, stamp_of
from r2p.runtime.sample import Sample, Source
from r2p.units import SECOND

UTC = 1_700_000_000 * SECOND
PUBLISHED = UTC + 5
CAN = ClockOffset(epoch=1, offset=UTC - 40 * SECOND, error=1000)
MEASURED = Timestamp(41, 7)
"""One second after UTC, by the clock of the CAN network."""


class Late(r2p.Message):
    """Its stamp is behind a text, and so at no fixed place."""

    name: Annotated[str, r2p.Max(9)] = ""
    header: Header = Header()


def sample(message: r2p.Message, **options: Any) -> Sample[Any]:
    return Sample(message.encode(), Source("IMU"), PUBLISHED, **options)


@pytest.mark.parametrize(
    ("message", "options", "expected"),
    [
        (StampedIMU(MEASURED), {"clock": CAN}, UTC + SECOND + 7),
        (StampedIMU(Timestamp.from_ns(UTC)), {"clock": CAN}, UTC),  # of a program, which stamps in UTC
        (StampedIMU(Timestamp.from_ns(UTC)), {}, UTC),
        (StampedIMU(MEASURED), {}, PUBLISHED),  # of a clock that is not known
        (StampedIMU(), {"clock": CAN}, PUBLISHED),
        (Log(Timestamp.from_ns(UTC)), {}, UTC),
        (LaserScan(header=Header(3, Timestamp.from_ns(UTC))), {}, UTC),
        (LaserScan(), {}, PUBLISHED),
        (Late("abc", Header(stamp=MEASURED)), {"clock": CAN}, UTC + SECOND + 7),
        (Late(), {}, PUBLISHED),
        (Led(), {"clock": CAN}, PUBLISHED),
    ],
)
def test_the_stamp_of_the_message_then_of_the_sample(
    message: r2p.Message, options: dict[str, Any], expected: int
) -> None:
    counts: Counter[str] = Counter()
    assert StampSource(type(message), counts).find(sample(message, **options)) == expected
    assert not counts


def test_a_time_of_reception_is_counted() -> None:
    counts: Counter[str] = Counter()
    for message in (Led(), StampedEncoder(), StampedEncoder(MEASURED)):
        assert StampSource(type(message), counts).find(sample(message, stamped=False)) == PUBLISHED
    assert counts == {STAMP_OF_RECEPTION: 3}
    assert StampSource(StampedEncoder, counts).find(sample(StampedEncoder(MEASURED), stamped=False, clock=CAN)) > UTC
    assert counts.total() == 3


@pytest.mark.parametrize("cls", [StampedIMU, LaserScan, Late])
def test_cut_messages_have_the_stamp_of_the_sample(cls: type[r2p.Message]) -> None:
    cut = Sample(b"\1\0\0", Source(), PUBLISHED)
    assert StampSource(cls, Counter()).find(cut) == PUBLISHED


def test_the_stamp_of_a_message() -> None:
    assert stamp_of(LaserScan(header=Header(stamp=MEASURED))) == stamp_of(StampedIMU(MEASURED)) == MEASURED
    assert stamp_of(LaserScan()) is stamp_of(Led()) is None
