"""Frames to messages, with losses by source (PROTOCOL.md 6).

A frame says only how many follow it, so a beginning is known by the size that its topic must have, or, where the length
varies, by a header whose length fits that number. A frame that does not continue a message in the right way ends it;
the rest is skipped up to the next beginning. A repeat of the last frame, which CAN can make, is not a gap.

Where the length varies, frames of two messages can look like one: then the checksum is wrong, and the message counts as
"damaged". Management without its zeros is shorter than its size says: there the first frame is marked.
"""

from collections import Counter, defaultdict

import msgspec

from r2p.codecs import rtcan
from r2p.codecs.rtcan import FIRST_MARK, FRAME_MAX, HEADER_SIZE, LEFT_MASK, MESSAGE_MAX, MESSAGE_SHIFT, Frame
from r2p.errors import DecodeError
from r2p.protocols.rtcan.events import Received
from r2p.units import NEVER

TIMEOUT = 100_000_000
"""ns from one frame of a message to the next."""
_IDLE = -1  # `SourceBuffer.expected` between two messages
_UNKNOWN = -1  # `SourceBuffer.first` between two messages whose length varies


class SourceBuffer(msgspec.Struct, eq=False):
    """The unfinished message of one publisher. All of them have `size` bytes, and begin with `first` fragments left; if
    their length `varies`, each has its own, and `empty` says that all are. If they are `packed`, those with a marked
    first frame are without their zeros.

    With `parts`, a message is being received and `expected` is the number of its next frame; without, frames from
    `expected` down are the rest of a lost one. `tail` is the last frame of the previous message.
    """

    message: int
    first: int
    size: int
    varies: bool = False
    empty: bool = False
    packed: bool = False
    expected: int = _IDLE
    parts: list[bytes] = msgspec.field(default_factory=list)
    identifier: int = 0
    started: int = 0
    last: int = 0
    tail: bytes = b""


