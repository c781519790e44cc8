"""Find out which protocol the server at a TCP port speaks, where connecting succeeds but leads nowhere.

A debug line begins to send by itself. zenoh and TLS wait for the client, so `identify_server` sends zenoh the first
message of its handshake, to which a server for TLS answers with an alert. Nothing in it begins a message of the debug
line: firmware skips it up to the next line end.
"""

import asyncio
import contextlib
import enum

import msgspec

from r2p.codecs import debug

_TIMEOUT_S = 1.2  # seconds for a server to send something: idle firmware announces an item each half or whole second

_ZENOH_INIT = b"\x04\x00\x01\x09\x02\x11"  # 4 bytes: InitSyn, version 9, a client with the 1-byte identifier 0x11
_ZENOH_LENGTH = 2  # bytes of the length before each zenoh message, little-endian
_ZENOH_ID_MASK = 0x1F  # the other bits of the first byte are flags
_ZENOH_ANSWERS = {0x01, 0x03}  # InitAck, Close
_TLS_ALERT = b"\x15\x03"  # the record type, and the major version
_SHOWN_MAX = 40  # characters of an unknown server's first line that are shown


class ServerKind(enum.Enum):
    """Protocols of servers."""

    UNKNOWN = enum.auto()
    """The server sent nothing, or nothing that is known."""
    DEBUG_LINE = enum.auto()
    ZENOH = enum.auto()
    TLS = enum.auto()


class Server(msgspec.Struct, frozen=True):
    """The protocol of a server, and the first bytes that it sent."""

    kind: ServerKind
    sent: bytes

    @property
    def first_line(self) -> str:
        """The first line of text that the server sent, such as SSH-2.0-OpenSSH_9.2; empty if it sent no text."""
        line = self.sent.partition(b"\n")[0].strip()
        return line.decode()[:_SHOWN_MAX] if line.isascii() and line.decode().isprintable() else ""


async def identify_server(host: str, port: int) -> Server:
    """Connect, and return what the server speaks. Raises OSError without a connection.

    The connection is closed again. It takes up to 1.2 s where the server sends nothing.
    """
    reader, writer = await asyncio.open_connection(host, port)
    try:
        writer.write(_ZENOH_INIT)
        return await _read(reader)
    finally:
        writer.transport.abort()


async def _read(reader: asyncio.StreamReader) -> Server:
    sent = b""
    with contextlib.suppress(TimeoutError, OSError):
        async with asyncio.timeout(_TIMEOUT_S):
            while _kind(sent) is ServerKind.UNKNOWN and (more := await reader.read(debug.PAYLOAD_MAX)):
                sent = (sent + more)[-4 * debug.PAYLOAD_MAX :]  # a server that sends without end is not kept
    return Server(_kind(sent), sent)


def _kind(sent: bytes) -> ServerKind:
    if sent.startswith(debug.OPENING) or debug.Reader({}).feed(sent):
        return ServerKind.DEBUG_LINE
    if sent.startswith(_TLS_ALERT):
        return ServerKind.TLS
    length, message = sent[:_ZENOH_LENGTH], sent[_ZENOH_LENGTH:]
    if message and len(message) == int.from_bytes(length, "little") and message[0] & _ZENOH_ID_MASK in _ZENOH_ANSWERS:
        return ServerKind.ZENOH
    return ServerKind.UNKNOWN
