"""python-can on a simulated bus: how many frames it keeps up with, beside python-can's own virtual bus."""

import statistics
import threading
import time
from collections.abc import Iterator
from typing import Any, NamedTuple

import can

from benchmarks.table import Row, rate
from r2p.codecs.can_bits import INTERMISSION, frame_bits

FRAMES = 30_000
ROUND_TRIPS = 500
MESSAGE = can.Message(arbitration_id=0x123456, data=b"12345678")
BITS = frame_bits(MESSAGE.arbitration_id, bytes(MESSAGE.data)) + INTERMISSION


class Flow(NamedTuple):
    """Frames a second from one `can.Bus` to another, and the seconds of processor time that each took."""

    rate: float
    cost: float


def flow(interface: str, **options: Any) -> Flow:
    """One thread sends as fast as it can, another one receives."""
    with (
        can.Bus(interface=interface, channel="benchmark", **options) as sender,
        can.Bus(interface=interface, channel="benchmark", **options) as receiver,
    ):
        thread = threading.Thread(target=_send, args=(sender,))
        began, spent = time.perf_counter(), time.process_time()
        thread.start()
        for _ in range(FRAMES):
            assert receiver.recv(10.0)
        took, spent = time.perf_counter() - began, time.process_time() - spent
        thread.join()
    return Flow(FRAMES / took, spent / FRAMES)


def round_trip(interface: str, **options: Any) -> float:
    """The median time of a message to another thread and back, in seconds."""
    with (
        can.Bus(interface=interface, channel="benchmark", **options) as here,
        can.Bus(interface=interface, channel="benchmark", **options) as there,
    ):
        thread = threading.Thread(target=_echo, args=(there,))
        thread.start()
        times = []
        for _ in range(ROUND_TRIPS):
            began = time.perf_counter()
            here.send(MESSAGE)
            assert here.recv(10.0)
            times.append(time.perf_counter() - began)
        thread.join()
    return statistics.median(times)


def rows() -> Iterator[Row]:
    virtual = flow("virtual")
    beside = f"python-can's virtual: {rate(virtual.rate)}, {virtual.cost * 1e6:.0f} us each"
    for bitrate, share in ((1_000_000, 0.95), (10_000_000, 0.3)):
        measured, limit = flow("r2psim", bitrate=bitrate, served=False), bitrate / BITS
        figures = f"{measured.rate / 1e3:.1f} k/s, {measured.cost * 1e6:.0f} us each"
        goal = f"{share:.0%} of the wire's {limit / 1e3:.1f} k/s"
        what = f"two can.Bus of one process, {bitrate // 1_000_000} Mbit/s"
        yield Row(what, figures, beside, goal, measured.rate >= share * limit)
    frames = 2 * (BITS - INTERMISSION)
    trip, bare = round_trip("r2psim", served=False), round_trip("virtual")
    baseline = f"virtual: {bare * 1e6:.0f} us; the frames: {frames} us"
    yield Row("the same at 1 Mbit/s, there and back, p50", f"{trip * 1e6:.0f} us", baseline, "", None)


def _send(bus: can.BusABC) -> None:
    for _ in range(FRAMES):
        bus.send(MESSAGE)


def _echo(bus: can.BusABC) -> None:
    for _ in range(ROUND_TRIPS):
        message = bus.recv(10.0)
        assert message
        bus.send(message)
