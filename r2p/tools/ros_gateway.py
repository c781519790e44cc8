"""The options of a gateway to ROS: which types topics have, and how they are shown there."""

from typing import Annotated, Any

import msgspec
import typer

import r2p
from r2p.tools.options import topic_pairs
from r2p.tools.session import Settings, UsageError
from r2p.tools.types import Types, is_service, load_service, load_type
from r2p.transports.url import is_ros, open_transport

_Pairs = list[str] | None

Type = Annotated[
    _Pairs, typer.Option("--type", metavar="TOPIC=TYPE", help="The type of a topic, for ROS: as --type elsewhere.")
]
RosType = Annotated[
    _Pairs, typer.Option(metavar="TOPIC=PKG/NAME", help="The type of a topic on ROS, not the usual one (repeatable).")
]
Qos = Annotated[
    _Pairs, typer.Option(metavar="TOPIC=QOS", help="On ROS: best_effort, transient_local, depth:5, ... joined by +.")
]
RosNodes = Annotated[
    bool, typer.Option("--ros-nodes", help="Show each node behind the gateway as a ROS node /MODULE/NODE.")
]


class RosGatewayOptions(msgspec.Struct, frozen=True):
    """The options as the user has given them."""

    types: _Pairs = None
    ros_types: _Pairs = None
    qos: _Pairs = None
    ros_nodes: bool = False


def open_links(settings: Settings, given: RosGatewayOptions) -> list[Any]:
    """Return the URLs of the settings, and in place of those to ROS their transports, with these options.

    Raises UsageError for options that can't be, or that have no effect, as no link leads to ROS.
    """
    if not any(map(is_ros, settings.via)):
        for option, value in (("--type", given.types), ("--ros-type", given.ros_types), ("--qos", given.qos)):
            if value:
                raise UsageError(f"{option} {value[0]} is for links to ROS, and there is none: add --via ros2:")
        if given.ros_nodes:
            raise UsageError("--ros-nodes is for links to ROS, and there is none: add --via ros2:")
        return list(settings.via)
    return [_opened(url, _options(settings, given)) if is_ros(url) else url for url in settings.via]


def _opened(url: str, options: Any) -> Any:
    from r2p.ros.transport import ros_transport  # only where it is used: it takes as long as the rest of the command

    return ros_transport(open_transport(url), options)


def _options(settings: Settings, given: RosGatewayOptions) -> Any:
    from r2p.ros.options import RosOptions, qos_change

    types = _stated_types(settings)
    for topic, text in topic_pairs(given.types, "--type", "TOPIC=TYPE"):
        types[topic] = _load(topic, text, settings)
    ros_types = {topic: _ros_type(text) for topic, text in topic_pairs(given.ros_types, "--ros-type", "TOPIC=PKG/NAME")}
    qos = {}
    for topic, text in topic_pairs(given.qos, "--qos", "TOPIC=QOS"):
        try:
            qos[topic] = qos_change(text)
        except ValueError as error:
            raise UsageError(f"--qos {topic}: {error}") from error
    return RosOptions(types=types, ros_types=ros_types, qos=qos, ros_nodes=given.ros_nodes)


def _stated_types(settings: Settings) -> dict[str, Any]:
    """Return the types in [types]. Raises UsageError."""
    found = {}
    for topic, text in settings.types.items():
        try:
            found[topic] = _load(topic, text, settings)
        except UsageError as error:
            raise UsageError(f"[types] {topic}: {error}") from error
    return found


def _load(topic: str, text: str, settings: Settings) -> Any:
    """Return the class of a message; of a service the class with its two types."""
    if not is_service(text):
        return Types(settings).load(text) if "/" in text and ":" not in text else load_type(text)
    definition = load_service(topic, text)
    parts = {"Request": definition.request.cls, "Response": definition.response.cls}
    return type(topic.rpartition("/")[2], (r2p.Service,), parts)


def _ros_type(text: str) -> str:
    parts = text.split("/")
    if len(parts) not in (2, 3) or not all(parts):
        raise UsageError(f"--ros-type: {text!r} is not the name of a ROS type, such as sensor_msgs/Imu")
    return text
