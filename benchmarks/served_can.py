"""A simulated bus that another process serves: frames from a program to two others, and what each process spends."""

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator

from benchmarks.table import Row
from r2p.codecs.can_bits import INTERMISSION, Frame, frame_bits
from r2p.sim.buses import attach
from r2p.sim.buses.attachment import AttachmentOptions, BusAttachment

FRAMES = 30_000
FRAME = Frame(0x123456, b"12345678")
EMPTY = Frame(0x123456, b"")
WAIT = 10.0  # seconds

SERVER = """
import asyncio, sys, time
from r2p.sim.buses.server import serve_bus
from r2p.sim.transport import SimCan

async def main():
    async with serve_bus(SimCan(bitrate=int(sys.argv[1])), "benchmark"):
        print("ready", flush=True)
        await asyncio.to_thread(sys.stdin.readline)
        spent = time.process_time()
        await asyncio.to_thread(sys.stdin.readline)
        print(time.process_time() - spent, flush=True)

asyncio.run(main())
"""
SENDER = """
import sys, time
from benchmarks.served_can import EMPTY, FRAME, FRAMES, attach, OPTIONS
bus = attach("benchmark", OPTIONS)
frame = FRAME if sys.argv[1] == "8" else EMPTY
print("ready", flush=True)
sys.stdin.readline()
spent = time.process_time()
for _ in range(FRAMES):
    bus.send(frame)
print(time.process_time() - spent, flush=True)
sys.stdin.readline()
bus.close()
"""
OPTIONS = AttachmentOptions(served=True)


class Process:
    """A Python that says "ready", is told to go on by a line, and says what it spent."""

    def __init__(self, code: str, argument: str) -> None:
        self._child = subprocess.Popen(
            [sys.executable, "-c", code, argument], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        assert self.line() == "ready"

    def line(self) -> str:
        assert self._child.stdout is not None
        return self._child.stdout.readline().strip()

    def go_on(self) -> None:
        assert self._child.stdin is not None
        self._child.stdin.write("\n")
        self._child.stdin.flush()

    def end(self) -> None:
        self._child.kill()
        self._child.communicate()


def rows() -> Iterator[Row]:
    for bitrate, size, share in ((1_000_000, 8, 0.95), (1_000_000, 0, 0.9), (10_000_000, 8, 0.2)):
        frame = FRAME if size else EMPTY
        limit = bitrate / (frame_bits(frame.id, frame.data) + INTERMISSION)
        rate, server, sender, receiver = _flow(bitrate, size)
        figures = f"{rate / 1e3:.1f} k/s; server {server:.0f}, sender {sender:.0f}, receiver {receiver:.0f} us each"
        what = f"a served bus of {bitrate // 1_000_000} Mbit/s, a sender and 2 receivers, {size} bytes"
        yield Row(what, figures, f"the wire: {limit / 1e3:.1f} k/s", f"{share:.0%}", rate >= share * limit)


def _flow(bitrate: int, size: int) -> tuple[float, ...]:
    """Return frames a second, and what server, sender and a receiver spend for a frame (us)."""
    before = os.environ.get("XDG_RUNTIME_DIR", "")
    with tempfile.TemporaryDirectory() as folder:
        os.environ["XDG_RUNTIME_DIR"] = folder
        server = Process(SERVER, str(bitrate))
        receivers = [attach("benchmark", OPTIONS) for _ in range(2)]
        sender = Process(SENDER, str(size))
        server.go_on()
        began, spent = time.perf_counter(), time.process_time()
        sender.go_on()
        for _ in range(FRAMES):
            for each in receivers:
                _receive(each)
        took, spent = time.perf_counter() - began, time.process_time() - spent
        server.go_on()
        costs = [float(server.line()), float(sender.line()), spent / len(receivers)]
        for each in receivers:
            each.close()
        sender.end()
        server.end()
    os.environ["XDG_RUNTIME_DIR"] = before
    return FRAMES / took, *(cost / FRAMES * 1e6 for cost in costs)


def _receive(bus: BusAttachment) -> None:
    event = bus.receive(WAIT)
    assert event is not None
    assert event.frame is not None
