"""Large packets: in which order, and how soon one after the other; a stand-in takes the thread's place."""

import asyncio
from collections.abc import Callable
from typing import Any

import pytest
import zenoh

from r2p.codecs import PublisherClass
from r2p.protocols.flow_control import SendWindow
from r2p.transports.stats import LoggedCounter
from r2p.transports.zenoh.large import LARGE, WAITING_MAX, LargePacket, LargeSender

pytestmark = pytest.mark.virtual_time

MEGABYTE = 1_000_000
SESSION = 5


class Network:
    """The thread, zenoh and a subscriber."""

    def __init__(self) -> None:
        self.puts: list[bytes] = []
        self.uses_thread = False
        self.lost = LoggedCounter()
        self.waits = self.rooms = 0
        self.sender = LargeSender(asyncio.get_running_loop(), self.lost)
        self.sender.on_wait = self._wait
        self.sender.on_room = self._room
        self._jobs: list[tuple[Callable[[], Any], Callable[[Any], object] | None]] = []
        thread: Any = self
        self.sender.connect(thread, thread)

    def submit(self, job: Callable[[], Any], then: Callable[[Any], object] | None = None) -> None:
        self._jobs.append((job, then))

    def work(self) -> None:
        """Let the thread make all its calls."""
        while self._jobs:
            job, then = self._jobs.pop(0)
            result = job()
            if then is not None:
                then(result)

    def put(self, data: bytes, *, attachment: bytes) -> None:
        assert attachment == b"header"
        if data[:1] == b"x":
            raise zenoh.ZError("closed")
        self.puts.append(data[:1])

    def window(self) -> SendWindow:
        window = SendWindow()
        window.add(SESSION, 100)
        return window

    def send(self, window: SendWindow, mark: bytes, *, size: int = MEGABYTE, urgent: bool = False) -> None:
        window.serial += 1
        publisher_class = PublisherClass.PERIODIC if urgent else PublisherClass.NON_REAL_TIME
        data = mark + bytes(size - 1)
        self.sender.send(LargePacket(window, publisher_class, window.serial, 1, data, b"header", self.put))

    def confirm(self, window: SendWindow) -> None:
        """The subscriber has accepted everything."""
        window.acknowledge(SESSION, window.serial)
        self.sender.confirm(window, window.serial)

    def _wait(self) -> None:
        self.waits += 1

    def _room(self) -> None:
        self.rooms += 1


async def test_the_next_one_goes_when_the_one_before_is_there() -> None:
    net = Network()
    images, scans = net.window(), net.window()
    net.send(images, b"1")
    net.send(scans, b"2", size=100_000)
    net.work()
    assert (net.puts, net.waits) == ([b"1"], 1)
    net.confirm(scans)
    net.work()
    assert net.puts == [b"1"]
    net.confirm(images)
    net.work()
    assert (net.puts, net.rooms) == ([b"1", b"2"], 2)


async def test_some_may_be_on_their_way_if_zenoh_has_room_for_all_of_them() -> None:
    net = Network()
    scans = net.window()
    for mark in (b"1", b"2", b"3"):
        net.send(scans, mark, size=400_000)
        net.work()
    assert net.puts == [b"1", b"2"]


async def test_one_that_is_lost_holds_up_the_next_for_as_long_as_a_slow_network_would_need() -> None:
    net = Network()
    images = net.window()
    net.send(images, b"1")
    net.send(images, b"2")
    net.work()
    await asyncio.sleep(0.099)
    net.work()
    assert net.puts == [b"1"]
    await asyncio.sleep(0.002)
    net.work()
    assert net.puts == [b"1", b"2"]


async def test_the_urgent_ones_overtake_and_short_ones_keep_their_place() -> None:
    net = Network()
    images, periods = net.window(), net.window()
    net.send(images, b"1")
    net.send(images, b"2")
    assert not net.sender.accepts(periods, LARGE)
    assert net.sender.accepts(periods, LARGE + 1)
    assert net.sender.accepts(images, 1)
    assert net.sender.is_full(images)
    assert not net.sender.is_full(periods)
    net.send(periods, b"p", urgent=True)
    net.work()
    for window in (images, periods):
        net.confirm(window)
        net.work()
    assert net.puts == [b"1", b"p", b"2"]
    assert not net.sender.accepts(images, 1)
    assert WAITING_MAX == 2


async def test_while_another_thread_makes_the_calls_nothing_goes_by_two_ways() -> None:
    net = Network()
    net.uses_thread = True
    assert net.sender.accepts(net.window(), 1)


async def test_with_shared_memory_several_are_on_their_way_unless_a_subscriber_is_slow() -> None:
    net = Network()
    net.sender.shared = True
    images = net.window()
    net.send(images, b"1")
    assert net.puts == [b"1"]  # by the loop: the thread would take longer to wake up
    net.send(images, b"2")
    assert net.puts == [b"1"]  # whether a subscriber is slow is not known yet
    net.confirm(images)
    for mark in (b"3", b"4", b"5"):
        net.send(images, mark)
    assert net.puts == [b"1", b"2", b"3", b"4", b"5"]
    await asyncio.sleep(0.02)
    net.confirm(images)
    for mark in (b"6", b"7"):
        net.send(images, mark)
    assert net.puts[5:] == [b"6"]


async def test_what_waits_when_the_link_goes_down_is_discarded() -> None:
    net = Network()
    images = net.window()
    for mark in (b"1", b"2", b"3"):
        net.send(images, mark)
    assert net.sender.discard() == 2
    assert images.serial == 1  # later ones get their serials, so no other end counts them again
    net.work()
    net.confirm(images)
    net.send(images, b"4")
    net.work()
    assert net.puts == [b"1", b"4"]


async def test_what_waits_at_the_end_is_sent_and_a_closed_session_is_counted() -> None:
    net = Network()
    images, scans = net.window(), net.window()
    for window, mark in ((images, b"1"), (images, b"2"), (scans, b"3")):
        net.send(window, mark)
    net.sender.flush([images])
    net.work()
    assert net.puts == [b"1", b"2"]
    net.sender.close()
    net.work()
    assert net.puts == [b"1", b"2", b"3"]
    net = Network()
    net.send(net.window(), b"x")
    net.work()
    assert net.lost == {"link down": 1}
