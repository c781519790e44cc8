"""What r2p's standard messages are in ROS, and back: one function for each pair of types.

Each takes `RosParts`, the classes on both sides, and returns the two functions of a `Conversion`. Those to ROS get the
message, its stamp (UTC, ns) and its source, and return one message or several; all raise MessageError for what the
other type can't say.

Axes are those of both: x forward, y to the left, z up; angles counter-clockwise (REP 103). Frames of coordinates are
named as REP 105 does: `odom` and `base_link`, those of sensors like their topics.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import msgspec

from r2p.errors import MessageError
from r2p.messages import Message, Timestamp, layout
from r2p.msg import Header, Pose3, Velocity3
from r2p.ros.classes import RosTypes
from r2p.runtime.sample import Source

ToRos: TypeAlias = Callable[[Any, int, Source], Sequence[Message]]
FromRos: TypeAlias = Callable[[Any], Message]
Functions: TypeAlias = tuple[ToRos, FromRos]

ODOM, BASE = "odom", "base_link"
UNKNOWN_U16 = 65_535
UNKNOWN_CHARGE = 255

_NO_ESTIMATE = (-1.0, *(0.0,) * 8)  # a covariance of Imu for a quantity that the sensor does not have
_RANGES = 4  # range finders of a Proximity
_INFRARED = 1
_NOTHING_IN_RANGE = math.inf  # REP 117
_RANGE_ERROR = 5.0  # m of a satellite receiver at a dilution of precision of 1: typical of one without corrections
_GPS = 1  # NavSatStatus.SERVICE_GPS
_FIX_TO_ROS = {1: 0, 2: 1, 3: 0, 4: 2, 5: 2}  # NMEA's quality to NavSatStatus; all others: -1, no fix
_FIX_FROM_ROS = {0: 1, 1: 2, 2: 4}
_CHARGING, _DISCHARGING = 1, 2
_SEA_LEVEL = 101_325.0  # Pa, of the standard atmosphere
_SCALE_HEIGHT, _EXPONENT = 44_330.77, 0.190263  # of its lowest layer: m, and the power of the ratio of pressures


class RosNames(msgspec.Struct, frozen=True):
    """Names that messages of ROS contain: of the topic, the namespace (`/robot1`, or empty), which is also in front of
    frames, and of this module, whose nodes have no module in front of their names in ROS.
    """

    topic: str = ""
    namespace: str = ""
    module: str = ""

    def frame(self, name: str) -> str:
        """Return the full name of a frame."""
        return f"{self.namespace}/{name}".removeprefix("/")


class RosParts(msgspec.Struct, frozen=True):
    """What a conversion is made of: r2p's class, ROS's type and those in it as classes, ROS's version, and names."""

    ours: Any
    types: RosTypes
    theirs: Any
    version: int
    names: RosNames

    def cls(self, name: str) -> Any:
        """Return the class of a type that is in ROS's type."""
        return self.types.load(name)

    def stamped(self, message: Any, **fields: Any) -> Message:
        """Make r2p's message; a `timestamp`, if it has one, is that of the header of ROS's message."""
        if hasattr(self.ours, "timestamp"):
            fields["timestamp"] = message.header.stamp
        made: Message = self.ours(**fields)
        return made


def header(ns: int, frame: str) -> Header:
    """Return the header of a message of ROS. Raises MessageError for a stamp outside of 1970 to 2106."""
    return Header(stamp=Timestamp.from_ns(ns), frame_id=frame)


# Geometry


