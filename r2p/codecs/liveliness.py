"""Liveliness tokens: the modules on zenoh with their publishers and subscribers (PROTOCOL.md 10).

Each is a key that zenoh keeps while the session that declared it lives.

    1/SESSION/module/NAME/INSTANCE/FLAGS/HOPS
    1/SESSION/pub|sub/TOPIC/INSTANCE/NODE/CLASS/SIZE/FINGERPRINT/WINDOW/HOPS
    2/SESSION/version/INSTANCE/WIRE/RELEASE
    3/SESSION/tokens/TOKEN;TOKEN;...

The first part is the version; tokens of another version are ignored. The last two were added later: with a 2 or a 3,
modules that know the first two only ignore them. The last one is a pack: several other tokens of its session in one
key, each without the session, and with `,` for its slashes. zenoh's work grows with the number of keys, hardly with
their length. `SESSION` is the instance of the r2p module that declares the token, in hex;
`INSTANCE` is that of the module concerned, another one behind gateways (`HOPS` counts them), and `-` for firmware. `-`
stands also for a node, a fingerprint or a release that is not known; `%` for each slash of a topic or a module. Names
are whole. `SIZE` is that of a message, up to 64 MiB; `v` and the bound, if the length varies. Modules from before there
were such messages count a token with a `v` as undecodable.

In front of each token stands `live/*`, behind the name of the network; `live` alone is accepted, too. Every session
numbers the keys that zenoh passes on to it, up to their first wildcard, and keeps these numbers for as long as it
lives: so a key without a wildcard would stay in the memory of every router, for each module that has ever been there.
"""

import functools
import re
from collections.abc import Sequence

import msgspec

from r2p.codecs import UnknownType
from r2p.codecs.management import ANY_TYPE, RELEASE_MAX, ROLE_PUBLISHES, ROLE_SUBSCRIBES
from r2p.errors import DecodeError
from r2p.messages import SIZE_MAX
from r2p.names import CARRIED_MAX, MODULE_PATH, MODULE_PATH_MAX, NODE, TOPIC

VERSION = "1"
_SOFTWARE_VERSION = "2"

_PACK_VERSION = "3"

PACKED = "tokens"
"""The part of the key that marks a pack."""

PACK_MAX = 64
"""Tokens in a pack, at most."""

PACK_LENGTH_MAX = 32_768
"""Characters of a pack, at most: 64 tokens of the longest names. zenoh's messages hold 64 kB without being cut."""

KEY_PREFIX = "live"
"""The part of the key under which tokens are watched."""

_WILD = "*/"

_CACHED = 256  # keys whose tokens are kept: 8 MB of the longest ones

_NONE = "-"
_HEX32 = r"[0-9a-f]{1,8}"
_MODULE = re.compile(
    rf"({_HEX32})/module/({MODULE_PATH.replace('/', '%')})/({_HEX32}|-)/([0-9a-f]{{1,2}})/([0-9]{{1,2}})"
)
_TOPIC = re.compile(
    rf"({_HEX32})/(pub|sub)/({TOPIC.replace('/', '%')})/({_HEX32}|-)/({NODE}|-)"
    r"/([0-9]{1,3})/(v?)([0-9]{1,8})/([0-9a-f]{16}|-)/([0-9]{1,6})/([0-9]{1,2})"
)
_SOFTWARE = re.compile(rf"({_HEX32})/version/({_HEX32})/([0-9]{{1,3}})/([A-Za-z0-9.+_-]{{1,{RELEASE_MAX}}})")
_PACK = re.compile(rf"{_PACK_VERSION}/({_HEX32})/{PACKED}/([^/]+)")
_BYTE_MAX = 0xFF
_OBSERVER = 0x80
FLAGS_MASK = 0x7F
"""The flags of ALIVE that a token can hold."""

_ROLES = {"pub": ROLE_PUBLISHES, "sub": ROLE_SUBSCRIBES}
_ROLE_NAMES = {role: name for name, role in _ROLES.items()}


class ModuleToken(msgspec.Struct, frozen=True, gc=False):
    """A running module. `flags` are the FLAG_... bits of ALIVE. Firmware behind a gateway has no `instance`."""

    session: int
    name: str
    instance: int | None
    flags: int = 0
    observer: bool = False
    hops: int = 0


class TopicToken(msgspec.Struct, frozen=True, gc=False):
    """A publisher or subscriber (`role` is ROLE_...) of a topic.

    `publisher_class` is CLASS_..., a sum; `size` in bytes, 0: unknown. A subscriber with a `window` wants its
    publishers to wait for it: so many messages may be on their way. 0: a lossy one.
    """

    session: int
    role: int
    topic: str
    instance: int | None
    node: str = ""
    publisher_class: int = 0
    size: int = 0
    fingerprint: bytes = ANY_TYPE
    window: int = 0
    hops: int = 0
    varies: bool = False


class SoftwareToken(msgspec.Struct, frozen=True, gc=False):
    """The versions of the module that runs as `instance`: `wire` and `release` as in its HELLO."""

    session: int
    instance: int
    wire: int = 0
    release: str = ""


Token = ModuleToken | TopicToken | SoftwareToken


