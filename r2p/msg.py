"""The standard messages: the firmware's, those of the modules of thesis 7, texts, gateways' states, and some of ROS's.

All fields default to zero. For other data define your own `r2p.Message`. A changed layout needs a new topic.

In `Stamped...` messages `timestamp` is the network time (RTCAN) of the measurement. An RTCAN fragment carries 8 bytes;
classes that are not the firmware's say how many their message takes.
"""

from typing import Annotated, ClassVar

from r2p.messages import Array, Len, Max, Message, f32, f64, i8, i16, i32, u8, u16, u32, u64
from r2p.messages import Duration as Duration  # as Timestamp
from r2p.messages import Timestamp as Timestamp  # a part of the standard messages: imported from here

# The firmware's, byte for byte (PROTOCOL.md 2). The names are the firmware's, without `Msg`, and with `Stamped` for its
# `t`. The firmware does not say which units it uses; those given here are the ones of thesis 7 and 8.


class Led(Message):
    """State of one LED (topic `leds`)."""

    led: u32 = 0
    """Number of the LED."""
    value: u8 = 0
    """0 off, 1 on."""


class Float32(Message):
    """A number."""

    data: f32 = 0.0


class PWM(Message):
    """Duty of one PWM output."""

    pwm: u16 = 0
    """Counts of the timer that makes the wave."""


class PWM2(Message):
    """Duties of two motors."""

    pwm1: i16 = 0
    """Counts of the timer; negative: backwards."""
    pwm2: i16 = 0


class PWM3(Message):
    """Duties of three motors."""

    pwm1: i16 = 0
    """Counts of the timer; negative: backwards."""
    pwm2: i16 = 0
    pwm3: i16 = 0


class Speed(Message):
    """Speed of a motor."""

    speed: u16 = 0
    """In units of the motor's controller."""


class Speed2(Message):
    """Speed setpoints of two wheels (topic `speed`)."""

    value: tuple[f32, f32] = (0.0, 0.0)
    """In units of the motors' controllers."""


class Speed3(Message):
    """Speed setpoints of three wheels (topic `speed`)."""

    value: tuple[f32, f32, f32] = (0.0, 0.0, 0.0)
    """In units of the motors' controllers."""


class QEI(Message):
    """Movement of a quadrature encoder since the previous message."""

    delta: i16 = 0
    """Ticks."""


class StampedQEI(Message):
    """Movement of a quadrature encoder since the previous message, with its time."""

    timestamp: Timestamp = Timestamp()
    delta: i16 = 0
    """Ticks."""


class Encoder(Message):
    """Movement of an encoder since the previous message (topic `encoder`)."""

    delta: f32 = 0.0
    """In units of the node that publishes it."""


class StampedEncoder(Message):
    """Movement of an encoder since the previous message, with its time (topic `encoder`)."""

    timestamp: Timestamp = Timestamp()
    delta: f32 = 0.0
    """In units of the node that publishes it."""


class Encoder2(Message):
    """Movement of the two wheels of a differential drive since the previous message."""

    left_delta: f32 = 0.0
    """In units of the node that publishes it."""
    right_delta: f32 = 0.0


class AbsoluteEncoder(Message):
    """Position of an absolute encoder."""

    position: f32 = 0.0
    """In units of the node that publishes it."""


class StampedPose3(Message):
    """Position and heading in the plane, with its time."""

    timestamp: Timestamp = Timestamp()
    x: f32 = 0.0
    """m."""
    y: f32 = 0.0
    """m."""
    w: f32 = 0.0
    """Heading, counter-clockwise from the x axis, rad."""


class Velocity3(Message):
    """Velocity in the plane, in the frame of the robot (topics `velocity`, `velocity_cmd`)."""

    x: f32 = 0.0
    """Forward, m/s."""
    y: f32 = 0.0
    """To the left, m/s."""
    w: f32 = 0.0
    """Counter-clockwise, rad/s."""


class StampedVelocity3(Message):
    """Velocity in the plane as in Velocity3, with its time."""

    timestamp: Timestamp = Timestamp()
    x: f32 = 0.0
    y: f32 = 0.0
    w: f32 = 0.0


class Tilt(Message):
    """Inclination about one axis (topic `tilt`)."""

    angle: f32 = 0.0
    """rad."""


class TiltRate(Message):
    """Inclination about one axis, and how fast it changes (topic `tilt`, thesis 7.4.2). 1 fragment."""

    angle: f32 = 0.0
    """rad."""
    rate: f32 = 0.0
    """rad/s."""


