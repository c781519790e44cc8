"""What comes in and finds no room: who waits, for how long, and what is lost."""

import asyncio
from collections import deque
from collections.abc import Hashable
from typing import Any

import msgspec
import pytest

from r2p.runtime.backpressure import WaitQueue
from r2p.runtime.sample import Sample, Source
from r2p.runtime.topic import FULL_QUEUE_TURNS, RemoteSubscriber, Topic, WakeScheduler
from r2p.transports.receiver import STALL, Arrival, LinkStats, Receiver

pytestmark = pytest.mark.virtual_time


class Line(msgspec.Struct):
    topic: bytes
    data: bytes


class Other(RemoteSubscriber):
    """The way to another link; it takes as many as there is `space` for."""

    def __init__(self) -> None:
        super().__init__("other", self, WaitQueue())
        self.space = 0
        self.taken: list[bytes] = []

    def offer(self, sample: Sample) -> bool:
        if not self.space:
            return False
        self.space -= 1
        self.taken.append(sample.data)
        return True

    def force(self, sample: Sample) -> None:
        if not self.offer(sample):
            self.lost += 1

    def refill(self) -> None:
        self.waiting.serve()


class Passing(Topic):
    """A topic of a gateway: what comes in goes out by the other link."""

    def deliver(self, sample: Sample, own: object = None, slot_link: object = None) -> Any:
        return self._send(sample, None, slot_link)


class End:
    """The link where it comes in."""

    def __init__(self, *, waits: bool) -> None:
        self.waits = waits
        self.reads = True
        self.stats = LinkStats()

    def sample(self, topic: str, arrival: Arrival) -> Sample:
        return Sample(arrival.data, Source(link="line"), 0)

    def sender(self, arrival: Arrival) -> Hashable:
        return None

    def latched(self, topic: str) -> bool:
        return False

    def take_other(self, arrival: Arrival) -> None:
        raise AssertionError(arrival)

    def take_unexpected(self, arrival: Arrival) -> None:
        raise AssertionError(arrival)

    def pause(self) -> None:
        self.reads = False

    def resume(self) -> None:
        self.reads = True


def gateway(*, waits: bool, other: Other | None = None) -> tuple[End, Receiver, Other]:
    loop = asyncio.get_running_loop()
    end, other, topic = End(waits=waits), other or Other(), Passing("leds", WakeScheduler(loop))
    topic.join(other)
    intake = Receiver(end, loop, end.stats)
    intake.open(topic, 1, None)
    return end, intake, other


LINES = [Line(b"leds", bytes((number,))) for number in range(5)]
ALL = [line.data for line in LINES]


async def test_an_end_that_waits_is_made_to_wait_and_nothing_is_lost() -> None:
    end, intake, other = gateway(waits=True)
    intake.take(LINES)
    await asyncio.sleep(STALL / 2)
    assert (other.taken, end.reads) == ([], False)
    for _ in LINES:
        other.space = 1
        other.refill()
        await asyncio.sleep(STALL / 2)
    assert (other.taken, other.lost, end.reads) == (ALL, 0, True)


async def test_a_link_that_hangs_holds_it_up_once() -> None:
    end, intake, other = gateway(waits=True)
    intake.take(LINES)
    await asyncio.sleep(STALL * 1.5)
    assert (other.taken, other.lost, other.waits, end.reads) == ([], len(LINES), False, True)


async def test_many_topics_without_room_hold_it_up_hardly_longer_than_one() -> None:
    end, intake, _ = gateway(waits=True)
    loop = asyncio.get_running_loop()
    others = [Other() for _ in range(8)]
    for number, other in enumerate(others):
        topic = Passing(f"topic{number}", WakeScheduler(loop))
        topic.join(other)
        intake.open(topic, 1, None)
    intake.take(Line(f"topic{number}".encode(), b"1") for number in range(len(others)))
    await asyncio.sleep(STALL * 1.5)
    assert [other.lost for other in others] == [1] * len(others)
    assert end.reads
    await asyncio.sleep(STALL)
    intake.take(LINES[:1])
    await asyncio.sleep(STALL * 0.9)  # it is given its time again
    assert not end.reads


async def test_a_line_that_is_connected_anew_is_held_up_as_the_old_one_was() -> None:
    end, intake, other = gateway(waits=True)
    intake.take(LINES)
    await asyncio.sleep(STALL / 2)
    end.reads = True
    intake.take(LINES)
    assert not end.reads
    other.space = 2 * len(LINES)
    other.refill()
    await asyncio.sleep(0.01)
    assert (other.taken, end.reads) == (2 * ALL, True)


async def test_one_that_does_not_wait_loses_soon() -> None:
    end, intake, other = gateway(waits=False)
    intake.take(LINES)
    for _ in range(2 * FULL_QUEUE_TURNS):
        await asyncio.sleep(0)
    assert (other.taken, other.lost, end.reads) == ([], len(LINES), True)


async def test_closed_while_it_waits() -> None:
    _, intake, other = gateway(waits=True)
    intake.take(LINES)
    await asyncio.sleep(STALL / 2)
    intake.close()
    assert not other.wait_queue()
    other.space = len(LINES)
    other.refill()
    await asyncio.sleep(STALL * 2)
    assert (other.taken, other.lost) == ([], 0)


class Faulty(Other):
    """A link that raises at the message 1, at what is forced on it, or when it is given up."""

    def __init__(self, *faults: str) -> None:
        super().__init__()
        self.faults = faults

    def offer(self, sample: Sample) -> bool:
        if "offer" in self.faults and self.space and sample.data == b"\x01":
            raise RuntimeError(sample)
        return super().offer(sample)

    def force(self, sample: Sample) -> None:
        if "force" in self.faults:
            raise RuntimeError(sample)
        super().force(sample)

    def become_lossy(self, refusal: str) -> None:
        if "give up" in self.faults:
            raise RuntimeError(refusal)
        super().become_lossy(refusal)


@pytest.mark.internal_errors
@pytest.mark.parametrize("waits", [True, False])
@pytest.mark.parametrize(
    ("faults", "space", "taken", "errors"),
    [
        (["offer"], 9, [0, 2, 3, 4], 1),
        (["force"], 2, [0, 1], 3),
        (["force", "give up"], 2, [0, 1], 3),
    ],
)
async def test_a_message_that_raises_does_not_stop_the_others(
    faults: list[str], space: int, taken: list[int], errors: int, *, waits: bool
) -> None:
    end, intake, other = gateway(waits=waits, other=Faulty(*faults))
    other.space = space
    intake.take(LINES)
    await asyncio.sleep(10 * STALL)
    assert (other.taken, end.reads) == ([LINES[number].data for number in taken], True)
    assert end.stats.lost["internal error"] == errors
    other.space = 1
    other.refill()
    intake.take(LINES[:1])
    await asyncio.sleep(10 * STALL)
    assert other.taken[-1] == LINES[0].data


@pytest.mark.internal_errors
async def test_a_message_that_raises_while_it_waits_for_room_waits_no_more() -> None:
    end, intake, other = gateway(waits=True, other=Faulty("offer"))
    intake.take(LINES[1:])
    await asyncio.sleep(STALL / 2)
    other.space = 9
    with pytest.raises(RuntimeError):
        other.refill()  # a link guards this, and goes on
    await asyncio.sleep(STALL)
    assert (other.taken, end.reads, other.waiting.deliveries) == (ALL[2:], True, deque())
