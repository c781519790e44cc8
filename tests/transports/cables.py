"""Two modules and something between them that can be cut, mended and frozen: one class for each transport.

`@conforms` runs one and the same test over all of them: memory, a simulated CAN bus and an in-process line under
virtual time, TCP, serial ports and zenoh on asyncio's loop and on uvloop's.
"""

import asyncio
import os
import socket
import tempfile
import tty
from collections.abc import Callable, Coroutine
from pathlib import Path
from types import TracebackType
from typing import Any, Self, cast

import msgspec
import pytest
import uvloop

from r2p.sim import SimCan, VirtualLoop
from r2p.transports.line import Carrier, LineLink
from r2p.transports.link import Hub, Link, Transport
from r2p.transports.memory import MemoryLink, MemoryNetwork
from r2p.transports.serial import SerialTransport
from r2p.transports.tcp import TcpListenTransport, TcpTransport
from r2p.transports.url import parse

GUARD = 30.0
"""Seconds, real or virtual, after which a test has hung."""


class Cable:
    """A connection between module A and module B. `a()` and `b()` make the transport of a module that comes."""

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.cut()

    def a(self) -> Transport:
        raise NotImplementedError

    def b(self) -> Transport:
        raise NotImplementedError

    async def cut(self) -> None:
        """Both ends notice that the other one is gone."""
        raise NotImplementedError

    async def mend(self) -> None:
        raise NotImplementedError

    def freeze(self) -> None:
        """Nothing that A sends arrives from now on, and nothing of it is lost: the other end does not read."""
        raise NotImplementedError

    def thaw(self) -> None:
        raise NotImplementedError


class MemoryCable(Cable):
    """A memory network; nothing but the plugs can fail."""

    def __init__(self) -> None:
        self.network = MemoryNetwork()
        self._links: list[MemoryLink] = []
        self._connected = True

    def a(self) -> Transport:
        return _Attached(self.network.transport("lab"), self._attached)

    b = a

    async def cut(self) -> None:
        self._connected = False
        for link in self._links:
            link.disconnect()

    async def mend(self) -> None:
        self._connected = True
        for link in self._links:
            link.connect()

    def _attached(self, link: Link) -> None:
        assert isinstance(link, MemoryLink)
        self._links = [each for each in self._links if not each._closed]
        self._links.append(link)
        if not self._connected:
            asyncio.get_running_loop().call_soon(link.disconnect)


class _Attached(Transport):
    """A transport that tells of the links it attaches."""

    def __init__(self, inner: Transport, attached: Callable[[Link], None]) -> None:
        self._inner = inner
        self._attached = attached

    async def run(self, hub: Hub, opened: Callable[[], object]) -> None:
        class Telling:
            def __getattr__(_self, name: str) -> Any:  # noqa: N805
                return getattr(hub, name)

            def attach(_self, link: Link) -> None:  # noqa: N805
                hub.attach(link)
                self._attached(link)

        await self._inner.run(Telling(), opened)


class SimCable(Cable):
    """A simulated CAN bus; power can fail."""

    async def __aenter__(self) -> Self:
        self._bus = SimCan(seed=1)
        return self

    def a(self) -> Transport:
        return self._bus.transport()

    b = a

    async def cut(self) -> None:
        self._bus.power_off()

    async def mend(self) -> None:
        self._bus.power_on()


class LineEnd(Transport, Carrier):
    """One end of a line in this process: `arrived` gets what its module sends. `name` is that of the link."""

    name = "line"

    def __init__(self, arrived: Callable[[bytes], None]) -> None:
        self.link: LineLink | None = None
        self.frozen = False
        self._arrived = arrived
        self._plugged = False
        self._wanted = True
        self._paused = False
        self._inbox: list[bytes] = []
        self._stuck: list[bytes] = []

    async def run(self, hub: Hub, opened: Callable[[], object]) -> None:
        self.link = link = LineLink(self.name, hub)
        self.prepare(link)
        hub.attach(link)
        try:
            if self._wanted:
                self.plug()
            opened()
            await asyncio.get_running_loop().create_future()
        finally:
            link.close()
            hub.detach(link)
            self.link = None

    def prepare(self, link: LineLink) -> None:
        """Equip the link before the module gets it."""

    def plug(self) -> None:
        self._wanted = True
        if self.link is not None and not self._plugged:
            self._plugged = True
            self.link.connect(self)

    def pull(self, reason: str = "pulled") -> None:
        self._wanted = self.frozen = False
        self._stuck.clear()
        if self.link is not None and self._plugged:
            self._plugged = False
            self.link.disconnect(reason)

    def arrive(self, data: bytes) -> None:
        """The other end sent this."""
        if self._paused:
            self._inbox.append(data)
        elif self.link is not None and self._plugged:
            self.link.feed(data)

    def thaw(self) -> None:
        self.frozen = False
        stuck, self._stuck = self._stuck, []
        for data in stuck:
            self._arrived(data)
        if self.link is not None:
            self.link.carrier_ready()

    def send(self, data: bytes) -> None:
        if self.frozen:
            self._stuck.append(data)
            if self.link is not None:
                self.link.carrier_full()
        else:
            self._arrived(data)

    def pause(self) -> None:
        self._paused = True

    def resume(self) -> None:
        self._paused = False
        while self._inbox and not self._paused:
            self.arrive(self._inbox.pop(0))

    def close(self) -> None:
        self._plugged = False


