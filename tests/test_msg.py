"""The standard messages: byte for byte the firmware's, with fingerprints that must never change."""

import pytest

import r2p.msg
from r2p.messages import Message, Timestamp, layout
from r2p.msg import Led, Log, Odometry, Pose3, Proximity, StampedIMURaw9, StampedQEI, Tilt, Velocity3
from r2p.tools.types import standard_types

EVERY = standard_types()
FIXED = [cls for cls in EVERY if not layout(cls).varies]

FIRMWARE = {
    "Led": (5, "led:u32 value:u8"),
    "Float32": (4, "data:f32"),
    "PWM": (2, "pwm:u16"),
    "PWM2": (4, "pwm1:i16 pwm2:i16"),
    "PWM3": (6, "pwm1:i16 pwm2:i16 pwm3:i16"),
    "Speed": (2, "speed:u16"),
    "Speed2": (8, "value:f32[2]"),
    "Speed3": (12, "value:f32[3]"),
    "QEI": (2, "delta:i16"),
    "StampedQEI": (10, "timestamp.sec:u32 timestamp.nsec:u32 delta:i16"),
    "Encoder": (4, "delta:f32"),
    "StampedEncoder": (12, "timestamp.sec:u32 timestamp.nsec:u32 delta:f32"),
    "Encoder2": (8, "left_delta:f32 right_delta:f32"),
    "AbsoluteEncoder": (4, "position:f32"),
    "Velocity3": (12, "x:f32 y:f32 w:f32"),
    "StampedVelocity3": (20, "timestamp.sec:u32 timestamp.nsec:u32 x:f32 y:f32 w:f32"),
    "StampedPose3": (20, "timestamp.sec:u32 timestamp.nsec:u32 x:f32 y:f32 w:f32"),
    "Tilt": (4, "angle:f32"),
    "IMURaw9": (18, " ".join(f"{sensor}_{axis}:i16" for sensor in ("acc", "gyro", "mag") for axis in "xyz")),
    "StampedIMURaw9": (
        26,
        "timestamp.sec:u32 timestamp.nsec:u32 "
        + " ".join(f"{sensor}_{axis}:i16" for sensor in ("acc", "gyro", "mag") for axis in "xyz"),
    ),
}
"""PROTOCOL.md 2."""

SIZES = {
    "IMU": 24,
    "StampedIMU": 32,
    "Proximity": 8,
    "Battery": 7,
    "PowerEvent": 6,
    "Pressure": 8,
    "GPS": 32,
    "StampedGPS": 40,
    "Setpoint": 4,
    "TiltRate": 8,
    "Effort2": 8,
    "Pose3": 12,
    "Odometry": 24,
    "StampedOdometry": 32,
    "Text": 64,
    "Log": 152,
    "GatewayStatus": 96,
    "Timestamp": 8,
    "Duration": 8,
}


@pytest.mark.parametrize("name", FIRMWARE)
def test_firmware_layout(name: str) -> None:
    shape = layout(getattr(r2p.msg, name))
    assert (shape.size, shape.schema) == FIRMWARE[name]


@pytest.mark.parametrize("name", SIZES)
def test_size(name: str) -> None:
    assert layout(getattr(r2p.msg, name)).size == SIZES[name]


def test_all_are_listed() -> None:
    assert {cls.__name__ for cls in FIXED} == {*FIRMWARE, *SIZES}


@pytest.mark.parametrize("cls", EVERY)
def test_defaults_are_zero(cls: type[Message]) -> None:
    assert cls() == layout(cls).zero
    assert cls().encode() == bytes(layout(cls).size_min)


@pytest.mark.parametrize("cls", FIXED)
def test_a_debug_line_carries_what_firmware_may_send(cls: type[Message]) -> None:
    assert layout(cls).size <= 255


@pytest.mark.parametrize("cls", EVERY)
def test_is_documented(cls: type[Message]) -> None:
    assert cls.__doc__


@pytest.mark.parametrize(
    ("cls", "fingerprint"),
    [
        (Led, "9ef58fbde4f40142"),
        (Velocity3, "c9e1a1a464f51d66"),
        (StampedIMURaw9, "44137799cf5d0152"),
        (Odometry, "075f2f25b6e57f3e"),
        (Log, "13c1319ee84036c3"),
    ],
)
def test_fingerprints_are_the_same_for_ever(cls: type[Message], fingerprint: str) -> None:
    """Peers compare them: a layout that changes must get another one, any other change must not."""
    assert layout(cls).fingerprint.hex() == fingerprint


@pytest.mark.golden
@pytest.mark.parametrize(
    ("message", "payload"),
    [
        (Led(led=2, value=1), "0200000001"),
        (Led(led=2), "0200000000"),
        (Velocity3(x=1.0, y=2.0, w=3.0), "0000803F0000004000004040"),
        (Velocity3(x=0.5, y=-0.25, w=0.125), "0000003F000080BE0000003E"),
        (Velocity3(x=1001.0), "00407A440000000000000000"),
    ],
)
def test_recorded_payloads(message: Message, payload: str) -> None:
    assert message.encode().hex().upper() == payload
    assert type(message).decode(bytes.fromhex(payload)) == message


@pytest.mark.parametrize(
    ("message", "payload"),
    [
        (Tilt(-1.0), "000080bf"),
        (StampedQEI(Timestamp(1, 2), -3), "0100000002000000fdff"),
        (Proximity((1, 2, 3, 65535)), "010002000300ffff"),
        (Odometry(Pose3(1.0, 0.0, 0.0), Velocity3(w=2.0)), "0000803f" + "00" * 16 + "00000040"),
        (
            Log(Timestamp(1, 0), 20, "PC1", "blink", "hi"),
            "010000000000000014" + b"PC1\0\0\0\0blink\0\0\0hi".hex() + "00" * 126,
        ),
    ],
)
def test_packed(message: Message, payload: str) -> None:
    assert message.encode().hex() == payload
    assert type(message).decode(bytes.fromhex(payload)) == message
