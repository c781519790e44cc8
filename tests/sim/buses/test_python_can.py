"""python-can's interface `r2psim` in real time: buses of one process, threads, notifiers, shutdown."""

import asyncio
import gc
import os
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import can
import pytest

import r2p
import r2p.sim
from r2p.msg import Led
from r2p.sim.transport import running_buses
from r2p.testing.network import node_in

SOON = 20.0  # seconds: for what happens at once, unless the computer is busy


@pytest.fixture
def channel(request: pytest.FixtureRequest) -> str:
    return str(request.node.name)


def message(identifier: int, data: bytes = b"", **more: Any) -> can.Message:
    return can.Message(arbitration_id=identifier, data=data, **more)


def until(condition: Callable[[], object]) -> None:
    """Wait for what another thread does."""
    end = time.monotonic() + SOON
    while not condition() and time.monotonic() < end:
        time.sleep(0.001)
    assert condition()


def received(bus: can.BusABC, count: int) -> list[can.Message]:
    """Receive so many messages."""
    found: list[can.Message] = []
    while len(found) < count and (each := bus.recv(SOON)):
        found.append(each)
    return found


def identifiers(bus: can.BusABC, count: int) -> list[int]:
    return [each.arbitration_id for each in received(bus, count)]


def contents(bus: can.BusABC, count: int) -> list[bytes]:
    return [bytes(each.data) for each in received(bus, count)]


@pytest.fixture
def pair(channel: str) -> Iterator[tuple[can.BusABC, can.BusABC]]:
    with (
        can.Bus(interface="r2psim", channel=channel, served=False) as a,
        can.Bus(interface="r2psim", channel=channel, served=False) as b,
    ):
        yield a, b


KINDS = [
    message(0x1FFFFFFF, bytes(range(8))),
    message(0x7FF),
    message(0x7FF, bytes(range(8)), is_extended_id=False),
    message(0, is_extended_id=False),
    message(0x7FF, is_extended_id=False, is_remote_frame=True, dlc=0),
    message(0x7FF, is_extended_id=False, is_remote_frame=True, dlc=8),
    message(0x1FFFFFFF, is_remote_frame=True, dlc=3),
]


@pytest.mark.parametrize("sent", KINDS, ids=str)
def test_messages_go_back_and_forth(pair: tuple[can.BusABC, can.BusABC], sent: can.Message) -> None:
    for sender, receiver in (pair, pair[::-1]):
        sender.send(sent)
        found = receiver.recv(SOON)
        assert found is not None
        assert found.equals(sent, timestamp_delta=None, check_channel=False, check_direction=False)
        assert found.is_rx
        assert found.channel == receiver.channel  # type: ignore[attr-defined]


def test_there_is_nothing_to_receive(pair: tuple[can.BusABC, can.BusABC]) -> None:
    assert pair[0].recv(0) is None
    assert pair[0].recv(0.001) is None


def test_stamps_are_utc_and_rise(pair: tuple[can.BusABC, can.BusABC]) -> None:
    a, b = pair
    for identifier in range(300):
        a.send(message(identifier), SOON)
    found = [b.recv(SOON) for _ in range(300)]
    assert [each and each.arbitration_id for each in found] == list(range(300))
    stamps = [each.timestamp for each in found if each]
    assert stamps == sorted(set(stamps))
    assert abs(stamps[0] - time.time()) < SOON


def test_the_description_says_where_the_bus_is(pair: tuple[can.BusABC, can.BusABC], channel: str) -> None:
    assert str(pair[0]) == f"r2psim {channel}: a bus of this process, 1000000 bit/s"
    assert pair[0].protocol is can.CanProtocol.CAN_20


def test_many_threads_use_one_bus(pair: tuple[can.BusABC, can.BusABC]) -> None:
    a, b = pair

    def send(number: int) -> None:
        for each in range(50):
            a.send(message(number << 8 | each), SOON)

    def receive() -> list[int]:
        found = [b.recv(SOON) for _ in range(50)]
        return [each.arbitration_id for each in found if each]

    with ThreadPoolExecutor(8) as threads:
        receivers = [threads.submit(receive) for _ in range(4)]
        for sender in [threads.submit(send, number) for number in range(4)]:
            sender.result()
        everything = [identifier for receiver in receivers for identifier in receiver.result()]
    assert sorted(everything) == [number << 8 | each for number in range(4) for each in range(50)]


def test_sending_waits_for_room(pair: tuple[can.BusABC, can.BusABC]) -> None:
    a, b = pair
    for identifier in range(1000):  # far more than the queue holds
        a.send(message(identifier))
    assert identifiers(b, 1000) == list(range(1000))