def quaternion(cls: Any, roll: float, pitch: float, yaw: float) -> Any:
    """Return the rotation about the fixed axes x, y, z in this order, as a geometry_msgs/Quaternion.

    Raises MessageError for an infinite angle; NaN makes a quaternion of NaN.
    """
    if math.isinf(roll) or math.isinf(pitch) or math.isinf(yaw):
        raise MessageError(f"{roll}, {pitch}, {yaw}: an infinite angle is not a rotation")
    cr, sr = math.cos(roll / 2), math.sin(roll / 2)
    cp, sp = math.cos(pitch / 2), math.sin(pitch / 2)
    cy, sy = math.cos(yaw / 2), math.sin(yaw / 2)
    return cls(
        x=sr * cp * cy - cr * sp * sy,
        y=cr * sp * cy + sr * cp * sy,
        z=cr * cp * sy - sr * sp * cy,
        w=cr * cp * cy + sr * sp * sy,
    )


def angles(rotation: Any) -> tuple[float, float, float]:
    """Return roll, pitch and yaw of a quaternion of any length. Raises MessageError if it is not a rotation."""
    x, y, z, w = rotation.x, rotation.y, rotation.z, rotation.w
    length = math.hypot(x, y, z, w)
    if not 0.0 < length < math.inf:
        raise MessageError(
            f"the orientation {x:g}, {y:g}, {z:g}, {w:g} (x, y, z, w) is not a rotation; none is 0, 0, 0, 1"
        )
    x, y, z, w = x / length, y / length, z / length, w / length
    roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = math.asin(max(-1.0, min(1.0, 2 * (w * y - z * x))))
    return roll, pitch, math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def _planar_pose(parts: RosParts) -> tuple[Callable[[Any], Any], Callable[[Any], dict[str, float]]]:
    """Return the functions between a pose in the plane and a geometry_msgs/Pose."""
    make, point, rotation = (parts.cls(f"geometry_msgs/{name}") for name in ("Pose", "Point", "Quaternion"))

    def to_ros(pose: Any) -> Any:
        return make(position=point(x=pose.x, y=pose.y), orientation=quaternion(rotation, 0.0, 0.0, pose.w))

    def from_ros(pose: Any) -> dict[str, float]:
        return {"x": pose.position.x, "y": pose.position.y, "w": angles(pose.orientation)[2]}

    return to_ros, from_ros


def _planar_twist(parts: RosParts) -> tuple[Callable[[Any], Any], Callable[[Any], dict[str, float]]]:
    """Return the functions between a velocity in the plane and a geometry_msgs/Twist."""
    make, vector = parts.cls("geometry_msgs/Twist"), parts.cls("geometry_msgs/Vector3")

    def to_ros(velocity: Any) -> Any:
        return make(linear=vector(x=velocity.x, y=velocity.y), angular=vector(z=velocity.w))

    def from_ros(twist: Any) -> dict[str, float]:
        return {"x": twist.linear.x, "y": twist.linear.y, "w": twist.angular.z}

    return to_ros, from_ros


# Motion


def velocity(parts: RosParts) -> Functions:
    """Convert Velocity3 and StampedVelocity3 to and from Twist and TwistStamped."""
    twist, planar = _planar_twist(parts)
    frame = parts.names.frame(BASE)
    if not hasattr(parts.theirs, "header"):
        return lambda message, ns, source: (twist(message),), lambda message: parts.ours(**planar(message))
    return (
        lambda message, ns, source: (parts.theirs(header=header(ns, frame), twist=twist(message)),),
        lambda message: parts.stamped(message, **planar(message.twist)),
    )


def pose(parts: RosParts) -> Functions:
    """Convert Pose3 and StampedPose3 to and from Pose and PoseStamped."""
    full, planar = _planar_pose(parts)
    frame = parts.names.frame(ODOM)
    if not hasattr(parts.theirs, "header"):
        return lambda message, ns, source: (full(message),), lambda message: parts.ours(**planar(message))
    return (
        lambda message, ns, source: (parts.theirs(header=header(ns, frame), pose=full(message)),),
        lambda message: parts.stamped(message, **planar(message.pose)),
    )


