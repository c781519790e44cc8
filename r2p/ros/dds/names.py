"""Names of ROS 2 in DDS, and what endpoints say of themselves in their user data. Nothing here does I/O.

| in ROS 2 | in DDS |
| --- | --- |
| topic `/robot1/scan` | `rt/robot1/scan` |
| type `sensor_msgs/LaserScan` | `sensor_msgs::msg::dds_::LaserScan_` |
| hash of the type | `typehash=RIHS01_...;` in the user data of the endpoint |
| enclave | `enclave=/;` in the user data of the participant |
"""

from r2p.errors import DecodeError
from r2p.ros.type_names import type_of_dds

TOPIC = "rt"
"""What stands before the names of topics; those of services begin with `rq` and `rr`."""
DISCOVERY = "ros_discovery_info"
"""The topic in which each participant publishes the names of its nodes."""
ENCLAVE = b"enclave=/;"


def dds_topic(name: str) -> str:
    """Return the name in DDS of a topic: `/scan` is `rt/scan`."""
    return f"{TOPIC}{name}"


def ros_topic(name: str) -> str:
    """Return the name of a topic in ROS; empty for one that is not a topic of ROS."""
    prefix, slash, rest = name.partition("/")
    return f"/{rest}" if prefix == TOPIC and slash and rest else ""


def ros_type(name: str) -> str:
    """Return the name here of a type in DDS; empty for one that is not of ROS."""
    try:
        return type_of_dds(name)
    except DecodeError:
        return ""


def user_data(checksum: str) -> bytes:
    """Return the user data of an endpoint of a type with this hash."""
    return f"typehash={checksum};".encode()


def checksum_in(data: bytes) -> str:
    """Return the type hash in an endpoint's user data; empty without one, as ROS 2 before Iron sends none."""
    for entry in data.rstrip(b"\0").decode(errors="replace").split(";"):
        key, _, value = entry.partition("=")
        if key == "typehash":
            return value
    return ""


def split_node(node: str) -> tuple[str, str]:
    """Return the namespace and the name of a node: `/robot1/arm` is "/robot1" and "arm"."""
    namespace, _, name = node.rpartition("/")
    return namespace or "/", name


def join_node(namespace: str, name: str) -> str:
    """Return the full name of a node."""
    return f"{namespace.rstrip('/')}/{name}"
