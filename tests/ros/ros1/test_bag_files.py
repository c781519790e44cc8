"""The recordings that r2p writes for ROS 1, as Debian's rosbag reads them."""

from __future__ import annotations

import json
import os
import subprocess
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import pytest

from r2p.messages import layout
from r2p.recording.convert.formats import convert
from r2p.recording.convert.stream import ConversionOptions
from r2p.ros.classes import standard_classes
from tests.recording.convert.samples import MESSAGES, START, record, same
from tests.ros.ros1 import packages

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = [pytest.mark.processes, pytest.mark.xdist_group("ros1")]

READ = """
import json, sys, rosbag

def plain(value):
    if hasattr(value, "secs"):
        return {"sec": value.secs, "nsec": value.nsecs}
    if hasattr(value, "__slots__"):
        return {name: plain(getattr(value, name)) for name in value.__slots__}
    return [plain(each) for each in value] if isinstance(value, (bytes, list, tuple)) else value

with rosbag.Bag(sys.argv[1]) as bag:
    for topic, message, time, header in bag.read_messages(return_connection_header=True):
        caller = header["callerid"]
        caller = caller.decode() if isinstance(caller, bytes) else caller
        print(json.dumps([topic, message._type, time.to_nsec(), caller, plain(message)]))
"""


def read(usr: Path, path: Path) -> list[Any]:
    environment = {**os.environ, **packages.environment(usr)}
    done = subprocess.run(
        [packages.PYTHON, "-c", READ, str(path)],
        env=environment,
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    return [json.loads(line, object_hook=lambda fields: SimpleNamespace(**fields)) for line in done.stdout.splitlines()]


def test_rosbag_reads_all_types(ros1_usr: Path, tmp_path: Path) -> None:
    convert(record(tmp_path / "drive.mcap"), tmp_path / "drive.bag")
    found = read(ros1_usr, tmp_path / "drive.bag")
    assert len(found) == 2 * len(MESSAGES)
    for topic, kind, time, caller, message in found:
        ours = MESSAGES[topic.removeprefix("/")]
        assert caller == "/IMU/led"
        assert layout(standard_classes()[kind]).schema == layout(type(ours)).schema  # rosbag mixes up types like this
        assert START <= time < START + 10**9
        assert same(ours, message), topic


def test_rosbag_reads_standard_types(ros1_usr: Path, tmp_path: Path) -> None:
    options = ConversionOptions(topics=("t_r2p_msgs_odometry",), ros=True)
    convert(record(tmp_path / "drive.mcap"), tmp_path / "drive.bag", options)
    first, _ = read(ros1_usr, tmp_path / "drive.bag")
    assert first[1] == "nav_msgs/Odometry"
    assert same(MESSAGES["t_r2p_msgs_odometry"].pose.x, first[4].pose.pose.position.x)  # type: ignore[attr-defined]
