"""What the two ends of a ROS connection compare: the md5 sum of a type in ROS 1, its hash in ROS 2."""

from r2p.errors import MessageError
from r2p.messages import Message, layout
from r2p.ros.classes import RosTypes, definitions_of
from r2p.ros.definitions import Definitions, md5
from r2p.ros.hashes import TypeDescriptions
from r2p.ros.library import definitions_of_ros
from r2p.ros.packages import OF_ROS


def ros1_md5(cls: type[Message]) -> str:
    """Return the md5 sum of a message class in ROS 1. Raises MessageError for a type that ROS can't define."""
    return md5(layout(cls).name, _definitions(cls, 1))


def ros2_hash(cls: type[Message]) -> str:
    """Return the hash of a message class in ROS 2. Raises MessageError for a type that ROS can't define."""
    return TypeDescriptions(_definitions(cls, 2)).hash(layout(cls).name)


def _definitions(cls: type[Message], version: int) -> Definitions:
    """Return ROS's own definitions of a type that comes with it, as they have constants and bounds; else the class's.

    Raises MessageError if rosbags is missing, which has these, or if ROS has other fields in this type.
    """
    shape = layout(cls)
    if shape.name.partition("/")[0] not in OF_ROS:
        return definitions_of(cls, version)
    found = definitions_of_ros(shape.name, version)
    theirs = layout(RosTypes(version, found).load(shape.name))
    if theirs.schema != shape.schema:
        raise MessageError(f"{shape.name} of ROS {version} has other fields than {cls.__name__}")
    return found
