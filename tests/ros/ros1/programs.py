"""Real ROS 1 programs: a master, Debian's tools, and a rospy node that does what tests say."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import json
import os
import subprocess
import threading
from concurrent.futures import Future
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from tests.ros.ros1 import packages

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterator

_MASTER = """
import sys, rosmaster.master
master = rosmaster.master.Master(int(sys.argv[1]))
master.start()
print(master.uri, flush=True)
sys.stdin.read()
"""
"""What `rosmaster --core` does; this one takes any port, says when it is there, and ends with the tests."""


class Done(NamedTuple):
    """What a tool has printed, in both of its outputs, and its exit code."""

    code: int
    output: str


class Ros1:
    """One master and the programs that use it."""

    def __init__(self, usr: Path, home: Path, port: int = 0) -> None:
        """Start a master; `home` is an empty folder for what the programs write."""
        self.usr = usr
        self._home = home
        own = {"ROS_IP": "127.0.0.1", "ROS_HOME": str(home), "PYTHONUNBUFFERED": "1", "LC_ALL": "C.UTF-8"}
        inherited = {name: value for name, value in os.environ.items() if not name.startswith(("ROS", "PYTHON"))}
        self.environment = {**inherited, **packages.environment(usr), **own}
        self._master = self._start_master(port)

    def _start_master(self, port: int) -> subprocess.Popen[str]:
        command = (packages.PYTHON, "-c", _MASTER, str(port))
        with (self._home / "master.log").open("a") as log:
            master = subprocess.Popen(
                command, env=self.environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log, text=True
            )
        assert master.stdout
        self.uri = master.stdout.readline().strip().rstrip("/")
        assert self.uri, (self._home / "master.log").read_text()
        self.environment["ROS_MASTER_URI"] = self.uri
        return master

    def close(self) -> None:
        """End the master, whatever it is doing: it unregisters nothing and tells nobody."""
        self._master.kill()
        self._master.communicate()

    def restart(self) -> None:
        """Start a master, that knows nothing, in the place of the one that was closed."""
        self._master = self._start_master(int(self.uri.rpartition(":")[2]))

    def command(self, program: str, *arguments: str) -> tuple[str, ...]:
        """How to run a tool (`rostopic`), or a node that has a package (`topic_tools/relay`)."""
        if "/" in program:
            return (str(self.usr / "lib" / program), *arguments)
        return (packages.PYTHON, str(self.usr / "bin" / program), *arguments)

    async def run(self, program: str, *arguments: str, limit: float = 60.0) -> Done:
        """Run a tool until it ends."""
        async with self.running(program, *arguments) as process, asyncio.timeout(limit):
            output, _ = await process.communicate()
            assert process.returncode is not None
            return Done(process.returncode, output.decode())

    @contextlib.asynccontextmanager
    async def running(self, program: str, *arguments: str) -> AsyncIterator[asyncio.subprocess.Process]:
        """A tool or node that runs until the block ends; both of its outputs are in `stdout`."""
        process = await asyncio.create_subprocess_exec(
            *self.command(program, *arguments),
            env=self.environment,
            stdin=asyncio.subprocess.DEVNULL,
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.STDOUT,
        )
        try:
            yield process
        finally:
            with contextlib.suppress(ProcessLookupError):
                process.kill()
            await process.communicate()

    @contextlib.contextmanager
    def peer(self, name: str, *remappings: str) -> Iterator[RospyPeer]:
        """A rospy node of this name."""
        peer = RospyPeer(self, name, self._home / f"{name}.log", *remappings)
        try:
            yield peer
        finally:
            peer.close()


class RospyPeer:
    """A rospy node, in its own process; `rospy_peer.py` has its commands."""

    def __init__(self, ros1: Ros1, name: str, log: Path, *remappings: str) -> None:
        command = (packages.PYTHON, str(Path(__file__).with_name("rospy_peer.py")), name, *remappings)
        pipe = subprocess.PIPE
        with log.open("a") as file:
            self.process = subprocess.Popen(
                command, env=ros1.environment, stdin=pipe, stdout=pipe, stderr=file, text=True
            )
        self.name = name
        self._log = log
        self._numbers = itertools.count(1)
        self._waiting: dict[int, Future[Any]] = {0: Future()}
        self._reader = threading.Thread(target=self._read, daemon=True)
        started = self._waiting[0]
        self._reader.start()
        started.result(60.0)

    async def do(self, command: str, **arguments: Any) -> Any:
        """Give a command and return its result; its errors are RuntimeErrors."""
        return await asyncio.wrap_future(self.begin(command, **arguments))

    def begin(self, command: str, **arguments: Any) -> Future[Any]:
        """Give a command; the future gets its result."""
        number = next(self._numbers)
        future: Future[Any] = Future()
        self._waiting[number] = future
        assert self.process.stdin
        self.process.stdin.write(json.dumps({"id": number, "do": command, **arguments}) + "\n")
        self.process.stdin.flush()
        return future

    def kill(self) -> None:
        """End the process as a fault does: it unregisters nothing."""
        self.process.kill()

    def close(self) -> None:
        """End the node in order: it unregisters."""
        assert self.process.stdin
        with contextlib.suppress(BrokenPipeError):
            self.process.stdin.close()
        try:
            self.process.wait(10.0)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        self._reader.join()
        assert self.process.stdout
        self.process.stdout.close()

    def _read(self) -> None:
        assert self.process.stdout
        for line in self.process.stdout:
            answer = json.loads(line)
            future = self._waiting.pop(answer["id"])
            if "error" in answer:
                future.set_exception(RuntimeError(answer["error"]))
            else:
                future.set_result(answer["result"])
        for future in self._waiting.values():
            if not future.done():
                future.set_exception(RuntimeError(f"the rospy node has ended: {self._log.read_text()[-2000:]}"))
