"""Run an emulated module: its timer, and its lines.

All peers on its lines receive everything that the module sends, as on one serial line; the bytes of each of them are
read separately, so that half a line of one does not corrupt the line of another.
"""

import asyncio
import contextlib
import os
from collections.abc import Callable
from typing import Protocol, Self, cast

from r2p.clock import Alarm, clock_of
from r2p.codecs import debug
from r2p.errors import Broken
from r2p.messages import Message
from r2p.sim.modules.firmware import FirmwareModule
from r2p.transports.line import Carrier, LineLink
from r2p.transports.link import Hub, Transport
from r2p.transports.tcp import cannot_listen

BUFFER = 64 * 1024
"""Bytes kept for a peer that does not read; it loses any more."""

_CHUNK = 4096


class LineEnd(Protocol):
    """The end of a line at the module."""

    @property
    def waiting(self) -> int:
        """Bytes that the peer has not read."""

    def send(self, data: bytes) -> None:
        """Send bytes of the module, or drop them if the peer does not read."""

    def close(self) -> None:
        """Close the line."""


class Powered:
    """An emulated module under power, for the time of an `async with` block.

    It starts at the beginning of the block; a peer that connects later misses the boot marker, as with a board.
    """

    def __init__(self, module: FirmwareModule) -> None:
        self.module = module
        self._ends: set[LineEnd] = set()
        self._servers: list[asyncio.Server] = []

    async def __aenter__(self) -> Self:
        self._loop = asyncio.get_running_loop()
        self._clock = clock_of(self._loop)
        self._alarm = Alarm(self._loop, self._poll, background=True)
        self.reset()
        return self

    async def __aexit__(self, *_exception: object) -> None:
        self._alarm.close()
        for server in self._servers:
            server.close()
        ends = list(self._ends)
        for end in ends:
            end.close()
        await asyncio.gather(*(end.closed for end in ends if isinstance(end, _Client)))
        for server in self._servers:  # last: since Python 3.12 this waits until all connections are closed
            await server.wait_closed()

    # Lines

    async def listen(self, host: str = "127.0.0.1", port: int = 0) -> tuple[str, int]:
        """Serve the line on TCP to any number of clients, and return the address (port 0: any free one).

        Raises TransportError if another program listens there.
        """
        try:
            server = await self._loop.create_server(lambda: _Client(self), host, port)
        except OSError as error:
            raise cannot_listen(f"{host}:{port}", error) from error
        self._servers.append(server)
        bound: tuple[str, int] = server.sockets[0].getsockname()[:2]
        return bound

    def open_pty(self) -> str:
        """Serve the line on a new pseudo terminal, and return its device name. Raises OSError without any."""
        end = _Pty(self)
        self._ends.add(end)
        return end.device

    def wire(self) -> "Wire":
        """Return a transport inside the process for `Module(via=...)`; it works under virtual time."""
        return Wire(self)

    # The module

    def reset(self, *, boot_mode: bool = False) -> None:
        """Cut its power for a moment: it restarts."""
        self._broadcast(self.module.power_on(self._clock.monotonic(), boot_mode=boot_mode))

    def publish(self, topic: str, message: Message) -> None:
        """Let it publish a message. Raises Error if it has no publisher of the topic."""
        self._broadcast(self.module.publish(self._clock.monotonic(), topic, message))

    # For the ends

    def attach(self, end: LineEnd) -> None:
        self._ends.add(end)

    def detach(self, end: LineEnd) -> None:
        self._ends.discard(end)

    def receive(self, lines: list[debug.Line]) -> None:
        """Receive lines from a peer."""
        now = self._clock.monotonic()
        self._broadcast(b"".join([self.module.receive_line(now, line) for line in lines]))

    def _poll(self) -> None:
        self._broadcast(self.module.poll(self._clock.monotonic()))

    def _broadcast(self, data: bytes) -> None:
        if data:
            for end in list(self._ends):
                end.send(data)
        self._alarm.set(self.module.next_deadline())