def test_a_queue_that_no_frame_leaves_is_an_error(channel: str) -> None:
    with can.Bus(interface="r2psim", channel=channel, served=False) as alone:
        for identifier in range(128):
            alone.send(message(identifier))
        passive = alone.recv(SOON)
        assert passive is not None
        assert passive.is_error_frame
        with pytest.raises(can.exceptions.CanTimeoutError, match="first one fails again and again, 128 transmit"):
            alone.send(message(1), 0.001)
        with pytest.raises(can.exceptions.CanTimeoutError, match="the queue of 128 frames is full"):
            alone.send(message(1), 0)
        alone.flush_tx_buffer()
        alone.send(message(1), 0)


@pytest.mark.parametrize("timeout", [None, SOON])
def test_shutdown_ends_calls_that_wait(channel: str, timeout: float | None) -> None:
    bus = can.Bus(interface="r2psim", channel=channel, served=False, ignore_rx_error_frames=True)
    with ThreadPoolExecutor(3) as threads:
        receiving = [threads.submit(bus.recv, timeout) for _ in range(2)]
        for identifier in range(128):
            bus.send(message(identifier))
        waiting: list[Any] = [*receiving, threads.submit(bus.send, message(1), timeout)]
        bus.shutdown()
        for each in waiting:
            with pytest.raises(can.CanOperationError, match=r"closed|is full"):
                each.result(SOON)
    calls: list[Callable[[], object]] = [bus.recv, partial(bus.send, message(1)), bus.fileno, bus.flush_tx_buffer]
    for call in calls:
        with pytest.raises(can.CanOperationError, match="closed"):
            call()
    bus.shutdown()


def test_what_is_sent_before_shutdown_arrives(pair: tuple[can.BusABC, can.BusABC]) -> None:
    a, b = pair
    for identifier in range(100):
        a.send(message(identifier))
    a.shutdown()
    assert identifiers(b, 100) == list(range(100))


def test_closing_leaves_nothing_behind(channel: str) -> None:
    def descriptors() -> int:
        gc.collect()
        return len(list(Path("/proc/self/fd").glob("*")))  # none where there is no /proc

    def use() -> None:
        with (
            can.Bus(interface="r2psim", channel=channel, served=False) as a,
            can.Bus(interface="r2psim", channel=channel, served=False) as b,
        ):
            b.fileno()
            a.send(message(1))
            assert b.recv(SOON)

    before = descriptors()
    for _ in range(20):
        use()
    assert descriptors() <= before
    assert f"r2psim {channel}" not in [each.name for each in threading.enumerate()]
    assert channel not in [name for name, _ in running_buses()]


def test_an_unclosed_bus_is_closed_with_its_last_reference(channel: str) -> None:
    bus = can.Bus(interface="r2psim", channel=channel, served=False)
    del bus
    gc.collect()
    assert channel not in [name for name, _ in running_buses()]


def test_notifiers_have_threads(pair: tuple[can.BusABC, can.BusABC]) -> None:
    a, b = pair
    reader = can.BufferedReader()
    with can.Notifier(b, [reader], timeout=0.01):
        a.send(message(5))
        found = reader.get_message(SOON)
    assert found is not None
    assert found.arbitration_id == 5


async def notify_by_event_loop(channel: str) -> None:
    with (
        can.Bus(interface="r2psim", channel=channel, served=False) as a,
        can.Bus(interface="r2psim", channel=channel, served=False) as b,
    ):
        reader = can.AsyncBufferedReader()
        threads = threading.active_count()
        with can.Notifier(b, [reader], loop=asyncio.get_running_loop()):
            assert threading.active_count() == threads
            for identifier in range(50):
                a.send(message(identifier))
            async with asyncio.timeout(SOON):
                assert [(await reader.get_message()).arbitration_id for _ in range(50)] == list(range(50))


def test_notifiers_use_event_loops(channel: str) -> None:
    asyncio.run(notify_by_event_loop(channel))


def test_periodic_messages(pair: tuple[can.BusABC, can.BusABC]) -> None:
    a, b = pair
    task = a.send_periodic(message(3), 0.001)
    assert identifiers(b, 5) == [3] * 5
    task.stop()


def test_periodic_messages_to_nobody_are_counted_and_never_a_traceback(
    channel: str, caplog: pytest.LogCaptureFixture
) -> None:
    with can.Bus(interface="r2psim", channel=channel, served=False) as alone:
        for _ in range(128):  # the first one is sent again and again, as no node acknowledges
            alone.send(message(1))
        task: Any = alone.send_periodic(message(3), 0.001)
        again: Any = alone.send_periodic(message(4), 0.001)
        until(lambda: task.lost > 2 and again.lost > 2)
        task.stop()
    until(lambda: not task.thread_runs and not again.thread_runs)
    assert [each.levelname for each in caplog.records] == ["WARNING"] * 2
    assert "is there a node that acknowledges?; messages of send_periodic are lost" in caplog.text
    assert "Traceback" not in caplog.text


