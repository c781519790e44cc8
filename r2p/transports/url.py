"""Transport URLs: `SCHEME:ADDRESS`, with options as `?baud=115200&x=1` or `,baud=115200` (shells expand a `?`).

The built-in schemes are a table of import strings, so that a transport's library is loaded only when it is used; other
packages add theirs through the entry-point group `r2p.transports`.
"""

import difflib
import importlib
import re
from collections.abc import Callable
from typing import TYPE_CHECKING, TypeVar, cast

import msgspec

from r2p import keys
from r2p.clock import duration as duration  # for the options of URLs
from r2p.errors import TransportError
from r2p.keys import SharedKey
from r2p.transports.link import Transport

if TYPE_CHECKING:
    from importlib.metadata import EntryPoints

T = TypeVar("T")

BUILT_IN = {
    "memory": "r2p.transports.memory:from_url",
    "tcp": "r2p.transports.tcp:TcpTransport",
    "tcp-listen": "r2p.transports.tcp:TcpListenTransport",
    "serial": "r2p.transports.serial:SerialTransport",
    "ros1": "r2p.ros.ros1.transport:from_url",
    "rtcan": "r2p.transports.rtcan.transport:from_url",
    "sim": "r2p.sim.transport:from_url",
    "zenoh": "r2p.transports.zenoh:from_url",
    "ros2": "r2p.ros.ros2:from_url",
    "dds": "r2p.ros.dds:from_url",
}

GROUP = "r2p.transports"

ROS = ("ros1", "ros2", "dds")
"""The schemes of links to ROS networks."""

_IP = frozenset({*ROS, "tcp", "tcp-listen", "zenoh"})

_OPTIONS = re.compile(r"[?,&]")
_CAN = re.compile(r"[a-z]*can[0-9]+")
_CAN_INTERFACES = ("r2psim", "slcan", "socketcan")  # of RTCAN's URLs: rtcan:slcan:/dev/ttyACM0
_TABLE_MAX = 1_000_000  # some 600 MB of topics
_CLOSE = 0.65  # how alike a name must be to be suggested (difflib): can and rtcan are 0.75


class Url(msgspec.Struct, frozen=True):
    """The parts of a transport's URL."""

    scheme: str
    address: str
    options: dict[str, str]

    def __str__(self) -> str:
        options = ",".join(f"{name}={value}" for name, value in self.options.items())
        return f"{self.scheme}:{self.address}" + (f",{options}" if options else "")

    def parsed(self, known: dict[str, Callable[[str], T]]) -> dict[str, T]:
        """Convert the options by `known`: name -> converter. Raises TransportError for an unknown or a bad one."""
        values: dict[str, T] = {}
        for name, value in self.options.items():
            if name not in known:
                options = ", ".join(sorted(known)) or "none"
                raise TransportError(f"{self.scheme}: has no option {name!r}; it knows: {options}")
            try:
                values[name] = known[name](value)
            except ValueError as error:
                raise TransportError(f"{self}: option {name}={value}: {error}") from error
        return values


def parse(text: str) -> Url:
    """Parse a URL. Raises TransportError if it has no scheme or an option without `=`."""
    scheme, colon, rest = text.partition(":")
    if not colon or not scheme:
        meant = f"rtcan:{text}" if _CAN.match(text) else f"serial:{text}" if text.startswith("/dev/") else ""
        hint = f"did you mean {meant}?" if meant else "for example tcp:192.168.0.10:23"
        raise TransportError(f"transport {text!r}: give it as SCHEME:ADDRESS, {hint}")
    address, *pairs = _OPTIONS.split(rest)
    options: dict[str, str] = {}
    for pair in filter(None, pairs):
        name, equals, value = pair.partition("=")
        if not equals:
            if ":" in pair:
                raise TransportError(f"transport {text!r}: is {pair} another URL? give each one its own --via")
            raise TransportError(f"transport {text!r}: option {pair!r} needs a value: {pair}=...")
        options[name] = value
    return Url(scheme, address, options)


def open_transport(text: str) -> Transport:
    """Return the transport of a URL, not running yet.

    Raises TransportError for an unknown scheme or option, and for an extra that is not installed.
    """
    url = parse(text)
    try:
        factory = _factory(url)
    except ImportError as error:
        raise TransportError(f"transport {url.scheme!r} can't be used here: {error}") from error
    return factory(url)


def schemes() -> list[str]:
    """Return all available schemes, those of other packages included."""
    return sorted({*BUILT_IN, *(entry.name for entry in _entry_points())})


def scheme_of(link: str) -> str:
    """Return the scheme of a link, by its name."""
    return link.partition(":")[0]


def is_ip(link: str) -> bool:
    """Return whether any computer of an IP network may reach a link (by name): REBOOT and changes need permission."""
    return scheme_of(link) in _IP


def is_ros(link: str) -> bool:
    """Return whether a link, by its name or URL, is one to a ROS network."""
    return scheme_of(link) in ROS


def one_of(*values: str) -> Callable[[str], str]:
    """Return a converter for an option that has one of these values."""

    def check(text: str) -> str:
        if text not in values:
            raise ValueError(f"use one of {', '.join(values)}")
        return text

    return check


def key_file(text: str) -> SharedKey:
    """Return the key in this file, of the option `key`."""
    return keys.load(text)


def table_size(text: str) -> int:
    """Return the number of entries in each table of discovery, of the option `topics`."""
    if not text.isdecimal() or not 0 < int(text) <= _TABLE_MAX:
        raise ValueError(f"give the number of topics that are kept, 1 to {_TABLE_MAX}")
    return int(text)


def yes_or_no(text: str) -> bool:
    """Return True for "yes" and False for "no"."""
    if text not in ("yes", "no"):
        raise ValueError("write yes or no")
    return text == "yes"


def _factory(url: Url) -> Callable[[Url], Transport]:
    if url.scheme in BUILT_IN:
        module, _, name = BUILT_IN[url.scheme].partition(":")
        return cast("Callable[[Url], Transport]", getattr(importlib.import_module(module), name))
    for entry in _entry_points():
        if entry.name == url.scheme:
            return cast("Callable[[Url], Transport]", entry.load())
    known = schemes()
    close = difflib.get_close_matches(url.scheme, known, n=1, cutoff=_CLOSE)
    if url.scheme in _CAN_INTERFACES:
        hint = f"; did you mean rtcan:{url}?"
    elif not close and url.address.isdecimal():  # HOST:PORT alone
        hint = f"; did you mean tcp:{url}?"
    else:
        hint = "".join(f"; did you mean {scheme}:{url.address}?" for scheme in close)
    raise TransportError(f"unknown transport {url.scheme!r}: use one of {', '.join(known)}{hint}")


def _entry_points() -> "EntryPoints":
    """The transports of other packages."""
    from importlib import metadata  # not at the top: it takes as long as the rest of r2p

    return metadata.entry_points(group=GROUP)
