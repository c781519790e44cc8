"""What each process of a network measures, and how the benchmark talks to it: lines of JSON on its input and output.

It prints `"ready"` when each of its subscriptions has received something; `begin` starts the measurement, and `end`
ends it, with the result.
"""

from __future__ import annotations

import json
import os
import resource
import sys
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable, Collection

    from benchmarks.robot_networks.plans import Plan

LATE = (0.2, 0.005)
"""A message is late after this share of its period, or after so many seconds, whichever is less, as iRobot has it."""

TOO_LATE = (1.0, 0.05)

CONNECTED_AFTER = 30.0
"""Seconds after which a process is ready in any case: a subscription that received nothing shows as messages lost."""


def now() -> int:
    """The clock (ns) that all processes of a computer share."""
    return time.monotonic_ns()


class Recorder:
    """Counts what the subscriptions of one process receive; what is lost shows in the counters of the messages."""

    def __init__(self, plan: Plan, names: Collection[str]) -> None:
        """`names`: those of this process's nodes."""
        self._missing = plan.pairs(names)
        self.connected = threading.Event()
        if not self._missing:
            self.connected.set()
        self._limits = {
            name: tuple(int(min(share * topic.period, most) * 1e9) for share, most in (LATE, TOO_LATE))
            for name, topic in plan.topics.items()
        }
        self._last: dict[tuple[str, str], int] = {}
        self._clear()

    def _clear(self) -> None:
        self.received = self.late = self.too_late = self.lost = 0
        self.latencies: list[int] = []
        self._began, self._spent = time.perf_counter(), _cpu()

    def message(self, node: str, topic: str, counter: int, sent: int) -> None:
        """A message that a node's next line has: its counter, and when it was sent (ns)."""
        took = now() - sent
        late, too_late = self._limits[topic]
        self.received += 1
        self.late += late < took <= too_late
        self.too_late += took > too_late
        last = self._last.get((node, topic))
        if last is None:
            last = counter - 1
            self._connect(node, topic)
        self.lost += max(counter - last - 1, 0)
        self._last[node, topic] = counter
        self.latencies.append(took)

    def _connect(self, node: str, topic: str) -> None:
        self._missing.discard((node, topic))
        if not self._missing:
            self.connected.set()

    def begin(self) -> None:
        self._clear()

    def result(self) -> dict[str, Any]:
        """Everything, with the processor time (share of one core) and the resident memory (bytes) of this process."""
        return {
            "received": self.received,
            "late": self.late,
            "too_late": self.too_late,
            "lost": self.lost,
            "latencies": self.latencies,
            "cpu": (_cpu() - self._spent) / (time.perf_counter() - self._began),
            "rss": _resident(),
        }


def _cpu() -> float:
    """Seconds of processor time, of all threads."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def _resident() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def serve(recorder: Recorder, end: Callable[[], object]) -> None:
    """Answer in a thread; `end` is called there when the benchmark has ended this process's work."""

    def answer() -> None:
        recorder.connected.wait(CONNECTED_AFTER)
        say("ready")
        for line in sys.stdin:
            if line.strip() == "begin":
                recorder.begin()
            elif line.strip() == "end":
                say(recorder.result())
                break
        end()

    threading.Thread(target=answer, daemon=True).start()


def say(value: object) -> None:
    """Print a line for the benchmark."""
    print(json.dumps(value), flush=True)
