"""XMLRPC over HTTP/1.1, as ROS 1's master and nodes speak it: a client and a server on asyncio's streams.

A request or answer is a header, whose `Content-Length` is needed, and that many bytes of XML. Connections are kept for
further calls, one after the other. XML is parsed as it arrives, so that a length alone reserves nothing. Python's
servers compress long answers for clients that accept it; this one does not.
"""

import asyncio
import contextlib
import logging
import re
import socket
from collections import Counter
from collections.abc import Callable
from typing import Final
from urllib.parse import quote, urlsplit

from r2p.errors import DecodeError, Error
from r2p.ros.ros1.xmlrpc_codec import (
    Value,
    XmlCall,
    XmlFault,
    XmlParser,
    XmlResult,
    encode_call,
    encode_fault,
    encode_result,
)

logger = logging.getLogger("r2p.ros.ros1")

BODY_MAX: Final = 8 << 20
"""Bytes of a request or answer: a robot's description, in a parameter, may have one or two millions."""

CONNECTIONS_MAX: Final = 64
"""Connections to one server; another one takes the place of the one that has been idle for longest."""

_HEADER_MAX: Final = 16 * 1024  # bytes
_PIECE: Final = 32 * 1024  # bytes parsed at once: a few milliseconds
_CLOSE_S: Final = 0.5  # seconds for callers to take their last answers
_HOST: Final = re.compile(
    r"(?=.{1,253}$)[A-Za-z0-9_-]{1,63}(\.[A-Za-z0-9_-]{1,63})*\.?|[0-9A-Fa-f:.]{2,45}(%[A-Za-z0-9_.-]{1,15})?"
)
_SHOWN: Final = 300  # characters of another program's text in an error


class XmlRpcError(Error):
    """A call that the other end answered with a fault or with invalid XMLRPC; the text names the call."""


Handler = Callable[[str, list[Value]], object]
"""Answers a call, from its method and arguments. Raises XmlRpcError for a fault."""


# HTTP


class _HttpError(Exception):
    """A request that is answered with an HTTP status instead of XML."""

    def __init__(self, status: str, text: str) -> None:
        super().__init__(text)
        self.status = status


async def _read_head(reader: asyncio.StreamReader) -> tuple[str, dict[str, str]]:
    """Return the first line of a request or answer, and its header by names in lower case."""
    try:
        block = await reader.readuntil(b"\r\n\r\n")
    except asyncio.LimitOverrunError:
        raise _HttpError("431 Request Header Fields Too Large", "the header is too long") from None
    first, *lines = block.decode("latin-1").split("\r\n")
    pairs = (line.partition(":") for line in lines if line)
    return first, {name.strip().lower(): value.strip() for name, _, value in pairs}


async def _read_body(reader: asyncio.StreamReader, header: dict[str, str]) -> XmlParser:
    """Return the parser that has read the XML."""
    length = header.get("content-length", "")
    if not (length.isascii() and length.isdecimal()) or len(length) > len(str(BODY_MAX)):
        raise _HttpError("411 Length Required", "Content-Length is missing or not a number of bytes")
    if int(length) > BODY_MAX:
        raise _HttpError("413 Content Too Large", f"{length} bytes are more than {BODY_MAX}")
    if header.get("content-encoding", "identity") != "identity" or "transfer-encoding" in header:
        raise _HttpError("415 Unsupported Media Type", "send the XML as it is")
    remaining, parser = int(length), XmlParser()
    while remaining:
        data = await reader.readexactly(min(remaining, _PIECE))
        remaining -= len(data)
        parser.feed(data)
    return parser


def _stays_open(first: str, header: dict[str, str]) -> bool:
    default = "close" if "HTTP/1.0" in first else "keep-alive"
    return header.get("connection", default).lower() != "close"


def _send_at_once(writer: asyncio.StreamWriter) -> None:
    with contextlib.suppress(OSError):  # a connection that is gone already
        writer.get_extra_info("socket").setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)


# The client


