"""What goes out at once, and what together with the others of a turn of the event loop."""

import asyncio

import pytest

from r2p.transports.intake import LinkStats
from r2p.transports.zenoh.burst import MOST, Burst

pytestmark = pytest.mark.virtual_time


class Wire:
    """Stands for zenoh."""

    def __init__(self) -> None:
        self.sent: list[bytes] = []
        self.stats = LinkStats()
        self.burst = Burst(asyncio.get_running_loop(), self.stats, ConnectionError)

    def put(self, data: bytes, *, attachment: bytes) -> None:
        if data == b"x":
            raise ConnectionError
        self.sent.append(data + attachment)

    def add(self, data: bytes, *, urgent: bool = False) -> None:
        self.burst.add(self.put, data, b"!", urgent=urgent)


async def test_the_first_goes_at_once_the_others_together_and_the_urgent_never_wait() -> None:
    wire = Wire()
    for data in (b"1", b"2", b"3"):
        wire.add(data)
    wire.add(b"urgent", urgent=True)
    assert wire.sent == [b"1!", b"urgent!"]
    await asyncio.sleep(0)
    assert wire.sent == [b"1!", b"urgent!", b"2!", b"3!"]
    wire.add(b"4")
    assert wire.sent[-1] == b"4!"
    assert (wire.stats.sent, wire.stats.bytes_sent) == (5, len("123urgent4"))


async def test_a_turn_that_does_not_end_is_no_reason_to_keep_all_of_it() -> None:
    wire = Wire()
    for _ in range(1 + MOST):
        wire.add(b"1")
    assert len(wire.sent) == 1 + MOST
    assert not wire.burst.waiting


async def test_a_link_that_goes_down_takes_along_what_waits() -> None:
    wire = Wire()
    for data in (b"1", b"2", b"3"):
        wire.add(data)
    assert wire.burst.discard() == 2
    await asyncio.sleep(0)
    assert wire.sent == [b"1!"]


async def test_what_zenoh_does_not_take_is_counted() -> None:
    wire = Wire()
    for data in (b"1", b"x", b"2"):
        wire.add(data)
    wire.burst.flush()
    assert wire.sent == [b"1!", b"2!"]
    assert (wire.stats.sent, dict(wire.stats.lost)) == (2, {"link down": 1})
