"""Names of modules, nodes and topics: which are valid, and the aliases of those that a wire has no room for.

Names are checked where a program gives them. Those that come from a wire are only compared: no bytes from outside may
raise an error. zenoh and the memory network carry names whole. The fields of management messages and of debug lines
are shorter: there a longer name travels as an alias, which depends on the name alone (PROTOCOL.md 1).
"""

import re
from collections.abc import Iterable, Mapping
from hashlib import blake2b

from r2p.errors import InvalidName, NameTooLong

# Characters of names, at most.
MODULE_MAX = 64
NODE_MAX = 64
TOPIC_MAX = 255
"""Of a topic or a service that a program names."""
CARRIED_MAX = TOPIC_MAX + 2
"""Of a topic on a link: the two topics of a service have two characters more than its name."""
PARAMETER_MAX = 64
NAMESPACE_MAX = 16
"""Characters of the namespace of a robot at most: `robot1` in `robot1/MOTOR1`."""
MODULE_PATH_MAX = NAMESPACE_MAX + 1 + MODULE_MAX
"""Characters of `robot1/MOTOR1` at most: a module of one robot on a network of several."""

# Characters of the fields of messages on the debug line and on RTCAN. Longer names travel there as aliases.
MODULE_FIELD = 7
NODE_FIELD = 8
TOPIC_FIELD = 16

MODULE_PATH = rf"(?:[A-Za-z0-9_]{{1,{NAMESPACE_MAX}}}/)?[A-Za-z0-9_]{{1,{MODULE_PATH_MAX}}}"
"""The name of a module on a network of several robots, as a regular expression; at most MODULE_PATH_MAX characters."""
NODE = rf"[A-Za-z0-9_]{{1,{NODE_MAX}}}"
"""The name of a node as a regular expression."""
TOPIC = r"[A-Za-z0-9_]+(?:/[A-Za-z0-9_]+)*"
"""The name of a topic from a wire as a regular expression; at most CARRIED_MAX characters."""

MANAGEMENT = "R2P"
"""The topic of management messages."""
CALLS, REPLIES = "R2P_CALL", "R2P_REPLY"
"""The topics of r2p's own services: requests and answers, which modules know without an announcement."""
RESERVED = (MANAGEMENT, CALLS, REPLIES)
"""The topics that programs can't use."""
LOG = "log"
"""The topic on which each r2p module publishes the log records of its nodes."""
BUS_LOAD, BUS_SLOTS = "bus_load", "bus_slots"
"""The topics on which a module of an RTCAN bus publishes what is on the bus, while they are subscribed."""
LOADER_PREFIX = "BOOT_"
"""The topics of boot loaders begin with this; the module's name follows."""

SERVICE_SUFFIXES = ("_q", "_r")
"""The ends of the names of a service's two topics."""

_FOREIGN = re.compile(r"[^A-Za-z0-9_]")
_ALLOWED = re.compile(r"[A-Za-z0-9_]+")
_FIELD = re.compile(rf"[A-Za-z0-9_/]{{1,{TOPIC_FIELD}}}")
_DIGITS = "0123456789abcdefghijklmnopqrstuvwxyz"
_ALIAS_DIGITS = 4
_SHOWN_MAX = 80  # characters of a name that an error shows


def module_name(name: str, longest: int = MODULE_MAX) -> str:
    """Return a valid name of a module: 1 to 64 characters of `[A-Za-z0-9_]`. Raises InvalidName or NameTooLong."""
    return _checked("module", name, longest)


def module_path(name: str) -> str:
    """Return a valid name of a module of any robot, which may have a prefix: `robot1/MOTOR1`, `robot1_MOTOR1`.

    Raises InvalidName or NameTooLong.
    """
    namespace, slash, inner = name.partition("/")
    if slash:
        _checked("namespace", namespace, NAMESPACE_MAX)
    _checked("module", inner if slash else name, MODULE_PATH_MAX)
    _check_length("module", name, MODULE_PATH_MAX)
    return name


def node_name(name: str) -> str:
    """Return a valid name of a node: 1 to 64 characters of `[A-Za-z0-9_]`. Raises InvalidName or NameTooLong."""
    return _checked("node", name, NODE_MAX)


def parameter_name(name: str) -> str:
    """Return a valid name of a parameter: parts of `[A-Za-z0-9_]` joined by dots, 1 to 64 characters.

    Raises InvalidName or NameTooLong.
    """
    plain = name.replace(".", "")
    if not all(name.split(".")) or _FOREIGN.search(plain):
        reason = _foreign(plain) if _FOREIGN.search(plain) else "it is empty" if not name else "a part of it is empty"
        raise InvalidName(f"parameter name {_shown(name)}: {reason}: use letters, digits and underscores, and dots")
    _check_length("parameter", name, PARAMETER_MAX)
    return name


def topic_name(name: str, longest: int = TOPIC_MAX) -> str:
    """Return a valid name of a topic: parts of `[A-Za-z_][A-Za-z0-9_]*` joined by `/`, 1 to 255 characters.

    A leading slash, as in the thesis and in ROS, is removed. A part may begin with a digit in a name of one part, or of
    two, with at most 16 characters each. Raises InvalidName, which lists everything wrong, or NameTooLong.
    """
    plain = name.removeprefix("/")
    problems = _topic_problems(plain)
    if problems:
        if len(plain) > longest:
            problems.append(f"it has {len(plain)} characters, at most {longest} are possible")
        raise InvalidName(
            f"topic name {_shown(name)}: {'; '.join(problems)}: use letters, digits and underscores, and `/` between "
            "parts, as in robot1/encoder"
        )
    _check_length("topic", plain, longest)
    return plain