class _Client(asyncio.Protocol):
    """A TCP client at the module."""

    def __init__(self, power: Powered) -> None:
        self.closed: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._power = power
        self._reader = debug.Reader(power.module.drops)

    @property
    def waiting(self) -> int:
        return self._transport.get_write_buffer_size()

    def send(self, data: bytes) -> None:
        if self.waiting < BUFFER:
            self._transport.write(data)

    def close(self) -> None:
        self._transport.abort()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast("asyncio.Transport", transport)
        self._power.attach(self)

    def data_received(self, data: bytes) -> None:
        self._power.receive(self._reader.feed(data))

    def connection_lost(self, exc: Exception | None) -> None:
        self._power.detach(self)
        self.closed.set_result(None)


class _Pty:
    """The master's side of a pseudo terminal; the other side stays open, so that programs can come and go."""

    def __init__(self, power: Powered) -> None:
        import tty  # not on Windows

        self._loop = asyncio.get_running_loop()
        self._power = power
        self._reader = debug.Reader(power.module.drops)
        self._unsent = bytearray()
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        self.device = os.ttyname(self._slave)
        os.set_blocking(self._master, False)
        self._loop.add_reader(self._master, self._read)

    @property
    def waiting(self) -> int:
        return len(self._unsent)

    def send(self, data: bytes) -> None:
        if self.waiting >= BUFFER:
            return
        if not self._unsent:
            self._loop.add_writer(self._master, self._write)
        self._unsent += data

    def close(self) -> None:
        self._loop.remove_reader(self._master)
        self._loop.remove_writer(self._master)
        os.close(self._master)
        os.close(self._slave)
        self._power.detach(self)

    def _read(self) -> None:
        with contextlib.suppress(BlockingIOError):
            self._power.receive(self._reader.feed(os.read(self._master, _CHUNK)))

    def _write(self) -> None:
        with contextlib.suppress(BlockingIOError):
            del self._unsent[: os.write(self._master, self._unsent)]
        if not self._unsent:
            self._loop.remove_writer(self._master)


class Wire(Transport, Carrier):
    """A cable between an emulated module and one `Module` in this process; it can be pulled and plugged in again."""

    def __init__(self, power: Powered) -> None:
        self._power = power
        self._end = _WireEnd(self)
        self._reader = debug.Reader(power.module.drops)
        self._link: LineLink | None = None
        self._plugged = False
        self._paused = False
        self._held: list[bytes] = []

    async def run(self, hub: Hub, opened: Callable[[], object]) -> None:
        self._link = link = LineLink(f"wire:{self._power.module.name}", hub)
        hub.attach(link)
        try:
            self.plug_in()
            opened()
            await asyncio.get_running_loop().create_future()
        finally:
            link.close()
            hub.detach(link)

    def plug_in(self) -> None:
        """Connect; a `Module` that opens it does so by itself. Raises Broken while no module has it open."""
        if self._link is None:
            raise Broken("this wire has only one end: give it to a Module(via=...) first")
        if not self._plugged:
            self._plugged = True
            self._paused = False
            self._power.attach(self._end)
            self._link.connect(self)

    def pull(self) -> None:
        """Disconnect. The emulated module does not notice it, the other one does."""
        if self._plugged and self._link is not None:
            self.close()
            self._link.disconnect("the wire is pulled")

    def receive(self, data: bytes) -> None:
        """Receive bytes of the emulated module."""
        if not self._plugged or self._link is None:
            return
        if self._paused:
            self._held.append(data)
        else:
            self._link.feed(data)

    # Carrier: the end at the Module

    def send(self, data: bytes) -> None:
        asyncio.get_running_loop().call_soon(self._power.receive, self._reader.feed(data))

    def pause(self) -> None:
        self._paused = True

    def resume(self) -> None:
        self._paused = False
        held, self._held = self._held, []
        for data in held:
            self.receive(data)

    def close(self) -> None:
        self._plugged = False
        self._held.clear()
        self._power.detach(self._end)


class _WireEnd:
    """The end at the emulated module."""

    waiting = 0  # the link at the other end has a buffer of its own

    def __init__(self, wire: Wire) -> None:
        self._wire = wire

    def send(self, data: bytes) -> None:
        asyncio.get_running_loop().call_soon(self._wire.receive, data)

    def close(self) -> None:
        self._wire.pull()
