"""What a `zenoh:` URL says.

zenoh:                          peer: finds others by multicast, and is found
zenoh:tcp/HOST:PORT             client of a router, or of a peer that listens there
zenoh:?mode=router&listen=tcp/0.0.0.0:7447
zenoh:?config=FILE              any zenoh configuration (JSON5): TLS, passwords, access control
"""

import re
import socket
from collections.abc import Callable
from pathlib import Path

import msgspec

from r2p.errors import TransportError
from r2p.transports.url import Url

MODES = ("peer", "client", "router")

_MOST_NAMED = 8  # networks in one text
_NETWORK = re.compile(r"[A-Za-z0-9_.-]{1,64}")
_AT_PORTS = ("tcp", "udp", "tls", "quic", "ws")
_PROTOCOLS = (*_AT_PORTS, "unixsock-stream", "unixpipe", "serial", "vsock")
_PORT = re.compile(r".+:([0-9]+)(#.*)?")  # behind # are options of the endpoint: its network interface
_PORT_MAX = 65_535


class Options(msgspec.Struct, frozen=True):
    """A URL, checked. What is None is left to the configuration file, or to zenoh; the network to `chosen`."""

    name: str
    network: str | None = None
    mode: str | None = None
    connect: str | None = None
    listen: str | None = None
    scouting: bool | None = None
    batching: bool = True
    """Whether several messages may share a payload."""
    config: Path | None = None

    def error(self, text: str) -> TransportError:
        """What is wrong with it, in words."""
        return TransportError(f"{self.name.removesuffix(':')}: {text}")


def options_of(url: Url) -> Options:
    """Check a URL. Raises TransportError."""
    given = url.parsed(_PARSERS)
    endpoint = url.address or None
    if endpoint is not None:
        try:
            _endpoint_text(endpoint)
        except ValueError as error:
            raise TransportError(f"{url}: {error}") from None
    mode = given.get("mode") or (_default_mode(endpoint, given.get("config")))
    if mode == "client" and given.get("listen"):
        raise TransportError(f"{url}: a client listens nowhere: leave out listen=, or use mode=peer or mode=router")
    config = given.get("config")
    return Options(
        name=f"{url.scheme}:{url.address}",
        network=given.get("network"),
        mode=mode,
        connect=endpoint,
        listen=given.get("listen"),
        scouting=None if "scouting" not in given else given["scouting"] == "on",
        batching=given.get("batching") != "off",
        config=None if config is None else Path(config),
    )


def default_network() -> str:
    """The name of a network that has been given none: the host's, without its domain."""
    return re.sub(r"[^A-Za-z0-9_.-]", "", socket.gethostname().partition(".")[0]) or "robot"


def chosen(found: set[str]) -> str:
    """The network that a tool joins which was not told one: the host's, or else the only one that there is.

    Raises ValueError where there are several others.
    """
    own = default_network()
    others = sorted(found - {own})
    if own in found or not others:
        return own
    if len(others) > 1:
        raise ValueError(f"there are the networks {listed(others)}: say which, as ?network={others[0]}")
    return others[0]


def listed(networks: list[str]) -> str:
    """Networks for a text: the first ones by name, where there are many."""
    more = len(networks) - _MOST_NAMED
    return ", ".join(networks[:_MOST_NAMED]) + f" and {more} more" * (more > 0)


def is_network_name(text: str) -> bool:
    """Whether a network can have this name; keys of others may hold anything in its place."""
    return _NETWORK.fullmatch(text) is not None


def _default_mode(endpoint: str | None, config: str | None) -> str | None:
    if endpoint is not None:
        return "client"
    return None if config is not None else "peer"


def _one_of(*values: str) -> Callable[[str], str]:
    def check(text: str) -> str:
        if text not in values:
            raise ValueError(f"use one of {', '.join(values)}")
        return text

    return check


def _network_name(text: str) -> str:
    if not is_network_name(text):
        raise ValueError("a network's name has 1 to 64 letters, digits, dots, dashes and underscores")
    return text


def _endpoint_text(text: str) -> str:
    protocol, _, address = text.partition("/")
    if not address:
        raise ValueError(f"{text!r} is no zenoh endpoint: give it as tcp/ADDRESS:PORT or tls/ADDRESS:PORT")
    if protocol not in _PROTOCOLS:
        raise ValueError(f"{protocol!r} is no protocol of zenoh: use one of {', '.join(_PROTOCOLS)}")
    if protocol in _AT_PORTS:
        found = _PORT.fullmatch(address)
        if found is None:
            raise ValueError(f"the port is missing: {protocol}/{address}:7447")
        if int(found[1]) > _PORT_MAX:
            raise ValueError(f"{found[1]} is no port: the last one is {_PORT_MAX}")
    return text


_PARSERS: dict[str, Callable[[str], str]] = {
    "mode": _one_of(*MODES),
    "listen": _endpoint_text,
    "network": _network_name,
    "scouting": _one_of("on", "off"),
    "batching": _one_of("on", "off"),
    "config": str,
}
