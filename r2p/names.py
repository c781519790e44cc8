"""Names of modules, nodes and topics, with as many characters as the wire carries (PROTOCOL.md 1).

Names are checked where a program gives them. Those that come from a wire are only compared: no bytes from outside may
raise an error.
"""

import re
from hashlib import blake2b

from r2p.errors import InvalidName, NameTooLong

# Characters of names. The first three are fields of firmware's messages; other links carry longer names.
MODULE_MAX = 7
NODE_MAX = 8
TOPIC_MAX = 16
MODULE_PATH_MAX = 24
"""Characters of `robot1/MOTOR1` at most: a module of one robot on a network of several."""
NAMESPACED_MAX = 2 * TOPIC_MAX + 1
"""Characters of `robot1/encoder` at most: a topic of one robot on a network of several."""

MODULE_PATH = r"(?:[A-Za-z0-9_]{1,16}/)?[A-Za-z0-9_]{1,24}"
"""The name of a module on a network of several robots, as a regular expression; at most MODULE_PATH_MAX characters."""

MANAGEMENT = "R2P"
"""The topic of management messages."""
LOG = "log"
"""The topic on which each r2p module publishes the log records of its nodes."""
LOADER_PREFIX = "BOOT_"
"""The topics of boot loaders begin with this; the module's name follows."""

_ALLOWED = re.compile(r"[A-Za-z0-9_]+")
_DIGITS = "0123456789abcdefghijklmnopqrstuvwxyz"
_ALIAS_DIGITS = 4


def module_name(name: str) -> str:
    """Return a valid name of a module: 1 to 7 characters of `[A-Za-z0-9_]`. Raises InvalidName or NameTooLong."""
    return _checked("module", name, MODULE_MAX)


def module_path(name: str) -> str:
    """Return a valid name of a module of any robot, which may have a prefix: `robot1/MOTOR1`, `robot1_MOTOR1`.

    Raises InvalidName or NameTooLong.
    """
    if name.count("/") != 1 and (len(name) <= MODULE_MAX or "_" not in name):
        return module_name(name)
    namespace, slash, inner = name.rpartition("/")
    if slash:
        _checked("namespace", namespace, TOPIC_MAX)
    _checked("module", inner, MODULE_PATH_MAX)
    if len(name) > MODULE_PATH_MAX:
        raise NameTooLong(f"module name {name!r} has {len(name)} characters, at most {MODULE_PATH_MAX} are possible")
    return name


def module_alias(name: str) -> str:
    """The name of a module where the wire carries 7 characters (PROTOCOL.md 9).

    A name that fits is its own alias. For a longer one, or one in a namespace, it is the first 3 characters and 4
    digits of a hash: the same everywhere, without anything to agree on.
    """
    if len(name) <= MODULE_MAX and "/" not in name:
        return name
    number = int.from_bytes(blake2b(name.encode(), digest_size=8).digest(), "little")
    digits = ""
    for _ in range(_ALIAS_DIGITS):
        number, digit = divmod(number, len(_DIGITS))
        digits += _DIGITS[digit]
    return name[: MODULE_MAX - _ALIAS_DIGITS].replace("/", "_") + digits


def node_name(name: str) -> str:
    """Return a valid name of a node: 1 to 8 characters of `[A-Za-z0-9_]`. Raises InvalidName or NameTooLong."""
    return _checked("node", name, NODE_MAX)


def topic_name(name: str) -> str:
    """Return a valid name of a topic: 1 to 16 characters of `[A-Za-z0-9_]`. Raises InvalidName or NameTooLong.

    One `/` may stand in it, after a namespace that follows the same rules: `robot1/encoder`. A leading slash, as in the
    thesis and in ROS, is removed.
    """
    plain = name.removeprefix("/")
    namespace, slash, inner = plain.rpartition("/")
    if not _ALLOWED.fullmatch(inner) or (slash and not _ALLOWED.fullmatch(namespace)):
        raise InvalidName(
            f"topic name {name!r}: use letters, digits and underscores, and at most one `/`, after a namespace, as in "
            "robot1/encoder"
        )
    if slash:
        _check_length("namespace", namespace, TOPIC_MAX)
    _check_length("topic", inner, TOPIC_MAX)
    return plain


def module_name_from(hostname: str) -> str:
    """The default name of a module: as much of the computer's host name as fits ("lab-pc.local" -> "labpc")."""
    letters = "".join(_ALLOWED.findall(hostname.partition(".")[0]))
    return letters[:MODULE_MAX] or "PC"


def _checked(what: str, name: str, longest: int) -> str:
    if not _ALLOWED.fullmatch(name):
        raise InvalidName(f"{what} name {name!r}: use letters, digits and underscores only")
    _check_length(what, name, longest)
    return name


def _check_length(what: str, name: str, longest: int) -> None:
    if len(name) > longest:
        raise NameTooLong(f"{what} name {name!r} has {len(name)} characters, the wire carries {longest}: shorten it")
