"""Bytes <-> values: pure functions over frozen structs, without I/O, clocks or state beyond one unfinished message.

Each codec is a pair, `encode` and `decode`. A value that does not fit is the caller's mistake (`MessageError`); bytes
that are no such message are a `DecodeError`, which whoever reads the wire counts and drops.
"""

from r2p.errors import DecodeError


class UnknownType(DecodeError):
    """A type byte, or the version of an r2p type, from another time: ignored, as firmware does (PROTOCOL.md 4)."""
