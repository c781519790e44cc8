"""What attachments are asked for, and the filters of what they receive."""

import pytest

from r2p.codecs.can_bits import Frame, OtherFrame
from r2p.errors import MessageError
from r2p.sim.buses.attachment import AttachmentOptions, BusFilter


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"bitrate": 300_000}, "at 300000 bit/s a bit does not take whole nanoseconds"),
        ({"bitrate": 0}, "at 0 bit/s"),
        ({"noise": 1.5}, r"noise is a share, 0.0 to 1.0, not 1.5"),
        ({"loss": -0.1}, r"loss is a share"),
        ({"rx_queue": 0}, "at least one frame has to fit the queue of received frames, not 0"),
    ],
)
def test_options_that_no_bus_can_have_are_refused(options: dict[str, float], words: str) -> None:
    with pytest.raises(MessageError, match=words):
        AttachmentOptions(**options)  # type: ignore[arg-type]


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
