"""The options of a `zenoh:` URL, and zenoh's configuration for them.

The configuration consists of r2p's needs, then the user's file, then the URL. Later ones take precedence.
"""

import contextlib
import json
import re
import socket
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from r2p.errors import TransportError
from r2p.keys import SharedKey
from r2p.transports.url import Url, key_file, one_of
from r2p.transports.zenoh.diagnose import ConnectionSettings, Tls

if TYPE_CHECKING:  # imported when it is used: a URL can be checked without zenoh, and loading it takes long
    import zenoh

MODES = ("peer", "client", "router")

_TOKENS_MAX = 131_072  # so many answers of a query always fit into its channel

_NAMED_MAX = 8  # networks that one text names

_NETWORK = re.compile(r"[A-Za-z0-9_.-]{1,64}")
_PORT_PROTOCOLS = ("tcp", "udp", "tls", "quic", "ws")
_PROTOCOLS = (*_PORT_PROTOCOLS, "unixsock-stream", "unixpipe", "serial", "vsock")
_PORT = re.compile(r".+:([0-9]+)(#.*)?")  # behind # are options of the endpoint, such as its network interface
_PORT_MAX = 65_535


class ZenohOptions(msgspec.Struct, frozen=True):
    """A checked URL. Options that are None are left to the configuration file or to zenoh, the network to
    `choose_network`.
    """

    name: str
    network: str | None = None
    mode: str | None = None
    connect: str | None = None
    listen: str | None = None
    scouting: bool | None = None
    batching: bool = True
    """True if several messages may share a payload."""
    shm: bool | None = None
    """Whether messages may go through shared memory."""
    config: Path | None = None
    tokens: int | None = None
    """Tokens of other modules that are kept."""
    key: SharedKey | None = None

    def error(self, text: str) -> TransportError:
        """Return an error that begins with the URL."""
        return TransportError(f"{self.name.removesuffix(':')}: {text}")


def parse_options(url: Url) -> ZenohOptions:
    """Parse and check a URL. Raises TransportError."""
    given = url.parsed(_PARSERS)
    endpoint = url.address or None
    if endpoint is not None:
        try:
            endpoint_text(endpoint)
        except ValueError as error:
            raise TransportError(f"{url}: {error}") from None
    mode = given.get("mode") or _default_mode(endpoint, given.get("config"))
    if mode == "client" and given.get("listen"):
        raise TransportError(f"{url}: a client does not listen: leave out listen=, or use mode=peer or mode=router")
    config = given.get("config")
    return ZenohOptions(
        name=f"{url.scheme}:{url.address}",
        network=given.get("network"),
        mode=mode,
        connect=endpoint,
        listen=given.get("listen"),
        scouting=None if "scouting" not in given else given["scouting"] == "on",
        batching=given.get("batching") != "off",
        shm=None if "shm" not in given else given["shm"] == "on",
        config=None if config is None else Path(config),
        tokens=given.get("tokens"),
        key=given.get("key"),
    )


def default_network() -> str:
    """Return the network's name for a URL without one: the host's, without its domain."""
    return re.sub(r"[^A-Za-z0-9_.-]", "", socket.gethostname().partition(".")[0]) or "robot"


def choose_network(found: set[str]) -> str:
    """Return the network that a tool joins if its URL names none: the host's, or the only one. Raises ValueError for
    several.
    """
    own = default_network()
    others = sorted(found - {own})
    if own in found or not others:
        return own
    if len(others) > 1:
        raise ValueError(
            f"there are several networks, {list_networks(others)}: choose one, as with ?network={others[0]}"
        )
    return others[0]


def list_networks(networks: list[str]) -> str:
    """Return the names for a text: only the first ones, if there are many."""
    more = len(networks) - _NAMED_MAX
    return ", ".join(networks[:_NAMED_MAX]) + f" and {more} more" * (more > 0)


def is_network_name(text: str) -> bool:
    """Return whether a network can have this name; keys of other programs may hold anything in its place."""
    return _NETWORK.fullmatch(text) is not None


def _default_mode(endpoint: str | None, config: str | None) -> str | None:
    if endpoint is not None:
        return "client"
    return None if config is not None else "peer"


def _network_name(text: str) -> str:
    if not is_network_name(text):
        raise ValueError("a network's name has 1 to 64 letters, digits, dots, dashes and underscores")
    return text


def _file_name(text: str) -> str:
    if not text:
        raise ValueError("give the configuration's file, such as router.json5")
    return text


def _token_count(text: str) -> int:
    if not text.isdecimal() or not 0 < int(text) <= _TOKENS_MAX:
        raise ValueError(f"give the number of tokens that are kept, 1 to {_TOKENS_MAX}")
    return int(text)


