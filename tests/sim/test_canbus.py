"""The simulated CAN bus without faults: timing, arbitration, mailboxes, clocks, statistics."""

from __future__ import annotations

import asyncio
import hashlib
from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from r2p.clock import clock_of
from r2p.codecs.can_bits import EXTENDED, REMOTE, AnyFrame, Frame, OtherFrame, arbitration_field
from r2p.codecs.rtcan import encode_identifier
from r2p.errors import Deadlock, MessageError
from r2p.sim import run
from r2p.sim.can import CanBus, CanController, CanNode, Latency
from tests import can_reference
from tests.can_watch import BIT, GAP, HIGH, LOW, MIDDLE, Watch, at, bits, gives_up, length, make

if TYPE_CHECKING:
    from collections.abc import Callable

# Time


@pytest.mark.virtual_time
async def test_a_frame_takes_its_bits() -> None:
    _, watch, (a, _) = make("A", "B")
    await at(5_000_017)
    a.request(LOW)
    await at(6_000_000)
    end = 5_000_017 + length(LOW)
    assert watch.spans == [(5_000_017, end, LOW)]
    assert watch.heard == [("sent", "A", LOW, end), ("received", "B", LOW, end)]


@pytest.mark.virtual_time
async def test_the_next_frame_starts_right_after_the_intermission() -> None:
    _, watch, (a, b) = make("A", "B")
    a.request(LOW, 0)
    a.request(HIGH, 1)
    b.request(MIDDLE)
    await asyncio.sleep(0.001)
    first = length(LOW)
    second = first + GAP + length(MIDDLE)
    third = second + GAP + length(HIGH)
    assert watch.spans == [(0, first, LOW), (first + GAP, second, MIDDLE), (second + GAP, third, HIGH)]


@pytest.mark.virtual_time
@pytest.mark.parametrize("late", [0, 1, GAP - 1, GAP])
async def test_a_request_in_the_intermission_waits_for_its_end(late: int) -> None:
    _, watch, (a, b) = make("A", "B")
    a.request(LOW)
    await at(length(LOW) + late)
    b.request(MIDDLE)
    await asyncio.sleep(0.001)
    assert watch.records[1].start == length(LOW) + GAP


@pytest.mark.virtual_time
async def test_an_idle_bus_starts_at_once() -> None:
    _, watch, (a, b) = make("A", "B")
    a.request(LOW)
    await at(length(LOW) + GAP + 1)
    b.request(MIDDLE)
    await asyncio.sleep(0.001)
    assert watch.records[1].start == length(LOW) + GAP + 1


@pytest.mark.virtual_time
@pytest.mark.parametrize(("late", "winner"), [(0, LOW), (BIT - 1, LOW), (BIT, HIGH), (BIT + 1, HIGH)])
async def test_only_what_is_requested_within_a_bit_of_the_start_contends(late: int, winner: Frame) -> None:
    _, watch, (a, b) = make("A", "B")
    await at(1_000_000)
    a.request(HIGH)
    await at(1_000_000 + late)
    b.request(LOW)
    await asyncio.sleep(0.001)
    assert watch.spans[0] == (1_000_000, 1_000_000 + length(winner), winner)
    assert [record.frame for record in watch.records] == [winner, HIGH if winner is LOW else LOW]


@pytest.mark.virtual_time
@pytest.mark.parametrize("bitrate", [125_000, 250_000, 500_000])
async def test_bit_rate(bitrate: int) -> None:
    bus = CanBus(asyncio.get_running_loop(), bitrate=bitrate)
    watch = Watch(bus)
    a, _ = bus.attach(CanNode("A")), bus.attach(CanNode("B"))
    a.request(LOW)
    await asyncio.sleep(0.01)
    assert watch.records[0].end == bits(LOW) * 1_000_000_000 // bitrate


@pytest.mark.virtual_time
async def test_a_bit_takes_whole_nanoseconds() -> None:
    with pytest.raises(ValueError, match="whole nanoseconds"):
        CanBus(asyncio.get_running_loop(), bitrate=83_333)


