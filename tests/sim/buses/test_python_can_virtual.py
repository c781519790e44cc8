"""python-can's interface `r2psim` under virtual time: instants, arbitration, errors, asyncio."""

import asyncio
import contextlib
import itertools
from collections.abc import Iterator
from typing import Any

import can
import pytest

import r2p
import r2p.sim
from r2p.clock import clock_of
from r2p.codecs.can_bits import INTERMISSION, FrameField, frame_bits
from r2p.msg import Led
from r2p.testing.network import node_in
from r2p.units import SECOND

pytestmark = pytest.mark.virtual_time
BIT = 1000  # ns


def bus(**options: Any) -> can.BusABC:
    return can.Bus(interface="r2psim", channel="lab", **options)


def message(identifier: int, data: bytes = b"") -> can.Message:
    return can.Message(arbitration_id=identifier, data=data)


def received(node: can.BusABC) -> Iterator[can.Message]:
    while (found := node.recv(0)) is not None:
        yield found


def state(node: can.BusABC) -> can.BusState:
    return node.state


def identifiers(node: can.BusABC) -> list[int]:
    return [each.arbitration_id for each in received(node)]


async def test_a_message_arrives_when_its_frame_has_ended() -> None:
    start = clock_of().now()
    with bus() as a, bus() as b:
        a.send(message(0x123, b"hello"))
        assert b.recv(0) is None
        await asyncio.sleep(frame_bits(0x123, b"hello") * BIT / SECOND)
        found = b.recv(0)
    assert found is not None
    assert found.timestamp == (start + frame_bits(0x123, b"hello") * BIT) / SECOND
    assert (found.arbitration_id, bytes(found.data), found.is_rx) == (0x123, b"hello", True)
    assert found.channel == "lab"
    assert (found.is_extended_id, found.is_remote_frame, found.is_error_frame) == (True, False, False)


async def test_the_lowest_identifier_wins() -> None:
    with bus() as a, bus() as b, bus() as c:
        a.send(message(0x300))
        b.send(message(0x200))
        await asyncio.sleep(0.001)
        assert identifiers(c) == [0x200, 0x300]
        assert identifiers(a) == [0x200]


async def test_frames_of_all_kinds_are_arbitrated() -> None:
    kinds = [
        can.Message(arbitration_id=0x10, is_extended_id=False),
        can.Message(arbitration_id=0x10, is_extended_id=False, is_remote_frame=True, dlc=4),
        can.Message(arbitration_id=0x10 << 18, data=b"x"),
        can.Message(arbitration_id=0x10 << 18, is_remote_frame=True, dlc=4),
    ]
    with bus() as spy, contextlib.ExitStack() as stack:
        for sent in reversed(kinds):
            stack.enter_context(bus()).send(sent)
        await asyncio.sleep(0.001)
        found = list(received(spy))
    for one, other in zip(found, kinds, strict=True):
        assert one.equals(other, timestamp_delta=None, check_channel=False, check_direction=False)


async def test_messages_of_one_node_keep_their_order() -> None:
    with bus() as a, bus() as b:
        for identifier in (5, 9, 1, 7):
            a.send(message(identifier))
        await asyncio.sleep(0.001)
        assert identifiers(b) == [5, 9, 1, 7]


async def test_stamps_are_apart_as_frames_are_long() -> None:
    with bus() as a, bus() as b:
        data = [bytes([number] * 8) for number in range(100)]
        for each in data:
            a.send(message(0x1FFFFFFF, each))
        await asyncio.sleep(0.1)
        stamps = [each.timestamp for each in received(b)]
    lengths = [(frame_bits(0x1FFFFFFF, each) + INTERMISSION) * BIT / SECOND for each in data]
    assert [later - earlier for earlier, later in itertools.pairwise(stamps)] == pytest.approx(lengths[1:], abs=5e-7)


async def test_a_notifier_handles_each_message_at_the_instant_of_its_stamp() -> None:
    loop, instants = asyncio.get_running_loop(), []
    with bus() as a, bus() as b:
        reader = can.AsyncBufferedReader()
        with can.Notifier(b, [reader, lambda _: instants.append(clock_of().now() / SECOND)], loop=loop):
            for identifier in range(20):
                a.send(message(identifier, bytes(identifier % 9)))
            stamps = [(await reader.get_message()).timestamp for _ in range(20)]
    assert instants == stamps
    assert len(set(stamps)) == 20


