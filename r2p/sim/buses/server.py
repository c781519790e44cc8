"""A simulated bus for other programs of this computer: each one that connects has a controller of its own.

    async with serve_bus(sim.can_bus("lab"), "lab"):
        ...                                         # elsewhere: can.Bus(interface="r2psim", channel="lab")

The bus runs on in its event loop as it does without a server, also under virtual time at a speed. A client that
disconnects, or is killed, has cut the power of its controller. One that does not read loses its oldest events.
"""

from __future__ import annotations

import asyncio
import contextlib
import hmac
import socket
from collections import deque
from typing import TYPE_CHECKING, Final, cast

import msgspec

from r2p.clock import clock_of, real_time
from r2p.errors import DecodeError, Error, TransportError
from r2p.log_lines import LineLimit, get_logger
from r2p.sim.buses import rendezvous, wire
from r2p.sim.buses.attachment import TX_QUEUE, AttachmentOptions
from r2p.sim.buses.driver import BusDriver, bus_clock

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from r2p.codecs.can_bits import Frame, OtherFrame
    from r2p.sim.buses.attachment import BusFrame
    from r2p.sim.transport import SimCan

logger = get_logger("r2p.buses")

CLIENTS_MAX: Final = 64
"""Programs that use a bus at once, at most."""

EVENTS_KEPT: Final = 8192
"""Events that wait for a client which does not read, beside some 100 KB in its connection: half a second at least."""

_NAME_MAX: Final = 64  # characters
_HOST: Final = "127.0.0.1"
_BACKLOG: Final = 1024  # connections that the kernel keeps until the loop has time: beyond, clients wait a second
_STRANGERS_MAX: Final = 64  # connections that have not sent the secret yet
_GREETING_TIMEOUT: Final = 5.0  # seconds
_MESSAGE_MAX: Final = 1 << 13  # bytes of a message of a client: more than TX_QUEUE frames, or FILTERS_MAX filters
_BUFFER_MAX: Final = 1 << 16  # bytes of events that wait in a connection before they wait here


class BusServer:
    """The clients of a served bus, which is called `name`."""

    def __init__(self, can: SimCan, served: rendezvous.ServedBus) -> None:
        self.can = can
        self.name = served.name
        self.secret = served.secret
        self.clients: dict[str, ServedClient] = {}
        """By the names of their nodes."""
        self.refused = 0
        """Connections that were ended for what they sent, or did not send."""
        self._strangers: dict[ServedClient, None] = {}  # connected, and not one of the clients yet; the oldest first
        self._lines = LineLimit(5)

    def accept(self) -> ServedClient:
        """Return the protocol of a new connection."""
        return ServedClient(self)

    def close(self) -> None:
        """Disconnect all clients."""
        for client in [*self.clients.values(), *self._strangers]:
            client.hang_up()

    # For clients

    def connected(self, client: ServedClient) -> None:
        self._strangers[client] = None
        if len(self._strangers) > _STRANGERS_MAX:
            next(iter(self._strangers)).refuse("too many connections without a greeting")

    def greeted(self, client: ServedClient, options: AttachmentOptions) -> BusDriver:
        """Return the node of a client that knows the secret. Raises TransportError."""
        if len(self.clients) >= CLIENTS_MAX:
            raise TransportError(f"{CLIENTS_MAX} programs use the bus {self.name}, and no more can: end one of them")
        if options.bitrate not in (None, self.can.bitrate):
            raise TransportError(
                f"the bus {self.name} has {self.can.bitrate} bit/s, not {options.bitrate}: "
                f"open it with bitrate={self.can.bitrate}"
            )
        if len(options.name) > _NAME_MAX:
            raise TransportError(f"the name of a node has {_NAME_MAX} characters at most")
        driver = BusDriver(self.can, options, client.on_event, client.on_change)
        del self._strangers[client]
        self.clients[driver.controller.name] = client
        logger.info("bus %s: %s joins", self.name, driver.controller.name)
        return driver

    def describe(self, driver: BusDriver) -> wire.BusDescription:
        """Return what a client learns of the bus."""
        clock = bus_clock(self.can)
        return wire.BusDescription(self.can.bitrate, driver.controller.name, clock.at, clock.since, clock.speed)

    def disconnected(self, client: ServedClient, driver: BusDriver | None) -> None:
        self._strangers.pop(client, None)
        if driver is not None:
            del self.clients[driver.controller.name]
            logger.info("bus %s: %s leaves", self.name, driver.controller.name)

    def note_refused(self, reason: str) -> None:
        """Count a connection that is ended, and log the reason."""
        self.refused += 1
        more = self._lines.suffix("refused", clock_of().monotonic())
        if more is not None:
            logger.warning("bus %s: ended a connection: %s%s", self.name, reason, more)


