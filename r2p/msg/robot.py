"""The messages of the modules of thesis 7 that have no published layout: in SI units, and in few CAN fragments.

An RTCAN fragment carries 8 bytes; each class says how many its message takes. `timestamp` is the network time (RTCAN)
of the measurement. Angles are in rad, counter-clockwise, except geographic ones.
"""

from r2p.messages import Message, Timestamp, f32, f64, i16, i32, u8, u16
from r2p.msg.firmware import Velocity3


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
    """Attitude and rates of the robot, filtered, with their time (topic `imu`). 4 fragments."""

    timestamp: Timestamp = Timestamp()
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
    """A fix of the GPS receiver, with its time (topic `gps`). 5 fragments."""

    timestamp: Timestamp = Timestamp()
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


class Setpoint(Message):
    """The position or speed that a motor controller is to reach, as configured (topic `setpoint`, thesis 7.3.2).

    The controller counts encoder ticks; how far a tick is, the kinematics know. 1 fragment.
    """

    ticks: i32 = 0
    """Position in ticks, or speed in ticks/s."""


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
    """The movement of the robot, with its time (topic `odometry`). 4 fragments."""

    timestamp: Timestamp = Timestamp()
    pose: Pose3 = Pose3()
    """Since the start, in the frame of the start."""
    velocity: Velocity3 = Velocity3()
    """In the frame of the robot."""
