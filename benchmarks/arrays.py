"""performance_test's sweep: arrays of 1 kB to 4 MB at 20 to 1 000 Hz, one publisher and one subscriber, two processes.

r2p over zenoh, zenoh-python and rclpy over Fast DDS, each to the rate where it saturates: less than 95 % arrives. Its
mean, maximum and loss are by the second over 30 s; here it is the median and the 99th percentile of a shorter time.
"""

import contextlib
import functools
import json
import os
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

from benchmarks.byte_links import QUIET, Client, measure
from benchmarks.payloads import BARE, OURS
from benchmarks.table import Row, p50_p99
from tests.ros.rclpy import install

SIZES = {"1k": 1 << 10, "4k": 1 << 12, "16k": 1 << 14, "64k": 1 << 16, "256k": 1 << 18, "1m": 1 << 20, "4m": 1 << 22}
RATES = (20, 100, 500, 1000)
SECONDS = 1.0
ARRIVES = 0.95


class Cell(NamedTuple):
    """Of one size and rate: the share that arrived, and latencies (ms)."""

    arrived: float
    p50: float
    p99: float

    @property
    def saturated(self) -> bool:
        """Whether too little arrives: higher rates are not tried."""
        return self.arrived < ARRIVES

    def __str__(self) -> str:
        return f"{self.p50:.2f}/{self.p99:.2f} ms" + f", {self.arrived:.0%} arrives" * self.saturated


Sweep = dict[tuple[str, int], Cell]


def rows() -> Iterator[Row]:
    sweeps = {OURS: measure(OURS, _sweep), BARE: measure(BARE, _sweep), "rclpy": _rclpy()}
    for name in SIZES:
        for rate in RATES:
            cells = {peer: str(sweep.get((name, rate), "-")) for peer, sweep in sweeps.items()}
            if set(cells.values()) == {"-"}:
                continue
            ours = cells.pop(OURS)
            baseline = "; ".join(f"{peer} {cell}" for peer, cell in cells.items())
            yield Row(f"Array{name} at {rate} Hz, p50/p99", ours, baseline, "", None)


async def _sweep(client: Client) -> Sweep:
    found: Sweep = {}
    for name, size in SIZES.items():
        for rate in RATES:
            count = await client.pace(size, rate, SECONDS)
            found[name, rate] = _cell(list(count.latencies), rate)
            if found[name, rate].saturated:
                break
    return found


def _cell(latencies: list[float], rate: float) -> Cell:
    p50, p99 = p50_p99(latencies, 1e-3) if latencies else (0.0, 0.0)
    return Cell(len(latencies) / (rate * SECONDS), p50, p99)


def _rclpy() -> Sweep:
    """The same with rclpy; empty where it is not installed."""
    python = install.find()
    if isinstance(python, str):
        return {}
    found: Sweep = {}
    with _ends(python) as ask:
        for name, size in SIZES.items():
            for rate in RATES:
                found[name, rate] = _cell(ask(size, rate), rate)
                if found[name, rate].saturated:
                    break
    return found


@contextlib.contextmanager
def _ends(python: Path) -> Iterator[Callable[[int, float], list[float]]]:
    """Two processes of rclpy, and how to have a size and rate sent: it gives the latencies (s) of what arrived."""
    with tempfile.TemporaryDirectory() as home, contextlib.ExitStack() as stack:
        own = {"ROS_LOCALHOST_ONLY": "1", "ROS_DOMAIN_ID": str(os.getpid() % 100 + 1), "ROS_LOG_DIR": home}
        script, pipe = str(Path(__file__).with_name("rclpy_arrays.py")), subprocess.PIPE
        start = functools.partial(subprocess.Popen, env=os.environ | own, stdin=pipe, stdout=pipe, text=True)
        receiver, sender = (stack.enter_context(start([python, script, each])) for each in ("receive", "send"))
        for each in (receiver, sender):
            stack.callback(each.kill)
        _line(sender)

        def ask(size: int, rate: float) -> list[float]:
            _tell(receiver, "count")
            _line(receiver)
            _tell(sender, f"{size} {rate} {SECONDS}")
            _line(sender)
            return _settled(receiver)

        yield ask


def _settled(receiver: "subprocess.Popen[str]") -> list[float]:
    """What came, when no more comes."""
    latencies: list[float] = []
    while True:
        with contextlib.suppress(subprocess.TimeoutExpired):
            receiver.wait(QUIET)
        _tell(receiver, "count")
        came: list[float] = json.loads(_line(receiver))
        if not came:
            return latencies
        latencies += came


def _tell(end: "subprocess.Popen[str]", text: str) -> None:
    assert end.stdin
    print(text, file=end.stdin, flush=True)


def _line(end: "subprocess.Popen[str]") -> str:
    assert end.stdout
    return end.stdout.readline()
