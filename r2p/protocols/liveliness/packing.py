"""Which keys carry the tokens of a module: several tokens each, as zenoh's work grows with the number of keys.

A router passes each key on to each session, and every session keeps it. 100 modules that had a key for each of ten
topics took it more than 20 s of processor time until they had seen each other, without any of r2p's own work.
"""

import msgspec

from r2p.codecs import liveliness
from r2p.protocols.discovery.events import Declare, Undeclare

TOKENS_OF_PACK = 32
"""Tokens that share a key: as many come and go with each that changes."""


class _Pack(msgspec.Struct, eq=False):
    """Tokens that share a key, and that key while it is declared."""

    tokens: dict[str, None] = msgspec.field(default_factory=dict)
    key: str = ""


class TokenPacker:
    """The keys of some tokens of one session. Changes are collected until `pop_changes`."""

    def __init__(self) -> None:
        self._pack_of: dict[str, _Pack] = {}
        self._with_room: dict[int, _Pack] = {}  # by id
        self._changed: dict[int, _Pack] = {}

    @property
    def has_changes(self) -> bool:
        return bool(self._changed)

    def add(self, token: str) -> None:
        """Add a token that is not there."""
        pack = next(iter(self._with_room.values()), None) or _Pack()
        pack.tokens[token] = None
        self._pack_of[token] = pack
        self._note(pack)

    def remove(self, token: str) -> None:
        """Remove a token that is there."""
        pack = self._pack_of.pop(token)
        del pack.tokens[token]
        self._note(pack)

    def pop_changes(self) -> list[Declare | Undeclare]:
        """Return the keys to declare since the last call, and behind them those that end."""
        declared, ended = dict[str, None](), dict[str, None]()
        changed, self._changed = self._changed, {}
        for pack in changed.values():
            key = liveliness.pack(list(pack.tokens)) if pack.tokens else ""
            if key != pack.key:
                declared[key] = ended[pack.key] = None
                pack.key = key
        # A token that was taken out and added again may have the key of before, in another pack.
        both = (declared.keys() & ended.keys()) | {""}
        return [
            *(Declare(key) for key in declared if key not in both),
            *(Undeclare(key) for key in ended if key not in both),
        ]

    def withdraw_all(self) -> list[Declare | Undeclare]:
        """Undeclare everything; it is declared anew by the next `pop_changes`."""
        packs = {id(pack): pack for pack in self._pack_of.values()} | self._changed
        events: list[Declare | Undeclare] = []
        for pack in packs.values():
            if pack.key:
                events.append(Undeclare(pack.key))
                pack.key = ""
        self._changed = packs
        return events

    def _note(self, pack: _Pack) -> None:
        """Note that a pack has changed: whether it has room, too, and tokens at all."""
        self._changed[id(pack)] = pack
        if 0 < len(pack.tokens) < TOKENS_OF_PACK:
            self._with_room[id(pack)] = pack
        else:
            self._with_room.pop(id(pack), None)
