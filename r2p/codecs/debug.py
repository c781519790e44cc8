r"""The debug transport's lines: `@DDDDDDDD:LLname:PPpayload:CC\r\n` (PROTOCOL.md 3).

The reader matches a line that is complete in its buffer with one regular expression. Anything else - a line cut by the
end of a chunk, damage, noise - it reads field by field, as firmware does. Both ways give the same lines, however the
bytes are cut into chunks.

The reader differs from firmware in two points: it drops a message with a wrong checksum, and one with a character in
its topic name that is not printable. So a line end always ends the damage.
"""

import functools
import re
from binascii import Error as BadHex
from binascii import hexlify, unhexlify
from collections.abc import Callable

import msgspec

from r2p.errors import MessageError
from r2p.names import TOPIC_FIELD

PAYLOAD_MAX = 255

OPENING = b"\r\n\r\n"
"""The first bytes on a line, which end any unfinished message of the other end's reader."""

NO_DEADLINE = 0x7FFFFFFF
"""Microseconds after the stamp, for a message without a deadline: as in firmware."""

_HEX = b"0123456789ABCDEFabcdef"
_PRINTABLE = bytes(range(0x20, 0x7F))
_LINE_END = b"\r\n"
_AT = ord("@")
_WHOLE = re.compile(rb"@([^:]{8}):([^:]{2})([ -9;-~]{1,16}):([^:]{2,512}):([^:]{2})[\r\n]*")
_NOISE = re.compile(rb"[^\r\n]+")


class Line(msgspec.Struct, frozen=True, gc=False):
    """One message on the line.

    `topic` is 1 to 16 bytes of printable ASCII, `data` is at most 255 bytes. `deadline` is an unsigned 32-bit number of
    microseconds, which has a meaning for the sender only.
    """

    topic: bytes
    data: bytes
    deadline: int


def encode(topic: bytes, data: bytes, deadline: int) -> bytes:
    """Encode one line, with its end. Raises `MessageError` for a topic or a payload that does not fit.

    The deadline wraps.
    """
    return encoder(topic)(data, deadline)


@functools.lru_cache(maxsize=1024)
def encoder(topic: bytes, *, empty: bool = False) -> Callable[[bytes, int], bytes]:
    """Return a function of payload and deadline that encodes many messages of one topic faster than `encode`.

    All links share it, and a message that goes to many of them, one after the other, is encoded once. With `empty`,
    messages may be empty, as between r2p modules: firmware never gets such a line.
    """
    if not 1 <= len(topic) <= TOPIC_FIELD or topic.strip(_PRINTABLE):
        raise MessageError(f"topic {topic!r}: a line carries 1 to {TOPIC_FIELD} printable characters")
    name = b":%02X%b:" % (len(topic), topic)  # what all messages of the topic share is worked out once
    name_sum = len(topic) + sum(topic)
    least = 0 if empty else 1
    last: tuple[bytes, int, bytes] = b"", -1, b""  # payload, deadline and line: one object, as threads share it

    def encode_message(data: bytes, deadline: int) -> bytes:
        nonlocal last
        last_data, last_deadline, line = last
        if data is last_data and deadline == last_deadline:
            return line
        size = len(data)
        if not least <= size <= PAYLOAD_MAX:
            raise MessageError(f"topic {topic.decode()}: a line carries {least} to {PAYLOAD_MAX} bytes, not {size}")
        stamp = (deadline & 0xFFFFFFFF).to_bytes(4, "big")
        checksum = -(name_sum + sum(stamp) + size + sum(data)) & 0xFF
        line = b"@%b%b%02X%b:%02X\r\n" % (hexlify(stamp).upper(), name, size, hexlify(data).upper(), checksum)
        last = bytes(data), deadline, line  # the same object, if it is bytes: nobody can change those
        return line

    return encode_message


