"""Messages of r2p's own services out of their parts (`r2p.codecs.call_parts`), whatever was lost or repeated."""

from collections import Counter

import msgspec

from r2p.codecs import call_parts
from r2p.codecs.call_parts import CallPart
from r2p.units import SECOND

_SENDERS_MAX = 64
"""Senders of which something is kept; the one that was silent for longest is forgotten."""

_LIFETIME = 5 * SECOND
"""Ns after its last part in which a message may go on: a slow bus takes a second for all of it."""


class _PartialMessage(msgspec.Struct):
    """The last message of a sender: its `pieces` by number until it is complete, and the time of its last part."""

    serial: int
    length: int
    at: int
    pieces: dict[int, bytes] = {}
    complete: bool = False


class CallAssembler:
    """Puts the parts on one link together. `counts` is the counter of losses."""

    def __init__(self, counts: Counter[str]) -> None:
        self._counts = counts
        self._messages: dict[int, _PartialMessage] = {}

    def receive(self, now: int, part: CallPart) -> bytes | None:
        """Return the message that this part completes. Of each sender only the latest one is put together."""
        message = self._messages.pop(part.sender, None)
        if message is None or message.serial != part.serial or now - message.at > _LIFETIME:
            self._give_up(message)
            message = _PartialMessage(part.serial, part.length, now)
            if len(self._messages) >= _SENDERS_MAX:
                self._give_up(self._messages.pop(next(iter(self._messages))))
        self._messages[part.sender] = message
        message.at = now
        if message.complete or part.length != message.length:
            return None
        message.pieces[part.part] = part.piece
        if len(message.pieces) < call_parts.count(part.length):
            return None
        data = b"".join(piece for _, piece in sorted(message.pieces.items()))
        message.pieces, message.complete = {}, True
        return data

    def _give_up(self, message: _PartialMessage | None) -> None:
        if message is not None and not message.complete:
            self._counts["call incomplete"] += 1