# Arbitration


def prefixes(draw: st.DrawFn) -> AnyFrame:
    """A frame of any kind, one of many that begin with the same bits: ties up to RTR, SRR, IDE, the last bit."""
    base = draw(st.sampled_from([0x2AA, 0x2AB, 0x2BA, 0x000, 0x7FF]))
    data = draw(st.binary(max_size=8))
    remote = draw(st.sampled_from([None, None, 0, 8, 15]))
    if draw(st.booleans()):
        return OtherFrame(base, data) if remote is None else OtherFrame(base, b"", False, remote)
    identifier = base << 18 | draw(st.sampled_from([0, 1, 0x155, 0x3FFFF]))
    return Frame(identifier, data) if remote is None else OtherFrame(identifier, b"", True, remote)


def extended(draw: st.DrawFn) -> AnyFrame:
    """A frame with a 29-bit identifier, one of many that differ in one bit."""
    near = st.integers(0, 28).map(lambda bit: 0x0AAA5555 ^ 1 << bit)
    return Frame(draw(near | st.integers(0, (1 << 29) - 1)), draw(st.binary(max_size=8)))


@st.composite
def traffic(draw: st.DrawFn, make: Callable[[st.DrawFn], AnyFrame]) -> list[list[tuple[int, AnyFrame]]]:
    """What each of 2 to 4 nodes requests: (at which bit, frame). No two frames have one identifier and kind."""
    frames = {arbitration_field(each): each for each in [make(draw) for _ in range(draw(st.integers(2, 10)))]}
    nodes: list[list[tuple[int, AnyFrame]]] = [[] for _ in range(draw(st.integers(2, 4)))]
    for frame in frames.values():
        when = draw(st.sampled_from([0, 0, 1, 60, 120, 130, 400]) | st.integers(0, 700))
        draw(st.sampled_from(nodes)).append((when, frame))
    return nodes


