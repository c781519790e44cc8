"""How late a computer wakes for a slot: which slots a PC could hold, with and without real-time priority.

`python -m benchmarks slots_on_pcs`. A callback of asyncio waits on a timerfd (`r2p.clock.ExactAlarm`) for instants that
are a period apart, which is what a module has; a thread that sleeps until then is the least that Python can do. A slot
holds a frame if it is as much longer than the longest frame as the frame is late. The way from there to the wire comes
on top: on a real interface some ten to some hundred microseconds. In a user-mode Linux, the frame's way through the
kernel to a vcan interface is part of the lateness.

As a program, it measures in such a kernel: `python -m benchmarks.slots_on_pcs FILE`.
"""

import asyncio
import json
import math
import os
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from benchmarks.socketcan import measured_inside
from benchmarks.table import Row, percentile
from r2p.clock import ExactAlarm, clock_of
from r2p.codecs.can_bits import INTERMISSION, frame_bits_max
from r2p.codecs.rtcan import FRAME_MAX
from tests.uml import kernel, packages

PERIOD = 1_990_000
"""Ns between two slots: no multiple of the kernel's ticks."""
WAKES = 5_000
"""In each way: 10 s."""
FRAME = (frame_bits_max(FRAME_MAX) + INTERMISSION) * 1000
"""Ns of the longest frame at 1 Mbit/s."""
_PRIORITY = 50  # of SCHED_FIFO
_STEP = 10_000  # ns
_CAN = "vcan0"
_FRAME = struct.pack("=IB3x8s", socket.CAN_EFF_FLAG, 8, bytes(8)) if hasattr(socket, "CAN_EFF_FLAG") else b""

Lateness = dict[str, list[int] | None]
"""By the way to wake up: ns; None where that is not allowed."""


def in_a_loop(send: Callable[[], object], wakes: int = WAKES) -> list[int]:
    """Return how late `send` has done its work in an event loop, in ns."""
    return asyncio.run(_in_a_loop(send, wakes))


async def _in_a_loop(send: Callable[[], object], wakes: int) -> list[int]:
    clock, late, done = clock_of(), list[int](), asyncio.Event()
    due = clock.monotonic() + PERIOD

    def expired() -> None:
        nonlocal due
        send()
        late.append(clock.monotonic() - due)
        if len(late) == wakes:
            done.set()
            return
        due = following(due, clock.monotonic())
        alarm.set(due)

    alarm = ExactAlarm(asyncio.get_running_loop(), expired)
    alarm.set(due)
    await done.wait()
    alarm.close()
    return late


def in_a_thread(send: Callable[[], object], wakes: int = WAKES) -> list[int]:
    """Return how late a thread has done it that does nothing but sleep until each instant, in ns."""
    late = []
    due = time.monotonic_ns() + PERIOD
    for _ in range(wakes):
        while (left := due - time.monotonic_ns()) > 0:
            time.sleep(left / 1e9)
        send()
        late.append(time.monotonic_ns() - due)
        due = following(due, time.monotonic_ns())
    return late


def following(due: int, now: int) -> int:
    """Return the first instant after `due`, whole periods later, that is not over."""
    return due + max(1, math.ceil((now - due) / PERIOD)) * PERIOD


def shortest_slot(late: list[int], percent: float) -> int:
    """Return the shortest slot in ns, in steps of 10 us, that holds a frame as late as so many percent of these are."""
    return math.ceil((FRAME + percentile(late, percent)) / _STEP) * _STEP


def with_priority(measure: Callable[[], list[int]]) -> list[int] | None:
    """Measure in a thread of real-time priority; None if this user may not have it."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(_PRIORITY))
    except OSError:
        return None
    try:
        return measure()
    finally:
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


def measured(send: Callable[[], object], wakes: int = WAKES) -> Lateness:
    """Measure both ways, with and without priority."""
    found: Lateness = {}
    for name, way in (("event loop", in_a_loop), ("thread that sleeps", in_a_thread)):
        found[name] = way(send, wakes)
        found[f"{name}, SCHED_FIFO"] = with_priority(lambda way=way: way(send, wakes))  # type: ignore[misc]
    return found


def table(found: Lateness, where: str) -> Iterator[Row]:
    """Return a row for each way."""
    for name, late in found.items():
        what = f"{name}{where}: late p50, p99, p99.9, most"
        if late is None:
            yield Row(what, "not allowed", "", "", None)
            continue
        shares = [*(percentile(late, percent) for percent in (50, 99, 99.9)), max(late)]
        slots = ", ".join(f"{shortest_slot(late, percent) / 1000:.0f}" for percent in (99, 99.9, 100))
        in_us = ", ".join(f"{each / 1000:.0f}" for each in shares)
        yield Row(what, f"{in_us} us", f"slots that hold 99 %, 99.9 %, all: {slots} us", "", None)


def rows() -> Iterator[Row]:
    """Measure here, and in a user-mode Linux if its packages are there."""
    yield from table(measured(lambda: None), "")
    tools = packages.find()
    if isinstance(tools, str):
        print(f"vcan is left out: {tools}", file=sys.stderr)
        return
    try:
        inside: Lateness = measured_inside(tools, "benchmarks.slots_on_pcs")  # type: ignore[assignment]
    except kernel.KernelFailed as error:
        print(f"vcan is left out: {error}", file=sys.stderr)
        return
    yield from table(inside, ", to vcan in UML")


def main(file: str) -> None:
    """Measure with frames to a vcan interface, and write ns as JSON."""
    subprocess.run(("ip", "link", "add", "dev", _CAN, "up", "type", "vcan"), check=True)
    with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as sock:
        sock.bind((_CAN,))
        Path(file).write_text(json.dumps(measured(lambda: sock.send(_FRAME), WAKES // 2)), encoding="ascii")


if __name__ == "__main__":
    main(sys.argv[1])