def odometry(parts: RosParts) -> Functions:
    """Convert Odometry and StampedOdometry to and from nav_msgs/Odometry: the velocity is in the robot's frame."""
    full_pose, planar_pose = _planar_pose(parts)
    full_twist, planar_twist = _planar_twist(parts)
    with_pose, with_twist = (parts.cls(f"geometry_msgs/{name}WithCovariance") for name in ("Pose", "Twist"))
    frame, child = parts.names.frame(ODOM), parts.names.frame(BASE)

    def to_ros(message: Any, ns: int, source: Source) -> Sequence[Message]:
        made: Message = parts.theirs(
            header=header(ns, frame),
            child_frame_id=child,
            pose=with_pose(pose=full_pose(message.pose)),
            twist=with_twist(twist=full_twist(message.velocity)),
        )
        return (made,)

    def from_ros(message: Any) -> Message:
        return parts.stamped(
            message,
            pose=Pose3(**planar_pose(message.pose.pose)),
            velocity=Velocity3(**planar_twist(message.twist.twist)),
        )

    return to_ros, from_ros


def imu(parts: RosParts) -> Functions:
    """Convert IMU and StampedIMU to and from sensor_msgs/Imu."""
    rotation, vector = parts.cls("geometry_msgs/Quaternion"), parts.cls("geometry_msgs/Vector3")
    frame = parts.names.frame(BASE)

    def to_ros(message: Any, ns: int, source: Source) -> Sequence[Message]:
        made: Message = parts.theirs(
            header=header(ns, frame),
            orientation=quaternion(rotation, message.roll, message.pitch, message.yaw),
            angular_velocity=vector(x=message.roll_rate, y=message.pitch_rate, z=message.yaw_rate),
            linear_acceleration_covariance=_NO_ESTIMATE,
        )
        return (made,)

    def from_ros(message: Any) -> Message:
        unknown = message.orientation_covariance[0] == -1.0
        roll, pitch, yaw = (math.nan,) * 3 if unknown else angles(message.orientation)
        rates = message.angular_velocity
        return parts.stamped(
            message,
            roll=roll,
            pitch=pitch,
            yaw=yaw,
            roll_rate=rates.x,
            pitch_rate=rates.y,
            yaw_rate=rates.z,
        )

    return to_ros, from_ros


# Other sensors


def _whole(what: str, value: float, unit: str, least: int, most: int) -> int:
    """Return a value in whole units. Raises MessageError unless it is in the range of the field."""
    if not least <= value <= most:
        raise MessageError(f"{what} of {value:g} {unit} is not between {least} and {most}")
    return round(value)


def battery(parts: RosParts) -> Functions:
    """Convert Battery to and from BatteryState, whose current is positive while the battery charges."""

    def to_ros(message: Any, ns: int, source: Source) -> Sequence[Message]:
        nan = math.nan
        current = message.current
        made: Message = parts.theirs(
            header=header(ns, ""),
            voltage=message.voltage / 1000,
            temperature=nan,
            current=-current / 1000,
            charge=nan,
            capacity=nan,
            design_capacity=nan,
            percentage=nan if message.charge == UNKNOWN_CHARGE else message.charge / 100,
            power_supply_status=_CHARGING if current < 0 else _DISCHARGING if current > 0 else 0,
            present=True,
        )
        return (made,)

    def from_ros(message: Any) -> Message:
        share, current = message.percentage, message.current
        made: Message = parts.ours(
            voltage=_whole("a voltage", message.voltage * 1000, "mV", 0, 65_535),
            current=0 if math.isnan(current) else _whole("a current", -current * 1000, "mA", -32_768, 32_767),
            charge=round(share * 100) if 0.0 <= share <= 1.0 else UNKNOWN_CHARGE,
            remaining=UNKNOWN_U16,
        )
        return made

    return to_ros, from_ros


