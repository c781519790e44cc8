"""Conversions between r2p's standard messages and ROS's, against the definitions and the code of rosbags."""

import contextlib
import math
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_typestore

import r2p
from r2p import msg
from r2p.messages import message_type
from r2p.msg import Battery, Log, Odometry, Pose3, Proximity, StampedIMU, Text, Timestamp, Velocity3
from r2p.names import module_alias
from r2p.ros.cdr import cdr
from r2p.ros.conversions import PAIRS, Conversion, RosNames, conversion, standard_type
from r2p.ros.reports import owner_of
from r2p.ros.standard import angles, quaternion
from r2p.runtime.sample import Source
from tests.docs.blocks import ROOT
from tests.ros.recorded import recorded

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


CASES: list[tuple[r2p.Message, dict[str, Any]]] = [
    (
        StampedIMU(Timestamp(1), roll=0.1, pitch=-0.2, yaw=math.pi / 2, roll_rate=1.0, pitch_rate=2.0, yaw_rate=-3.0),
        {
            "header.frame_id": "robot1/base_link",
            "orientation.y": -0.03534,  # the product of three rotations about one axis each
            "orientation.z": 0.70622,
            "orientation.w": 0.69917,
            "angular_velocity.z": -3.0,
            "linear_acceleration_covariance.0": -1.0,  # ROS's "this sensor has none"
        },
    ),
    (
        Odometry(Pose3(1.0, 2.0, -math.pi / 2), Velocity3(0.5, -0.25, 0.125)),
        {
            "header.frame_id": "robot1/odom",
            "child_frame_id": "robot1/base_link",
            "pose.pose.position.y": 2.0,
            "pose.pose.orientation.z": -math.sqrt(0.5),
            "twist.twist.linear.y": -0.25,
            "twist.twist.angular.z": 0.125,
        },
    ),
    (
        Battery(voltage=11_100, current=1500, charge=87, remaining=42),
        {"voltage": 11.1, "current": -1.5, "percentage": 0.87, "power_supply_status": 2, "present": True},
    ),
    (Battery(current=-700, charge=255), {"current": 0.7, "percentage": math.nan, "power_supply_status": 1}),
    (
        msg.GPS(45.5, 9.25, 120.0, hdop=90, satellites=9, fix=4),
        {"latitude": 45.5, "altitude": 120.0, "status.status": 2, "position_covariance.0": 20.25},
    ),
    (msg.Pressure(101_325.0, 0.0), {"fluid_pressure": 101_325.0, "header.frame_id": "robot1/prox_front"}),
    (Velocity3(1.0, -2.0, 0.5), {"linear.x": 1.0, "linear.y": -2.0, "angular.z": 0.5}),
    (
        msg.PowerEvent(crossed=5, exceeded=5, voltage=9000, current=4000),
        {"status.0.level": 2, "status.0.message": "low voltage, high current", "status.0.values.0.value": "9 V"},
    ),
    (
        msg.GatewayStatus(source="rtcan:can0", state="down", forwarded=7),
        {"status.0.level": 2, "status.0.name": "MOTOR1: link rtcan:can0", "status.0.values.0.value": "7"},
    ),
    (
        msg.BusTraffic(bus="rtcan:can0", kind="total", share=0.5, free_used=0.9),
        {"status.0.level": 1, "status.0.message": "events wait long", "status.0.values.0.value": "50.0%"},
    ),
]


def leaf(message: Any, path: str) -> Any:
    for part in path.split("."):
        message = message[int(part)] if part.isdecimal() else getattr(message, part)
    return message


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize(("message", "expected"), CASES, ids=lambda each: type(each).__name__)
def test_units_signs_and_frames(message: r2p.Message, expected: dict[str, Any], version: int) -> None:
    name = standard_type(type(message), version) or ""
    (found,) = in_ros(pair(type(message), version), message, version, name)
    for path, value in expected.items():
        seen = leaf(found, path)
        seen = seen[0] if isinstance(seen, bytes) else int(seen) if path.endswith("level") else seen  # ROS 2's byte
        assert seen == (pytest.approx(value, abs=1e-4, nan_ok=True) if isinstance(value, float) else value), path


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize(
    "message",
    [
        *(message for message, _ in CASES[:6]),
        msg.StampedVelocity3(Timestamp(9), 1.0, 2.0, 3.0),
        msg.StampedPose3(Timestamp(9), 1.0, 2.0, -3.0),
        Log(Timestamp(9), 40, "MOTOR1", "pid", "hot"),
        msg.Float32(0.5),
        Text("hello"),
    ],
    ids=lambda each: type(each).__name__,
)
def test_there_and_back(message: Any, version: int) -> None:
    """What both types have is the same again; the stamps are those of the header, and the rest is unknown."""
    found = pair(type(message), version)
    (made,) = found.to_ros(message, STAMP, SOURCE)
    again: Any = found.from_ros(found.theirs.decode(made.encode()))
    for field in r2p.layout(type(message)).fields:
        before, after = getattr(message, field.name), getattr(again, field.name)
        if field.name in ("timestamp", "stamp"):
            assert after.ns == STAMP
        elif field.name not in ("remaining", "speed", "course", "satellites"):
            assert numbers(after) == pytest.approx(numbers(before), abs=1e-6), field.name


