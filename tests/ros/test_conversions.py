"""Conversions between r2p's standard messages and ROS's, against the definitions and the code of rosbags."""

from typing import Any

import pytest
from rosbags.typesys import Stores, get_typestore

import r2p
from r2p import msg
from r2p.ros.cdr import cdr
from r2p.ros.conversions import PAIRS, Conversion, RosNames, conversion, standard_type
from r2p.runtime.sample import Source

STAMP = 1_700_000_000_123_456_789
NAMES = RosNames("prox_front", "/robot1", "PC")
SOURCE = Source("MOTOR1", "log")
STORES = {1: get_typestore(Stores.ROS1_NOETIC), 2: get_typestore(Stores.LATEST)}


def pair(ours: type[r2p.Message], version: int, theirs: str | None = None) -> Conversion:
    found = conversion(ours, theirs or standard_type(ours, version) or "", version, NAMES)
    assert found is not None
    return found


def in_ros(found: Conversion, message: r2p.Message, version: int, name: str) -> list[Any]:
    """The messages as another implementation reads them."""
    made = found.to_ros(message, STAMP, SOURCE)
    full = name.replace("/", "/msg/")
    if version == 1:
        return [STORES[1].deserialize_ros1(each.encode(), full) for each in made]
    return [STORES[2].deserialize_cdr(cdr(found.theirs).encode(each), full) for each in made]


def test_a_class_with_another_name_or_other_fields_is_not_converted() -> None:
    class IMU(r2p.Message):
        roll: r2p.f32 = 0.0

    class Other(r2p.Message, name="r2p_msgs/IMU"):
        roll: r2p.f32 = 0.0

    for cls in (IMU, Other, msg.LaserScan, msg.IMURaw9, msg.Led):
        assert standard_type(cls, 2) is None
        assert conversion(cls, "sensor_msgs/Imu", 2) is None
    assert conversion(msg.IMU, "sensor_msgs/BatteryState", 1) is None


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("row", PAIRS, ids=lambda row: f"{row.ours.__name__}-{row.ros2}")
def test_each_pair_has_its_bytes_in_both_versions(row: Any, version: int) -> None:
    found = pair(row.ours, version, row.theirs(version))
    for each in in_ros(found, row.ours(), version, row.theirs(version)):
        if hasattr(each, "header"):
            assert (each.header.stamp.sec, each.header.stamp.nanosec) == divmod(STAMP, 10**9)
