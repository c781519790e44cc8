"""Starts the program of zenoh-ros2-sdk, and talks to it."""

import asyncio
import contextlib
import json
import sys
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import Any

GUARD = 30.0


class SdkPeer:
    """A running program; `received` and `asked` have what its subscribers got, and its servers were asked."""

    def __init__(self, process: asyncio.subprocess.Process) -> None:
        self.process = process
        self.received: list[list[Any]] = []
        self.asked: list[list[Any]] = []

    async def ask(self, *command: Any) -> Any:
        """Have the program do something, and return the result."""
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps(command).encode() + b"\n")
        return await self._answer()

    async def until(self, condition: Callable[[], object]) -> None:
        """Read what the program says until something is true."""
        async with asyncio.timeout(GUARD):
            while not condition():
                assert "result" not in await self._line()

    async def kill(self) -> None:
        """End the program without any word."""
        self.process.kill()
        await self.process.wait()

    async def _answer(self) -> Any:
        async with asyncio.timeout(GUARD):
            while "result" not in (line := await self._line()):
                pass
        return line["result"]

    async def _line(self) -> dict[str, Any]:
        assert self.process.stdout is not None
        text = await self.process.stdout.readline()
        assert text, "the program ended"
        line: dict[str, Any] = json.loads(text)
        assert "error" not in line, line
        self.received += [line["received"]] if "received" in line else []
        self.asked += [line["asked"]] if "asked" in line else []
        return line


@asynccontextmanager
async def sdk_peer(port: int) -> AsyncIterator[SdkPeer]:
    """Start the program at a router's port; it ends by itself behind the block."""
    pipe = asyncio.subprocess.PIPE
    process = await asyncio.create_subprocess_exec(
        sys.executable, "-m", "tests.ros.ros2.sdk_program", str(port), stdin=pipe, stdout=pipe
    )
    peer = SdkPeer(process)
    try:
        await peer._answer()
        yield peer
    finally:
        assert process.stdin is not None
        process.stdin.close()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(GUARD):
                await process.wait()
        if process.returncode is None:
            await peer.kill()
