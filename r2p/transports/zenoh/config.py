"""zenoh's configuration for a link: what r2p needs, then the user's file, then what the URL says."""

import json
import re

import zenoh

from r2p.transports.zenoh.options import Options
from r2p.transports.zenoh.trouble import Tls, Way

LEASE_MS = 1000
"""A peer that says nothing for so long is gone: one that hangs is noticed within two seconds."""

_OURS: dict[str, object] = {
    "scouting/delay": 0,  # else opening takes half a second
    "transport/link/tx/lease": LEASE_MS,
    "connect/retry": {"period_init_ms": 100, "period_max_ms": 500, "period_increase_factor": 2},
    "connect/exit_on_failure": {"router": False, "peer": False, "client": True},
    "transport/unicast/open_timeout": 3000,
    "transport/link/tx/queue/size/data": 16,  # batches of 64 kB: what r2p.protocols.flow allows to be on the way fits
    # Urgent messages are batches of their own: what comes while zenoh's threads do not get to run fits.
    "transport/link/tx/queue/size/interactive_high": 16,
    "transport/link/tx/queue/size/real_time": 16,
}

_USUAL = ["tcp/[::]:7447"]
"""Where the first peer on a computer listens, so that clients find it without a router."""

_ANY_PORT: dict[str, object] = {  # the others; where there is no IPv6, not even that
    "listen/endpoints": ["tcp/[::]:0"],
    "listen/exit_on_failure": False,
}

_LOOPBACK = re.compile(r"(unix|serial|vsock)|[a-z]+/(localhost|127\.[0-9.]+|\[::1\]):")
"""Endpoints that other computers do not reach by a network."""

_LISTENS: dict[str, object] = {
    # This session's own, which tells where it listens. Not for clients: zenoh keeps 37 kB for ever of each session that
    # is closed with one.
    "adminspace/enabled": True,
}


def config_of(options: Options) -> zenoh.Config:
    """Raises TransportError for a file that zenoh can't read, and for what it does not take."""
    config = _from_file(options)
    try:
        for key, value in _stated(options).items():
            config.insert_json5(key, json.dumps(value))
    except zenoh.ZError as error:
        raise options.error(f"zenoh does not take this: {_words(error)}") from error
    return config


def take_any_port(config: zenoh.Config, options: Options) -> bool:
    """Listen at any port, as the usual one can't be had. False where a place was asked for, or it was tried already."""
    if not _may_choose(options) or json.loads(config.get_json("listen/endpoints")) != _USUAL:
        return False
    for key, value in _ANY_PORT.items():
        config.insert_json5(key, json.dumps(value))
    return True


def open_to_all(config: zenoh.Config) -> list[str]:
    """The endpoints where it takes connections of other computers without asking who they are."""
    if (
        json.loads(config.get_json("mode")) == "client"
        or json.loads(config.get_json("transport/auth/usrpwd"))["dictionary_file"]
    ):
        return []
    certified = ("tls/", "quic/") if json.loads(config.get_json("transport/link/tls"))["enable_mtls"] else ()
    return [each for each in way_of(config).listens if not each.startswith(certified) and not _LOOPBACK.match(each)]


def way_of(config: zenoh.Config) -> Way:
    """What it connects to, and with what; and where it listens."""
    tls = json.loads(config.get_json("transport/link/tls"))
    user = json.loads(config.get_json("transport/auth/usrpwd"))
    names = Tls(
        tls["root_ca_certificate"],
        tls["connect_certificate"],
        tls["connect_private_key"],
        tls["verify_name_on_connect"] is not False,
    )
    connects, listens = (json.loads(config.get_json(f"{what}/endpoints")) for what in ("connect", "listen"))
    if isinstance(listens, dict):
        listens = listens.get(json.loads(config.get_json("mode")) or "peer", [])
    return Way(_texts(connects), names, user["user"], _texts(listens))


def _from_file(options: Options) -> zenoh.Config:
    config = zenoh.Config()
    ours = _OURS if options.mode == "client" else _OURS | _LISTENS
    for key, value in ours.items():
        config.insert_json5(key, json.dumps(value))
    if options.config is None:
        return config
    try:
        theirs = zenoh.Config.from_file(options.config)
    except (zenoh.ZError, OSError) as error:
        reason = "there is no such file" if not options.config.exists() else _words(error)
        raise options.error(f"can't read {options.config}: {reason}") from error
    blank = zenoh.Config()
    for key, value in ours.items():
        if theirs.get_json(key) == blank.get_json(key):  # what the file says counts
            theirs.insert_json5(key, json.dumps(value))
    return theirs


def _stated(options: Options) -> dict[str, object]:
    stated: dict[str, object] = {}
    if options.mode is not None:
        stated["mode"] = options.mode
    if options.connect is not None:
        stated["connect/endpoints"] = [options.connect]
    if options.listen is not None:
        stated["listen/endpoints"] = [options.listen]
    elif _may_choose(options):
        stated["listen/endpoints"] = _USUAL
    if options.scouting is not None:
        stated["scouting/multicast/enabled"] = options.scouting
    return stated


def _may_choose(options: Options) -> bool:
    """Whether it is left to us where to listen."""
    return options.listen is None and options.mode == "peer" and options.config is None


def _words(error: Exception) -> str:
    """zenoh's text without its own places, and with that in the file, if it tells it, in front."""
    text = re.sub(r" at /\S+?\.rs:\d+\.?", "", str(error)).strip()
    found = re.search(r'msg: "(.*)", location: Some\(Location \{ line: (\d+), column: (\d+)', text, re.DOTALL)
    return f"line {found[2]}, column {found[3]}: {found[1]}" if found else text


def _texts(value: object) -> list[str]:
    """The endpoints in a list, or in a list for each mode."""
    if isinstance(value, dict):
        return [text for each in value.values() for text in _texts(each)]
    if not isinstance(value, list):
        return []
    return [each if isinstance(each, str) else str(each.get("endpoint", "")) for each in value]