def endpoint_text(text: str) -> str:
    """Return a valid endpoint of zenoh, `tcp/router:7447`. Raises ValueError."""
    protocol, _, address = text.partition("/")
    if not address:
        raise ValueError(f"{text!r} is not a zenoh endpoint: give it as tcp/ADDRESS:PORT or tls/ADDRESS:PORT")
    if protocol not in _PROTOCOLS:
        raise ValueError(f"{protocol!r} is not a protocol of zenoh: use one of {', '.join(_PROTOCOLS)}")
    if protocol in _PORT_PROTOCOLS:
        found = _PORT.fullmatch(address)
        if found is None:
            raise ValueError(f"the port is missing: {protocol}/{address}:7447")
        if int(found[1]) > _PORT_MAX:
            raise ValueError(f"{found[1]} is not a valid port: the last one is {_PORT_MAX}")
    return text


_PARSERS: dict[str, Callable[[str], Any]] = {
    "mode": one_of(*MODES),
    "listen": endpoint_text,
    "network": _network_name,
    "scouting": one_of("on", "off"),
    "batching": one_of("on", "off"),
    "shm": one_of("on", "off"),
    "config": _file_name,
    "tokens": _token_count,
    "key": key_file,
}


# Configuration


LEASE_MS = 1750
"""Milliseconds without a sign of life after which a peer is gone: a hanging one is noticed within two seconds.

It can't be much shorter: where a hundred modules start on two cores, zenoh's two receiving threads do not get to a
connection for a second, and take it for lost. Then all of its tokens end and appear again, and some are missed.
"""

_DROP_AFTER = "transport/link/tx/queue/congestion_control/drop/max_wait_before_drop_fragments"  # microseconds

_NEEDED: dict[str, object] = {
    "scouting/delay": 0,  # else opening a session takes half a second
    "transport/link/tx/lease": LEASE_MS,
    "connect/retry": {"period_init_ms": 100, "period_max_ms": 500, "period_increase_factor": 2},
    "connect/exit_on_failure": {"router": False, "peer": False, "client": True},
    "transport/unicast/open_timeout": 3000,
    "transport/link/tx/queue/size/data": 16,  # batches of 64 kB: what flow control allows to be on the way fits
    # Each urgent message is a batch of its own: this many fit while zenoh's threads do not get to run.
    "transport/link/tx/queue/size/interactive_high": 16,
    "transport/link/tx/queue/size/real_time": 16,
    # Of topics with large messages: batches of 64 kB, too (r2p.transports.zenoh.large).
    "transport/link/tx/queue/size/data_low": 16,
    "transport/link/tx/queue/size/data_high": 16,
    "transport/link/tx/queue/size/interactive_low": 16,
    # How long a large message waits for room before all of it is dropped: 64 MiB on a network of 500 Mbit/s. One that
    # this session passes on from another one holds up what else comes from there for as long.
    _DROP_AFTER: 1_000_000,
}

_NEEDED_OF_CLIENT: dict[str, object] = {
    _DROP_AFTER: 10_000_000,  # it passes nothing on: the thread of large messages waits, 64 MiB on 50 Mbit/s
}

_DEFAULT_LISTEN = ["tcp/[::]:7447"]
"""The endpoint at which a computer's first peer listens, so that clients find it without a router."""

_ANY_PORT: dict[str, object] = {  # for the other peers on the computer; without IPv6 not even this one listens
    "listen/endpoints": ["tcp/[::]:0"],
    "listen/exit_on_failure": False,
}

_INVALID = "Invalid configuration: "
"""How zenoh's text begins that contains a whole configuration."""

_LOOPBACK = re.compile(r"(unix|serial|vsock)|[a-z]+/(localhost|127\.[0-9.]+|\[::1\]):")
"""Endpoints that other computers do not reach over a network."""

_NEEDED_TO_LISTEN: dict[str, object] = {
    # The session's own admin space says where it listens. Not for clients: zenoh never frees 37 kB of each closed
    # session with one.
    "adminspace/enabled": True,
}


def build_config(options: ZenohOptions) -> "zenoh.Config":
    """Return zenoh's configuration. Raises TransportError for a file or an option that zenoh can't read."""
    import zenoh

    config = _from_file(options)
    try:
        for key, value in _from_url(options).items():
            config.insert_json5(key, json.dumps(value))
    except zenoh.ZError as error:
        raise options.error(f"zenoh rejects this: {plain_text(error)}") from error
    return config