class Reassembly:
    """Joins frames, in any order of sources, to messages; holds at most one unfinished message of each source."""

    def __init__(self) -> None:
        self.losses: defaultdict[int, Counter[str]] = defaultdict(Counter)
        """Losses, by id8 of the source and reason."""
        self._buffers: dict[int, SourceBuffer] = {}
        self.open: dict[int, SourceBuffer] = {}
        """Unfinished messages by id, the oldest first."""

    def subscribe(self, message: int, size: int, *, varies: bool = False, packed: bool = False) -> None:
        """Receive messages with this id, of `size` bytes, or at most so many. Raises `MessageError` beyond 1..1024.

        If they are `packed`, they may come without their zeros; `receive` returns them with these.
        """
        before = self._buffers.get(message)
        if varies:
            if before is None or (before.varies, before.empty) != (True, not size):
                self._enter(SourceBuffer(message, _UNKNOWN, 0, varies=True, empty=not size))
        elif before is None or before.varies or before.size != size:
            self._enter(SourceBuffer(message, rtcan.fragment_count(size) - 1, size, packed=packed))

    def unsubscribe(self, message: int) -> None:
        """Stop receiving messages with this id; an unfinished one is lost."""
        unfinished = self.open.get(message)
        if unfinished is not None:
            self._reset(unfinished, "interrupted")
        self._buffers.pop(message, None)

    def subscribed(self, message: int) -> bool:
        return message in self._buffers

    def ends_with_next(self, message: int) -> bool:
        """Return whether a message with this id is being received, and only its last frame is missing."""
        buffer = self.open.get(message)
        return buffer is not None and buffer.expected == 0

    @property
    def messages(self) -> list[int]:
        """The ids of received messages."""
        return list(self._buffers)

    def receive(self, frame: Frame, stamp: int) -> Received | None:
        """Receive a frame that ended at `stamp`; return the message that it completes."""
        identifier, data = frame.id, frame.data
        # The codec's functions are inlined: this runs for each frame on the bus.
        buffer = self._buffers.get(identifier >> MESSAGE_SHIFT & MESSAGE_MAX)
        if buffer is None:
            return None
        left = identifier & LEFT_MASK
        if buffer.first or left or buffer.expected != _IDLE:
            return self._fragment(buffer, frame, left, stamp)
        if len(data) == buffer.size:
            return Received(identifier, data, stamp)
        self._lose(buffer.message, "wrong length")
        return None

    @property
    def due(self) -> int:
        """Return when to call `poll`, which then gives up the oldest unfinished message."""
        for oldest in self.open.values():
            return oldest.last + TIMEOUT
        return NEVER

    def poll(self, now: int) -> None:
        """Give up messages whose next frame is overdue."""
        while self.due <= now:
            oldest = next(iter(self.open.values()))
            self._reset(oldest, "time-out")
            oldest.expected = _IDLE

    def reset(self) -> None:
        """Forget unfinished messages."""
        for buffer in list(self.open.values()):
            self._reset(buffer, "interrupted")
            buffer.expected = _IDLE

    def _enter(self, buffer: SourceBuffer) -> None:
        self.unsubscribe(buffer.message)
        self._buffers[buffer.message] = buffer

    def _fragment(self, buffer: SourceBuffer, frame: Frame, left: int, stamp: int) -> Received | None:
        if stamp - buffer.last > TIMEOUT:
            if buffer.parts:
                self._reset(buffer, "time-out")
            buffer.expected = _IDLE
        if not buffer.parts:
            return self._begin(buffer, frame, left, stamp)
        if left == buffer.expected:
            return self._continue(buffer, frame, stamp)
        number = left & ~FIRST_MARK if buffer.packed else left
        if number == buffer.expected + 1 and frame.data == buffer.parts[-1]:
            self._lose(buffer.message, "repeat")
            return None
        self._reset(buffer, "gap")
        if left < buffer.expected:  # more of the same message: skip it as the rest of something lost
            buffer.expected = left
        return self._begin(buffer, frame, left, stamp)

    def _begin(self, buffer: SourceBuffer, frame: Frame, left: int, stamp: int) -> Received | None:
        """Handle a frame without an open message: a beginning, or part of a message without its beginning."""
        rest = left == buffer.expected  # of something that has been counted as lost
        begins = left == buffer.first and not rest
        if buffer.varies:
            buffer.size = _size_of_beginning(buffer, frame, left, rest=rest)
            begins = buffer.size > 0
            buffer.first = left if begins else _UNKNOWN
        elif buffer.packed:
            whole = rtcan.fragment_count(buffer.size) - 1
            marked, left = left & FIRST_MARK, left & ~FIRST_MARK
            begins = left <= whole if marked else left == whole and not rest
            buffer.first = left if marked and begins else whole
        if begins:
            buffer.identifier, buffer.started = frame.id, stamp
            return self._continue(buffer, frame, stamp)
        if left == 0 and not rest and frame.data == buffer.tail:
            self._lose(buffer.message, "repeat")
        elif not rest:
            too_long = left > buffer.first and not buffer.varies
            self._lose(buffer.message, "too long" if too_long else "no beginning")
        buffer.expected = left - 1
        buffer.last = stamp
        return None

    def _continue(self, buffer: SourceBuffer, frame: Frame, stamp: int) -> Received | None:
        data, left = frame.data, buffer.first - len(buffer.parts)
        buffer.last = stamp
        # Only the last frame may be shorter.
        packed = buffer.packed and buffer.identifier & FIRST_MARK
        last = len(data) if packed else buffer.size - buffer.first * FRAME_MAX
        if len(data) != (FRAME_MAX if left else last):
            self._reset(buffer, "damaged" if buffer.varies else "wrong length")
            buffer.expected = left  # the rest of it, unless it begins another message
            return self._begin(buffer, frame, left, stamp)
        buffer.expected = left - 1
        buffer.parts.append(data)
        self.open.pop(buffer.message, None)
        if left:
            self.open[buffer.message] = buffer  # at the end: `poll` looks at the oldest only
            return None
        payload = b"".join(buffer.parts)
        buffer.parts.clear()
        buffer.tail = data
        if buffer.varies:
            return self._check_variable(buffer, payload, frame, stamp)
        if packed:
            try:
                payload = rtcan.unpack_management(payload, buffer.size)
            except DecodeError:
                self._lose(buffer.message, "damaged")
                return None
        return Received(buffer.identifier, payload, buffer.started)

    def _check_variable(self, buffer: SourceBuffer, data: bytes, frame: Frame, stamp: int) -> Received | None:
        """Return the message if its checksum is right, else a whole message in the last frame alone, if there is one.

        Without that, a message whose last frame is lost would take the next one along, if that has one frame.
        """
        alone, buffer.first = buffer.first == 0, _UNKNOWN
        if alone:
            buffer.tail = b""  # equal messages of one frame are no repeats
        try:
            return Received(buffer.identifier, rtcan.decode_variable(data), buffer.started, data[:HEADER_SIZE])
        except DecodeError:
            self._lose(buffer.message, "damaged")
        buffer.tail = b""
        if not alone and _size_of_beginning(buffer, frame, 0, rest=True):
            header, payload = frame.data[:HEADER_SIZE], frame.data[HEADER_SIZE:]
            return Received(frame.id, payload, stamp, header)
        return None

    def _reset(self, buffer: SourceBuffer, reason: str) -> None:
        self._lose(buffer.message, reason)
        self.open.pop(buffer.message, None)
        buffer.parts.clear()

    def _lose(self, message: int, reason: str) -> None:
        counts = self.losses[rtcan.id8_of(message)]
        counts[reason] += 1


def _size_of_beginning(buffer: SourceBuffer, frame: Frame, left: int, *, rest: bool) -> int:
    """Return the bytes of the message, of those whose length varies, that a frame begins; 0 if it begins none.

    `rest`: it may be left over from a message that is lost, so one frame alone must be right as a whole.
    """
    if left == 0 and frame.data == buffer.tail:
        return 0  # a repeat, whatever it looks like
    size = rtcan.beginning_of(frame.data, left, empty=buffer.empty)
    return 0 if rest and not left and not _is_whole(frame.data) else size


def _is_whole(data: bytes) -> bool:
    try:
        rtcan.decode_variable(data)
    except DecodeError:
        return False
    return True