class XmlRpcClient:
    """Calls methods of servers. The connections of `keep=True` stay open for further calls of the same server."""

    def __init__(self) -> None:
        self._kept: dict[str, _HttpConnection] = {}

    async def call(self, uri: str, method: str, *arguments: object, timeout: float = 5.0, keep: bool = False) -> Value:
        """Call a method and return its value, within `timeout` seconds.

        Raises XmlRpcError for a fault or an unusable answer, OSError if the connection fails, TimeoutError.
        """
        try:
            answer = await self._ask(uri, encode_call(method, arguments), timeout, keep=keep)
        except (TypeError, _HttpError, DecodeError) as error:
            raise XmlRpcError(f"{method} of {uri}: {error}") from None
        if isinstance(answer, XmlFault):
            raise XmlRpcError(f"{method} of {uri}: {answer.text[:_SHOWN]}")
        return answer.value

    async def _ask(self, uri: str, body: bytes, timeout: float, *, keep: bool) -> XmlResult | XmlFault:
        connection = self._kept.get(uri) if keep else None
        if connection is None:
            connection = _HttpConnection(*split_uri(uri))
            if keep:
                self._kept[uri] = connection
        try:
            async with asyncio.timeout(timeout), connection.lock:
                return await connection.ask(body)
        finally:
            if not keep:
                connection.close()

    def local_host(self, uri: str) -> str:
        """Return the local address of the open connection to the server; empty without one."""
        connection = self._kept.get(uri)
        return connection.local_host() if connection is not None else ""

    def close(self) -> None:
        """Close the connections that were kept."""
        for connection in self._kept.values():
            connection.close()
        self._kept.clear()


def split_uri(uri: str, scheme: str = "http") -> tuple[str, str, int]:
    """Return path, host and port of the URI of a server. Raises XmlRpcError."""
    with contextlib.suppress(ValueError):
        parts = urlsplit(uri)
        if parts.scheme == scheme and is_host(parts.hostname or "") and parts.port:
            return quote(parts.path or "/"), str(parts.hostname), parts.port
    raise XmlRpcError(f"{uri[:_SHOWN]!r} is not the URI of a server: those look like {scheme}://host:11311/")


def is_host(text: str) -> bool:
    """Return whether a text may be the name or the address of a computer, so that looking it up never raises."""
    return _HOST.fullmatch(text) is not None


class _HttpConnection:
    """One connection to a server, opened when it is needed."""

    def __init__(self, path: str, host: str, port: int) -> None:
        self.lock = asyncio.Lock()
        self._path, self._host, self._port = path, host, port
        self._streams: tuple[asyncio.StreamReader, asyncio.StreamWriter] | None = None

    async def ask(self, body: bytes) -> XmlResult | XmlFault:
        """Return the answer. If the server has closed an idle connection, ask again on a new one."""
        host = f"[{self._host}]" if ":" in self._host else self._host
        head = (
            f"POST {self._path} HTTP/1.1\r\nHost: {host}:{self._port}\r\nUser-Agent: r2p\r\n"
            f"Content-Type: text/xml\r\nContent-Length: {len(body)}\r\n\r\n"
        )
        if self._streams is not None:
            with contextlib.suppress(ConnectionError):
                return await self._exchange(head.encode() + body)
        return await self._exchange(head.encode() + body)

    async def _exchange(self, request: bytes) -> XmlResult | XmlFault:
        stays_open = False
        try:
            reader, writer = self._streams = self._streams or await self._connect()
            writer.write(request)
            await writer.drain()
            first, header = await _read_head(reader)
            if first.split(" ")[1:2] != ["200"]:
                raise DecodeError(f"the server answered {first[:_SHOWN]!r}")
            answer = (await _read_body(reader, header)).answer()
            stays_open = _stays_open(first, header)
            return answer
        except asyncio.IncompleteReadError:
            raise ConnectionResetError("the server closed the connection before its answer was complete") from None
        finally:
            if not stays_open:  # nor after an error: the rest of this answer would be taken for that of the next call
                self.close()

    async def _connect(self) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
        streams = await asyncio.open_connection(self._host, self._port, limit=_HEADER_MAX)
        _send_at_once(streams[1])
        return streams

    def local_host(self) -> str:
        own = self._streams[1].get_extra_info("sockname") if self._streams is not None else None
        return str(own[0]) if own else ""

    def close(self) -> None:
        if self._streams is not None:
            self._streams[1].close()
        self._streams = None