def use_any_port(config: "zenoh.Config", options: ZenohOptions) -> bool:
    """Listen at any port, as the default one is in use. Return False if the user chose one, or it was tried already."""
    if not _may_choose(options) or json.loads(config.get_json("listen/endpoints")) != _DEFAULT_LISTEN:
        return False
    for key, value in _ANY_PORT.items():
        config.insert_json5(key, json.dumps(value))
    return True


def open_endpoints(config: "zenoh.Config") -> list[str]:
    """Return the endpoints where other computers can connect without authentication."""
    if (
        json.loads(config.get_json("mode")) == "client"
        or json.loads(config.get_json("transport/auth/usrpwd"))["dictionary_file"]
    ):
        return []
    certified = ("tls/", "quic/") if json.loads(config.get_json("transport/link/tls"))["enable_mtls"] else ()
    return [
        each
        for each in connection_settings(config).listens
        if not each.startswith(certified) and not _LOOPBACK.match(each)
    ]


def connection_settings(config: "zenoh.Config") -> ConnectionSettings:
    """Return the endpoints that the session connects to and listens at, and its credentials."""
    tls = json.loads(config.get_json("transport/link/tls"))
    user = json.loads(config.get_json("transport/auth/usrpwd"))
    root, check_name = tls["root_ca_certificate"], tls["verify_name_on_connect"] is not False
    names = Tls(root, tls["connect_certificate"], tls["connect_private_key"], check_name)
    connects, listens = (json.loads(config.get_json(f"{what}/endpoints")) for what in ("connect", "listen"))
    mode = json.loads(config.get_json("mode")) or "peer"
    if isinstance(listens, dict):
        listens = listens.get(mode, [])
    return ConnectionSettings(
        _texts(connects),
        names,
        user["user"],
        _texts(listens),
        client=mode == "client",
        listener_tls=Tls(root, tls["listen_certificate"], tls["listen_private_key"]),
        users=user["dictionary_file"],
    )


def _from_file(options: ZenohOptions) -> "zenoh.Config":
    import zenoh

    config = zenoh.Config()
    needed = _NEEDED | (_NEEDED_OF_CLIENT if options.mode == "client" else _NEEDED_TO_LISTEN)
    for key, value in needed.items():
        config.insert_json5(key, json.dumps(value))
    if options.config is None:
        return config
    try:
        given = zenoh.Config.from_file(options.config)
    except (zenoh.ZError, OSError) as error:
        reason = "there is no such file" if not options.config.exists() else plain_text(error)
        raise options.error(f"can't read {options.config}: {reason}") from error
    blank = zenoh.Config()
    for key, value in needed.items():
        if given.get_json(key) == blank.get_json(key):  # not set in the file
            given.insert_json5(key, json.dumps(value))
    return given


def _from_url(options: ZenohOptions) -> dict[str, object]:
    settings: dict[str, object] = {}
    if options.mode is not None:
        settings["mode"] = options.mode
    if options.connect is not None:
        settings["connect/endpoints"] = [options.connect]
    if options.listen is not None:
        settings["listen/endpoints"] = [options.listen]
    elif _may_choose(options):
        settings["listen/endpoints"] = _DEFAULT_LISTEN
    if options.shm is not None:
        settings["transport/shared_memory/enabled"] = options.shm
    if options.scouting is not None:
        settings["scouting/multicast/enabled"] = options.scouting
    return settings


def _may_choose(options: ZenohOptions) -> bool:
    """Return whether this module chooses where to listen."""
    return options.listen is None and options.mode == "peer" and options.config is None


def plain_text(error: Exception) -> str:
    """Return zenoh's text without positions in its source, and behind the position in the file, if it has one."""
    text = re.sub(r" at /\S+?\.rs:\d+\.?", "", str(error)).strip()
    if text.startswith(_INVALID):
        return _contradiction(text)
    found = re.search(r'msg: "(.*)", location: Some\(Location \{ line: (\d+), column: (\d+)', text, re.DOTALL)
    return f"line {found[2]}, column {found[3]}: {found[1]}" if found else text


def _contradiction(text: str) -> str:
    """Return which settings of a configuration contradict each other. zenoh prints all of it, but not which."""
    with contextlib.suppress(ValueError, KeyError, TypeError):
        user = json.loads(text.removeprefix(_INVALID))["transport"]["auth"]["usrpwd"]
        if (user["user"] is None) != (user["password"] is None):
            return "transport/auth/usrpwd needs both, a user and a password"
    return "zenoh rejects the combination of its settings"


def _texts(value: object) -> list[str]:
    """Return the endpoints in a list, or in a list for each mode."""
    if isinstance(value, dict):
        return [text for each in value.values() for text in _texts(each)]
    if not isinstance(value, list):
        return []
    return [each if isinstance(each, str) else str(each.get("endpoint", "")) for each in value]
