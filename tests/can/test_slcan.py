"""A CAN adapter on a serial line: slcand makes an interface of one end, and a program has the other."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import time
from types import SimpleNamespace
from typing import TYPE_CHECKING

import pytest
from can.interfaces import slcan

from r2p.codecs.can_bits import Frame
from r2p.protocols.can_orders import Mailbox, Outcome, Transmit
from r2p.transports.can import netlink
from r2p.transports.can.pythoncan import PythonCanPort
from tests.can.rig import ip, port_on, until, using

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

pytestmark = [pytest.mark.can, pytest.mark.anyio]

FRAME = Frame(10 << 23 | 0x0242 << 7, b"abc")


@contextlib.asynccontextmanager
async def program(*command: str, end: signal.Signals = signal.SIGKILL) -> AsyncIterator[None]:
    """Run it inside of the block. SIGTERM is for what has to clean up: socat overlooks one just before its select()."""
    process = await asyncio.create_subprocess_exec(*command)
    try:
        yield
    finally:
        process.send_signal(end)
        await process.wait()


@contextlib.asynccontextmanager
async def adapter(device: str) -> AsyncIterator[str]:
    """Make a CAN interface of a serial device, and set it up."""
    async with program("slcand", "-F", "-o", "-s8", device, "slcan0", end=signal.SIGTERM):
        await until(lambda: netlink.find_interface("slcan0"))
        ip("set", "slcan0", "up")
        yield "slcan0"
    await until(lambda: netlink.find_interface("slcan0") is None)


async def test_both_ways(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """SocketCAN at one end, python-can at the other."""
    monkeypatch.setattr(slcan, "time", SimpleNamespace(sleep=lambda _: None, time=time.time))  # it gives Arduinos 2 s
    ends = [tmp_path / "near", tmp_path / "far"]
    async with program("socat", *(f"pty,raw,echo=0,link={end}" for end in ends)):
        await until(lambda: all(end.exists() for end in ends))
        far = PythonCanPort("slcan", str(ends[1].resolve()), 1_000_000)
        async with (
            adapter(str(ends[0].resolve())) as name,
            port_on(name) as (near, kernel),
            using(far) as python,
        ):
            near.transmit(Transmit(FRAME, Mailbox.SRT, 0))
            await python.until(lambda: python.frames)
            await kernel.until(lambda: kernel.outcomes)
            assert (python.frames, kernel.outcomes) == ([FRAME], [(Mailbox.SRT, Outcome.SENT)])
            far.transmit(Transmit(FRAME, Mailbox.NRT, 0))
            await kernel.until(lambda: kernel.frames)
            await python.until(lambda: python.outcomes)
            assert (kernel.frames, python.outcomes) == ([FRAME], [(Mailbox.NRT, Outcome.SENT)])


async def test_what_the_kernel_reports_of_it() -> None:
    main, device = os.openpty()
    async with adapter(os.ttyname(device)) as name:
        there = netlink.find_interface(name)
        assert there is not None
        assert (there.kind, there.up, there.state, there.problem) == ("can", True, "error-active", "")
        ip("set", name, "down")
        there = netlink.find_interface(name)
        assert there is not None
        assert there.state == "stopped"
    os.close(main)
    os.close(device)
