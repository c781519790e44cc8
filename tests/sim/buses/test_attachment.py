"""What attachments are asked for, and the filters of what they receive."""

import math
import threading
import time

import pytest

from r2p.codecs.can_bits import Frame, OtherFrame
from r2p.errors import MessageError
from r2p.sim.buses.attachment import AttachmentOptions, BusFilter, deadline_of
from r2p.units import SECOND


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"bitrate": 300_000}, "at 300000 bit/s a bit does not take whole nanoseconds"),
        ({"bitrate": 0}, "at 0 bit/s"),
        ({"noise": 1.5}, r"noise is a share, 0.0 to 1.0, not 1.5"),
        ({"loss": -0.1}, r"loss is a share"),
        ({"rx_queue": 0}, "at least one frame has to fit the queue of received frames, not 0"),
        ({"drift_ppm": math.nan}, "a clock drifts by less than 1000000 ppm, not nan"),
        ({"drift_ppm": -1e6}, "a clock drifts by less than 1000000 ppm, not -1000000"),
        ({"offset": 10**30}, "a clock's offset is at most 1000000000 s"),
        ({"filters": (BusFilter(1, 1),) * 513}, "513 filters, of 512 at most"),
    ],
)
def test_options_that_no_bus_can_have_are_refused(options: dict[str, object], words: str) -> None:
    with pytest.raises(MessageError, match=words):
        AttachmentOptions(**options)  # type: ignore[arg-type]


@pytest.mark.parametrize("wrong", [-1, 1 << 32, "1", None])
def test_filters_have_32_bits(wrong: int) -> None:
    for numbers in ((wrong, 0), (0, wrong)):
        with pytest.raises(MessageError, match="an identifier and a mask of at most 32 bits, not"):
            BusFilter(*numbers)
    with pytest.raises(MessageError, match="by True, False or None, not"):
        BusFilter(0, 0, extended="no")  # type: ignore[arg-type]


def test_timeouts_are_never_too_long_and_never_less_than_nothing() -> None:
    now = time.monotonic_ns()
    assert deadline_of(None) is None
    for timeout in (0, -1.0, -math.inf, math.nan):
        assert now <= (deadline_of(timeout) or 0) <= time.monotonic_ns()
    for timeout in (math.inf, 1e300):
        assert 0 < (deadline_of(timeout) or 0) - now < threading.TIMEOUT_MAX * SECOND


def test_a_filter_compares_the_bits_of_its_mask() -> None:
    odd = BusFilter(0x101, 0x1)
    assert odd.passes(OtherFrame(0x7FF))
    assert odd.passes(Frame(0x1FFFFFFF, b""))
    assert not odd.passes(OtherFrame(0x100))


def test_a_filter_may_choose_the_length_of_the_identifier() -> None:
    assert [BusFilter(5, 0x7FF, extended=False).passes(frame) for frame in KINDS] == [True, False, False]
    assert [BusFilter(5, 0x7FF, extended=True).passes(frame) for frame in KINDS] == [False, True, True]
    assert all(BusFilter(5, 0x7FF).passes(frame) for frame in KINDS)


KINDS: list[Frame | OtherFrame] = [OtherFrame(5), OtherFrame(5, extended=True, remote=0), Frame(5, b"")]
