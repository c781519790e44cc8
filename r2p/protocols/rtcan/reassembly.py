"""Frames to messages, with an account of what was lost, by source (PROTOCOL.md 6).

A frame says only how many follow it, so a beginning is known by the size that its topic must have. Whatever does not
continue a message in the right way ends it; the rest of it is skipped up to the next beginning. A repeat of the last
frame, which CAN can make, is no gap.
"""

from collections import Counter

import msgspec

from r2p.codecs import rtcan
from r2p.codecs.rtcan import FRAME_MAX, Frame
from r2p.protocols.rtcan.events import NEVER, Received

TIMEOUT = 100_000_000
"""ns from one frame of a message to the next."""
_IDLE = -1  # Inlet.expected between two messages


class SourceBuffer(msgspec.Struct, eq=False):
    """What is being received from one publisher. `first` and `size` are those of all its messages.

    With `parts`, a message is being received and `expected` is what its next frame says; without, frames from
    `expected` down are the rest of something lost. `tail` is the last frame of the last message.
    """

    first: int
    size: int
    expected: int = _IDLE
    parts: list[bytes] = msgspec.field(default_factory=list)
    identifier: int = 0
    started: int = 0
    last: int = 0
    tail: bytes = b""


class Reassembly:
    """Puts messages together from frames in any order of sources; holds at most one unfinished message of each."""

    def __init__(self) -> None:
        self.losses: dict[int, Counter[str]] = {}
        """What was lost, by id8 of the source and reason."""
        self._inlets: dict[int, SourceBuffer] = {}
        self.open: dict[int, SourceBuffer] = {}
        """Unfinished messages by id, the oldest first."""

    def subscribe(self, message: int, size: int) -> None:
        """Take messages with this id, of `size` bytes. Raises `MessageError` beyond 1..1024."""
        before = self._inlets.get(message)
        if before is None or before.size != size:
            inlet = SourceBuffer(rtcan.fragment_count(size) - 1, size)
            self.unsubscribe(message)
            self._inlets[message] = inlet

    def unsubscribe(self, message: int) -> None:
        """Take no more messages with this id; one that is being received is lost."""
        unfinished = self.open.get(message)
        if unfinished is not None:
            self._reset(message, unfinished, "interrupted")
        self._inlets.pop(message, None)

    def subscribed(self, message: int) -> bool:
        return message in self._inlets

    def ends_with_next(self, message: int) -> bool:
        """Whether a message with this id is being received, and only its last frame is missing."""
        inlet = self.open.get(message)
        return inlet is not None and inlet.expected == 0

    @property
    def messages(self) -> list[int]:
        """The ids that are taken."""
        return list(self._inlets)

    def receive(self, frame: Frame, stamp: int) -> Received | None:
        """A frame came in; `stamp` is the instant when it ended. The message that it completes comes back."""
        identifier, data = frame.id, frame.data
        inlet = self._inlets.get(identifier >> 7 & 0xFFFF)
        if inlet is None:
            return None
        if inlet.first or identifier & 0x7F or inlet.expected != _IDLE:
            return self._fragment(inlet, identifier, data, stamp)
        if len(data) == inlet.size:
            return Received(identifier, data, stamp)
        self._lose(identifier, "wrong length")
        return None

    @property
    def due(self) -> int:
        """When to call `poll`: that is when the oldest unfinished message is given up."""
        for oldest in self.open.values():
            return oldest.last + TIMEOUT
        return NEVER

    def poll(self, now: int) -> None:
        """Give up messages whose next frame stays away."""
        while self.open:
            message, inlet = next(iter(self.open.items()))
            if now < inlet.last + TIMEOUT:
                return
            self._reset(message, inlet, "time-out")
            inlet.expected = _IDLE

    def reset(self) -> None:
        """Forget what is unfinished."""
        for message, inlet in list(self.open.items()):
            self._reset(message, inlet, "interrupted")
            inlet.expected = _IDLE

    def _fragment(self, inlet: SourceBuffer, identifier: int, data: bytes, stamp: int) -> Received | None:
        message, left = identifier >> 7 & 0xFFFF, identifier & 0x7F
        if stamp - inlet.last > TIMEOUT:
            if inlet.parts:
                self._reset(message, inlet, "time-out")
            inlet.expected = _IDLE
        if not inlet.parts:
            return self._begin(inlet, identifier, data, stamp)
        if left == inlet.expected:
            return self._continue(message, inlet, data, stamp)
        if left == inlet.expected + 1 and data == inlet.parts[-1]:
            self._lose(identifier, "repeat")
            return None
        self._reset(message, inlet, "gap")
        if left < inlet.expected:  # more of the same message
            inlet.expected = left
        return self._begin(inlet, identifier, data, stamp)

    def _begin(self, inlet: SourceBuffer, identifier: int, data: bytes, stamp: int) -> Received | None:
        """Nothing is open: the frame is a beginning, or belongs to something of which the beginning is missing."""
        left = identifier & 0x7F
        rest = left == inlet.expected
        if left == inlet.first and not rest:
            inlet.identifier, inlet.started = identifier, stamp
            return self._continue(identifier >> 7 & 0xFFFF, inlet, data, stamp)
        if left == 0 and not rest and data == inlet.tail:
            self._lose(identifier, "repeat")
        elif not rest:
            self._lose(identifier, "too long" if left > inlet.first else "no beginning")
        inlet.expected = left - 1
        inlet.last = stamp
        return None

    def _continue(self, message: int, inlet: SourceBuffer, data: bytes, stamp: int) -> Received | None:
        left = inlet.first - len(inlet.parts)
        inlet.expected = left - 1
        inlet.last = stamp
        if len(data) != (FRAME_MAX if left else inlet.size - inlet.first * FRAME_MAX):
            self._reset(message, inlet, "wrong length")
            return None
        inlet.parts.append(data)
        self.open.pop(message, None)
        if left:
            self.open[message] = inlet  # at the end: the oldest comes first
            return None
        payload = b"".join(inlet.parts)
        inlet.parts.clear()
        inlet.tail = data
        return Received(inlet.identifier, payload, inlet.started)

    def _reset(self, message: int, inlet: SourceBuffer, reason: str) -> None:
        self._lose(message << 7, reason)
        self.open.pop(message, None)
        inlet.parts.clear()

    def _lose(self, identifier: int, reason: str) -> None:
        source = identifier >> 7 & 0xFF
        counts = self.losses.get(source)
        if counts is None:
            counts = self.losses[source] = Counter()
        counts[reason] += 1