class Reader:
    """Turns a stream into lines. It never fails: bytes that are not a message are counted by reason in `drops`.

    | reason | received |
    | --- | --- |
    | garbage | anything between messages but line ends, once for each run up to a line end or an `@` |
    | cut short | a line end inside a message |
    | bad hex, bad separator, bad name | another wrong character in that place |
    | topic length | no name, or one of more than 16 bytes |
    | empty payload | a payload length of 0 and a wrong sum: firmware sends no such line, r2p only a right one |
    | checksum | a wrong sum, which firmware does not check |

    Bytes after a dropped message up to the line end belong to it, and are not counted again. The reader holds at most
    one unfinished message, less than 600 bytes.
    """

    def __init__(self, drops: dict[str, int] | None = None) -> None:
        """`drops` is the counter to use, if several readers share one."""
        self.drops: dict[str, int] = {} if drops is None else drops
        self._held = b""
        self._counted = False  # the noise that comes next, up to a line end, is already counted

    def feed(self, data: bytes) -> list[Line]:
        """Return the messages that these bytes complete, in order."""
        buffer = self._held + data
        lines: list[Line] = []
        at = 0
        while at < len(buffer):
            if buffer[at] != _AT:
                at = self._skip_noise(buffer, at)
            elif (whole := _WHOLE.match(buffer, at)) and (line := _checked(whole)):
                lines.append(line)
                self._counted = False
                at = whole.end()
            else:
                try:
                    at = self._read(buffer, at, lines)
                except _Unfinished:
                    break
        self._held = buffer[at:]
        return lines

    def _skip_noise(self, buffer: bytes, start: int) -> int:
        end = buffer.find(b"@", start)
        if end < 0:
            end = len(buffer)
        runs = sum(1 for _ in _NOISE.finditer(buffer, start, end))
        if self._counted and buffer[start] not in _LINE_END:
            runs -= 1
        if runs:
            self._drop("garbage", runs)
        self._counted = buffer[end - 1] not in _LINE_END
        return end

    def _read(self, buffer: bytes, start: int, lines: list[Line]) -> int:
        """Read one message field by field; return where to go on: behind the wrong character, as in firmware."""
        fields = _Fields(buffer, start + 1)
        try:
            lines.append(fields.line())
            self._counted = False
        except _Wrong as wrong:
            self._drop(str(wrong))
            self._counted = buffer[fields.at - 1] not in _LINE_END
        return fields.at

    def _drop(self, reason: str, count: int = 1) -> None:
        self.drops[reason] = self.drops.get(reason, 0) + count


def _checked(whole: re.Match[bytes]) -> Line | None:
    """Return the line of a match, if its hex digits, lengths and checksum are right."""
    deadline, name_size, topic, payload, checksum = whole.groups()
    try:
        raw = unhexlify(deadline + name_size + payload + checksum)
    except BadHex:
        return None
    # raw: 4 bytes of deadline, the length of the name, that of the payload, the payload, the checksum
    if raw[4] != len(topic) or raw[5] != len(raw) - 7 or (sum(raw) + sum(topic)) & 0xFF:
        return None
    return Line(topic, raw[6:-1], int.from_bytes(raw[:4], "big"))


class _Unfinished(Exception):
    """Raised for the valid beginning of a message whose rest is missing."""


class _Wrong(Exception):
    """Raised for bytes that are not a message; the argument is the reason."""


class _Fields:
    """A position in the buffer, which moves field by field, and behind the first wrong character."""

    def __init__(self, buffer: bytes, at: int) -> None:
        self.at = at
        self._buffer = buffer

    def line(self) -> Line:
        deadline = self._hex(4)
        self._separator()
        name_size = self._hex(1)
        if not 1 <= name_size[0] <= TOPIC_FIELD:
            raise _Wrong("topic length")
        topic = self._accept(name_size[0], _PRINTABLE, "bad name")
        self._separator()
        size = self._hex(1)
        data = self._hex(size[0])
        self._separator()
        if sum(deadline + name_size + topic + size + data + self._hex(1)) & 0xFF:
            raise _Wrong("checksum" if size[0] else "empty payload")
        return Line(topic, data, int.from_bytes(deadline, "big"))

    def _separator(self) -> None:
        self._accept(1, b":", "bad separator")

    def _hex(self, size: int) -> bytes:
        return unhexlify(self._accept(2 * size, _HEX, "bad hex"))

    def _accept(self, count: int, allowed: bytes, otherwise: str) -> bytes:
        text = self._buffer[self.at : self.at + count]
        if wrong := text.lstrip(allowed):
            self.at += len(text) - len(wrong) + 1
            raise _Wrong("cut short" if wrong[0] in _LINE_END else otherwise)
        if len(text) < count:
            raise _Unfinished
        self.at += count
        return text
