"""SocketCAN to a typed subscriber, against a bare drain loop and python-can's Notifier: in a user-mode Linux kernel."""

import json
import sys
from collections.abc import Iterator
from pathlib import Path

from benchmarks.table import Row, rate
from tests.uml import kernel, packages

BUSY = 7000.0
"""Frames a second of 8 bytes on a saturated bus of 1 Mbit/s."""

_LIMIT = 300.0  # seconds
_RESULTS = "results"


def rows() -> Iterator[Row]:
    tools = packages.find()
    if isinstance(tools, str):
        print(f"SocketCAN is left out: {tools}", file=sys.stderr)
        return
    found = measured_inside(tools, "benchmarks.socketcan_inside")
    bare, notifier = found["bare"], found["notifier"]
    for loop in ("uvloop", "asyncio"):
        ours = found[loop]
        yield Row(
            f"SocketCAN to a typed subscriber, 8 bytes ({loop}, in UML)",
            rate(ours),
            f"bare drain loop {rate(bare)}: {ours / bare:.2f}x, Notifier {rate(notifier)}: {ours / notifier:.1f}x",
            "0.5 of bare, 5x Notifier",
            ours >= 0.5 * bare and ours >= 5 * notifier,
        )
    yield Row(
        "CPU of a module at 7 k frames/s, from the row above",
        f"{BUSY / found['asyncio']:.0%} of a core",
        "",
        "30 %",
        BUSY / found["asyncio"] < 0.3,
    )


def measured_inside(tools: packages.Tools, module: str) -> dict[str, float]:
    """Run a module in the kernel, and return what it has written to the file that its argument names, as JSON."""
    with kernel.folder() as shared:
        results = shared / _RESULTS
        command = [sys.executable, "-m", module, str(results)]
        kernel.run(tools, shared, command, cwd=Path(__file__).parents[1], environment={}, limit=_LIMIT)
        if not results.exists():
            raise kernel.KernelFailed(kernel.tail(shared))
        found: dict[str, float] = json.loads(results.read_text(encoding="ascii"))
        return found
