"""The messages that say which name an alias stands for (PROTOCOL.md 9): NAME for modules, LONG_NAME for all others.

`r2p.codecs.management` exports all of this, and encodes and decodes the messages.
"""

import msgspec

from r2p.codecs._gateway_fields import PARTS_MAX, make_part
from r2p.names import module_alias, name_hash

_PIECE = 22  # characters of Name.piece
_LONG_PIECE = 24  # characters of LongName.piece
LONG_TEXT_MAX = PARTS_MAX * _LONG_PIECE
"""Characters of a text in LONG_NAME at most."""

# LongName.kind
KIND_TOPIC = 1
KIND_NODE = 2


class Name(msgspec.Struct, frozen=True, gc=False):
    """A piece of the name that an alias stands for. `part` has its number and that of the last one: see `make_part`."""

    alias: str
    part: int
    piece: str


class LongName(msgspec.Struct, frozen=True, gc=False):
    """A piece of a name that travels as an alias. `kind` is KIND_..., `part` as in `Name`.

    The text in the pieces is the name, or `ALIAS=NAME` where the alias was chosen. `number` is `long_name_number` of
    the text: it tells the pieces of several names apart.
    """

    kind: int
    part: int
    number: int
    piece: str


def alias_messages(name: str) -> list[Name]:
    """Return the messages that announce the name behind a module's alias; none if the name fits into a message."""
    alias = module_alias(name)
    if alias == name:
        return []
    return [Name(alias, part, piece) for part, piece in _pieces(name, _PIECE)]


def long_name_messages(kind: int, text: str) -> list[LongName]:
    """Return the messages that announce the text, a name behind an alias."""
    number = long_name_number(text)
    return [LongName(kind, part, number, piece) for part, piece in _pieces(text, _LONG_PIECE)]


def long_name_number(text: str) -> int:
    """Return the number of a text: the first four bytes of its BLAKE2b."""
    return name_hash(text) & 0xFFFFFFFF


def _pieces(text: str, size: int) -> list[tuple[int, str]]:
    pieces = [text[at : at + size] for at in range(0, len(text), size)]
    return [(make_part(number, len(pieces) - 1), piece) for number, piece in enumerate(pieces)]
