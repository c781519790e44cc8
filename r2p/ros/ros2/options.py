"""The options of a `ros2:` URL, the environment that programs of ROS 2 heed, and zenoh's configuration for both.

The configuration consists of what rmw_zenoh needs, then the user's file, then ZENOH_CONFIG_OVERRIDE, then the URL.
Later ones take precedence.
"""

import json
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from r2p.errors import TransportError
from r2p.ros.options import URL_OPTIONS, RosOptions, domain, domain_of, from_parsed
from r2p.transports.url import Url, one_of
from r2p.transports.zenoh.config import ZenohOptions, build_config, connection_settings, endpoint_text, plain_text

if TYPE_CHECKING:  # imported when it is used: a URL can be checked without zenoh
    import zenoh

DEFAULT_ENDPOINT = "tcp/localhost:7447"
"""Where rmw_zenoh expects its router."""

_NEEDED = {"timestamping/enabled": "true"}
"""Without it there are no transient local publishers: what they keep is in the order of its stamps."""

_WITHOUT_A_FILE = {"scouting/multicast/enabled": "false"}
"""As in rmw_zenoh's own configuration."""


class Ros2Options(msgspec.Struct, frozen=True):
    """A checked URL, with what the environment adds to it."""

    name: str
    """The URL without its options."""
    domain: int
    zenoh: ZenohOptions
    ros: RosOptions = RosOptions()
    overrides: dict[str, str] = {}
    """Keys of zenoh's configuration, and their values in JSON5, of ZENOH_CONFIG_OVERRIDE."""

    def error(self, text: str) -> TransportError:
        """Return an error that begins with the URL."""
        return self.zenoh.error(text)


def parse_options(url: Url, environ: Mapping[str, str] = os.environ) -> Ros2Options:
    """Parse and check a URL. Raises TransportError."""
    given = url.parsed(URL_OPTIONS | PARSERS)
    ros = from_parsed(given)
    endpoint = url.address or None
    if endpoint is not None:
        try:
            endpoint_text(endpoint)
        except ValueError as error:
            raise TransportError(f"{url}: {error}") from None
    name = f"{url.scheme}:{url.address}"
    config = given.get("config") or environ.get("ZENOH_SESSION_CONFIG_URI") or None
    zenoh = ZenohOptions(
        name=name,
        mode=given.get("mode", "client"),
        connect=endpoint,
        shm=None if "shm" not in given else given["shm"] == "on",
        config=None if config is None else Path(config),
    )
    domain = domain_of(url, given, environ)
    return Ros2Options(name, domain, zenoh, ros, _overrides(environ.get("ZENOH_CONFIG_OVERRIDE", "")))


def zenoh_config(options: Ros2Options) -> "zenoh.Config":
    """Return zenoh's configuration. Raises TransportError for a file or an override that zenoh can't read."""
    import zenoh

    config = build_config(options.zenoh)
    _insert(config, _NEEDED | (_WITHOUT_A_FILE if options.zenoh.config is None else {}))
    chosen = {"mode"} | ({"connect/endpoints"} if options.zenoh.connect is not None else set())
    try:
        _insert(config, {key: value for key, value in options.overrides.items() if key not in chosen})
        if options.zenoh.mode == "client":  # rmw_zenoh's file also makes a session listen
            _insert(config, {"listen/endpoints": "[]"})
        may_be_alone = options.zenoh.mode == "peer" and options.zenoh.config is not None
        if not connection_settings(config).endpoints and not may_be_alone:
            _insert(config, {"connect/endpoints": json.dumps([DEFAULT_ENDPOINT])})
    except zenoh.ZError as error:
        raise options.error(f"ZENOH_CONFIG_OVERRIDE: zenoh rejects this: {plain_text(error)}") from error
    return config


def _insert(config: "zenoh.Config", settings: Mapping[str, str]) -> None:
    for key, value in settings.items():
        config.insert_json5(key, value)


def _overrides(text: str) -> dict[str, str]:
    """Return the settings in `KEY=VALUE;KEY=VALUE`. Raises TransportError."""
    found: dict[str, str] = {}
    for each in filter(None, map(str.strip, text.split(";"))):
        key, equals, value = each.partition("=")
        if not equals:
            raise TransportError(f"ZENOH_CONFIG_OVERRIDE: write KEY=VALUE instead of {each!r}")
        found[key.strip()] = value.strip()
    return found


PARSERS: dict[str, Callable[[str], Any]] = {
    "domain": domain,
    "mode": one_of("client", "peer"),
    "config": str,
    "shm": one_of("on", "off"),
}
"""The options of the URL that other ROS links do not have, and what converts them."""