def numbers(value: Any) -> Any:
    """The fields of a message in a message, in a row."""
    return list(msgspec.structs.astuple(value)) if isinstance(value, r2p.Message) else value


def test_four_ranges_and_one_of_them() -> None:
    found = pair(Proximity, 2)
    made = in_ros(found, Proximity(ranges=(100, 65_535, 0, 2500)), 2, "sensor_msgs/Range")
    assert [each.range for each in made] == [pytest.approx(0.1), math.inf, 0.0, 2.5]
    assert [each.header.frame_id for each in made] == [f"robot1/prox_front_{place}" for place in range(4)]
    assert all(each.radiation_type == 1 and each.min_range <= each.max_range == pytest.approx(65.534) for each in made)
    back = [found.from_ros(each) for each in found.to_ros(Proximity(ranges=(100, 65_535, 0, 2500)), STAMP, SOURCE)]
    assert back == [
        Proximity((100, *(65_535,) * 3)),
        Proximity((65_535,) * 4),
        Proximity((65_535, 65_535, 0, 65_535)),
        Proximity((*(65_535,) * 3, 2500)),
    ]


@pytest.mark.parametrize("version", [1, 2])
def test_names_and_levels_of_log_records(version: int) -> None:
    found = pair(Log, version)
    names, levels = [], []
    for node, source in (("blink", "PC"), ("", "PC"), ("pid", "MOTOR1"), ("pid", "arm_controller")):
        record = Log(Timestamp(1), 25, module_alias(source), node, "")
        (made,) = found.to_ros(record, STAMP, Source(source, "log"))
        names.append(made.name)  # type: ignore[attr-defined]
    for level in (0, 10, 19, 20, 25, 30, 40, 50, 255):
        (made,) = found.to_ros(Log(level=level), STAMP, SOURCE)
        levels.append(made.level)  # type: ignore[attr-defined]
    if version == 1:
        assert names == ["/robot1/blink", "/robot1/PC", "/robot1/MOTOR1/pid", "/robot1/arm_controller/pid"]
        assert levels == [1, 1, 1, 2, 2, 4, 8, 16, 16]
    else:
        assert names == ["robot1.blink", "robot1.PC", "robot1.MOTOR1.pid", "robot1.arm_controller.pid"]
        assert levels == [10, 10, 10, 20, 20, 30, 40, 50, 50]


@pytest.mark.parametrize(
    ("name", "owner"),
    [
        ("/robot1/MOTOR1/pid", ("MOTOR1", "pid")),
        ("robot1.MOTOR1.pid", ("MOTOR1", "pid")),
        ("/talker", ("talker", "talker")),
        ("/arm/camera/driver", ("camera", "driver")),
        ("", ("", "")),
        ("///", ("", "")),
    ],
)
def test_names_of_ros_in_log_records(name: str, owner: tuple[str, str]) -> None:
    assert owner_of(name, "/robot1") == owner


def test_the_page_has_all_conversions() -> None:
    page = (ROOT / "docs" / "how-to" / "ros-types.md").read_text()
    table = page.split("| r2p | ROS | to ROS without | from ROS without |\n")[1].split("\n\n")[0]
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines()[1:]]
    assert rows == [
        [
            f"`{row.ours.__name__}`",
            " / ".join(f"`{name}`" for name in dict.fromkeys([row.ros1, row.ros2])),
            row.lost_to_ros,
            row.lost_from_ros,
        ]
        for row in PAIRS
    ]


def test_a_class_made_of_a_schema_is_converted_by_its_name() -> None:
    shape = r2p.layout(Odometry)
    found = pair(message_type(shape.name, shape.schema), 2)
    (made,) = found.to_ros(found.ours.decode(Odometry(Pose3(1.0)).encode()), STAMP, SOURCE)
    back = found.from_ros(made)
    assert type(back) is found.ours
    assert Odometry.decode(back.encode()) == Odometry(Pose3(1.0))


