"""The options of a link to a ROS network, given in its URL, on the command line, or in a program.

via="ros2:tcp/localhost:7447?domain=3&ns=/robot1"
RosOptions(types={"pose": Pose}, ros_types={"imu": "sensor_msgs/Imu"}, qos={"scan": QosChange(depth=1)})
"""

import re
from collections.abc import Callable, Mapping
from fnmatch import fnmatchcase
from typing import Any, TypeVar

import msgspec

from r2p.clock import duration
from r2p.errors import TransportError
from r2p.ros.middleware import Qos
from r2p.transports.url import Url, yes_or_no
from r2p.units import SECOND

ABSOLUTE = ("clock", "diagnostics", "diagnostics_agg", "parameter_events", "rosout", "tf", "tf_static")
"""Topics that ROS has once for all robots: no namespace is put before their names."""

DOMAIN_MAX = 232
"""The highest domain of ROS 2: those above have no ports in DDS."""

T = TypeVar("T")

_NAMESPACE = re.compile(r"(/[A-Za-z][A-Za-z0-9_]*)+")
_FLAGS = {
    "reliable": ("reliable", True),
    "best_effort": ("reliable", False),
    "transient_local": ("transient_local", True),
    "volatile": ("transient_local", False),
}
_QOS_FORM = "write reliable, best_effort, transient_local, volatile, depth:N, deadline:10ms or lifespan:1s, joined by +"


class QosChange(msgspec.Struct, frozen=True, kw_only=True):
    """The parts of a quality of service that are to differ from what follows from the publisher or subscriber."""

    reliable: bool | None = None
    transient_local: bool | None = None
    depth: int | None = None
    deadline: int | None = None
    lifespan: int | None = None

    def apply(self, qos: Qos) -> Qos:
        """Return a quality of service with these parts."""
        given = {name: value for name, value in msgspec.structs.asdict(self).items() if value is not None}
        return msgspec.structs.replace(qos, **given)


class RosOptions(msgspec.Struct, frozen=True, kw_only=True):
    """What to do differently on one link to a ROS network. The keys of all tables are topics, or patterns for them.

    `ns` is the namespace of this side's topics and nodes (`/robot1`), except for topics in `absolute`, by their names
    without the first slash. `types` has the classes of topics and services that no node here has a class for, and
    `ros_types` the full names of the ROS types that topics are to have there. `qos` changes the quality of service.
    With `ros_nodes` each node behind a gateway is shown as a ROS node of its own.

    `remappings` are other full names on the ROS network for topics and services, by the full names that they would have
    (`{"/chatter": "/talk"}`). `node_name` is the name there of the program: of its first node, and the beginning of the
    names of others (`left`, `left_other`).
    """

    ns: str = ""
    absolute: tuple[str, ...] = ABSOLUTE
    types: Mapping[str, type[Any]] = {}
    ros_types: Mapping[str, str] = {}
    qos: Mapping[str, QosChange] = {}
    ros_nodes: bool = False
    remappings: Mapping[str, str] = {}
    node_name: str = ""


def merged(options: RosOptions, others: RosOptions) -> RosOptions:
    """Return options with those of `others` that are not the default."""
    default = RosOptions()
    given = {name: getattr(others, name) for name in others.__struct_fields__}
    return msgspec.structs.replace(
        options, **{name: value for name, value in given.items() if value != getattr(default, name)}
    )


def lookup(table: Mapping[str, T], topic: str) -> T | None:
    """Return the entry of a topic: its own, else that of the first pattern that it matches."""
    found = table.get(topic)
    if found is None and table:
        return next((value for pattern, value in table.items() if fnmatchcase(topic, pattern)), None)
    return found


def namespace(text: str) -> str:
    """Return a valid namespace. Raises ValueError."""
    text = text.rstrip("/")
    if text and not text.startswith("/"):
        text = f"/{text}"
    if text and not _NAMESPACE.fullmatch(text):
        raise ValueError("a namespace is letters, digits and underscores, and begins with a letter: /robot1")
    return text


def qos_change(text: str) -> QosChange:
    """Return the change of `best_effort+depth:5`. Raises ValueError."""
    given: dict[str, Any] = {}
    for part in text.split("+"):
        name, colon, value = part.partition(":")
        if part in _FLAGS:
            given.update([_FLAGS[part]])
        elif name == "depth" and value.isdecimal() and len(value) < 6:
            given["depth"] = int(value)
        elif name in ("deadline", "lifespan") and colon:
            given[name] = round(duration(value) * SECOND)
        else:
            raise ValueError(f"{part!r} is not a quality of service: {_QOS_FORM}")
    return QosChange(**given)


def domain(text: str) -> int:
    """Return a domain of ROS 2. Raises ValueError."""
    if not text.isascii() or not text.isdecimal() or len(text) > len(str(DOMAIN_MAX)) or int(text) > DOMAIN_MAX:
        raise ValueError(f"a domain of ROS is a number from 0 to {DOMAIN_MAX}")
    return int(text)


def domain_of(url: Url, parsed: Mapping[str, Any], environ: Mapping[str, str]) -> int:
    """Return the domain of a URL's options, else that of ROS_DOMAIN_ID, else 0. Raises TransportError."""
    if "domain" in parsed:
        return int(parsed["domain"])
    text = environ.get("ROS_DOMAIN_ID", "")
    try:
        return domain(text) if text else 0
    except ValueError as error:
        raise TransportError(f"{url}: ROS_DOMAIN_ID={text}: {error}") from None


URL_OPTIONS: dict[str, Callable[[str], Any]] = {"ns": namespace, "ros_nodes": yes_or_no}
"""The options that URLs of all ROS links have, and what reads them: `Url.parsed(URL_OPTIONS | {...})`."""


def from_parsed(parsed: dict[str, Any]) -> RosOptions:
    """Return the options of a parsed URL, and remove them there: what is left is the transport's own."""
    return RosOptions(**{name: parsed.pop(name) for name in URL_OPTIONS if name in parsed})