# The server


class XmlRpcServer:
    """Answers calls at a port of its own. What can't be answered is counted in `lost`."""

    def __init__(self, host: str, handler: Handler, lost: Counter[str]) -> None:
        """Take a free port of `host`. Raises OSError."""
        self._socket = socket.create_server((host, 0), family=socket.AF_INET6 if ":" in host else socket.AF_INET)
        self.port: int = self._socket.getsockname()[1]
        self._handler = handler
        self._lost = lost
        self._server: asyncio.Server | None = None
        self._connections: dict[asyncio.Task[None], asyncio.StreamWriter] = {}
        """The one that has been idle for longest first."""
        self._closed = False

    async def start(self) -> None:
        """Accept connections."""
        self._server = await asyncio.start_server(self._serve, sock=self._socket, limit=_HEADER_MAX)

    async def close(self) -> None:
        """Stop, and close all connections."""
        self._closed = True
        if self._server is not None:
            await _stop_accepting(self._server)
            self._server.close()
        self._socket.close()
        for writer in self._connections.values():
            writer.close()  # which ends its task
        if self._connections:
            await asyncio.wait([*self._connections], timeout=_CLOSE_S)
        for writer in self._connections.values():
            writer.transport.abort()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        if self._closed:  # the connection was accepted just before
            writer.transport.abort()
            return
        self._connections[task] = writer
        if len(self._connections) > CONNECTIONS_MAX:
            self._lost["XMLRPC connections over the limit"] += 1
            self._connections.pop(next(iter(self._connections))).transport.abort()
        _send_at_once(writer)
        try:
            while await self._answer(reader, writer) and task in self._connections:
                self._connections[task] = self._connections.pop(task)  # the last to be closed for want of room
        except (OSError, asyncio.IncompleteReadError):
            pass  # the other end has closed it, which is how they all end
        finally:
            self._connections.pop(task, None)
            writer.close()

    async def _answer(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> bool:
        """Answer one request; return whether the connection stays open."""
        try:
            first, header = await _read_head(reader)
            if not first.startswith("POST "):
                raise _HttpError("405 Method Not Allowed", "this is the XMLRPC server of a ROS node: use POST")
            call = (await _read_body(reader, header)).call()
        except (_HttpError, DecodeError) as error:
            self._lost["XMLRPC requests that can't be read"] += 1
            status = error.status if isinstance(error, _HttpError) else "400 Bad Request"
            await _respond(writer, status, "text/plain", f"{error}\n".encode())
            return False
        await _respond(writer, "200 OK", "text/xml", self._called(call))
        return _stays_open(first, header)

    def _called(self, call: XmlCall) -> bytes:
        try:
            return encode_result(self._handler(call.method, call.arguments))
        except XmlRpcError as error:
            return encode_fault(-1, str(error))
        except Exception:
            logger.exception("internal error while answering an XMLRPC call")
            return encode_fault(-1, "internal error")


async def _stop_accepting(server: asyncio.Server) -> None:
    """Accept no more connections, and return when those that were accepted are set up.

    If a server is closed in between, asyncio (Python 3.11) leaves their sockets open.
    """
    for sock in server.sockets:
        with contextlib.suppress(NotImplementedError):  # on Windows
            server.get_loop().remove_reader(sock)
    for _ in range(2):
        await asyncio.sleep(0)


async def _respond(writer: asyncio.StreamWriter, status: str, kind: str, body: bytes) -> None:
    head = f"HTTP/1.1 {status}\r\nServer: r2p\r\nContent-Type: {kind}\r\nContent-Length: {len(body)}\r\n\r\n"
    writer.write(head.encode() + body)
    await writer.drain()