class IMURaw9(Message):
    """Unfiltered readings of accelerometer, gyroscope and magnetometer (topic `imu_raw`).

    In counts of the sensors. The size of a count depends on their full scale: at best 1 mg, 8.75 mdps and 0.9 mgauss
    (thesis 7.4.1).
    """

    acc_x: i16 = 0
    acc_y: i16 = 0
    acc_z: i16 = 0
    gyro_x: i16 = 0
    gyro_y: i16 = 0
    gyro_z: i16 = 0
    mag_x: i16 = 0
    mag_y: i16 = 0
    mag_z: i16 = 0


class StampedIMURaw9(Message):
    """Unfiltered readings as in IMURaw9, with their time (topic `imu_raw`)."""

    timestamp: Timestamp = Timestamp()
    acc_x: i16 = 0
    acc_y: i16 = 0
    acc_z: i16 = 0
    gyro_x: i16 = 0
    gyro_y: i16 = 0
    gyro_z: i16 = 0
    mag_x: i16 = 0
    mag_y: i16 = 0
    mag_z: i16 = 0


# Of the modules of thesis 7 that have no published layout: in SI units, and in few CAN fragments. Angles are in rad,
# counter-clockwise, except geographic ones.


class IMU(Message):
    """Attitude and rates of the robot, filtered (topic `imu`, thesis 7.4.2). 3 fragments."""

    roll: f32 = 0.0
    """About the x axis (forward), rad."""
    pitch: f32 = 0.0
    """About the y axis (to the left), rad."""
    yaw: f32 = 0.0
    """About the z axis (up), rad."""
    roll_rate: f32 = 0.0
    """rad/s."""
    pitch_rate: f32 = 0.0
    """rad/s."""
    yaw_rate: f32 = 0.0
    """rad/s."""


class StampedIMU(Message):
    """Attitude and rates of the robot as in IMU, with their time (topic `imu`). 4 fragments."""

    timestamp: Timestamp = Timestamp()
    roll: f32 = 0.0
    pitch: f32 = 0.0
    yaw: f32 = 0.0
    roll_rate: f32 = 0.0
    pitch_rate: f32 = 0.0
    yaw_rate: f32 = 0.0


class Proximity(Message):
    """Distances that the four range finders of one module measure (topic `proximity`, thesis 7.5.2). 1 fragment."""

    ranges: tuple[u16, u16, u16, u16] = (0, 0, 0, 0)
    """mm; 65535: nothing in range, or no sensor."""


class Battery(Message):
    """The battery at the power supply module (topic `battery`, thesis 7.2.2). 1 fragment."""

    voltage: u16 = 0
    """mV."""
    current: i16 = 0
    """Out of the battery, mA; negative while it charges."""
    charge: u8 = 0
    """Remaining life, 0 to 100 %; 255: not calibrated."""
    remaining: u16 = 0
    """Remaining time at the present current, minutes; 65535: unknown."""


class PowerEvent(Message):
    """The power supply crossed thresholds (topic `power_event`, thesis 7.2.2). 1 fragment.

    Several thresholds are added up; 0 means that none is exceeded.
    """

    LOW_VOLTAGE: ClassVar = 1
    HIGH_VOLTAGE: ClassVar = 2
    HIGH_CURRENT: ClassVar = 4

    crossed: u8 = 0
    """The thresholds that were crossed, in either direction; 0: the event is repeated, while one is exceeded."""
    exceeded: u8 = 0
    """The thresholds beyond which the supply is now."""
    voltage: u16 = 0
    """mV."""
    current: i16 = 0
    """Out of the battery, mA."""


class Pressure(Message):
    """Air pressure, and the altitude that follows from it (topic `pressure`, thesis 7.4.2). 1 fragment."""

    pressure: f32 = 0.0
    """Pa."""
    altitude: f32 = 0.0
    """In the standard atmosphere, m."""


class GPS(Message):
    """A fix of the GPS receiver (topic `gps`, thesis 7.4.2). 4 fragments."""

    latitude: f64 = 0.0
    """Degrees, north is positive (WGS 84)."""
    longitude: f64 = 0.0
    """Degrees, east is positive."""
    altitude: f32 = 0.0
    """Above mean sea level, m."""
    speed: f32 = 0.0
    """Over ground, m/s."""
    course: f32 = 0.0
    """Over ground, degrees clockwise from true north."""
    hdop: u16 = 0
    """Horizontal dilution of precision, 1/100."""
    satellites: u8 = 0
    """In use."""
    fix: u8 = 0
    """NMEA's fix quality: 0 none, 1 GPS, 2 differential, 4 RTK, 5 float RTK."""


class StampedGPS(Message):
    """A fix of the GPS receiver as in GPS, with its time (topic `gps`). 5 fragments."""

    timestamp: Timestamp = Timestamp()
    latitude: f64 = 0.0
    longitude: f64 = 0.0
    altitude: f32 = 0.0
    speed: f32 = 0.0
    course: f32 = 0.0
    hdop: u16 = 0
    satellites: u8 = 0
    fix: u8 = 0


