"""What comes in and finds no room: who waits, for how long, and what is lost."""

import asyncio
from collections import deque
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest

from r2p.clock import clock_of
from r2p.runtime.backpressure import WaitQueue
from r2p.runtime.queues import WakeScheduler
from r2p.runtime.sample import PublisherClass, Sample, Source
from r2p.runtime.topic import RemoteSubscriber, Topic, TopicSpace
from r2p.transports.buffered_link import Arrival, BufferedLink
from r2p.transports.receive_backpressure import FULL_QUEUE_TURNS, STALL_MAX_S

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
        self.wait_queue.serve()


class Passing(Topic):
    """A topic of a gateway: what comes in goes out by the other link."""

    def deliver(self, sample: Sample, own: object = None, slot_link: object = None) -> Any:
        return self._send(self.remote_subscribers, sample, None, slot_link)


class End(BufferedLink):
    """The link where it comes in."""

    flow_controlled = False
    full = False
    publisher_class = PublisherClass.NON_REAL_TIME

    def __init__(self, *, flow_controlled: bool) -> None:
        space = TopicSpace("A", asyncio.get_running_loop(), clock_of())
        hub: Any = SimpleNamespace(space=space, instance=1, observer=False)
        super().__init__("line", hub)
        self.flow_controlled = flow_controlled
        self.reads = True

    def sample(self, topic: str, arrival: Arrival) -> Sample:
        return Sample(arrival.data, Source(link="line"), 0, publisher_class=self.publisher_class)

    def receive_other(self, arrival: Arrival) -> None:
        raise AssertionError(arrival)

    def write(self, topic: str, sample: Sample) -> None:
        raise AssertionError(sample)

    def write_management(self, data: bytes, *, urgent: bool = False) -> None:
        raise AssertionError(data)

    def pause(self) -> None:
        self.reads = False

    def resume(self) -> None:
        self.reads = True


def gateway(*, flow_controlled: bool, other: Other | None = None) -> tuple[End, Other]:
    end, other = End(flow_controlled=flow_controlled), other or Other()
    topic = Passing("leds", WakeScheduler(asyncio.get_running_loop()))
    topic.join(other)
    end.add_publisher(topic, 1, None)
    return end, other


LINES = [Line(b"leds", bytes((number,))) for number in range(5)]
ALL = [line.data for line in LINES]


async def test_an_end_that_waits_is_made_to_wait_and_nothing_is_lost() -> None:
    end, other = gateway(flow_controlled=True)
    end.receive(LINES)
    await asyncio.sleep(STALL_MAX_S / 2)
    assert (other.taken, end.reads) == ([], False)
    for _ in LINES:
        other.space = 1
        other.refill()
        await asyncio.sleep(STALL_MAX_S / 2)
    assert (other.taken, other.lost, end.reads) == (ALL, 0, True)


async def test_a_link_that_hangs_holds_it_up_once() -> None:
    end, other = gateway(flow_controlled=True)
    end.receive(LINES)
    await asyncio.sleep(STALL_MAX_S * 1.5)
    assert (other.taken, other.lost, other.blocks_publishers, end.reads) == ([], len(LINES), False, True)


@pytest.mark.parametrize("publisher_class", [PublisherClass.SPORADIC, PublisherClass.PERIODIC])
async def test_what_expires_does_not_hold_it_up(publisher_class: PublisherClass) -> None:
    """And the other link is waited for as before when a message comes that does not expire."""
    end, other = gateway(flow_controlled=True)
    end.publisher_class = publisher_class
    end.receive(LINES)
    for _ in range(100):
        await asyncio.sleep(0)
    assert (other.taken, other.lost, end.reads) == ([], len(LINES), True)
    end.publisher_class = PublisherClass.NON_REAL_TIME
    end.receive(LINES[:1])
    await asyncio.sleep(STALL_MAX_S / 2)
    other.space = 1
    other.refill()
    await asyncio.sleep(0.1)
    assert (other.taken, other.lost, end.reads) == (ALL[:1], len(LINES), True)


async def test_many_topics_without_room_hold_it_up_hardly_longer_than_one() -> None:
    end, _ = gateway(flow_controlled=True)
    loop = asyncio.get_running_loop()
    others = [Other() for _ in range(8)]
    for number, other in enumerate(others):
        topic = Passing(f"topic{number}", WakeScheduler(loop))
        topic.join(other)
        end.add_publisher(topic, 1, None)
    end.receive(Line(f"topic{number}".encode(), b"1") for number in range(len(others)))
    await asyncio.sleep(STALL_MAX_S * 1.5)
    assert [other.lost for other in others] == [1] * len(others)
    assert end.reads
    await asyncio.sleep(STALL_MAX_S)
    end.receive(LINES[:1])
    await asyncio.sleep(STALL_MAX_S * 0.9)  # it is given its time again
    assert not end.reads


async def test_a_line_that_is_connected_anew_is_held_up_as_the_old_one_was() -> None:
    end, other = gateway(flow_controlled=True)
    end.receive(LINES)
    await asyncio.sleep(STALL_MAX_S / 2)
    end.reads = True
    end.receive(LINES)
    assert not end.reads
    other.space = 2 * len(LINES)
    other.refill()
    await asyncio.sleep(0.01)
    assert (other.taken, end.reads) == (2 * ALL, True)


async def test_one_that_does_not_wait_loses_soon() -> None:
    end, other = gateway(flow_controlled=False)
    end.receive(LINES)
    for _ in range(2 * FULL_QUEUE_TURNS):
        await asyncio.sleep(0)
    assert (other.taken, other.lost, end.reads) == ([], len(LINES), True)


async def test_closed_while_it_waits() -> None:
    end, other = gateway(flow_controlled=True)
    end.receive(LINES)
    await asyncio.sleep(STALL_MAX_S / 2)
    end.close()
    assert not other.get_wait_queue()
    other.space = len(LINES)
    other.refill()
    await asyncio.sleep(STALL_MAX_S * 2)
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
@pytest.mark.parametrize("flow_controlled", [True, False])
@pytest.mark.parametrize(
    ("faults", "space", "taken", "errors"),
    [
        (["offer"], 9, [0, 2, 3, 4], 1),
        (["force"], 2, [0, 1], 3),
        (["force", "give up"], 2, [0, 1], 3),
    ],
)
async def test_a_message_that_raises_does_not_stop_the_others(
    faults: list[str], space: int, taken: list[int], errors: int, *, flow_controlled: bool
) -> None:
    end, other = gateway(flow_controlled=flow_controlled, other=Faulty(*faults))
    other.space = space
    end.receive(LINES)
    await asyncio.sleep(10 * STALL_MAX_S)
    assert (other.taken, end.reads) == ([LINES[number].data for number in taken], True)
    assert end.stats.lost["internal error"] == errors
    other.space = 1
    other.refill()
    end.receive(LINES[:1])
    await asyncio.sleep(10 * STALL_MAX_S)
    assert other.taken[-1] == LINES[0].data


@pytest.mark.internal_errors
async def test_a_message_that_raises_while_it_waits_for_room_waits_no_more() -> None:
    end, other = gateway(flow_controlled=True, other=Faulty("offer"))
    end.receive(LINES[1:])
    await asyncio.sleep(STALL_MAX_S / 2)
    other.space = 9
    with pytest.raises(RuntimeError):
        other.refill()  # a link guards this, and goes on
    await asyncio.sleep(STALL_MAX_S)
    assert (other.taken, end.reads, other.wait_queue.non_real_time) == (ALL[2:], True, deque())
