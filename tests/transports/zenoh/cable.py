"""Two modules on one zenoh network: A listens, B connects through a proxy that can be cut. Multicast stays off."""

import asyncio
import contextlib
import functools
import secrets
import socket
from collections.abc import Callable, Coroutine, Iterator
from contextlib import contextmanager
from typing import Any, ParamSpec, Self

import zenoh

import r2p
from r2p.transports.link import Transport
from r2p.transports.url import open_transport
from tests.transports.cables import GUARD, Cable, Pump

P = ParamSpec("P")


def free_port() -> int:
    """A port of loopback that is free now; none of those that the kernel may give somebody before it is used."""
    while True:
        port = 20_000 + secrets.randbelow(10_000)
        with contextlib.suppress(OSError), socket.create_server(("127.0.0.1", port)):
            return port


class Proxy:
    """Takes connections on a port of its own, and carries them to another one while it is not cut."""

    def __init__(self, target: int) -> None:
        self._target = target
        self._loop = asyncio.get_running_loop()
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._listener.setblocking(False)
        self._sockets: list[socket.socket] = []
        self._pumps: list[Pump] = []
        self._connected = True
        self._loop.add_reader(self._listener, self._accept)

    @property
    def port(self) -> int:
        port: int = self._listener.getsockname()[1]
        return port

    def cut(self) -> None:
        self._connected = False
        self._hang_up()

    def mend(self) -> None:
        self._connected = True

    def close(self) -> None:
        self.cut()
        self._loop.remove_reader(self._listener)
        self._listener.close()

    def _accept(self) -> None:
        client, _ = self._listener.accept()
        server = socket.socket()
        try:
            if not self._connected:
                raise ConnectionRefusedError
            server.connect(("127.0.0.1", self._target))
        except ConnectionRefusedError:
            client.close()
            server.close()
            return
        self._sockets += [server, client]
        self._pumps += [
            Pump(server.fileno(), client.fileno(), self._hang_up),
            Pump(client.fileno(), server.fileno(), self._hang_up),
        ]

    def _hang_up(self) -> None:
        for pump in self._pumps:
            pump.close()
        for each in self._sockets:
            each.close()
        self._pumps, self._sockets = [], []


class ZenohCable(Cable):
    """A is a router, B its client."""

    async def __aenter__(self) -> Self:
        self._port = free_port()
        self._proxy = Proxy(self._port)
        return self

    async def __aexit__(self, *_reason: object) -> None:
        self._proxy.close()

    def a(self) -> Transport:
        return open_transport(f"zenoh:?mode=router&listen=tcp/127.0.0.1:{self._port}&scouting=off&network=cable")

    def b(self) -> Transport:
        return open_transport(f"zenoh:tcp/127.0.0.1:{self._proxy.port}?scouting=off&network=cable")

    async def cut(self) -> None:
        self._proxy.cut()

    async def mend(self) -> None:
        self._proxy.mend()


class Net:
    """A zenoh network on loopback: `listen` is the URL of its router, `join` that of everybody else."""

    def __init__(self, name: str = "lab") -> None:
        self.port = free_port()
        self.name = name

    @property
    def listen(self) -> str:
        return f"zenoh:?mode=router&listen=tcp/127.0.0.1:{self.port}&scouting=off&network={self.name}"

    @property
    def join(self) -> str:
        return f"zenoh:tcp/127.0.0.1:{self.port}?scouting=off&network={self.name}"


def module(name: str, via: str) -> r2p.Module:
    return r2p.Module(name, via=via, watchdog=False)


@contextmanager
def plain_session(net: Net) -> Iterator[zenoh.Session]:
    """A program on the same router that is none of ours."""
    config = zenoh.Config()
    for key, value in {
        "mode": '"client"',
        "connect/endpoints": f'["tcp/127.0.0.1:{net.port}"]',
        "scouting/multicast/enabled": "false",
    }.items():
        config.insert_json5(key, value)
    with zenoh.open(config) as session:
        yield session


def guarded(test: Callable[P, Coroutine[Any, Any, None]]) -> Callable[P, Coroutine[Any, Any, None]]:
    """A test that fails when it hangs."""

    @functools.wraps(test)
    async def run(*args: P.args, **kwargs: P.kwargs) -> None:
        async with asyncio.timeout(2 * GUARD):
            await test(*args, **kwargs)

    return run
