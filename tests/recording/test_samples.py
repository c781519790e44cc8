"""Samples are the same after they have been in a bag."""

from pathlib import Path

import pytest

import r2p
from r2p.messages import ClockOffset
from r2p.msg import Led
from r2p.recording.bag import Bag
from r2p.recording.samples import SampleWriter
from r2p.recording.writer import BagWriter

PLAIN = r2p.Sample(Led(3, 1).encode(), r2p.Source("IMU", "led", "tcp"), 1_000, sequence=7)
SAMPLES = {
    "plain": PLAIN,
    "of this module": r2p.Sample(Led(3, 1).encode(), r2p.Source("IMU", "led"), 1_000, sequence=1),
    "with a deadline": r2p.Sample(
        Led(3, 1).encode(), r2p.Source("IMU"), 1_000, 21_000, 8, r2p.PublisherClass.SPORADIC, expires=22_000
    ),
    "of firmware": r2p.Sample(Led(3, 1).encode(), r2p.Source(), 5_000, stamped=False),
    "in network time": r2p.Sample(
        Led(3, 1).encode(), r2p.Source("IMU"), 1_000, hops=2, clock=ClockOffset(77, -5, 300), drop_late=False
    ),
    "of a large number": r2p.Sample(Led(3, 1).encode(), r2p.Source("IMU"), 1_000, sequence=1 << 40),
    "of another size": r2p.Sample(b"12345", r2p.Source("IMU"), 1_000, sequence=9),
}


@pytest.mark.parametrize("sample", SAMPLES.values(), ids=SAMPLES)
def test_a_sample_comes_back(sample: r2p.Sample, tmp_path: Path) -> None:
    path = tmp_path / "one.mcap"
    with path.open("wb") as file:
        writer = BagWriter(file)
        SampleWriter(writer).write("leds", sample, Led, 5_000)
        writer.finish()
    with Bag(path) as bag:
        (record,) = bag.records()
    assert (record.topic, record.log_time, record.sample) == ("leds", 5_000, sample)
