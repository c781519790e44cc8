"""Names of modules that are too long for a message: an alias travels, and what it stands for (PROTOCOL.md 9).

Only gateways with a prefix tell of such modules. An alias depends on the name alone, so whoever knows the name can use
it at once, and nobody believes one that does not fit.
"""

from r2p.codecs.management import Name
from r2p.names import MODULE_PATH_MAX, module_alias

_PIECE = 22
_MOST = 4096
_MOST_PARTS = 256


def told(name: str) -> list[Name]:
    """The messages that tell what the alias of this name stands for; none if it is its own."""
    alias = module_alias(name)
    if alias == name:
        return []
    pieces = [name[at : at + _PIECE] for at in range(0, len(name), _PIECE)]
    return [Name(alias, number << 4 | len(pieces) - 1, piece) for number, piece in enumerate(pieces)]


class Aliases:
    """What was heard of aliases."""

    def __init__(self) -> None:
        self._names: dict[str, str] = {}
        self._parts: dict[str, dict[int, str]] = {}

    def name_of(self, alias: str) -> str:
        """The name, or the alias where none is known."""
        return self._names.get(alias, alias)

    def heard(self, message: Name) -> str | None:
        """A NAME was heard; gives back the name if it is new, and complete."""
        number, last = message.part >> 4, message.part & 15
        parts = self._parts.setdefault(message.alias, {})
        parts[number] = message.piece
        if not set(range(last + 1)) <= parts.keys():
            _bound(self._parts, _MOST_PARTS)
            return None
        del self._parts[message.alias]
        name = "".join(parts[each] for each in range(last + 1))
        if len(name) > MODULE_PATH_MAX or module_alias(name) != message.alias or self._names.get(message.alias) == name:
            return None
        self._names[message.alias] = name
        _bound(self._names, _MOST)
        return name


def _bound(table: dict[str, object] | dict[str, str] | dict[str, dict[int, str]], most: int) -> None:
    while len(table) > most:
        del table[next(iter(table))]