async def test_own_messages_come_back_when_they_are_sent() -> None:
    with bus(receive_own_messages=True) as a, bus() as b:
        a.send(message(1))
        await asyncio.sleep(0.001)
        own, other = a.recv(0), b.recv(0)
    assert own is not None
    assert other is not None
    assert (own.is_rx, other.is_rx) == (False, True)
    assert own.timestamp == other.timestamp


async def test_nothing_else_comes_back() -> None:
    with bus() as a, bus():
        a.send(message(1))
        await asyncio.sleep(0.001)
        assert a.recv(0) is None


async def test_periodic_messages_are_exactly_periodic() -> None:
    with bus() as a, bus() as b:
        task = a.send_periodic(message(1), 0.0137)
        await asyncio.sleep(1.0)
        task.stop()
        await asyncio.sleep(1.0)
        stamps = [each.timestamp for each in received(b)]
    assert len(stamps) == 73
    assert [later - earlier for earlier, later in itertools.pairwise(stamps)] == pytest.approx([0.0137] * 72, abs=5e-7)


async def test_periodic_messages_change_end_and_start_again() -> None:
    counted = itertools.count()

    def count(each: can.Message) -> None:
        each.data[0] = next(counted)

    with bus() as a, bus() as b:
        task: Any = a.send_periodic([message(1, b"a"), message(1, b"b")], 0.01, duration=0.035)
        await asyncio.sleep(0.1)
        assert [bytes(each.data) for each in received(b)] == [b"a", b"b", b"a", b"b"]
        task.modify_data([message(1, b"c"), message(1, b"d")])
        task.start()
        await asyncio.sleep(0.1)
        assert [bytes(each.data) for each in received(b)] == [b"c", b"d", b"c", b"d"]
        a.send_periodic(message(1, b"_"), 0.01, modifier_callback=count)
        await asyncio.sleep(0.035)
        assert [each.data[0] for each in received(b)] == [0, 1, 2, 3]
        a.stop_all_periodic_tasks()
        await asyncio.sleep(0.1)
        assert identifiers(b) == []


async def test_periodic_messages_to_nobody_are_counted(caplog: pytest.LogCaptureFixture) -> None:
    with bus() as alone:
        task: Any = alone.send_periodic(message(1), 0.01)
        await asyncio.sleep(1.295)  # 128 wait, the others are lost
        assert task.lost == 2
        with bus() as other:
            await asyncio.sleep(1.0)
            assert len(list(received(other))) == 228
        assert task.lost == 2
    assert caplog.text.count("messages of send_periodic are lost, and counted in the task's lost") == 1
    assert "Traceback" not in caplog.text


async def test_a_periodic_message_after_bus_off_ends_its_task_in_words(caplog: pytest.LogCaptureFixture) -> None:
    with bus(noise=1.0) as alone, bus():
        task: Any = alone.send_periodic(message(1), 0.01)
        await asyncio.sleep(1.0)
        assert task.lost == 0
    assert "bus off, after too many errors: restart the controller first; send_periodic has ended" in caplog.text
    assert "Traceback" not in caplog.text


async def test_the_period_of_a_task_is_positive() -> None:
    with bus() as a, pytest.raises(ValueError, match="more than 0 s, not 0"):
        a.send_periodic(message(1), 0)


async def test_filters_count_for_the_messages_that_follow() -> None:
    with bus() as a, bus(can_filters=[{"can_id": 0x100, "can_mask": 0x700}]) as b:
        several: list[Any] = [{"can_id": 2, "can_mask": 7}, {"can_id": 3, "can_mask": 7}]
        no_filters: list[Any] = []
        for filters in (None, several, no_filters):
            for identifier in (0x001, 0x102, 0x203):
                a.send(message(identifier))
            await asyncio.sleep(0.001)
            b.set_filters(filters)
        assert identifiers(b) == [0x102, 0x001, 0x102, 0x203, 0x102, 0x203]


async def test_waiting_in_the_thread_of_the_loop_would_never_end() -> None:
    with bus() as a, bus() as b:
        for timeout in (None, 1.0):
            with pytest.raises(can.CanOperationError, match=r"stands still while recv\(\) waits: use can.Notifier"):
                a.recv(timeout)
        with pytest.raises(can.CanOperationError, match="stands still"):
            await asyncio.to_thread(a.recv)
        b.send(message(1))
        await asyncio.sleep(0.001)
        assert a.recv(1.0) is not None  # it does not have to wait


