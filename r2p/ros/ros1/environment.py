"""Where the master and this computer are: `ROS_MASTER_URI`, `ROS_HOSTNAME`, `ROS_IP` (skeleton)."""

import msgspec


class RosAddress(msgspec.Struct, frozen=True):
    """The master's URI, the host that others reach this computer by, and the one that servers listen at."""

    master: str
    host: str
    bind: str
