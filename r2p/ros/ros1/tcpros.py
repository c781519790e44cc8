"""TCPROS, the protocol of ROS 1's topics and services: the headers of connections, and what follows them. No I/O.

A connection begins with a header from each side. All numbers are little-endian:

    header     u32 bytes of all fields, then for each field: u32 bytes, `name=value` in UTF-8 (up to the first `=`)
    message    u32 bytes, then the message; those of a topic follow each other, from the publisher to the subscriber
    request    as a message, from the caller to the server
    response   u8 1, then the response as a message; or u8 0, then the text of an error as a message

The side that connects, a subscriber or a caller, sends its header first. A side that refuses the other one answers with
a header that has only the field `error`, and closes the connection. `*` as type or checksum means: any.

`refuse_subscriber` and its neighbours compare a received header with what this side has, and return in words what is
wrong with it, or an empty text.
"""

import struct
from typing import NamedTuple

from r2p.errors import DecodeError
from r2p.messages import SIZE_MAX
from r2p.ros.middleware import RosService, RosType

ANY = "*"
"""The type, or the checksum, that fits all."""

HEADER_MAX = 1 << 20
"""Bytes of the longest header: nearly all of it is the text of a type, and the longest one of ROS has 15 kB."""

MESSAGE_MAX = SIZE_MAX
"""Bytes of the longest message."""

_LENGTH = struct.Struct("<I")
_RESPONSE = struct.Struct("<BI")

Fields = dict[str, str]
"""The fields of a header by name."""


def encode_header(fields: Fields) -> bytes:
    """Return the header with these fields."""
    return frame(b"".join(frame(f"{name}={value}".encode()) for name, value in fields.items()))


def decode_header(block: bytes) -> Fields:
    """Return the fields of a header without its first length; of a field that comes twice the last one counts.

    Raises DecodeError for a field that is cut, or has no name or no `=`.
    """
    fields: Fields = {}
    at = 0
    while at < len(block):
        begin = at + _LENGTH.size
        if begin > len(block):
            raise DecodeError("the header ends within a field's length")
        at = begin + _LENGTH.unpack_from(block, begin - _LENGTH.size)[0]
        if at > len(block):
            raise DecodeError("the header ends within a field")
        name, equals, value = block[begin:at].decode(errors="replace").partition("=")
        if not equals or not name:
            raise DecodeError("a field of the header is not name=value")
        fields[name] = value
    return fields


def encode_error(text: str) -> bytes:
    """Return the header that refuses a connection."""
    return encode_header({"error": text})


def frame(data: bytes | memoryview) -> bytes:
    """Return a message as it is sent."""
    return _LENGTH.pack(len(data)) + data


def encode_response(data: bytes) -> bytes:
    """Return the response of a server."""
    return b"\1" + frame(data)


def encode_failure(text: str) -> bytes:
    """Return a response that is the text of an error."""
    return b"\0" + frame(text.encode())


class FrameReader:
    """Splits received bytes into frames: a header first, then messages. It holds only bytes that have arrived."""

    def __init__(self, limit: int = HEADER_MAX) -> None:
        self.limit = limit
        """Bytes of the longest frame; a longer one ends the reading."""
        self.broken = ""
        """The reason why nothing is read any more; empty while all is well."""
        self._rest = bytearray()
        self._need = 0  # bytes that the first frame in `_rest` has with its length; 0: unknown

    def first(self, data: bytes) -> bytes | None:
        """Return the first frame as soon as it is complete. The bytes behind it are left for `feed(b"")`."""
        self._rest += data
        if self.broken or not self._is_complete():
            return None
        found = bytes(self._rest[_LENGTH.size : self._need])
        del self._rest[: self._need]
        self._need = 0
        return found

    def feed(self, data: bytes) -> list[bytes]:
        """Return all frames that are complete now, in order."""
        if self.broken:
            return []
        size = len(data)
        if not self._rest:
            if size >= 4 and _LENGTH.unpack_from(data)[0] == size - 4 <= self.limit:
                return [data[4:]]  # one message and nothing else, as it most often is
        else:
            self._rest += data
            if not self._is_complete():
                return []
            data = bytes(self._rest)
            self._rest.clear()
            self._need = 0
        return self._split(data)

    def _is_complete(self) -> bool:
        """Return whether the first frame is there."""
        if not self._need:
            if len(self._rest) < _LENGTH.size:
                return False
            size = _LENGTH.unpack_from(self._rest)[0]
            if size > self.limit:
                self._break(size)
                return False
            self._need = _LENGTH.size + size
        return len(self._rest) >= self._need

    def _split(self, data: bytes) -> list[bytes]:
        frames: list[bytes] = []
        at, end, limit, unpack = 0, len(data), self.limit, _LENGTH.unpack_from
        while at + 4 <= end:  # in one loop, as this is done for each message
            (size,) = unpack(data, at)
            if size > limit:
                self._break(size)
                return frames
            begin = at + 4
            if begin + size > end:
                self._need = 4 + size
                break
            at = begin + size
            frames.append(data[begin:at])
        if at < end:
            self._rest += data[at:]
        return frames

    def _break(self, size: int) -> None:
        self.broken = f"{size} bytes are announced, and at most {self.limit} are accepted"
        self._rest.clear()


