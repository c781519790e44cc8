"""Virtual CAN interfaces, programs beside r2p, and a listener that records what a port calls."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import subprocess
from pathlib import Path
from typing import TYPE_CHECKING, Self

from r2p.clock import clock_of
from r2p.transports.can.socketcan import SocketCanPort

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

    from r2p.codecs.can_bits import Frame, OtherFrame
    from r2p.protocols.can_orders import Mailbox, Outcome
    from r2p.transports.can.port import CanPort

GUARD = 30.0
"""Seconds after which something that should have happened will not."""

_LISTENERS = Path("/proc/net/can")
_numbers = itertools.count()


def ip(*arguments: str) -> None:
    """Run `ip link` with these arguments."""
    subprocess.run(("ip", "link", *arguments), check=True)


def add(name: str) -> None:
    ip("add", "dev", name, "up", "type", "vcan")


def new_name() -> str:
    return f"vcan{next(_numbers)}"


def cansend(name: str, frame: str) -> None:
    """Send a frame, as candump prints it in logs: "1FFFFFFF#0102"."""
    subprocess.run(("cansend", name, frame), check=True)


def cangen(name: str, count: int) -> None:
    """Send frames as fast as possible while the loop stands still, numbered in identifier and first byte."""
    subprocess.run(("cangen", name, "-e", "-g", "0", "-I", "i", "-L", "8", "-D", "i", "-n", str(count)), check=True)


async def until(condition: Callable[[], object]) -> None:
    """Wait for a condition of which the kernel notifies no process."""
    async with asyncio.timeout(GUARD):
        while not condition():  # noqa: ASYNC110 - what is awaited is not in this process
            await asyncio.sleep(0.002)


def listeners(name: str) -> int:
    """How many filters programs have set on an interface."""
    files = [file for file in _LISTENERS.glob("rcvlist_*") if file.name != "rcvlist_err"]
    lines = itertools.chain.from_iterable(file.read_text(encoding="ascii").splitlines() for file in files)
    return sum(line.split()[0] == name for line in lines if line.strip() and "device" not in line)


class Candump:
    """Runs candump, which listens inside of the `async with` block."""

    def __init__(self, name: str, *options: str) -> None:
        self._command = ("candump", *options, name)
        self._name = name
        self._process: asyncio.subprocess.Process | None = None

    async def __aenter__(self) -> Self:
        before = listeners(self._name)
        self._process = await asyncio.create_subprocess_exec(*self._command, stdout=subprocess.PIPE)
        await until(lambda: listeners(self._name) > before)
        return self

    async def __aexit__(self, *_: object) -> None:
        assert self._process is not None
        with contextlib.suppress(ProcessLookupError):
            self._process.kill()
        await self._process.communicate()

    async def line(self) -> str:
        """The next line that it prints, with single spaces."""
        assert self._process is not None
        assert self._process.stdout is not None
        async with asyncio.timeout(GUARD):
            return " ".join((await self._process.stdout.readline()).decode().split())


async def run_program(*command: str) -> str:
    """Run a program that has to succeed. Returns what it prints."""
    process = await asyncio.create_subprocess_exec(*command, stdout=subprocess.PIPE)
    async with asyncio.timeout(GUARD):
        output, _ = await process.communicate()
    assert process.returncode == 0, output
    return output.decode()


class RecordingListener:
    """Records what a port calls; `states` has one line for each change of its state."""

    def __init__(self) -> None:
        self.frames: list[Frame] = []
        self.others: list[OtherFrame] = []
        self.stamps: list[int] = []
        self.outcomes: list[tuple[Mailbox, Outcome]] = []
        self.instants: list[int] = []
        self.faults: list[str] = []
        self.states: list[str] = []
        self.on_confirm: Callable[[], object] = lambda: None
        self._changed = asyncio.Event()

    def on_frame(self, frame: Frame, stamp: int) -> None:
        self.frames.append(frame)
        self.stamps.append(stamp)
        self._changed.set()

    def on_other_frame(self, frame: OtherFrame, stamp: int) -> None:
        self.others.append(frame)
        self._changed.set()

    def on_confirmed(self, mailbox: Mailbox, outcome: Outcome, at: int) -> None:
        self.outcomes.append((mailbox, outcome))
        self.instants.append(at)
        self.on_confirm()
        self._changed.set()

    def on_up(self) -> None:
        self._note("up")

    def on_down(self, reason: str) -> None:
        self._note(f"down: {reason}")

    def on_waiting(self, reason: str) -> None:
        self._note(f"waits: {reason}")

    def on_fault(self, kind: str) -> None:
        self.faults.append(kind)
        self._changed.set()

    def internal_error(self, error: Exception) -> None:
        self.faults.append(f"internal error: {error}")
        self._changed.set()

    def has(self, count: int) -> bool:
        """Whether that many frames came in."""
        return len(self.frames) >= count

    async def until(self, condition: Callable[[], object]) -> None:
        """Wait until a call of the port makes this true."""
        async with asyncio.timeout(GUARD):
            while not condition():
                self._changed.clear()
                await self._changed.wait()

    def wake(self) -> None:
        """Let `until` evaluate its condition again."""
        self._changed.set()

    def _note(self, line: str) -> None:
        if self.states[-1:] != [line]:
            self.states.append(line)
        self._changed.set()


@contextlib.asynccontextmanager
async def using(port: CanPort) -> AsyncIterator[RecordingListener]:
    """The listener of a port that runs, and is up."""
    listener = RecordingListener()
    running = asyncio.create_task(port.run(listener, lambda: None), name="port")
    running.add_done_callback(lambda _: listener.wake())
    try:
        await listener.until(lambda: running.done() or listener.states)
        yield listener
    finally:
        running.cancel()
        await asyncio.wait([running])
    if not running.cancelled():
        running.result()


@contextlib.asynccontextmanager
async def port_on(name: str) -> AsyncIterator[tuple[SocketCanPort, RecordingListener]]:
    """A port on an interface, and its listener."""
    port = SocketCanPort(name)
    async with using(port) as listener:
        yield port, listener


def now() -> int:
    return clock_of().monotonic()