class Setpoint(Message):
    """The position or speed that a motor controller is to reach, as configured (topic `setpoint`, thesis 7.3.2).

    The controller counts encoder ticks; the length of a tick is part of the kinematics. 1 fragment.
    """

    ticks: i32 = 0
    """Position in ticks, or speed in ticks/s."""


class Effort2(Message):
    """What two motors are to exert, and the age of what that follows from (topic `effort`). 1 fragment."""

    value: tuple[i16, i16] = (0, 0)
    """Voltage or torque, in units of the motors' controllers."""
    measured: u32 = 0
    """UTC of the measurement that it follows from, us modulo 2^32."""


class Pose3(Message):
    """Position and heading in the plane. 2 fragments."""

    x: f32 = 0.0
    """m."""
    y: f32 = 0.0
    """m."""
    w: f32 = 0.0
    """Heading, counter-clockwise from the x axis, rad."""


class Odometry(Message):
    """The movement of the robot, by forward kinematics (topic `odometry`, thesis 8.1). 3 fragments."""

    pose: Pose3 = Pose3()
    """Since the start, in the frame of the start."""
    velocity: Velocity3 = Velocity3()
    """In the frame of the robot."""


class StampedOdometry(Message):
    """The movement of the robot as in Odometry, with its time (topic `odometry`). 4 fragments."""

    timestamp: Timestamp = Timestamp()
    pose: Pose3 = Pose3()
    velocity: Velocity3 = Velocity3()


class Text(Message):
    """A short text. 8 CAN fragments: a message has a fixed size, so a short text costs as much as a long one."""

    text: Annotated[str, Len(64)] = ""


class Log(Message):
    """A log record of a node (topic `log` of every module). 19 CAN fragments."""

    stamp: Timestamp = Timestamp()
    """Time of the record, UTC."""
    level: u8 = 0
    """As in Python's logging: 10 debug, 20 info, 30 warning, 40 error, 50 critical."""
    module: Annotated[str, Len(7)] = ""
    """The module of the node, as a debug line does not say who sent a message."""
    node: Annotated[str, Len(8)] = ""
    """The node that logged it."""
    text: Annotated[str, Len(128)] = ""


class GatewayStatus(Message):
    """The counters of a gateway, once a second (topic `gateway`). 12 CAN fragments.

    There is one message for each link, with `topic` and `target` empty, and one for each topic and pair of links on its
    way, with `state` empty.
    """

    topic: Annotated[str, Len(16)] = ""
    source: Annotated[str, Len(24)] = ""
    """The link from which messages arrive."""
    target: Annotated[str, Len(24)] = ""
    """The link to which they go."""
    state: Annotated[str, Len(12)] = ""
    """The state of a link: listening, alone, forwarding, blocked, converging, loop, down."""
    forwarded: u64 = 0
    """Messages since the gateway started."""
    dropped: u64 = 0
    rate: f32 = 0.0
    """Messages in the last second."""


class BusTraffic(Message):
    """What a topic of a module took of an RTCAN bus in the last second (topic `bus_load`), stuff bits included.

    There is one message for each topic of each module, and one for the whole bus, with `kind` "total". They are sent
    while the topic has subscribers, by one module of the bus.
    """

    bus: Annotated[str, Max(32)] = ""
    """The link of the module that measures: rtcan:can0."""
    kind: Annotated[str, Max(10)] = ""
    """The kind of frames: sync, hrt, srt, nrt, management, other; or total."""
    topic: Annotated[str, Max(72)] = ""
    module: Annotated[str, Max(64)] = ""
    """The module that sends it."""
    share: f32 = 0.0
    """Of the time; 1.0 is all of it."""
    frames: f32 = 0.0
    """A second."""
    errors: u32 = 0
    """Error frames, and other faults that the interface reports; of the whole bus only, as what follows."""
    reserved: f32 = 0.0
    """Share of the time that is reserved for slots."""
    free_used: f32 = 0.0
    """Used part of the other slots; above 0.8 events wait long."""


class BusSlots(Message):
    """The slots of a periodic topic on an RTCAN bus (topic `bus_slots`).

    There is one message for each topic of each module, also of the master's sync, and one without a topic for slots
    that are reserved and not used. All are sent to each new subscriber, and one when its slots have changed.
    """

    bus: Annotated[str, Max(32)] = ""
    """The link of the module that watches: rtcan:can0."""
    topic: Annotated[str, Max(72)] = ""
    module: Annotated[str, Max(64)] = ""
    """The module that owns the slots."""
    slots: Annotated[tuple[i8, ...], Max(64)] = ()
    """Their numbers, 0 is the sync; empty, if it has none any more."""
    slots_in_cycle: u8 = 0
    cycle: f32 = 0.0
    """s."""


