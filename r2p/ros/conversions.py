"""Conversions between r2p's standard messages and ROS's: which types go together, and what one of the two lacks.

    found = conversion(Battery, "sensor_msgs/BatteryState", 2)
    for each in found.to_ros(message, stamp, sample.source):
        data = cdr(found.theirs).encode(each)

The mapping goes by the full names of the types (`r2p_msgs/Battery` and `sensor_msgs/BatteryState`), never by their
fields: two types with the same numbers may mean different things. A class with the name of one of r2p's types, but
other fields, is not converted.

Types that are in `r2p.msg` as they are in ROS (LaserScan, JointState, Image, ...) need no conversion, nor do classes
that a program has of other ROS types. Everything else travels as a type of its own, `r2p_msgs/Name`. `standard` has the
functions for each pair, and `reports` those of logs and diagnostics.
"""

import functools
from collections.abc import Callable

import msgspec

import r2p.msg as ours
from r2p.messages import Message, layout
from r2p.ros import reports, standard
from r2p.ros.classes import RosTypes
from r2p.ros.library import definitions_of_ros
from r2p.ros.standard import FromRos, Functions, RosParts, ToRos
from r2p.ros.standard import RosNames as RosNames  # a parameter of `conversion`
from r2p.ros.type_names import short_name

NO_NAMES = RosNames()


class Conversion(msgspec.Struct, frozen=True):
    """The conversion between a message class and a ROS type.

    `theirs` is the ROS type as a class, whose bytes are those of ROS 1; for ROS 2 use `r2p.ros.cdr`. `to_ros` takes a
    message, its stamp (UTC, ns) and its source, and returns one message or several. `lost_to_ros` and `lost_from_ros`
    say in words what the result is without. Both functions raise MessageError for a message that it can't have.
    """

    ours: type[Message]
    theirs: type[Message]
    to_ros: ToRos
    from_ros: FromRos
    lost_to_ros: str
    lost_from_ros: str


class TypePair(msgspec.Struct, frozen=True):
    """A row of the table: the names of ROS's type in ROS 1 and ROS 2, and what is lost, in words."""

    ours: type[Message]
    ros1: str
    ros2: str
    make: Callable[[RosParts], Functions]
    lost_to_ros: str = ""
    lost_from_ros: str = ""

    def theirs(self, version: int) -> str:
        """Return the name of ROS's type in this version."""
        return self.ros1 if version == 1 else self.ros2


def conversion(ours: type[Message], theirs: str, version: int, names: RosNames = NO_NAMES) -> Conversion | None:
    """Return the conversion between a message class and a type of ROS 1 or 2, by its name, or None.

    Raises MessageError, which says what to install, if rosbags is missing, which has the definitions of ROS.
    """
    theirs = short_name(theirs)
    found = next((pair for pair in _pairs_of(ours) if pair.theirs(version) == theirs), None)
    if found is None:
        return None
    types, made = _classes(theirs, version)
    to_ros, from_ros = found.make(RosParts(found.ours, types, made, version, names))
    if ours is not found.ours:
        from_ros = _into(ours, from_ros)
    return Conversion(ours, made, to_ros, from_ros, found.lost_to_ros, found.lost_from_ros)


@functools.lru_cache(maxsize=256)
def _classes(theirs: str, version: int) -> tuple[RosTypes, type[Message]]:
    """Return the class of a ROS type, made once for all topics, and with it those of the types in it."""
    types = RosTypes(version, definitions_of_ros(theirs, version))
    return types, types.load(theirs)


def standard_type(ours: type[Message], version: int) -> str | None:
    """Return the name of the ROS type that messages of a class become by default; None: one of their own."""
    return next((pair.theirs(version) for pair in _pairs_of(ours)), None)


def _pairs_of(cls: type[Message]) -> list[TypePair]:
    shape = layout(cls)
    return [pair for pair in _by_name().get(shape.name, []) if layout(pair.ours).schema == shape.schema]


@functools.cache
def _by_name() -> dict[str, list[TypePair]]:
    found: dict[str, list[TypePair]] = {}
    for pair in PAIRS:
        found.setdefault(layout(pair.ours).name, []).append(pair)
    return found