def test_a_periodic_message_that_cannot_be_sent_ends_its_task_in_words(
    channel: str, caplog: pytest.LogCaptureFixture
) -> None:
    with can.Bus(interface="r2psim", channel=channel, served=False, listen_only=True) as listener:
        task: Any = listener.send_periodic(message(3), 0.001)
        until(lambda: not task.thread_runs)
    words = "this node only listens: open the bus without listen_only; send_periodic has ended"
    assert caplog.messages == [f"{channel}: a bus of this process, 1000000 bit/s: {words}"]


def test_a_periodic_task_in_a_thread_changes_ends_and_starts_again(pair: tuple[can.BusABC, can.BusABC]) -> None:
    a, b = pair
    task: Any = a.send_periodic([message(1, b"a"), message(1, b"b")], 0.001, duration=0.0035)
    assert contents(b, 4) == [b"a", b"b", b"a", b"b"]
    until(lambda: not task.thread_runs)
    task.modify_data([message(1, b"c"), message(1, b"d")])
    task.start()
    assert contents(b, 4) == [b"c", b"d", b"c", b"d"]
    until(lambda: not task.thread_runs)
    assert b.recv(0) is None


def test_filters(pair: tuple[can.BusABC, can.BusABC]) -> None:
    a, b = pair
    b.set_filters([{"can_id": 2, "can_mask": 0x7, "extended": True}])
    for identifier in range(1, 4):
        a.send(message(identifier))
    found = b.recv(SOON)
    assert found is not None
    assert found.arbitration_id == 2
    assert b.filters == [{"can_id": 2, "can_mask": 0x7, "extended": True}]


@pytest.mark.parametrize(
    ("options", "error", "words"),
    [
        ({"bitrat": 5}, TypeError, "has no option bitrat; it has channel, can_filters, bitrate, receive_own_messages,"),
        ({"fd": True}, can.CanInitializationError, "CAN 2.0, without CAN FD: open it without fd=True"),
        ({"bitrate": 300_000}, ValueError, "at 300000 bit/s a bit does not take whole nanoseconds"),
        ({"noise": 2}, ValueError, "noise is a share"),
        ({"bitrate": "500k"}, ValueError, "a bit rate is a number of bit/s, such as 500000, not '500k'"),
        ({"can_filters": [{"can_id": 1}]}, ValueError, 'a filter is a dict with "can_id" and "can_mask", not'),
        ({"can_filters": [{"can_id": -1, "can_mask": 0}]}, ValueError, "at most 32 bits, not -1"),
        ({"drift": float("nan")}, ValueError, "a clock drifts by less than 1000000 ppm, not nan"),
        ({"channel": ""}, ValueError, """such as "lab", not ''"""),
        ({"channel": b"lab"}, ValueError, """such as "lab", not b'lab'"""),
        ({"channel": " lab"}, ValueError, """a channel is the name of a bus, such as "lab", not ' lab'"""),
    ],
)
def test_wrong_options_are_said(options: dict[str, Any], error: type[Exception], words: str) -> None:
    with pytest.raises(error, match=words):
        can.Bus(**{"interface": "r2psim", "channel": "x", "served": False, **options})
    assert "x" not in [name for name, _ in running_buses()]


def test_the_number_of_a_channel_is_its_name() -> None:
    with (
        can.Bus(interface="r2psim", channel=0, served=False) as a,
        can.Bus(interface="r2psim", channel="0", served=False) as b,
    ):
        a.send(message(1))
        assert b.recv(SOON)


def test_another_bit_rate_is_refused(pair: tuple[can.BusABC, can.BusABC], channel: str) -> None:
    words = f"the bus {channel} has 1000000 bit/s, not 500000: ask for the same, or for none"
    with pytest.raises(can.CanInitializationError) as caught:
        can.Bus(interface="r2psim", channel=channel, bitrate=500_000)
    assert words in str(caught.value)
    with can.Bus(interface="r2psim", channel=channel, bitrate=1_000_000) as bus:
        assert bus.bitrate == 1_000_000  # type: ignore[attr-defined]


def test_what_can_does_not_have_is_refused(pair: tuple[can.BusABC, can.BusABC]) -> None:
    for wrong, words in (
        (message(1, is_fd=True), "without CAN FD"),
        (message(1, is_error_frame=True), "error frames come from errors"),
        (message(0x800, is_extended_id=False), "the identifier 0x800 has more than 11 bits"),
        (message(0x20000000), "the identifier 0x20000000 has more than 29 bits"),
        (message(1, bytes(9)), "9 bytes"),
    ):
        with pytest.raises(ValueError, match=words):
            pair[0].send(wrong)


