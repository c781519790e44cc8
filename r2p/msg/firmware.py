"""The messages of the R2P firmware, byte for byte (PROTOCOL.md 2).

The names are the firmware's, without `Msg`, and with `Stamped` for its `t`. The firmware does not say which units it
uses; those given here are the ones of thesis 7 and 8. `timestamp` is the network time (RTCAN) of the measurement.
"""

from r2p.messages import Message, Timestamp, f32, i16, u8, u16, u32


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
    """Movement of a quadrature encoder since the message before."""

    delta: i16 = 0
    """Ticks."""


class StampedQEI(Message):
    """Movement of a quadrature encoder since the message before, with its time."""

    timestamp: Timestamp = Timestamp()
    delta: i16 = 0
    """Ticks."""


class Encoder(Message):
    """Movement of an encoder since the message before (topic `encoder`)."""

    delta: f32 = 0.0
    """In units of the node that publishes it."""


class StampedEncoder(Message):
    """Movement of an encoder since the message before, with its time (topic `encoder`)."""

    timestamp: Timestamp = Timestamp()
    delta: f32 = 0.0
    """In units of the node that publishes it."""


class Encoder2(Message):
    """Movement of the two wheels of a differential drive since the message before."""

    left_delta: f32 = 0.0
    """In units of the node that publishes it."""
    right_delta: f32 = 0.0


class AbsoluteEncoder(Message):
    """Position of an absolute encoder."""

    position: f32 = 0.0
    """In units of the node that publishes it."""


class Velocity3(Message):
    """Velocity in the plane, in the frame of the robot (topics `velocity`, `velocity_cmd`)."""

    x: f32 = 0.0
    """Forward, m/s."""
    y: f32 = 0.0
    """To the left, m/s."""
    w: f32 = 0.0
    """Counter-clockwise, rad/s."""


class StampedVelocity3(Message):
    """Velocity in the plane, in the frame of the robot, with its time."""

    timestamp: Timestamp = Timestamp()
    x: f32 = 0.0
    """Forward, m/s."""
    y: f32 = 0.0
    """To the left, m/s."""
    w: f32 = 0.0
    """Counter-clockwise, rad/s."""


class StampedPose3(Message):
    """Position and heading in the plane, with its time."""

    timestamp: Timestamp = Timestamp()
    x: f32 = 0.0
    """m."""
    y: f32 = 0.0
    """m."""
    w: f32 = 0.0
    """Heading, counter-clockwise from the x axis, rad."""


class Tilt(Message):
    """Inclination about one axis (topic `tilt`)."""

    angle: f32 = 0.0
    """rad."""


class IMURaw9(Message):
    """Unfiltered readings of accelerometer, gyroscope and magnetometer (topic `imu_raw`).

    In counts of the sensors. What a count is depends on their full scale: at best 1 mg, 8.75 mdps and 0.9 mgauss
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