def module_name_from(hostname: str) -> str:
    """The default name of a module: as much of the host's name as fits all messages ("lab-pc.local" -> "labpc")."""
    letters = "".join(_ALLOWED.findall(hostname.partition(".")[0]))
    return letters[:MODULE_FIELD] or "PC"


# Aliases


def topic_alias(name: str) -> str:
    """Return the name of a topic in a field of 16 characters: the name itself, or the alias of a longer one.

    An alias is the first 12 characters, with `_` for a slash, and 4 digits of a hash: the same everywhere, without
    anything to agree on.
    """
    return name if len(name) <= TOPIC_FIELD else _alias(name, TOPIC_FIELD)


def node_alias(name: str) -> str:
    """Return the name of a node in a field of 8 characters: the name itself, or the alias of a longer one."""
    return name if len(name) <= NODE_FIELD else _alias(name, NODE_FIELD)


def module_alias(name: str) -> str:
    """Return the name of a module in a field of 7 characters: the name itself, or its alias.

    Longer names have an alias, and all names in a namespace.
    """
    return name if len(name) <= MODULE_FIELD and "/" not in name else _alias(name, MODULE_FIELD)


def name_hash(text: str) -> int:
    """Return the 8-byte BLAKE2b of a name as a little-endian number, from which its alias is made."""
    return int.from_bytes(blake2b(text.encode(), digest_size=8).digest(), "little")


def chosen_alias(name: str, chosen: Mapping[str, str]) -> str:
    """Return the alias of a topic: the one that was chosen for it, or for its service, else that of its hash."""
    if len(name) <= TOPIC_FIELD:
        return name
    alias = chosen.get(name)
    if alias is None and name.endswith(SERVICE_SUFFIXES) and (base := chosen.get(name[:-2])) is not None:
        alias = base + name[-2:]
    return alias if alias is not None and len(alias) <= TOPIC_FIELD else topic_alias(name)


def check_aliases(chosen: Mapping[str, str]) -> dict[str, str]:
    """Return the aliases chosen for topics and services. Raises InvalidName for one that can't be used.

    An alias has at most 16 characters (14 for a service, whose two topics add two), and belongs to one name.
    """
    names: dict[str, str] = {}
    for given, alias in chosen.items():
        name, alias = topic_name(given), topic_name(alias, TOPIC_FIELD)
        if len(name) <= TOPIC_FIELD - len(SERVICE_SUFFIXES[0]):
            raise InvalidName(f"alias {alias!r}: {name!r} needs none, it fits every link: remove the line")
        if alias == MANAGEMENT:
            raise InvalidName(f"alias {alias!r} of {name!r} is the topic of management messages: choose another one")
        other = next((each for each, taken in names.items() if taken == alias), None)
        if other is not None:
            raise InvalidName(f"{other!r} and {name!r} have one alias, {alias!r}: choose another one for either")
        names[name] = alias
    return names


def fits_field(name: str) -> bool:
    """Return whether a name from a wire can be that of a topic in a field of 16 characters."""
    return _FIELD.fullmatch(name) is not None


# Errors


def _alias(name: str, size: int) -> str:
    number = name_hash(name)
    digits = ""
    for _ in range(_ALIAS_DIGITS):
        number, digit = divmod(number, len(_DIGITS))
        digits += _DIGITS[digit]
    return name[: size - _ALIAS_DIGITS].replace("/", "_") + digits


def _topic_problems(name: str) -> list[str]:
    parts = name.split("/")
    problems = [_foreign(name.replace("/", ""))] if _FOREIGN.search(name.replace("/", "")) else []
    if not all(parts):
        problems.append("it is empty" if not name else "a part of it is empty")
    if len(parts) > 2 or any(len(part) > TOPIC_FIELD for part in parts):  # shorter names could always begin with one
        problems += [f"part {_shown(part)} begins with a digit" for part in parts if part[:1].isdecimal()]
    return problems


def _foreign(name: str) -> str:
    found = [repr(each) for each in dict.fromkeys(_FOREIGN.findall(name))]
    return f"{_listed(found[:5])} can't be in a name"


def _listed(things: Iterable[str]) -> str:
    *others, last = things
    return f"{', '.join(others)} and {last}" if others else last


def _checked(what: str, name: str, longest: int) -> str:
    if not _ALLOWED.fullmatch(name):
        problems = [_foreign(name) if name else "it is empty"]
        if len(name) > longest:
            problems.append(f"it has {len(name)} characters, at most {longest} are possible")
        raise InvalidName(f"{what} name {_shown(name)}: {'; '.join(problems)}: use letters, digits and underscores")
    _check_length(what, name, longest)
    return name


def _check_length(what: str, name: str, longest: int) -> None:
    if len(name) > longest:
        has = f"has {len(name)} characters, at most {longest} are possible: shorten it"
        raise NameTooLong(f"{what} name {_shown(name)} {has}")


def _shown(name: str) -> str:
    return repr(name) if len(name) <= _SHOWN_MAX else f"{name[:_SHOWN_MAX]!r}..."
