"""How ROS writes the names of types.

| where | a message | a service | a part of an action |
| --- | --- | --- | --- |
| here, and in ROS 1 | `sensor_msgs/Imu` | `std_srvs/SetBool` | `dock_msgs/action/Dock_Goal` |
| ROS 2 | `sensor_msgs/msg/Imu` | `std_srvs/srv/SetBool` | `dock_msgs/action/Dock_Goal` |
| DDS, and zenoh's keys | `sensor_msgs::msg::dds_::Imu_` | `std_srvs::srv::dds_::SetBool_` | `...::action::dds_::...` |
"""

import re

from r2p.errors import DecodeError, MessageError
from r2p.messages import show

NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
"""The name of a package, a type or a field."""

_OF_DDS = re.compile(r"([A-Za-z][A-Za-z0-9_]*)::(msg|srv|action)::(?:dds_::)?([A-Za-z][A-Za-z0-9_]*?)_?")
_PARTS_OF_ACTIONS = ("_SendGoal", "_GetResult", "_FeedbackMessage")


def short_name(name: str) -> str:
    """Return the name of a type as `package/Name`, also of one as ROS 2 writes it. Raises MessageError."""
    package, *kind, last = name.split("/") if "/" in name else ("", name)
    if not (NAME.fullmatch(package) and NAME.fullmatch(last) and kind in ([], ["msg"], ["srv"], ["action"])):
        raise MessageError(f"{show(name)} is not the name of a ROS type, such as sensor_msgs/Imu")
    return f"{package}/{last}"


def ros2_name(name: str, kind: str = "msg") -> str:
    """Return the name of a type as ROS 2 writes it; `kind` is "msg" or "srv", where the name does not have it."""
    return name if name.count("/") > 1 else name.replace("/", f"/{kind}/")


def dds_type(name: str, *, service: bool = False) -> str:
    """Return the name in DDS of `std_msgs/String` or `std_msgs/msg/String`: `std_msgs::msg::dds_::String_`."""
    package, *kind, last = name.split("/")
    default = "action" if last.endswith(_PARTS_OF_ACTIONS) else "srv" if service else "msg"
    return f"{package}::{kind[0] if kind else default}::dds_::{last}_"


def type_of_dds(type: str) -> str:
    """Return the name of a type in DDS as it is here: `std_msgs/String`. Raises DecodeError."""
    found = _OF_DDS.fullmatch(type)
    if found is None:
        raise DecodeError(f"{type[:80]!r} is not a type of ROS 2")
    package, kind, name = found.groups()
    return f"{package}/action/{name}" if kind == "action" else f"{package}/{name}"