def proximity(parts: RosParts) -> Functions:
    """Convert Proximity to four messages of Range, in the frames TOPIC_0 to TOPIC_3, and one of them to a reading."""
    frames = [parts.names.frame(f"{parts.names.topic}_{place}") for place in range(_RANGES)]
    most = (UNKNOWN_U16 - 1) / 1000

    def to_ros(message: Any, ns: int, source: Source) -> Sequence[Message]:
        return [
            parts.theirs(
                header=header(ns, frame),
                radiation_type=_INFRARED,
                max_range=most,
                range=_NOTHING_IN_RANGE if reading == UNKNOWN_U16 else reading / 1000,
            )
            for frame, reading in zip(frames, message.ranges, strict=True)
        ]

    def from_ros(message: Any) -> Message:
        last = message.header.frame_id[-2:]
        place = int(last[1]) if last in ("_1", "_2", "_3") else 0
        readings = [UNKNOWN_U16] * _RANGES
        if message.range >= 0.0 and message.range <= min(most, message.max_range or most):
            readings[place] = round(message.range * 1000)
        made: Message = parts.ours(ranges=tuple(readings))
        return made

    return to_ros, from_ros


def gps(parts: RosParts) -> Functions:
    """Convert GPS and StampedGPS to and from NavSatFix."""
    status = parts.cls("sensor_msgs/NavSatStatus")
    frame = parts.names.frame(parts.names.topic)

    def to_ros(message: Any, ns: int, source: Source) -> Sequence[Message]:
        horizontal = (message.hdop / 100 * _RANGE_ERROR) ** 2
        made: Message = parts.theirs(
            header=header(ns, frame),
            status=status(status=_FIX_TO_ROS.get(message.fix, -1), service=_GPS),
            latitude=message.latitude,
            longitude=message.longitude,
            altitude=message.altitude,
            position_covariance=(horizontal, 0.0, 0.0, 0.0, horizontal, 0.0, 0.0, 0.0, 4 * horizontal),
            position_covariance_type=1 if message.hdop else 0,  # approximated from the dilution of precision
        )
        return (made,)

    def from_ros(message: Any) -> Message:
        known = message.position_covariance_type != 0
        variance = max(0.0, message.position_covariance[0] + message.position_covariance[4]) / 2 if known else 0.0
        dilution = 100 * math.sqrt(variance) / _RANGE_ERROR
        return parts.stamped(
            message,
            latitude=message.latitude,
            longitude=message.longitude,
            altitude=message.altitude,
            speed=math.nan,
            course=math.nan,
            hdop=round(dilution) if dilution < UNKNOWN_U16 else UNKNOWN_U16,
            fix=_FIX_FROM_ROS.get(message.status.status, 0),
        )

    return to_ros, from_ros


def pressure(parts: RosParts) -> Functions:
    """Convert Pressure to and from FluidPressure; the altitude is computed again."""
    frame = parts.names.frame(parts.names.topic)

    def from_ros(message: Any) -> Message:
        value = message.fluid_pressure
        ratio = value / _SEA_LEVEL
        altitude = _SCALE_HEIGHT * (1.0 - ratio**_EXPONENT) if ratio > 0.0 else math.nan
        made: Message = parts.ours(pressure=value, altitude=altitude)
        return made

    return (
        lambda message, ns, source: (parts.theirs(header=header(ns, frame), fluid_pressure=message.pressure),),
        from_ros,
    )


# Plain values


def number(parts: RosParts) -> Functions:
    """Convert Float32 to and from std_msgs/Float32."""
    return lambda message, ns, source: (parts.theirs(data=message.data),), lambda message: parts.ours(data=message.data)


def text(parts: RosParts) -> Functions:
    """Convert Text to and from std_msgs/String."""
    length = layout(parts.ours).size
    return (
        lambda message, ns, source: (parts.theirs(data=message.text),),
        lambda message: parts.ours(text=ascii_text(message.data, length)),
    )


def ascii_text(value: str, length: int) -> str:
    """Return a text for a field of fixed length: ? for other characters than those of ASCII, and without its end."""
    return value.encode("ascii", "replace").replace(b"\0", b"?")[:length].decode()