class LineCable(Cable):
    """A debug line in this process, in chunks of `chunk` bytes."""

    def __init__(self, chunk: int = 50) -> None:
        self._chunk = chunk
        self._a = LineEnd(lambda data: self._carry(data, self._b))
        self._b = LineEnd(lambda data: self._carry(data, self._a))

    def a(self) -> Transport:
        return self._a

    def b(self) -> Transport:
        return self._b

    async def cut(self) -> None:
        self._a.pull()
        self._b.pull()

    async def mend(self) -> None:
        self._a.plug()
        self._b.plug()

    def freeze(self) -> None:
        self._a.frozen = True

    def thaw(self) -> None:
        self._a.thaw()

    def _carry(self, data: bytes, to: LineEnd) -> None:
        for at in range(0, len(data), self._chunk):
            asyncio.get_running_loop().call_soon(to.arrive, data[at : at + self._chunk])


class Pump:
    """Carries bytes from one socket or pty master to another, as fast as that takes them."""

    def __init__(self, source: int, target: int, broken: Callable[[], None]) -> None:
        self._loop = asyncio.get_running_loop()
        self._source = source
        self._target = target
        self._broken = broken
        self._held = b""
        self._frozen = False
        for each in (source, target):
            os.set_blocking(each, False)
        self._loop.add_reader(source, self._read)

    def freeze(self) -> None:
        self._frozen = True
        self._loop.remove_reader(self._source)

    def thaw(self) -> None:
        self._frozen = False
        self._loop.add_reader(self._source, self._read)

    def close(self) -> None:
        self._loop.remove_reader(self._source)
        self._loop.remove_writer(self._target)

    def _read(self) -> None:
        try:
            self._held = os.read(self._source, 4096)
        except BlockingIOError:
            return
        except OSError:
            self._held = b""
        if self._held:
            self._loop.remove_reader(self._source)
            self._write()
        else:
            self._broken()

    def _write(self) -> None:
        try:
            self._held = self._held[os.write(self._target, self._held) :]
        except BlockingIOError:
            pass
        except OSError:
            self._broken()
            return
        self._loop.remove_writer(self._target)
        if self._held:
            self._loop.add_writer(self._target, self._write)
        elif not self._frozen:
            self._loop.add_reader(self._source, self._read)


class Proxy:
    """Takes connections on a port of its own, and carries them to another one while it is not cut.

    `target` returns that port; None: there is none. `buffer` in bytes is what the sockets may hold.
    """

    def __init__(self, target: Callable[[], int | None], *, buffer: int | None = None) -> None:
        self.pumps: list[Pump] = []
        """Of the connections; the first one carries what comes back from the target of the first."""
        self._target = target
        self._buffer = buffer
        self._loop = asyncio.get_running_loop()
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._limit(self._listener)
        self._listener.setblocking(False)
        self._sockets: list[socket.socket] = []
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

    def _limit(self, each: socket.socket) -> None:
        if self._buffer is not None:
            each.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, self._buffer)

    def _accept(self) -> None:
        client, _ = self._listener.accept()
        server = socket.socket()
        self._limit(server)
        port = self._target()
        try:
            if not self._connected or port is None:
                raise ConnectionRefusedError
            server.connect(("127.0.0.1", port))
        except ConnectionRefusedError:
            client.close()
            server.close()
            return
        self._sockets += [server, client]
        self.pumps += [
            Pump(server.fileno(), client.fileno(), self._hang_up),
            Pump(client.fileno(), server.fileno(), self._hang_up),
        ]

    def _hang_up(self) -> None:
        for pump in self.pumps:
            pump.close()
        for each in self._sockets:
            each.close()
        self.pumps, self._sockets = [], []


