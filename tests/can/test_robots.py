"""Modules that speak RTCAN on one virtual bus, each a process of its own."""

from __future__ import annotations

import asyncio
import contextlib
import json
import subprocess
import sys
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

pytestmark = [pytest.mark.can, pytest.mark.anyio, pytest.mark.one_loop]

LONGEST = 120.0
"""Seconds; three interpreters have to start on one slow CPU."""

NEXT = {"A": "B", "B": "C", "C": "A"}
"""Whose topics each of them subscribes."""


@contextlib.asynccontextmanager
async def robot(name: str, url: str) -> AsyncIterator[asyncio.subprocess.Process]:
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "tests.can.robot", name, url, NEXT[name]), stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    try:
        yield process
    finally:
        if process.returncode is None:
            process.kill()
        await process.communicate()


async def line(process: asyncio.subprocess.Process) -> str:
    assert process.stdout is not None
    async with asyncio.timeout(LONGEST):
        return (await process.stdout.readline()).decode().strip()


async def report(process: asyncio.subprocess.Process) -> dict[str, Any]:
    assert process.stdin is not None
    process.stdin.close()
    found: dict[str, Any] = json.loads(await line(process))
    async with asyncio.timeout(LONGEST):
        assert await process.wait() == 0
    return found


@pytest.mark.parametrize("anyio_backend", [("asyncio", {"use_uvloop": True})], ids=["uvloop"])
async def test_three_processes_exchange_all_classes(vcan: str) -> None:
    """In slots of 10 ms, which a loaded PC may miss: how often is only printed. Nothing else gets lost unseen."""
    async with contextlib.AsyncExitStack() as stack:
        robots = {
            name: await stack.enter_async_context(robot(name, f"rtcan:{vcan},slots=10,cycle=100ms,priority={priority}"))
            for name, priority in (("A", 2), ("B", 1), ("C", 0))
        }
        for process in robots.values():
            assert await line(process) == "enough"
        reports = {name: await report(process) for name, process in robots.items()}
    sys.stdout.write(json.dumps(reports, indent=1) + "\n")
    for name, here in reports.items():
        source = NEXT[name]
        said = reports[source]["said"]
        received = {kind: here["received"][f"{kind}_{source}"] for kind in ("hrt", "srt", "nrt")}
        assert not any(topic["wrong"] for topic in received.values())
        paused = here["lost"].get("time-out", 0)  # the sender stood still for 100 ms within a message
        assert received["srt"]["missing"] <= said[f"srt_{source}"]["missed"] + paused
        assert received["nrt"]["missing"] <= said[f"nrt_{source}"]["missed"] + paused
        assert "gap" not in here["lost"]
        assert "receive queue full" not in here["faults"]
