"""Two modules on one zenoh network: A listens, B connects through a proxy that can be cut. Multicast stays off."""

import asyncio
import functools
from collections.abc import Callable, Coroutine, Iterator
from contextlib import contextmanager
from typing import Any, ParamSpec, Self

import zenoh

import r2p
from r2p.transports.link import Transport
from r2p.transports.url import open_transport
from tests.ports import free_port
from tests.transports.cables import GUARD, Cable, Proxy

P = ParamSpec("P")


class ZenohCable(Cable):
    """A is a router, B its client."""

    async def __aenter__(self) -> Self:
        self._port = free_port()
        self._proxy = Proxy(lambda: self._port)
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
