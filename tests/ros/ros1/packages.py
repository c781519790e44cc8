"""The Debian packages with real ROS 1 programs, and how to run those; `python -m tests.debian` gets them."""

from __future__ import annotations

import os
import sys
from pathlib import Path

from tests.uml.packages import cache

PACKAGES = {
    "python3-rosmaster": "bin/rosmaster",
    "python3-rostopic": "bin/rostopic",
    "python3-rosservice": "bin/rosservice",
    "python3-rosnode": "bin/rosnode",
    "python3-rosparam": "bin/rosparam",
    "python3-rosbag": "bin/rosbag",
    "rosout": "lib/rosout/rosout",
    "topic-tools": "lib/topic_tools/relay",
    "python3-rospy": "lib/python3/dist-packages/rospy",
    "python3-std-srvs": "lib/python3/dist-packages/std_srvs",
    "python3-geometry-msgs": "lib/python3/dist-packages/geometry_msgs",
    "python3-nav-msgs": "lib/python3/dist-packages/nav_msgs",
    "python3-sensor-msgs": "lib/python3/dist-packages/sensor_msgs",
    "python3-diagnostic-msgs": "lib/python3/dist-packages/diagnostic_msgs",
    "python3-tf2-msgs": "lib/python3/dist-packages/tf2_msgs",
}
"""Debian's packages, and something of each below /usr."""

PYTHON = "/usr/bin/python3"
"""Debian's modules are made for Debian's Python, which is not always that of the tests."""


def find() -> Path | str:
    """The folder that stands for /usr, or why there is none: one line for those who read that tests are skipped."""
    if sys.platform != "linux":
        return "the peers of ROS 1 are Debian's"
    folders = (Path("/usr"), cache() / "usr")
    for folder in folders:
        if not _missing(folder):
            return folder
    lacking = [_missing(folder) for folder in folders]
    fewest = min(lacking, key=len)
    return f"ROS 1 needs {' '.join(fewest)}: apt install {' '.join(fewest)}, or run make system"


def _missing(folder: Path) -> list[str]:
    return [package for package, file in PACKAGES.items() if not (folder / file).exists()]


def environment(usr: Path) -> dict[str, str]:
    """The variables with which programs below `usr` find each other."""
    if usr == Path("/usr"):
        return {}
    libraries = [path for folder in sorted((usr / "lib").glob("*-linux-gnu")) for path in (folder, *_folders(folder))]
    return {
        "PYTHONPATH": str(usr / "lib/python3/dist-packages"),
        "LD_LIBRARY_PATH": os.pathsep.join(map(str, libraries)),
        "ROS_PACKAGE_PATH": str(usr / "share"),
        "CMAKE_PREFIX_PATH": str(usr),
    }


def _folders(folder: Path) -> list[Path]:
    return sorted(path for path in folder.iterdir() if path.is_dir() and any(path.glob("*.so.*")))