class TcpCable(Cable):
    """A TCP connection from B to A, through a proxy that can cut it."""

    async def __aenter__(self) -> Self:
        self._server = TcpListenTransport(parse("tcp-listen:127.0.0.1:0"))
        self._proxy = Proxy(lambda: self._server.port, buffer=8192)
        return self

    async def __aexit__(self, *_reason: object) -> None:
        self._proxy.close()

    def a(self) -> Transport:
        self._server = TcpListenTransport(parse("tcp-listen:127.0.0.1:0"))
        return self._server

    def b(self) -> Transport:
        return TcpTransport(parse(f"tcp:127.0.0.1:{self._proxy.port}"))

    async def cut(self) -> None:
        self._proxy.cut()

    async def mend(self) -> None:
        self._proxy.mend()

    def freeze(self) -> None:
        self._proxy.pumps[0].freeze()

    def thaw(self) -> None:
        self._proxy.pumps[0].thaw()


class SerialCable(Cable):
    """Two pseudo terminals, connected; cutting it makes the devices disappear."""

    async def __aenter__(self) -> Self:
        self._folder = tempfile.TemporaryDirectory()
        self._devices = [Path(self._folder.name, name) for name in ("ttyA", "ttyB")]
        self._ends: list[int] = []
        self._pumps: list[Pump] = []
        await self.mend()
        return self

    async def __aexit__(self, *_reason: object) -> None:
        await self.cut()
        self._folder.cleanup()

    def a(self) -> Transport:
        return SerialTransport(parse(f"serial:{self._devices[0]},baud=921600"))

    def b(self) -> Transport:
        return SerialTransport(parse(f"serial:{self._devices[1]},baud=921600"))

    async def cut(self) -> None:
        for pump in self._pumps:
            pump.close()
        for device in self._devices:
            device.unlink(missing_ok=True)
        for end in self._ends:
            os.close(end)
        self._pumps, self._ends = [], []

    async def mend(self) -> None:
        for device in self._devices:
            master, slave = os.openpty()  # the slave stays open here too: else the master would see the users' comings
            tty.setraw(slave)
            device.symlink_to(os.ttyname(slave))
            self._ends += [master, slave]
        a, _, b, _ = self._ends
        self._pumps = [Pump(a, b, _never), Pump(b, a, _never)]

    def freeze(self) -> None:
        self._pumps[0].freeze()

    def thaw(self) -> None:
        self._pumps[0].thaw()


def _never() -> None:
    raise AssertionError("a pty whose both sides are open")


class Setup(msgspec.Struct, frozen=True):
    """A cable and the event loop that it runs on."""

    cable: Callable[[], Cable]
    loop: Callable[[], asyncio.AbstractEventLoop]

    def run(self, test: Callable[[Cable], Coroutine[Any, Any, None]]) -> None:
        """Run the test; an exception that is not awaited fails it."""
        lost: list[BaseException | str] = []

        async def main() -> None:
            loop = asyncio.get_running_loop()
            loop.set_exception_handler(lambda _, context: lost.append(context.get("exception") or context["message"]))
            async with asyncio.timeout(GUARD), self.cable() as cable:
                await test(cable)
            left = asyncio.all_tasks() - {asyncio.current_task()}
            assert not left

        with asyncio.Runner(loop_factory=self.loop) as runner:
            runner.run(main())
        assert not lost


def _zenoh() -> Cable:
    from tests.transports.zenoh.cable import ZenohCable  # which needs this module

    return ZenohCable()


SETUPS = {
    "memory": Setup(MemoryCable, VirtualLoop),
    "sim": Setup(SimCable, VirtualLoop),
    "line": Setup(LineCable, VirtualLoop),
    "tcp-asyncio": Setup(TcpCable, asyncio.new_event_loop),
    "tcp-uvloop": Setup(TcpCable, uvloop.new_event_loop),
    "serial-asyncio": Setup(SerialCable, asyncio.new_event_loop),
    "serial-uvloop": Setup(SerialCable, uvloop.new_event_loop),
    "zenoh-asyncio": Setup(_zenoh, asyncio.new_event_loop),
    "zenoh-uvloop": Setup(_zenoh, uvloop.new_event_loop),
}


def conforms(test: Callable[[Cable], Coroutine[Any, Any, None]]) -> Callable[[str], None]:
    """Make of `async def test(cable)` a test of every transport."""
    return _over(list(SETUPS), test)


def conforms_lines(test: Callable[[Cable], Coroutine[Any, Any, None]]) -> Callable[[str], None]:
    """The same, of every transport whose other end may stop reading; zenoh has tests of its own for that."""
    return _over([name for name in SETUPS if SETUPS[name].cable not in (MemoryCable, SimCable, _zenoh)], test)


def _over(names: list[str], test: Callable[[Cable], Coroutine[Any, Any, None]]) -> Callable[[str], None]:
    @pytest.mark.parametrize("setup", names)
    def run(setup: str) -> None:
        SETUPS[setup].run(test)

    run.__name__, run.__qualname__, run.__doc__ = test.__name__, test.__qualname__, test.__doc__
    return cast("Callable[[str], None]", run)