async def test_a_full_queue_is_said_at_once() -> None:
    with bus() as a, bus() as b:
        for _ in range(128):
            a.send(message(1))
        with pytest.raises(can.exceptions.CanTimeoutError, match=r"128 frames is full: await asyncio.sleep\(...\)"):
            a.send(message(1), 1.0)
        await asyncio.sleep(0.1)
        assert len(identifiers(b)) == 128
        a.send(message(2))


async def test_flushing_drops_what_has_not_started() -> None:
    with bus() as a, bus() as b:
        for identifier in range(10):
            a.send(message(identifier))
        await asyncio.sleep(100e-6)  # in the second frame
        a.flush_tx_buffer()
        await asyncio.sleep(0.01)
        assert identifiers(b) == [0, 1]
        a.send(message(3))
        await asyncio.sleep(0.01)
        assert identifiers(b) == [3]


async def test_messages_that_nobody_receives_are_counted(caplog: pytest.LogCaptureFixture) -> None:
    with bus() as a, bus(rx_queue_size=10) as b:
        for identifier in range(25):
            a.send(message(identifier))
        await asyncio.sleep(0.1)
        assert b.lost == 15  # type: ignore[attr-defined]
        assert identifiers(b) == list(range(15, 25))
    assert [each.getMessage() for each in caplog.records] == [
        "lab: under virtual time, 1000000 bit/s: 10 frames wait, and the oldest ones are dropped: receive them sooner"
    ]


async def test_a_bus_alone_is_error_passive_and_sends_as_soon_as_another_one_listens() -> None:
    with bus() as a:
        a.send(message(1))
        await asyncio.sleep(0.1)
        assert state(a) is can.BusState.PASSIVE
        passive = a.recv(0)
        assert passive is not None
        assert (passive.is_error_frame, passive.arbitration_id, passive.data[1]) == (True, 0x204, 0x20)
        assert passive.data[6] > 127
        with bus() as b:
            await asyncio.sleep(0.1)
            assert identifiers(b) == [1]
        assert state(a) is can.BusState.ACTIVE
        active = a.recv(0)
        assert active is not None
        assert (active.is_error_frame, active.arbitration_id, active.data[1]) == (True, 0x204, 0x40)


async def test_error_messages_can_be_left_out() -> None:
    with bus(ignore_rx_error_frames=True, berr_reporting=True) as a:
        a.send(message(1))
        await asyncio.sleep(0.1)
        assert a.state is can.BusState.PASSIVE
        assert a.recv(0) is None


async def test_each_error_frame_is_a_message_for_those_who_ask() -> None:
    with bus(berr_reporting=True) as a, bus(berr_reporting=True) as b:
        r2p.sim.can_bus("lab").bus.disturb_next(20)
        a.send(message(0x555))
        await asyncio.sleep(0.001)
        sender, (receiver, frame) = list(received(a)), received(b)
        assert [each.is_error_frame for each in sender] == [True]
        assert sender[0].arbitration_id == receiver.arbitration_id == 0x288
        assert (sender[0].data[2], sender[0].data[3], sender[0].data[6]) == (0x81, FrameField.ID_17_TO_13, 8)
        assert (receiver.is_error_frame, receiver.data[2], receiver.data[7]) == (True, 0x04, 1)
        assert frame.arbitration_id == 0x555  # it was sent again


async def test_too_many_errors_lead_to_bus_off() -> None:
    with bus() as a, bus() as b:
        wire = r2p.sim.can_bus("lab").bus
        wire.noise = 1.0
        a.send(message(1))
        await asyncio.sleep(0.1)
        assert a.state is can.BusState.ERROR
        assert [each.arbitration_id & 0x44 for each in received(a)] == [0x04, 0x40]
        with pytest.raises(can.CanOperationError, match="bus off, after too many errors"):
            a.send(message(2))
        wire.noise = 0.0
        list(received(b))
        a.state = can.BusState.ACTIVE
        await asyncio.sleep(0.1)
        assert a.state is can.BusState.ACTIVE
        assert [each.arbitration_id & 0x100 for each in received(a)] == [0x100]
        a.send(message(2))
        await asyncio.sleep(0.1)
        assert [each.arbitration_id for each in received(b) if not each.is_error_frame] == [1, 2]
        with pytest.raises(NotImplementedError, match="open the bus with listen_only=True"):
            a.state = can.BusState.PASSIVE