def test_channels_are_found(pair: tuple[can.BusABC, can.BusABC], channel: str) -> None:
    found = can.detect_available_configs("r2psim")
    assert {"interface": "r2psim", "channel": channel} in found
    assert {"interface": "r2psim", "channel": "channel-0"} in found


async def shut_down_under_a_notifier(channel: str, options: dict[str, Any]) -> None:
    def open_bus() -> can.BusABC:
        return can.Bus(interface="r2psim", channel=channel, **options)

    loop = asyncio.get_running_loop()
    first = open_bus()
    notifier = can.Notifier(first, [print], loop=loop)
    first.shutdown()  # before the notifier, which watches the descriptor
    with open_bus() as sender, open_bus() as second:
        received: asyncio.Queue[can.Message] = asyncio.Queue()
        other = can.Notifier(second, [received.put_nowait], loop=loop)
        for identifier in range(2):
            sender.send(message(identifier))
            assert (await asyncio.wait_for(received.get(), SOON)).arbitration_id == identifier
            notifier.stop()  # the first time: of another descriptor than that of `second`
        other.stop()


def test_a_bus_is_shut_down_before_its_notifier(channel: str) -> None:
    asyncio.run(shut_down_under_a_notifier(channel, {"served": False}))
    r2p.sim.run(shut_down_under_a_notifier(channel, {}))


async def use_from_threads(channel: str) -> None:
    shared = r2p.sim.can_bus(channel)
    with can.Bus(interface="r2psim", channel=channel) as here:
        a, b = [await asyncio.to_thread(can.Bus, interface="r2psim", channel=channel) for _ in range(2)]
        with a, b:
            a.send(message(1))
            found = await asyncio.to_thread(b.recv, SOON)
            assert found is not None
            assert shared.bus.statistics.total.frames == 1
            with pytest.raises(can.CanOperationError, match=r"the bus stands still, too: use can.Notifier"):
                [here.recv(SOON) for _ in range(2)]


def test_a_bus_of_an_event_loop_is_used_from_threads(channel: str) -> None:
    asyncio.run(use_from_threads(channel))


def test_a_bus_ends_with_its_event_loop(channel: str) -> None:
    opened: list[can.BusABC] = []

    async def main() -> None:
        bus = r2p.sim.can_bus(channel)
        opened.append(await asyncio.to_thread(can.Bus, interface="r2psim", channel=channel))
        waiting = asyncio.get_running_loop().run_in_executor(None, opened[0].recv, SOON)
        await asyncio.sleep(0)
        waits.append(waiting)
        del bus

    waits: list[asyncio.Future[can.Message | None]] = []
    asyncio.run(main())
    for call in (opened[0].recv, partial(opened[0].send, message(1))):
        with pytest.raises(can.CanOperationError, match="the event loop that ran it has ended"):
            call()
    opened[0].shutdown()
    assert waits[0].done()


def test_python_can_first_and_modules_after_it(channel: str) -> None:
    async def main() -> None:
        via = f"sim:{channel}"
        async with (
            r2p.Module("A", via=via, watchdog=False) as module_a,
            r2p.Module("B", via=via, watchdog=False) as module_b,
            node_in(module_a) as alice,
            node_in(module_b) as bob,
        ):
            publisher, subscriber = alice.advertise("leds", Led), bob.subscribe("leds", Led)
            await publisher.wait_subscriber()
            with pytest.raises(r2p.TransportError, match="runs in a thread of its own"):
                r2p.sim.can_bus(channel)
            fetching = asyncio.create_task(subscriber.fetch())
            while not fetching.done():  # a busy computer loses its master, and events with it
                await publisher.publish(Led(led=7))
                await asyncio.wait([fetching], timeout=0.1)
            assert fetching.result() == Led(led=7)

    with can.Bus(interface="r2psim", channel=channel) as spy:
        asyncio.run(main())
        assert spy.recv(0)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork")
def test_a_fork_has_no_bus_but_opens_others(pair: tuple[can.BusABC, can.BusABC], channel: str) -> None:
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            pair[0].recv(0)
        except can.CanOperationError as error:
            os.write(writer, str(error).encode())
            with (
                can.Bus(interface="r2psim", channel=channel, served=False) as a,
                can.Bus(interface="r2psim", channel=channel, served=False) as b,
            ):
                a.send(message(0x123))
                os.write(writer, b"; %x" % getattr(b.recv(SOON), "arbitration_id", 0))
        finally:
            os._exit(0)
    os.close(writer)
    with os.fdopen(reader) as pipe:
        assert pipe.read().endswith("forked from the one that opened the bus: open buses after the fork; 123")
    os.waitpid(child, 0)
    pair[0].send(message(1))
    assert pair[1].recv(SOON)
