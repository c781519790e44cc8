"""A robot and a tool on one memory network, for tests under virtual time; and `r2p` processes, for the few that need
them.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import subprocess
import sys
import threading
from typing import TYPE_CHECKING, Any

import r2p
from r2p.codecs import management
from r2p.tools.session import Session, Settings, join
from r2p.transports.memory import Datagram, network

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterator

    import pytest

    from r2p.modules.supervisor import NodeFunction

VIA = "memory:lab"
PUBLISH = ("topic", "pub", "leds", "led=3", "--type", "Led", "--rate", "50", "--via", "tcp-listen:0")
"""The arguments of a publisher that others can reach."""
PATIENCE = 60.0  # seconds after which a process that should have ended is killed, so that its test fails


@contextlib.asynccontextmanager
async def robot(*functions: NodeFunction, name: str = "BOT") -> AsyncIterator[r2p.Module]:
    """A module on the network."""
    async with r2p.Module(name, via=[VIA]) as module:
        for function in functions:
            module.start(function)
        yield module


@contextlib.asynccontextmanager
async def tool(*, verbose: int = 0, types: dict[str, str] | None = None) -> AsyncIterator[Session]:
    """A tool on it."""
    async with join(Settings(via=[VIA], types=types or {}), verbose=verbose) as session:
        yield session


class Firmware:
    """A module that sends what the test asks for, and no HELLO; make it inside the loop."""

    def __init__(self, name: str = "IMU") -> None:
        self._network = network("lab")
        self._port = self._network.new_address()
        self._name = name

    def send(self, message: management.Management) -> None:
        self._network.send(Datagram(self._port, b"R2P", management.encode(message)))

    def alive(self) -> None:
        self.send(management.Alive(self._name, 0))

    def advertise(self, topic: str, size: int) -> None:
        """Announce a topic, and answer subscribers."""
        self.send(management.Advertise(topic, size))
        self.send(management.SubscribeResponse(topic, size))

    def publish(self, topic: str, data: bytes) -> None:
        self._network.send(Datagram(self._port, topic.encode(), data))


def keep_types(module: r2p.Module) -> None:
    """Let a module answer as if it had no types: a tool does not learn those of its topics."""
    module._opened.own_services._handlers.clear()


def printed(capsys: pytest.CaptureFixture[str]) -> list[Any]:
    """What was printed as JSON lines since the last call."""
    return [json.loads(line) for line in capsys.readouterr().out.splitlines()]


@contextlib.contextmanager
def process(*arguments: str, patience: float = PATIENCE, **options: Any) -> Iterator[subprocess.Popen[str]]:
    """`r2p` with these arguments; killed at the end if it still runs, or after `patience` seconds."""
    environment = {name: value for name, value in os.environ.items() if name != "R2P_VIA"}
    child = subprocess.Popen(
        [sys.executable, "-c", "from r2p.tools.main import main; main()", *arguments],
        stdin=options.pop("stdin", subprocess.DEVNULL),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment | options.pop("env", {}),
        **options,
    )
    limit = threading.Timer(patience, child.kill)
    limit.start()
    with child:
        try:
            yield child
        finally:
            limit.cancel()
            child.kill()


def listening(child: subprocess.Popen[str]) -> str:
    """The URL to join a process at that was started with `--via tcp-listen:0`."""
    assert child.stderr is not None
    for line in child.stderr:
        if found := re.search(r"takes connections at (\S+)", line):
            return f"tcp:{found[1]}"
    raise AssertionError("the process does not listen")