def _into(cls: type[Message], from_ros: FromRos) -> FromRos:
    """Return a function whose messages are of another class with the same fields, such as one made of a schema."""
    return lambda message: cls.decode(from_ros(message).encode())


_IMU = "accelerations and covariances"
_FROM_IMU = "accelerations, covariances; without an orientation the angles are NaN"
_ODOMETRY = "covariances, which are 0: unknown"
_FROM_ODOMETRY = "z, roll, pitch, and their rates, covariances"
_FROM_TWIST = "the vertical velocity, the rates of roll and pitch"
_FROM_POSE = "z, roll, pitch"
_GPS = "speed, course, satellites in use, the height of the geoid: the altitude stays that above mean sea level"
_FROM_GPS = "covariances, except as a dilution of precision, and the service; speed and course are NaN"
_ONE_WAY = "not possible"


def _in_both(cls: type[Message], theirs: str, make: Callable[[RosParts], Functions], to: str, back: str) -> TypePair:
    return TypePair(cls, theirs, theirs, make, to, back)


PAIRS = (
    _in_both(ours.IMU, "sensor_msgs/Imu", standard.imu, _IMU, _FROM_IMU),
    _in_both(ours.StampedIMU, "sensor_msgs/Imu", standard.imu, _IMU, _FROM_IMU),
    _in_both(ours.Odometry, "nav_msgs/Odometry", standard.odometry, _ODOMETRY, _FROM_ODOMETRY),
    _in_both(ours.StampedOdometry, "nav_msgs/Odometry", standard.odometry, _ODOMETRY, _FROM_ODOMETRY),
    _in_both(ours.Velocity3, "geometry_msgs/Twist", standard.velocity, "", _FROM_TWIST),
    _in_both(ours.Velocity3, "geometry_msgs/TwistStamped", standard.velocity, "", _FROM_TWIST),
    _in_both(ours.StampedVelocity3, "geometry_msgs/TwistStamped", standard.velocity, "", _FROM_TWIST),
    _in_both(ours.Pose3, "geometry_msgs/Pose", standard.pose, "", _FROM_POSE),
    _in_both(ours.Pose3, "geometry_msgs/PoseStamped", standard.pose, "", _FROM_POSE),
    _in_both(ours.StampedPose3, "geometry_msgs/PoseStamped", standard.pose, "", _FROM_POSE),
    _in_both(
        ours.Battery,
        "sensor_msgs/BatteryState",
        standard.battery,
        "the remaining time, temperature, capacities",
        "temperature, capacities, cells, health, technology; a current that is not measured is 0",
    ),
    _in_both(
        ours.Proximity,
        "sensor_msgs/Range",
        standard.proximity,
        "the field of view; four messages, in the frames `TOPIC_0` to `TOPIC_3`",
        "field of view and limits; a frame's last digit says which of the four readings it is",
    ),
    _in_both(ours.GPS, "sensor_msgs/NavSatFix", standard.gps, _GPS, _FROM_GPS),
    _in_both(ours.StampedGPS, "sensor_msgs/NavSatFix", standard.gps, _GPS, _FROM_GPS),
    _in_both(
        ours.Pressure,
        "sensor_msgs/FluidPressure",
        standard.pressure,
        "the altitude, and a variance",
        "the variance; the altitude is computed by the standard atmosphere",
    ),
    TypePair(
        ours.Log,
        "rosgraph_msgs/Log",
        "rcl_interfaces/Log",
        reports.log,
        "file, function and line",
        "file, function, line; more than 128 characters, and others than ASCII; long names become aliases",
    ),
    _in_both(ours.GatewayStatus, "diagnostic_msgs/DiagnosticArray", reports.gateway_status, "", _ONE_WAY),
    _in_both(
        ours.PowerEvent,
        "diagnostic_msgs/DiagnosticArray",
        reports.power_event,
        "the thresholds that were just crossed",
        _ONE_WAY,
    ),
    _in_both(ours.BusTraffic, "diagnostic_msgs/DiagnosticArray", reports.bus_traffic, "", _ONE_WAY),
    _in_both(ours.Float32, "std_msgs/Float32", standard.number, "", ""),
    _in_both(ours.Text, "std_msgs/String", standard.text, "", "more than 64 characters, and others than ASCII"),
)
"""All pairs; the first one of a class is its standard type."""