# ROS's, with its names, fields and bytes (those of ROS 1), for data whose length varies. Their bounds, `r2p.Max`, are
# generous: they decide which links carry a topic. For smaller ones define the message with the same fields and name.


class Empty(Message, name="std_msgs/Empty"):
    """Nothing but the fact that it was sent."""


class String(Message, name="std_msgs/String"):
    """A text of any length. `Text`, of fixed length, is for links that firmware shares."""

    data: Annotated[str, Max(65_536)] = ""


class Header(Message, name="std_msgs/Header"):
    """The beginning of ROS's messages: when and in which frame of coordinates they were measured."""

    seq: u32 = 0
    """Counts the messages of a publisher; ROS 2 has it no more."""
    stamp: Timestamp = Timestamp()
    frame_id: Annotated[str, Max(256)] = ""


class Image(Message, name="sensor_msgs/Image"):
    """A picture, not compressed. `numpy.asarray(image.data).reshape(image.height, image.step)` copies nothing."""

    header: Header = Header()
    height: u32 = 0
    """Rows."""
    width: u32 = 0
    """Columns."""
    encoding: Annotated[str, Max(64)] = ""
    """What the bytes of a pixel are: rgb8, bgr8, mono8, 16UC1, 32FC1, ..."""
    is_bigendian: u8 = 0
    """1: numbers of several bytes begin with the highest."""
    step: u32 = 0
    """Bytes of a row."""
    data: Annotated[Array[u8], Max(32 << 20)] = Array()
    """`step * height` bytes; enough for 3840 x 2160 pixels of 4 bytes."""


class CompressedImage(Message, name="sensor_msgs/CompressedImage"):
    """A compressed picture."""

    header: Header = Header()
    format: Annotated[str, Max(64)] = ""
    """How it is compressed: jpeg, png, ..."""
    data: Annotated[Array[u8], Max(16 << 20)] = Array()
    """The contents of such a file."""


class LaserScan(Message, name="sensor_msgs/LaserScan"):
    """One scan of a planar laser range finder. Angles are counter-clockwise from the x axis (forward)."""

    header: Header = Header()
    """Its stamp is the time of the first ray."""
    angle_min: f32 = 0.0
    """Of the first ray, rad."""
    angle_max: f32 = 0.0
    """Of the last ray, rad."""
    angle_increment: f32 = 0.0
    """Between two rays, rad."""
    time_increment: f32 = 0.0
    """Between two rays, s."""
    scan_time: f32 = 0.0
    """Between two scans, s."""
    range_min: f32 = 0.0
    """m; a shorter range is no measurement."""
    range_max: f32 = 0.0
    """m; a longer range is no measurement."""
    ranges: Annotated[Array[f32], Max(16_384)] = Array()
    """m."""
    intensities: Annotated[Array[f32], Max(16_384)] = Array()
    """In units of the device; empty, if it measures none."""


class JointState(Message, name="sensor_msgs/JointState"):
    """State of joints. Each array has an element for each joint, or is empty."""

    header: Header = Header()
    name: Annotated[tuple[Annotated[str, Max(128)], ...], Max(256)] = ()
    position: Annotated[Array[f64], Max(256)] = Array()
    """rad or m."""
    velocity: Annotated[Array[f64], Max(256)] = Array()
    """rad/s or m/s."""
    effort: Annotated[Array[f64], Max(256)] = Array()
    """Nm or N."""


class PointField(Message, name="sensor_msgs/PointField"):
    """One number of each point of a PointCloud2."""

    INT8: ClassVar = 1
    UINT8: ClassVar = 2
    INT16: ClassVar = 3
    UINT16: ClassVar = 4
    INT32: ClassVar = 5
    UINT32: ClassVar = 6
    FLOAT32: ClassVar = 7
    FLOAT64: ClassVar = 8

    name: Annotated[str, Max(64)] = ""
    """x, y, z, intensity, rgb, ..."""
    offset: u32 = 0
    """Of its first byte in a point."""
    datatype: u8 = 0
    """INT8 to FLOAT64."""
    count: u32 = 0
    """Numbers of this kind in a row."""


class PointCloud2(Message, name="sensor_msgs/PointCloud2"):
    """Points, each of `point_step` bytes that `fields` describe."""

    header: Header = Header()
    height: u32 = 0
    """Rows; 1, if the points have no order."""
    width: u32 = 0
    """Points of a row."""
    fields: Annotated[tuple[PointField, ...], Max(64)] = ()
    is_bigendian: bool = False
    point_step: u32 = 0
    """Bytes of a point."""
    row_step: u32 = 0
    """Bytes of a row."""
    data: Annotated[Array[u8], Max(32 << 20)] = Array()
    """`row_step * height` bytes; enough for a million points of 32 bytes."""
    is_dense: bool = False
    """No point is invalid (NaN)."""
