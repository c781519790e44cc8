"""Packed messages to CDR and back, bit for bit, without decoding them."""

import functools
from collections.abc import Callable

import msgspec

from r2p.messages import Message, layout
from r2p.ros.cdr import cdr


class Transcoder(msgspec.Struct, frozen=True, eq=False):
    """The functions of one message class.

    `to_cdr` returns a packed message as CDR, and the rest: what CDR can't hold of it (the `seq` of a Header), empty if
    that is zero. `from_cdr` takes both, and returns the same bytes as before. Both raise DecodeError.
    """

    to_cdr: Callable[[bytes], tuple[bytes, bytes]]
    from_cdr: Callable[[bytes, bytes], bytes]


@functools.lru_cache(maxsize=1024)
def transcoder(cls: type[Message]) -> Transcoder:
    """Return the transcoder of a message class, generated at first use. Raises MessageError for an invalid class."""
    codec, packing = cdr(cls), layout(cls)
    return Transcoder(
        to_cdr=lambda data: (codec.encode(packing.decode(data)), b""),
        from_cdr=lambda data, rest: packing.encode(codec.decode(data)),
    )