@pytest.mark.parametrize("version", [1, 2])
def test_recorded_messages_become_ours(version: int) -> None:
    """Those of real ROS programs, most with values that are not physical: converted, or refused with a reason."""
    names: dict[str, list[Any]] = {}
    for row in PAIRS:
        names.setdefault(row.theirs(version), []).append(row)
    converted = refused = 0
    for case in recorded(version)["messages"]:
        for row in names.get(case["type"].replace("/msg/", "/"), []):
            found = pair(row.ours, version, row.theirs(version))
            data = bytes.fromhex(case["bytes"])
            try:
                message = cdr(found.theirs).decode(data) if version == 2 else found.theirs.decode(data)
                row.ours.decode(found.from_ros(message).encode())
                converted += 1
            except (r2p.MessageError, r2p.DecodeError):
                refused += 1
    assert converted > 30
    assert refused > 5


@pytest.mark.parametrize(
    ("name", "cls", "change", "error"),
    [
        ("sensor_msgs/BatteryState", Battery, {"voltage": 70.0}, "a voltage of 70000 mV is not between 0 and 65535"),
        ("sensor_msgs/BatteryState", Battery, {"voltage": math.nan}, "a voltage of nan mV"),
        ("sensor_msgs/BatteryState", Battery, {"current": 40.0}, "a current of -40000 mA"),
        ("diagnostic_msgs/DiagnosticArray", msg.PowerEvent, {}, "can't become a PowerEvent"),
    ],
)
def test_what_r2p_can_not_say_is_an_error(name: str, cls: Any, change: dict[str, Any], error: str) -> None:
    found = pair(cls, 2, name)
    with pytest.raises(r2p.MessageError, match=error):
        found.from_ros(msgspec.structs.replace(found.theirs(), **change))


FIXED = [msg.IMU, msg.GPS, msg.Pressure, Velocity3, Pose3, msg.StampedPose3, Battery]
"""Types of which any numbers are a message in ROS, behind an empty header."""


@given(st.sampled_from(FIXED), st.sampled_from([1, 2]), st.binary(min_size=400, max_size=400))
def test_any_numbers_are_converted_or_refused(cls: Any, version: int, data: bytes) -> None:
    found = pair(cls, version)
    before = 16 if hasattr(found.theirs, "header") else 0
    size = len(found.theirs().encode())
    after = 16 if cls is Battery else 0  # texts and arrays
    message = found.theirs.decode(bytes(before) + data[: size - before - after] + bytes(after))
    with contextlib.suppress(r2p.MessageError):
        found.from_ros(message).encode()


@pytest.mark.parametrize("cls", [msg.IMU, msg.Odometry, Pose3])
@pytest.mark.parametrize("angle", [math.inf, -math.inf, math.nan])
def test_angles_that_are_not_numbers_do_not_raise_in_the_link(cls: Any, angle: float) -> None:
    """A sensor may say anything: an infinite angle has no quaternion, and is counted as not convertible."""
    found = pair(cls, 2)
    pose = Pose3(1.0, 2.0, angle)
    message = {Pose3: pose, msg.Odometry: msg.Odometry(pose, Velocity3())}.get(cls, msg.IMU(yaw=angle))
    with contextlib.nullcontext() if math.isnan(angle) else pytest.raises(r2p.MessageError, match="infinite angle"):
        found.to_ros(message, 1, Source())


@given(st.sampled_from([1, 2]), st.text(max_size=40), st.text(max_size=200), st.integers(0, 100))
def test_any_log_record_of_ros_is_one_of_r2p(version: int, name: str, text: str, level: int) -> None:
    found = pair(Log, version)
    record = found.from_ros(msgspec.structs.replace(found.theirs(), name=name, msg=text, level=level))
    assert Log.decode(record.encode()) is not None


def test_orientations_that_are_not_rotations() -> None:
    """An Imu without an orientation has none here, either; elsewhere zeros, which ROS's tools send, are an error."""
    found = pair(msg.IMU, 2)
    none = (-1.0, *(0.0,) * 8)
    imu: Any = found.from_ros(msgspec.structs.replace(found.theirs(), orientation_covariance=none))
    assert math.isnan(imu.roll)
    assert math.isnan(imu.yaw)
    for name, cls in (("geometry_msgs/Pose", Pose3), ("nav_msgs/Odometry", Odometry)):
        found = pair(cls, 2, name)
        with pytest.raises(r2p.MessageError, match=r"0, 0, 0, 0 \(x, y, z, w\) is not a rotation"):
            found.from_ros(found.theirs())


@given(st.floats(-1.5, 1.5), st.floats(-3.1, 3.1), st.floats(-3.1, 3.1), st.floats(0.01, 100))
def test_angles_and_quaternions(pitch: float, roll: float, yaw: float, scale: float) -> None:
    """Also of quaternions that are not normalised."""
    found = quaternion(
        lambda **parts: SimpleNamespace(**{key: scale * each for key, each in parts.items()}), roll, pitch, yaw
    )
    assert angles(found) == pytest.approx((roll, pitch, yaw), abs=1e-5)
