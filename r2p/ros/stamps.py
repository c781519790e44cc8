"""Stamps: when what a message says was measured, for `header.stamp` of ROS, and from there.

Towards ROS the first of these counts that a message has:

1. its own: the field `timestamp` or `stamp`, or that of its header. A time of a CAN network, as in `Stamped...`
   messages, counts from the network's start, and is translated by the sample's clock. Without such a clock a time
   before 2001 is that of a module which does not know UTC, and does not count.
2. the stamp of the sample, which its publisher gave it.
3. the reception here, where the publisher's link carries no stamps: counted.
"""

import itertools
import struct
from collections import Counter
from collections.abc import Callable
from typing import Any

from r2p.errors import DecodeError
from r2p.messages import Layout, Message, Nested, Shape, Timestamp, layout
from r2p.runtime.sample import Sample
from r2p.units import SECOND

STAMP_OF_RECEPTION = "stamped at reception"
"""The counter of messages whose `header.stamp` is the time at which they arrived here."""

_NAMES = ("timestamp", "stamp")
_TIME = struct.Struct("<II")


def stamp_of(message: Any) -> Timestamp | None:
    """Return a message's own stamp: its `timestamp` or `stamp`, or that of its header; None without one, or if it is 0.

    The time is that of the clock by which the message was made.
    """
    owner = getattr(message, "header", message)
    owner = owner if isinstance(owner, Message) else message
    for name in _NAMES:
        found = getattr(owner, name, None)
        if isinstance(found, Timestamp) and (found.sec or found.nsec):
            return found
    return None


class StampSource:
    """Finds the stamps of messages of a type on their way to ROS; STAMP_OF_RECEPTION is counted in `counts`."""

    OLDEST_UTC = 1_000_000_000 * SECOND
    """Ns, September 2001: no module counts its time from its start for so long."""

    def __init__(self, cls: type[Message], counts: Counter[str]) -> None:
        self._counts = counts
        self.read = _reader(layout(cls))
        """Returns the own stamp of a packed message in ns, by whichever clock; None for a type without one."""

    def own(self, data: bytes) -> int:
        """Return the own stamp of a packed message in ns, by whichever clock; 0 without one."""
        return self.read(data) if self.read is not None else 0

    def find(self, sample: Sample[Any]) -> int:
        """Return the stamp of a sample, UTC in ns."""
        own = self.own(sample.data)
        if own >= self.OLDEST_UTC:
            return own
        if own and sample.clock is not None:
            return sample.clock.utc(own)
        if not sample.stamped:
            self._counts[STAMP_OF_RECEPTION] += 1
        return sample.stamp


def _reader(shape: Layout[Any]) -> Callable[[bytes], int] | None:
    """Return the function that reads the own stamp of packed messages (ns, 0: none); None for a type without one."""
    parts = {field.name: field.shape for field in shape.fields}
    header = parts.get("header")
    owner = header.layout if isinstance(header, Nested) else shape
    times = {field.name for field in owner.fields if _is_time(field.shape)}
    name = next((each for each in _NAMES if each in times), None)
    if name is None:
        return None
    offset = _offset(shape, "header") if owner is not shape else 0
    inside = _offset(owner, name)
    if offset is None or inside is None:
        return lambda data: _decoded_stamp(shape, data)
    at = offset + inside
    return lambda data: _stamp_at(data, at)


def _is_time(shape: Shape) -> bool:
    return isinstance(shape, Nested) and shape.layout.cls is Timestamp


def _offset(shape: Layout[Any], name: str) -> int | None:
    """Return the bytes before a field; None if they vary."""
    before = list(itertools.takewhile(lambda field: field.name != name, shape.fields))
    return None if any(field.shape.varies for field in before) else sum(field.shape.size for field in before)


def _stamp_at(data: bytes, offset: int) -> int:
    try:
        sec, nsec = _TIME.unpack_from(data, offset)
    except struct.error:  # cut short
        return 0
    return int(sec) * SECOND + int(nsec)


def _decoded_stamp(shape: Layout[Any], data: bytes) -> int:
    try:
        found = stamp_of(shape.decode(data))
    except DecodeError:
        return 0
    return found.ns if found is not None else 0
