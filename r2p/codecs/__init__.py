"""Bytes <-> values: pure functions over frozen structs, without I/O, clocks or state beyond one unfinished message.

Each codec is a pair, `encode` and `decode`, with the layout in its docstrings. A value that does not fit is a mistake
of the caller (`MessageError`). Bytes that are not such a message raise `DecodeError`: links count them, and go on.

- `debug`: the lines of the debug transport; `rtcan`: the identifiers and frames of RTCAN; `can_bits`: their length.
- `management`: the messages of the topic `R2P`; `loader`: those of `BOOT_<module>`; both in terms of `_records`.
- `attachment`, `liveliness`: what accompanies messages on zenoh, and the tokens there.
- `services`: the header of requests and responses, and the texts of errors.
- `nmea`: the sentences of GPS receivers.
- `schemas`: answers to requests for a type; `probes`: messages by which gateways find loops.
"""

import enum

from r2p.errors import DecodeError


class UnknownType(DecodeError):
    """An unknown type byte, or version of an r2p type: ignored, as firmware does (PROTOCOL.md 4)."""


class PublisherClass(enum.IntEnum):
    """The real-time class of a publisher (thesis 5.3.6), as several messages carry it."""

    NON_REAL_TIME = 1
    SPORADIC = 2
    PERIODIC = 3