class TcprosResponse(NamedTuple):
    """A server's response: its bytes, or the text of an error."""

    ok: bool
    data: bytes


class ResponseReader:
    """Puts received bytes together to responses."""

    def __init__(self) -> None:
        self.broken = ""
        """The reason why nothing is read any more; empty while all is well."""
        self._rest = bytearray()

    def feed(self, data: bytes) -> list[TcprosResponse]:
        """Return all responses that are complete now, in order."""
        self._rest += data
        found: list[TcprosResponse] = []
        while not self.broken and len(self._rest) >= _RESPONSE.size:
            ok, size = _RESPONSE.unpack_from(self._rest)
            if size > MESSAGE_MAX or ok > 1:
                self.broken = "bytes that are not the response of a service"
                self._rest.clear()
                break
            end = _RESPONSE.size + size
            if len(self._rest) < end:
                break
            found.append(TcprosResponse(bool(ok), bytes(self._rest[_RESPONSE.size : end])))
            del self._rest[:end]
        return found


# Headers of topics


def subscriber_header(node: str, topic: str, kind: RosType) -> Fields:
    """Return the header of a subscriber. It always asks for TCP_NODELAY: r2p's messages are not delayed."""
    fields = {"callerid": node, "topic": topic, "type": kind.name or ANY, "md5sum": kind.checksum or ANY}
    if kind.definition:
        fields["message_definition"] = kind.definition
    return {**fields, "tcp_nodelay": "1"}


def publisher_header(node: str, topic: str, kind: RosType, *, latching: bool) -> Fields:
    """Return the answer of a publisher."""
    return {
        "callerid": node,
        "topic": topic,
        "type": kind.name,
        "md5sum": kind.checksum,
        "message_definition": kind.definition,
        "latching": str(int(latching)),
    }


def refuse_subscriber(fields: Fields, node: str, topic: str, kind: RosType) -> str:
    """Return why a subscriber that sent this header can't have the topic of this node; empty if it can."""
    missing = _missing(fields, "callerid", "md5sum")
    if missing:
        return missing
    if _fits(fields["md5sum"], kind.checksum):
        return ""
    theirs = _title(fields.get("type", ANY), fields["md5sum"])
    return f"[{fields['callerid']}] wants [{topic}] as {theirs}, but [{node}] publishes {_own(kind)}{_SAME}"


def refuse_publisher(fields: Fields, topic: str, kind: RosType) -> str:
    """Return why the messages of a publisher with this answer are of no use; empty if they are."""
    if "error" in fields:
        return fields["error"]
    missing = _missing(fields, "md5sum", "type")
    if missing:
        return missing
    if _fits(fields["md5sum"], kind.checksum):
        return ""
    theirs = _title(fields["type"], fields["md5sum"])
    return f"[{fields.get('callerid', '?')}] publishes [{topic}] as {theirs}, but here it is {_own(kind)}{_SAME}"


# Headers of services


def caller_header(
    node: str, service: str, kind: RosService, *, persistent: bool = False, probe: bool = False
) -> Fields:
    """Return the header of a caller: `persistent` for more than one request, `probe` for none."""
    fields = {"callerid": node, "service": service, "md5sum": kind.checksum or ANY}
    if kind.name:
        fields["type"] = kind.name
    if persistent:
        fields["persistent"] = "1"
    if probe:
        fields["probe"] = "1"
    return fields


def server_header(node: str, service: str, kind: RosService) -> Fields:
    """Return the answer of a server."""
    return {
        "callerid": node,
        "service": service,
        "type": kind.name,
        "md5sum": kind.checksum,
        "request_type": f"{kind.name}Request",
        "response_type": f"{kind.name}Response",
    }


def refuse_caller(fields: Fields, node: str, service: str, kind: RosService) -> str:
    """Return why a caller that sent this header can't use the service of this node; empty if it can."""
    missing = _missing(fields, "callerid", "md5sum")
    if missing:
        return missing
    if _fits(fields["md5sum"], kind.checksum):
        return ""
    theirs = _title(fields.get("type", ""), fields["md5sum"])
    return f"[{fields['callerid']}] calls [{service}] as {theirs}, but [{node}] serves {_own(kind)}{_SAME}"


def refuse_server(fields: Fields, service: str, kind: RosService) -> str:
    """Return why a server with this answer can't be called; empty if it can."""
    if "error" in fields:
        return fields["error"]
    if _fits(fields.get("md5sum", ANY), kind.checksum):
        return ""
    theirs = _title(fields.get("type", ""), fields["md5sum"])
    return f"[{fields.get('callerid', '?')}] serves [{service}] as {theirs}, but here it is {_own(kind)}{_SAME}"


_SAME = ": use the same definition of the type on both sides"


def _missing(fields: Fields, *names: str) -> str:
    absent = [name for name in names if name not in fields]
    return f"the header of the connection lacks {' and '.join(absent)}" if absent else ""


def _fits(theirs: str, ours: str) -> bool:
    return theirs == ours or ANY in (theirs, ours) or not ours


def _own(kind: RosType | RosService) -> str:
    return _title(kind.name, kind.checksum)


def _title(name: str, checksum: str) -> str:
    return f"{name or 'a type'} (md5 {checksum})"