async def test_one_shot_gives_up_what_loses() -> None:
    with bus(one_shot=True) as a, bus() as b, bus() as c:
        a.send(message(0x300))
        b.send(message(0x200))
        a.send(message(0x301))
        await asyncio.sleep(0.01)
        assert identifiers(c) == [0x200, 0x301]


async def test_a_bus_that_only_listens_does_not_acknowledge() -> None:
    with bus() as a, bus(listen_only=True) as spy:
        a.send(message(1))
        await asyncio.sleep(0.1)
        assert a.state is can.BusState.PASSIVE
        assert spy.state is can.BusState.ACTIVE
        with pytest.raises(can.CanOperationError, match="only listens: open the bus without listen_only"):
            spy.send(message(1))
        with bus() as b:
            await asyncio.sleep(0.1)
            assert identifiers(b) == [1]
        assert identifiers(spy)[-1] == 1


async def test_the_same_seed_is_the_same_run() -> None:
    def run(seed: int) -> list[tuple[float, int]]:
        async def main() -> list[tuple[float, int]]:
            with bus(noise=0.2, seed=seed) as a, bus() as b:
                for identifier in range(50):
                    a.send(message(identifier))
                await asyncio.sleep(1.0)
                return [(each.timestamp, each.arbitration_id) for each in received(b)]

        return r2p.sim.run(main)

    first, again, other = [await asyncio.to_thread(run, seed) for seed in (1, 1, 2)]
    assert first == again != other


async def test_the_clock_of_a_node_may_be_wrong() -> None:
    with bus() as a, bus(drift=100.0, offset=2.5) as b, bus() as c:
        await asyncio.sleep(10.0)
        a.send(message(1))
        await asyncio.sleep(0.001)
        wrong, right = b.recv(0), c.recv(0)
    assert wrong is not None
    assert right is not None
    assert wrong.timestamp - right.timestamp == pytest.approx(2.501, abs=1e-6)


async def test_a_bus_that_closes_sends_its_queue() -> None:
    with bus() as b:
        with bus() as a:
            for identifier in range(5):
                a.send(message(identifier))
        await asyncio.sleep(0.001)
        assert identifiers(b) == [0, 1, 2, 3, 4]
        assert list(r2p.sim.can_bus("lab").names) == ["python-can"]


async def test_a_bus_that_closes_gives_up_after_a_second() -> None:
    with bus(listen_only=True):
        with bus(name="alone") as a:
            a.send(message(1))
        await asyncio.sleep(0.9)
        assert "alone" in r2p.sim.can_bus("lab").names
        await asyncio.sleep(0.2)
        assert "alone" not in r2p.sim.can_bus("lab").names


async def test_modules_and_python_can_are_on_one_bus() -> None:
    async with (
        r2p.Module("A", via="sim:lab", watchdog=False) as module_a,
        r2p.Module("B", via="sim:lab", watchdog=False) as module_b,
        node_in(module_a) as alice,
        node_in(module_b) as bob,
    ):
        with bus() as spy:
            publisher, subscriber = alice.advertise("leds", Led), bob.subscribe("leds", Led)
            await publisher.wait_subscriber()
            list(received(spy))
            await publisher.publish(Led(led=7))
            assert await subscriber.fetch(timeout=1.0) == Led(led=7)
            assert any(each.data[:1] == b"\7" for each in received(spy))


async def test_python_can_may_be_there_first() -> None:
    with bus(bitrate=500_000) as spy:
        async with r2p.Module("A", via="sim:lab,bitrate=500000,slots=30", watchdog=False):
            await asyncio.sleep(5.0)
            assert r2p.sim.can_bus("lab").bus.statistics.by_node["A"].frames
            assert identifiers(spy)


async def test_power_cuts_reach_python_can() -> None:
    with bus() as a, bus(name="ecu") as b:
        r2p.sim.can_bus("lab").port("ecu").power_off()
        assert b.state is can.BusState.ERROR
        b.send(message(1))
        await asyncio.sleep(0.1)
        assert identifiers(a) == []
        r2p.sim.can_bus("lab").port("ecu").power_on()
        await asyncio.sleep(0.1)
        assert identifiers(a) == [1]
