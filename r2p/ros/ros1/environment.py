"""Where the master and this computer are: `ROS_MASTER_URI`, `ROS_HOSTNAME`, `ROS_IP`, and arguments that replace them.

Other computers connect to what this one gives as its host. The classic fault of ROS 1 is a host that they can't reach:
everything is registered, and no data come. So without ROS_HOSTNAME and ROS_IP it is the address that the connection to
the master has here, never a name; with a master on this computer, it is that of the way to other computers, if any.
"""

import ipaddress
import socket
from collections.abc import Mapping
from typing import Final
from urllib.parse import urlsplit

import msgspec

from r2p.errors import TransportError

PORT: Final = 11311
"""The master's port, unless its URI says otherwise."""


class RosAddress(msgspec.Struct, frozen=True):
    """The master's URI, the host by which others reach this computer (empty: `reachable_host`), and the one that its
    servers listen at.
    """

    master: str
    host: str
    bind: str


def find_address(master: str, environ: Mapping[str, str], special: Mapping[str, str]) -> RosAddress:
    """Return where things are. `master` is of the URL (`robot:11311`, an URI, or empty), `special` of arguments.

    Raises TransportError for what is not an address.
    """
    source, text = _first(("the URL", master), ("__master:=", special.get("master", "")), *_master(environ))
    uri = _uri(source, text)
    given = (("__hostname:=", "hostname"), ("__ip:=", "ip"))
    own = [(name, special.get(key, "")) for name, key in given]
    source, host = _first(*own, *((name, environ.get(name, "")) for name in ("ROS_HOSTNAME", "ROS_IP")), ("", ""))
    host = _host(source, host) if host else ""
    return RosAddress(uri, host, _bind(host))


def _master(environ: Mapping[str, str]) -> tuple[tuple[str, str], ...]:
    return ("ROS_MASTER_URI", environ.get("ROS_MASTER_URI", "")), ("", f"localhost:{PORT}")


def _first(*candidates: tuple[str, str]) -> tuple[str, str]:
    """Return the first that is not empty."""
    return next((each for each in candidates if each[1].strip()), candidates[-1])


def _uri(source: str, text: str) -> str:
    text = text.strip()
    try:
        parts = urlsplit(text if "//" in text else f"http://{text}")
        host, port = parts.hostname, parts.port or PORT
    except ValueError:
        host, port, parts = None, 0, urlsplit("")
    if not host or parts.scheme != "http":
        raise TransportError(f"{source} {text!r} is not where a master may be: write http://HOST:{PORT}")
    return f"http://{_bracketed(host)}:{port}"


def _host(source: str, text: str) -> str:
    host = text.strip()
    try:
        ipaddress.ip_address(host)
    except ValueError:
        if any(sign in host for sign in ":/ "):
            raise TransportError(
                f"{source} {text!r}: write a host or an IP address alone, without http:// or a port"
            ) from None
    return host


def reachable_host(local: str) -> str:
    """Return the address by which others reach this computer, from the one that it has towards the master."""
    if local and not _is_loopback(local):
        return local
    for family, outside in ((socket.AF_INET, "192.0.2.1"), (socket.AF_INET6, "2001:db8::1")):  # for documents: no host
        try:
            with socket.socket(family, socket.SOCK_DGRAM) as udp:
                udp.connect((outside, PORT))  # which finds the way, and sends nothing
                return str(udp.getsockname()[0])
        except OSError:
            continue
    return local or "127.0.0.1"


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _bind(host: str) -> str:
    """Return where servers listen: on loopback if that is what others are given, else on all interfaces."""
    if _is_loopback(host):
        return "127.0.0.1" if host == "localhost" else host
    return "::" if ":" in host else "0.0.0.0"


def uri_of(scheme: str, host: str, port: int) -> str:
    """Return the URI of a server of this computer, `http://host:port/` or `rosrpc://host:port`."""
    return f"{scheme}://{_bracketed(host)}:{port}" + ("/" if scheme == "http" else "")


def _bracketed(host: str) -> str:
    return f"[{host}]" if ":" in host else host