class ServedClient(asyncio.Protocol):
    """A connection: first a stranger, then a node of the bus."""

    def __init__(self, server: BusServer) -> None:
        self._server = server
        self._loop = asyncio.get_running_loop()
        self._driver: BusDriver | None = None
        self._received = bytearray()
        self._waiting: deque[bytes] = deque()  # events
        self._accepted = 0  # frames
        self._lost = 0
        self._paused = False
        self._scheduled = False

    # The connection

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast("asyncio.Transport", transport)  # that of uvloop is none by its class
        self._transport.set_write_buffer_limits(_BUFFER_MAX)
        with real_time():
            self._timeout = self._loop.call_later(_GREETING_TIMEOUT, self.refuse, "no greeting in time")
        self._server.connected(self)

    def data_received(self, data: bytes) -> None:
        if self._transport.is_closing():
            return
        self._received += data
        try:
            if self._driver is None:
                self._greet()
            if self._driver is not None:
                self._handle_messages(self._driver)
        except DecodeError as error:
            self.refuse(str(error))

    def connection_lost(self, _error: Exception | None) -> None:
        self._leave()

    def pause_writing(self) -> None:
        self._paused = True

    def resume_writing(self) -> None:
        self._paused = False
        self._schedule()

    def hang_up(self) -> None:
        """End the connection. What the client has not read yet, it still can, but not what waits here."""
        self._flush()
        self._leave()
        self._transport.abort()

    def refuse(self, reason: str) -> None:
        """Close the connection of a program that does not speak r2p's protocol, or breaks its rules."""
        self._server.note_refused(reason)
        self._leave()
        self._transport.abort()

    def _leave(self) -> None:
        """Cut the power of the node, at once."""
        self._timeout.cancel()
        driver, self._driver = self._driver, None
        if driver is not None:
            driver.close()
        self._server.disconnected(self, driver)

    # From the client

    def _greet(self) -> None:
        """Answer HELLO, as soon as it is complete. Raises DecodeError."""
        if len(self._received) < wire.GREETING_SIZE:
            return
        hello = wire.decode_greeting(bytes(self._received[: wire.GREETING_SIZE]))
        end = wire.GREETING_SIZE + hello.size
        if len(self._received) < end:
            return
        body = bytes(self._received[wire.GREETING_SIZE : end])
        del self._received[:end]
        own, answer = self._server.secret[: wire.PROOF_SIZE], self._server.secret[wire.PROOF_SIZE :]
        if not hmac.compare_digest(hello.proof, own):
            raise DecodeError("it does not know the secret")
        self._timeout.cancel()
        try:
            self._driver = driver = self._server.greeted(self, self._options(hello, body))
        except Error as error:
            self._transport.write(wire.encode_greeting(b"", str(error).encode()[: wire.GREETING_MAX]))
            self._transport.close()
            return
        description = self._server.describe(driver)
        self._transport.write(wire.encode_greeting(answer, msgspec.json.encode(description)))

    def _options(self, hello: wire.Greeting, body: bytes) -> AttachmentOptions:
        if hello.version == wire.VERSION:
            with contextlib.suppress(msgspec.DecodeError):
                return msgspec.json.decode(body, type=AttachmentOptions)
        raise TransportError(f"the program that serves the bus {self._server.name} has another version of r2p")

    def _handle_messages(self, driver: BusDriver) -> None:
        received, offset = self._received, 0
        while len(received) - offset >= wire.HEAD_SIZE:
            kind, size = wire.decode_head(received, offset)
            if size > _MESSAGE_MAX:
                raise DecodeError(f"a message of {size} bytes, of {_MESSAGE_MAX} at most")
            end = offset + wire.HEAD_SIZE + size
            if len(received) < end:
                break
            self._handle(driver, kind, bytes(received[offset + wire.HEAD_SIZE : end]))
            offset = end
        del received[:offset]

    def _handle(self, driver: BusDriver, kind: int, body: bytes) -> None:
        match kind:
            case wire.MessageType.SEND:
                self._send(driver, wire.decode_frames(body))
            case wire.MessageType.FILTERS:
                driver.set_filters(wire.decode_filters(body))
            case wire.MessageType.FLUSH:
                driver.flush()
            case wire.MessageType.RESTART:
                driver.restart()
            case _:
                raise DecodeError(f"a message of unknown type {kind}")

    def _send(self, driver: BusDriver, frames: list[Frame | OtherFrame]) -> None:
        if len(driver.queue) + len(frames) > TX_QUEUE:
            raise DecodeError(f"more than {TX_QUEUE} frames in its queue")
        self._accepted += len(frames)
        driver.queue.extend(frames)
        driver.pump()

    # To the client

    def on_event(self, event: BusFrame) -> None:
        waiting = self._waiting
        waiting.append(wire.encode_event(event))
        if len(waiting) > EVENTS_KEPT:
            waiting.popleft()
            self._lost += 1
        self.on_change()

    def on_change(self) -> None:
        if not self._scheduled:
            self._schedule()

    def _schedule(self) -> None:
        # All that one turn of the loop brings goes in one message.
        self._scheduled = True
        self._loop.call_soon(self._flush)

    def _flush(self) -> None:
        self._scheduled = False
        driver = self._driver
        if driver is None or self._paused or self._transport.is_closing():
            return
        done = self._accepted - len(driver.queue)
        status = wire.Status(done, self._lost, driver.state, *driver.error_counters)
        body = wire.encode_status(status) + b"".join(self._waiting)
        self._waiting.clear()
        self._transport.write(wire.encode_message(wire.MessageType.EVENTS, body))


@contextlib.asynccontextmanager
async def serve_bus(can: SimCan, name: str) -> AsyncIterator[BusServer]:
    """Let other programs of this user use a bus of this event loop, under this name, while the block takes.

    Raises TransportError if a program serves a bus of that name already, or for a name that can't be served, and Error
    under virtual time that does not wait for other programs.
    """
    if getattr(clock_of(), "virtual", False) and not getattr(clock_of(), "paced", False):
        raise Error(f"virtual time does not wait for other programs, so it can't serve the bus {name}: give it a speed")
    with contextlib.ExitStack() as stack:
        listening = stack.enter_context(socket.create_server((_HOST, 0), backlog=_BACKLOG))
        port, bitrate = listening.getsockname()[1], can.bitrate
        served = stack.enter_context(rendezvous.publish(name, port, bitrate=bitrate))
        server = BusServer(can, served)
        loop = asyncio.get_running_loop()
        listener = await loop.create_server(server.accept, sock=listening, backlog=_BACKLOG)
        try:
            yield server
        finally:
            listener.close()
            server.close()
