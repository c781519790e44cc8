"""Names as they fit the wire: `module/node/topic` (PROTOCOL.md 1).

Names are checked where a person gives them; names that come from a wire are only compared.
"""

import re
from hashlib import blake2b

from r2p.errors import InvalidName, NameTooLong

MODULE_MAX = 7
MODULE_PATH_MAX = 24
"""`robot1/MOTOR1`: a module of a robot on a network of several."""
MODULE_PATH = r"(?:[A-Za-z0-9_]{1,16}/)?[A-Za-z0-9_]{1,24}"
"""What the name of a module on a network of several robots looks like; it has MODULE_PATH_MAX characters in all."""
NODE_MAX = 8
TOPIC_MAX = 16
NAMESPACED_MAX = 2 * TOPIC_MAX + 1
"""`robot1/encoder`: a robot's topic on a network of several, which only links without the wire's limit carry."""

MANAGEMENT = "R2P"
LOADER_PREFIX = "BOOT_"

_ALLOWED = re.compile(r"[A-Za-z0-9_]+")
_DIGITS = "0123456789abcdefghijklmnopqrstuvwxyz"
_ALIAS_DIGITS = 4


def module_name(name: str) -> str:
    """Check a module's name: 1 to 7 characters of `[A-Za-z0-9_]`."""
    return _checked("module", name, MODULE_MAX)


def module_path(name: str) -> str:
    """Check the name of a module of any robot, which may have a prefix: `robot1/MOTOR1`, `robot1_MOTOR1`."""
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
    """What a module is called where names of 7 characters travel: as it is, or for a longer name, or one in a
    namespace, the first 3 characters and 4 that follow from it (PROTOCOL.md 9).
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
    """Check a node's name: 1 to 8 characters of `[A-Za-z0-9_]`."""
    return _checked("node", name, NODE_MAX)


def topic_name(name: str) -> str:
    """Check a topic's name: 1 to 16 characters of `[A-Za-z0-9_]`; a leading slash, as in the thesis, is taken off.

    It may be in a namespace, as `robot1/encoder`, of which the same holds.
    """
    name = name.removeprefix("/")
    namespace, _, inner = name.partition("/")
    if name.count("/") != 1:
        return _checked("topic", name, TOPIC_MAX)
    return f"{_checked('namespace', namespace, TOPIC_MAX)}/{_checked('topic', inner, TOPIC_MAX)}"


def module_name_from(hostname: str) -> str:
    """The default module name on a machine: its host name as far as it fits ("lab-pc.local" -> "labpc")."""
    letters = "".join(_ALLOWED.findall(hostname.partition(".")[0]))
    return letters[:MODULE_MAX] or "PC"


def _checked(what: str, name: str, longest: int) -> str:
    if not _ALLOWED.fullmatch(name):
        raise InvalidName(f"{what} name {name!r}: use letters, digits and underscores only")
    if len(name) > longest:
        raise NameTooLong(f"{what} name {name!r} has {len(name)} characters, the wire carries {longest}: shorten it")
    return name