def encode(token: Token) -> str:
    """Encode a token as its key, without `live/*`."""
    instance = _NONE if token.instance is None else f"{token.instance:x}"
    if isinstance(token, ModuleToken):
        flags = token.flags | (_OBSERVER if token.observer else 0)
        name = token.name.replace("/", "%")
        return f"{VERSION}/{token.session:x}/module/{name}/{instance}/{flags:x}/{token.hops}"
    if isinstance(token, SoftwareToken):
        return f"{_SOFTWARE_VERSION}/{token.session:x}/version/{instance}/{token.wire}/{token.release or _NONE}"
    fingerprint = _NONE if token.fingerprint == ANY_TYPE else token.fingerprint.hex()
    topic = token.topic.replace("/", "%")
    return (
        f"{VERSION}/{token.session:x}/{_ROLE_NAMES[token.role]}/{topic}/{instance}/{token.node or _NONE}"
        f"/{token.publisher_class}/{'v' if token.varies else ''}{token.size}/{fingerprint}/{token.window}/{token.hops}"
    )


def decode(key: str) -> Token:
    """Decode a key. Raises `UnknownType` for a version to ignore, else `DecodeError`."""
    version, _, rest = key.partition("/")
    if version == _SOFTWARE_VERSION and (found := _SOFTWARE.fullmatch(rest)) and int(found[3]) <= _BYTE_MAX:
        session, instance, wire, release = found.groups()
        return SoftwareToken(int(session, 16), int(instance, 16), int(wire), _text(release))
    if version != VERSION:
        raise UnknownType(f"version {version[:8]} of a token")
    if (found := _MODULE.fullmatch(rest)) and len(found[2]) <= MODULE_PATH_MAX:
        session, name, instance, flags, hops = found.groups()
        bits = int(flags, 16)
        return ModuleToken(
            int(session, 16),
            name.replace("%", "/"),
            _instance(instance),
            bits & ~_OBSERVER,
            bool(bits & _OBSERVER),
            int(hops),
        )
    found = _TOPIC.fullmatch(rest)
    if found and len(found[3]) <= CARRIED_MAX and int(found[6]) <= _BYTE_MAX and int(found[8]) <= SIZE_MAX:
        session, role, topic, instance, node, publisher_class, varies, size, fingerprint, window, hops = found.groups()
        return TopicToken(
            int(session, 16),
            _ROLES[role],
            topic.replace("%", "/"),
            _instance(instance),
            _text(node),
            int(publisher_class),
            int(size),
            ANY_TYPE if fingerprint == _NONE else bytes.fromhex(fingerprint),
            int(window),
            int(hops),
            bool(varies),
        )
    raise DecodeError(f"{key[:80]!r} is not a token")


def pack(tokens: Sequence[str]) -> str:
    """Return the key that stands for several tokens of one session; that of a single one is the token itself."""
    if len(tokens) == 1:
        return tokens[0]
    _, session, _ = tokens[0].split("/", 2)
    return f"{_PACK_VERSION}/{session}/{PACKED}/" + ";".join(map(_without_session, tokens))


def unpack(key: str) -> list[str]:
    """Return the tokens that a key stands for, to be decoded each: itself, if it is not a pack.

    Raises DecodeError for a pack that is none.
    """
    if not key.startswith(f"{_PACK_VERSION}/"):
        return [key]
    found = _PACK.fullmatch(key) if len(key) <= PACK_LENGTH_MAX else None
    if found is None or found[2].count(";") >= PACK_MAX:
        raise DecodeError(f"{key[:80]!r} is not a pack of tokens")
    tokens = []
    for packed in found[2].split(";"):
        version, _, rest = packed.partition(",")
        tokens.append(f"{version}/{found[1]}/{rest.replace(',', '/')}")
    return tokens


@functools.lru_cache(_CACHED)
def tokens_of(key: str) -> tuple[dict[str, Token], list[DecodeError]]:
    """Return the tokens that a key stands for, by their own keys, and an error for each invalid part.

    Of the last ones the results are kept, not to be changed: all modules of a program get the same keys.
    """
    tokens: dict[str, Token] = {}
    errors: list[DecodeError] = []
    try:
        parts = unpack(key)
    except DecodeError as error:
        return tokens, [error]
    for part in parts:
        try:
            tokens[part] = decode(part)
        except DecodeError as error:
            errors.append(error)
    return tokens, errors


def _without_session(token: str) -> str:
    version, _, rest = token.split("/", 2)
    return f"{version},{rest.replace('/', ',')}"


def is_representable(token: Token) -> bool:
    """Return whether the token survives encoding and decoding. Names from another link may contain characters with a
    meaning in keys or key expressions of zenoh, such as `/` and `*`.
    """
    try:
        return decode(encode(token)) == token
    except DecodeError:
        return False


def token_key(token: str) -> str:
    """Return the key under which a token is declared, without the name of the network."""
    return f"{KEY_PREFIX}/{_WILD}{token}"


def token_of(suffix: str) -> str:
    """Return the token in a key after `live/`; other implementations may leave out the wildcard."""
    return suffix.removeprefix(_WILD)


def is_module(key: str, *, tools: bool = False) -> bool:
    """Return whether a key has the token of a module, or with `tools`, of a tool."""
    return any(isinstance(each, ModuleToken) and (tools or not each.observer) for each in tokens_of(key)[0].values())


def has_publisher(key: str) -> bool:
    """Return whether a key has the token of a publisher."""
    return any(isinstance(each, TopicToken) and each.role == ROLE_PUBLISHES for each in tokens_of(key)[0].values())


def _text(text: str) -> str:
    return "" if text == _NONE else text


def _instance(text: str) -> int | None:
    return None if text == _NONE else int(text, 16)