@given(traffic(extended) | traffic(prefixes), st.booleans())
def test_as_the_bus_that_goes_bit_by_bit(nodes: list[list[tuple[int, AnyFrame]]], one_shot: bool) -> None:
    async def main() -> None:
        loop = asyncio.get_running_loop()
        bus = CanBus(loop)
        watch = Watch(bus)
        for number, requests in enumerate(nodes):
            node = CanNode(str(number), one_shot=one_shot, mailboxes=10)
            controller = watch.add(bus.attach(node))
            for box, (bit, frame) in enumerate(requests):
                loop.call_at(bit * BIT / 1e9, controller.request, frame, box)
        await asyncio.sleep(0.01)
        expected = can_reference.simulate([can_reference.Node(list(requests), one_shot) for requests in nodes])
        frames = [(r.start // BIT, r.end // BIT, r.frame, int(r.senders[0])) for r in watch.records]
        assert frames == expected.frames
        assert bus.statistics.total.lost == len(expected.losses)
        if one_shot:
            losses = [(stamp // BIT, frame, int(name)) for name, frame, stamp in watch.of("lost")]
            assert sorted(losses, key=repr) == sorted(expected.losses, key=repr)
        received = sorted((stamp // BIT, repr(frame), int(name)) for name, frame, stamp in watch.of("received"))
        everybody = range(len(nodes))
        heard = sorted((e, repr(f), n) for _, e, f, sender in expected.frames for n in everybody if n != sender)
        assert received == heard

    run(main)


@pytest.mark.virtual_time
async def test_one_shot_gives_up_and_says_when() -> None:
    _, watch, (a, b, _) = make("A", "B", "C", one_shot=True)
    a.request(LOW)
    b.request(HIGH, 1)
    await asyncio.sleep(0.01)
    assert [record.frame for record in watch.records] == [LOW]
    assert watch.of("lost") == [("B", HIGH, gives_up(HIGH, LOW))]
    assert b.pending(1) is None


@pytest.mark.virtual_time
async def test_the_mailbox_of_a_lost_frame_is_free_when_its_node_hears_of_it() -> None:
    _, watch, (a, b) = make("A", "B", one_shot=True)
    b.on_lost = lambda frame, _: b.request(frame)
    a.request(LOW)
    b.request(HIGH)
    await asyncio.sleep(0.001)
    assert [record.frame for record in watch.records] == [LOW, HIGH]


@pytest.mark.virtual_time
async def test_identical_frames_are_one() -> None:
    _, watch, (a, b, _) = make("A", "B", "C")
    a.request(LOW)
    b.request(Frame(LOW.id, LOW.data))
    await asyncio.sleep(0.001)
    assert [(record.senders, record.error) for record in watch.records] == [(("A", "B"), None)]
    assert watch.of("sent") == [("A", LOW, length(LOW)), ("B", LOW, length(LOW))]
    assert watch.of("received") == [("C", LOW, length(LOW))]


# Mailboxes


@pytest.mark.virtual_time
async def test_a_mailbox_holds_one_frame() -> None:
    _, watch, (a, _) = make("A", "B")
    assert a.request(LOW)
    assert not a.request(MIDDLE)
    assert a.request(MIDDLE, 1)
    assert a.pending() is LOW
    await asyncio.sleep(0.001)
    assert a.pending() is None
    assert [record.frame for record in watch.records] == [LOW, MIDDLE]
    with pytest.raises(IndexError, match="mailboxes 0 to 2, not 3"):
        a.request(LOW, 3)


@pytest.mark.virtual_time
@pytest.mark.parametrize(
    "frame",
    [Frame(1 << 29, b""), Frame(-1, b""), Frame(0, bytes(9)), OtherFrame(0x800), OtherFrame(1, b"", extended=True)],
)
async def test_what_is_no_frame(frame: AnyFrame) -> None:
    _, watch, (a, _) = make("A", "B")
    with pytest.raises(MessageError):
        a.request(frame)
    a.request(LOW)
    await asyncio.sleep(0.001)
    assert [record.frame for record in watch.records] == [LOW]


@pytest.mark.virtual_time
async def test_the_lowest_identifier_of_the_mailboxes_goes_first_but_stops_no_frame() -> None:
    _, watch, (a, _) = make("A", "B")
    a.request(HIGH, 0)
    await at(BIT - 1)  # its start of frame has begun
    a.request(LOW, 2)
    a.request(MIDDLE, 1)
    await asyncio.sleep(0.001)
    assert [record.frame for record in watch.records] == [HIGH, LOW, MIDDLE]


@pytest.mark.virtual_time
async def test_a_pending_frame_can_be_withdrawn() -> None:
    _, watch, (a, b) = make("A", "B")
    a.request(LOW)
    await at(length(LOW))
    b.request(MIDDLE)
    a.request(HIGH)
    await at(length(LOW) + GAP - 1)
    assert b.abort()
    assert not b.abort()
    await asyncio.sleep(0.001)
    assert [record.frame for record in watch.records] == [LOW, HIGH]
    assert watch.records[1].start == length(LOW) + GAP


@pytest.mark.virtual_time
async def test_the_last_pending_frame_can_be_withdrawn() -> None:
    _, watch, (a, _) = make("A", "B")
    a.request(LOW)
    await at(length(LOW))
    a.request(MIDDLE)
    assert a.abort()
    await at(10 * length(LOW))
    a.request(HIGH)
    await asyncio.sleep(0.001)
    assert [record.start for record in watch.records] == [0, 10 * length(LOW)]


@pytest.mark.virtual_time
@pytest.mark.parametrize("late", [0, 1, BIT, length(LOW) - 1])
async def test_a_frame_that_has_started_can_not_be_withdrawn(late: int) -> None:
    _, watch, (a, _) = make("A", "B")
    a.request(LOW)
    await at(late)
    assert not a.abort()
    await asyncio.sleep(0.001)
    assert [record.frame for record in watch.records] == [LOW]


@pytest.mark.virtual_time
async def test_a_frame_that_has_lost_can_be_withdrawn_again() -> None:
    _, watch, (a, b) = make("A", "B")
    lost = gives_up(HIGH, LOW)
    a.request(LOW)
    b.request(HIGH)
    await at(lost - 1)
    assert not b.abort()
    await at(lost)
    assert b.abort()
    await asyncio.sleep(0.001)
    assert [record.frame for record in watch.records] == [LOW]


@pytest.mark.virtual_time
async def test_a_frame_on_its_way_to_the_controller_can_be_withdrawn() -> None:
    _, watch, (a, _) = make("A", "B", transmit=Latency(10_000))
    a.request(LOW)
    await at(9_999)
    assert a.abort()
    a.request(MIDDLE)
    await asyncio.sleep(0.001)
    assert watch.spans == [(19_999, 19_999 + length(MIDDLE), MIDDLE)]


@pytest.mark.virtual_time
async def test_filters() -> None:
    _, watch, (a, b, c) = make("A", "B", "C")
    b.filters = [(0x0206 << 7, 0xFFFF << 7), (0x0207 << 7, 0xFFFF << 7)]
    c.filters = [(0x0205 << 7, 0xFFFF << 7)]
    for box, frame in enumerate((LOW, MIDDLE, HIGH)):
        a.request(frame, box)
    await asyncio.sleep(0.001)
    assert [(name, frame) for name, frame, _ in watch.of("received")] == [("C", LOW), ("B", MIDDLE), ("B", HIGH)]


@pytest.mark.virtual_time
@pytest.mark.parametrize(
    ("filters", "passing"),
    [
        ([], "data remote data29 remote29"),
        ([(0x123, 0x7FF)], "data remote data29 remote29"),  # the flags are left open
        ([(0x123, 0x7FF | EXTENDED)], "data remote"),
        ([(0x123 | EXTENDED, 0x7FF | EXTENDED | REMOTE)], "data29"),
        ([(REMOTE, REMOTE)], "remote remote29"),
        ([(0x122, 0x7FF), (0x123, EXTENDED | REMOTE | 0x7FF)], "data"),
    ],
)
async def test_filters_with_flags(filters: list[tuple[int, int]], passing: str) -> None:
    _, watch, (a, b) = make("A", "B")
    frames: dict[str, AnyFrame] = {
        "data": OtherFrame(0x123, b"1"),
        "remote": OtherFrame(0x123, b"", False, 1),
        "data29": Frame(0x123, b"1"),
        "remote29": OtherFrame(0x123, b"", True, 1),
    }
    b.filters = filters
    for frame in frames.values():
        a.request(frame)
        await asyncio.sleep(0.001)
    assert [frame for _, frame, _ in watch.of("received")] == [frames[name] for name in passing.split()]


# Clocks and delays


@given(
    st.integers(0, 10**15),
    st.integers(-(10**12), 10**12),
    st.floats(-500, 500).map(lambda ppm: round(ppm, 3)),
)
def test_local_time_and_back(true: int, offset: int, drift_ppm: float) -> None:
    async def main() -> None:
        clock = CanBus(asyncio.get_running_loop()).attach(CanNode("A", offset=offset, drift_ppm=drift_ppm)).clock
        local = clock.local(true)
        assert abs(local - offset - true * (1 + drift_ppm / 1e6)) < 1.5  # 1, and what floats lose
        assert clock.local(clock.true(local)) >= local
        assert clock.local(clock.true(local) - 1) < local

    run(main)


@pytest.mark.virtual_time
async def test_each_node_stamps_with_its_own_clock() -> None:
    bus = CanBus(asyncio.get_running_loop())
    watch = Watch(bus)
    fast = watch.add(bus.attach(CanNode("fast", offset=7_000, drift_ppm=50.0)))
    slow = watch.add(bus.attach(CanNode("slow", drift_ppm=-50.0)))
    await asyncio.sleep(10)
    fast.request(LOW)
    utc = clock_of().now()
    assert fast.clock.monotonic() == 10_000_000_000 + 500_000 + 7_000
    assert slow.clock.monotonic() == 10_000_000_000 - 500_000
    assert slow.clock.now() == utc - 500_000
    await asyncio.sleep(0.001)
    end = 10_000_000_000 + length(LOW)
    assert watch.of("received") == [("slow", LOW, end - 500_000 - (length(LOW) * 50 // 1_000_000 + 1))]
    assert [record.end for record in watch.records] == [end]


@pytest.mark.virtual_time
async def test_timers_of_a_node_go_by_its_clock() -> None:
    bus, _, (a, b) = make("A", "B", drift_ppm=100.0)
    fired: list[tuple[int, int]] = []
    for local in (1_000_100_000, 500_000_000):
        a.call_at(local, lambda: fired.append((clock_of().monotonic(), a.clock.monotonic())))
    b.call_at(700_000_000, fired.clear).cancel()
    await asyncio.sleep(1)
    true = -(-500_000_000 * 1_000_000 // 1_000_100)
    assert fired == [(true, 500_000_000), (1_000_000_000, 1_000_100_000)]
    assert bus.timeline.now() == 1_000_000_000


@pytest.mark.virtual_time
async def test_a_timer_in_the_past_is_now() -> None:
    _, _, (a, _) = make("A", "B")
    await asyncio.sleep(1)
    fired: list[int] = []
    a.call_at(5, lambda: fired.append(a.clock.monotonic()))
    await asyncio.sleep(1)
    assert fired == [1_000_000_000]


@pytest.mark.virtual_time
async def test_delays_without_jitter_are_exact() -> None:
    _, watch, (a, _) = make("A", "B", transmit=Latency(4_000), receive=Latency(6_000))
    a.request(LOW)
    await asyncio.sleep(0.001)
    assert watch.spans == [(4_000, 4_000 + length(LOW), LOW)]
    heard = 10_000 + length(LOW)
    assert watch.heard == [("sent", "A", LOW, heard), ("received", "B", LOW, heard)]


@pytest.mark.virtual_time
async def test_jitter_is_spread_over_its_range() -> None:
    _, watch, (a, _) = make("A", "B", transmit=Latency(5_000, 3_000), receive=Latency(10_000, 3_000))
    for cycle in range(500):
        await at(cycle * 1_000_000)
        a.request(LOW)
    await asyncio.sleep(0.001)
    sent = [record.start % 1_000_000 for record in watch.records]
    heard = [stamp - record.end for (_, _, stamp), record in zip(watch.of("received"), watch.records, strict=True)]
    assert (min(sent) // 100, max(sent) // 100) == (20, 79)
    assert (min(heard) // 100, max(heard) // 100) == (70, 129)


def test_a_delay_is_never_negative() -> None:
    with pytest.raises(ValueError, match="the jitter"):
        Latency(1_000, 2_000)


@pytest.mark.virtual_time
async def test_a_node_hears_in_order_however_late() -> None:
    _, watch, (a, _) = make("A", "B", receive=Latency(1_000_000, 1_000_000))
    frames = [Frame(LOW.id, bytes([number])) for number in range(100)]
    for number, frame in enumerate(frames):
        await at(number * 200_000)
        a.request(frame)
    await asyncio.sleep(0.01)
    received = watch.of("received")
    assert [frame for _, frame, _ in received] == frames
    assert [stamp for _, _, stamp in received] == sorted(stamp for _, _, stamp in received)


# The same again


class Busy:
    """A node that always wants to send, and records what it receives."""

    def __init__(self, controller: CanController, trace: Any) -> None:
        self.controller = controller
        self.trace = trace
        self.count = 0
        controller.on_sent = controller.on_lost = controller.on_error = self.again
        controller.on_receive = self.hear
        self.again()

    def hear(self, *args: object) -> None:
        self.trace.update(repr((self.controller.name, args)).encode())

    def again(self, *args: object) -> None:
        self.hear(*args)
        self.count += 1
        identifier = encode_identifier(1 + self.count * 7 % 62, 0x0200 + ord(self.controller.name))
        self.controller.request(Frame(identifier, self.count.to_bytes(8, "little")))


async def busy(seed: int) -> str:
    bus = CanBus(asyncio.get_running_loop(), seed=seed, noise=0.01)
    trace = hashlib.sha256()
    bus.observers.append(lambda record: trace.update(repr(record).encode()))
    delay = Latency(5_000, 3_000)
    for number, name in enumerate("ABCD"):
        node = CanNode(
            name, one_shot=True, drift_ppm=10.0 * number, transmit=delay, receive=delay, loss=0.01, noise=0.01
        )
        Busy(bus.attach(node), trace)
    await asyncio.sleep(0.1)
    assert bus.load() > 0.9
    return trace.hexdigest()


def test_one_seed_one_course_of_events() -> None:
    first, again, other = (run(busy(seed)) for seed in (1, 1, 2))
    assert first == again
    assert first != other


# The loop


@pytest.mark.virtual_time
async def test_the_rest_of_the_loop_takes_part_at_its_own_instants() -> None:
    _, watch, (a, b) = make("A", "B")
    a.on_sent = lambda frame, _: a.request(frame)
    b.on_receive = lambda _, stamp: order.append(stamp)
    order: list[int] = []
    a.request(LOW)
    for _ in range(100):
        await asyncio.sleep(0.000_137)
        order.append(clock_of().monotonic())
        assert watch.records == [record for record in watch.records if record.end <= clock_of().monotonic()]
    assert order == sorted(order)
    assert len(order) == 100 + len(watch.records)
    starts = [record.start for record in watch.records]
    assert starts == [number * (length(LOW) + GAP) for number in range(len(starts))]


@pytest.mark.virtual_time
async def test_a_task_that_an_event_wakes_runs_before_the_next_event() -> None:
    _, watch, (a, b) = make("A", "B")
    woken = asyncio.Event()
    b.on_receive = lambda *_: woken.set()
    a.on_sent = lambda frame, _: a.request(frame)
    a.request(LOW)
    for number in range(1, 10):
        await woken.wait()
        woken.clear()
        assert clock_of().monotonic() == watch.records[-1].end
        assert len(watch.records) == number


@pytest.mark.virtual_time
async def test_time_stands_still_for_a_job_in_a_thread() -> None:
    _, _, (a, b) = make("A", "B")
    loop = asyncio.get_running_loop()
    jobs: list[asyncio.Future[int]] = []
    done: list[bool] = []

    def start_job(*_: object) -> None:
        done.extend(job.done() for job in jobs)
        jobs[:] = [loop.run_in_executor(None, sum, range(1000))]

    b.on_receive = start_job
    for box, frame in enumerate((LOW, MIDDLE, HIGH)):
        a.request(frame, box)
    await asyncio.sleep(0.001)
    assert done == [True, True]


def test_the_end_of_virtual_time_is_the_end_of_the_bus() -> None:
    async def main() -> None:
        _, _, (a, _) = make("A", "B")
        a.call_at(2**23 * 10**9, fired.append, "too late")
        a.call_at(1, fired.append, "in time")
        await asyncio.Event().wait()

    fired: list[str] = []
    with pytest.raises(Deadlock, match="over"):
        run(main)
    assert fired == ["in time"]


@pytest.mark.virtual_time
async def test_a_callback_that_raises_does_not_stop_the_bus() -> None:
    _, watch, (a, b) = make("A", "B")
    raised: list[object] = []
    asyncio.get_running_loop().set_exception_handler(lambda _, context: raised.append(context["exception"]))
    error = LookupError()

    def fail(*_: object) -> None:
        raise error

    b.on_receive = fail
    for box, frame in enumerate((LOW, MIDDLE)):
        a.request(frame, box)
    await asyncio.sleep(0.001)
    assert raised == [error, error]
    assert [frame for _, frame, _ in watch.of("sent")] == [LOW, MIDDLE]


@pytest.mark.virtual_time
async def test_nothing_happens_after_close() -> None:
    bus, watch, (a, _) = make("A", "B")
    a.request(LOW)
    bus.close()
    await asyncio.sleep(0.001)
    assert not watch.heard


@pytest.mark.anyio
async def test_paced_to_real_time() -> None:
    bus, watch, (a, b) = make("A", "B")
    done = asyncio.Event()
    began = clock_of().monotonic()
    a.on_sent = lambda frame, _: done.set() if len(watch.records) == 30 else a.request(frame)
    a.request(LOW)
    b.request(HIGH)
    await done.wait()
    bus.close()
    first = watch.records[0].start
    assert first >= began
    assert clock_of().monotonic() >= watch.records[-1].end
    # however late the loop is, on the bus each frame follows the one before
    assert [record.start for record in watch.records[:30]] == [first + n * (length(LOW) + GAP) for n in range(30)]
    assert [stamp for _, _, stamp in watch.of("received")][:30] == [record.end for record in watch.records[:30]]


# Statistics


@pytest.mark.virtual_time
async def test_statistics() -> None:
    bus, _, (a, b) = make("A", "B")
    a.request(LOW)
    b.request(HIGH)
    await asyncio.sleep(0.001)
    a.request(LOW)
    await asyncio.sleep(0.001)
    total = bus.statistics.total
    assert (total.frames, total.bits, total.lost, total.errors) == (3, 2 * bits(LOW) + bits(HIGH), 1, 0)
    assert bus.load() == (total.bits + 9) / 2000
    assert {name: (c.frames, c.bits, c.lost) for name, c in bus.statistics.by_node.items()} == {
        "A": (2, 2 * bits(LOW), 0),
        "B": (1, bits(HIGH), 1),
    }
    assert {i: (c.frames, c.bits, c.lost) for i, c in bus.statistics.by_message.items()} == {
        0x0205: (2, 2 * bits(LOW), 0),
        0x0207: (1, bits(HIGH), 1),
    }
    bus.reset_statistics()
    assert bus.load() == 0
    await asyncio.sleep(0.001)
    assert bus.statistics.total.frames == 0


@pytest.mark.virtual_time
async def test_statistics_of_identifiers_that_have_the_same_number() -> None:
    bus, _, (a, b) = make("A", "B")
    frames: list[AnyFrame] = [
        OtherFrame(0x205),
        OtherFrame(0x205, b"", False, 2),
        LOW,
        OtherFrame(LOW.id, b"", True, 8),
    ]
    for frame in frames:
        a.request(frame)
        await asyncio.sleep(0.001)
    a.request(OtherFrame(0))
    b.request(OtherFrame(0x205))
    await asyncio.sleep(0.001)
    frames += [OtherFrame(0), OtherFrame(0x205)]
    statistics = bus.statistics
    assert {i: (c.frames, c.lost) for i, c in statistics.by_message.items()} == {0x0205: (2, 0)}
    assert {i: (c.frames, c.lost) for i, c in statistics.by_standard_id.items()} == {0x205: (3, 1), 0: (1, 0)}
    assert statistics.total.bits == sum(map(bits, frames))
    assert statistics.by_node["A"].frames == 5


@pytest.mark.virtual_time
async def test_a_saturated_bus_has_load_1() -> None:
    bus, _, (a, b) = make("A", "B")
    a.on_sent = lambda frame, _: a.request(frame)
    b.on_sent = lambda frame, _: b.request(frame)
    a.request(LOW)
    b.request(MIDDLE)
    await at(1000 * (length(LOW) + GAP))
    assert bus.load() == 1.0


@pytest.mark.virtual_time
async def test_names_are_unique() -> None:
    bus, _, (a,) = make("A")
    with pytest.raises(ValueError, match="already a node A on this bus"):
        bus.attach(CanNode("A"))
    bus.detach(a)
    again = bus.attach(CanNode("A"))
    assert again.request(LOW)
    assert not a.request(LOW)
