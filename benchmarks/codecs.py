"""Packing messages and lines."""

import struct
import timeit
from collections.abc import Callable, Iterator

import r2p
from benchmarks.table import Row, rate, typical
from r2p.codecs import debug
from r2p.msg import Header, LaserScan, StampedIMURaw9

PAYLOAD = bytes(range(32))
NUMBER = 50_000
RAYS = 720


def seconds(function: Callable[[], object], number: int = NUMBER) -> float:
    """Seconds of one call."""
    return typical(5, lambda: timeit.timeit(function, number=number) / number)


def rows() -> Iterator[Row]:
    yield from _messages()
    yield from _scans()
    yield from _cdr()
    yield from _lines()


def _messages() -> Iterator[Row]:
    layout = r2p.layout(StampedIMURaw9)
    bare = struct.Struct("<II9h")
    values = (1, 2, *range(9))
    message = layout.decode(bare.pack(*values))
    data = layout.encode(message)
    encode, decode = layout.encode, layout.decode
    for what, ours, base in (
        ("encode", seconds(lambda: encode(message)), seconds(lambda: bare.pack(*values))),
        ("decode", seconds(lambda: decode(data)), seconds(lambda: bare.unpack(data))),
    ):
        yield Row(
            f"{what} StampedIMURaw9",
            f"{ours * 1e9:.0f} ns",
            f"bare struct {base * 1e9:.0f} ns: {ours / base:.1f}x",
            "within 3x",
            ours <= 3 * base,
        )


def _scans() -> Iterator[Row]:
    """A message of variable length against rosbags, which packs the same bytes."""
    import numpy as np
    from rosbags.typesys import Stores, get_typestore

    layout = r2p.layout(LaserScan)
    ranges = np.linspace(0.1, 30.0, RAYS, dtype=np.float32)
    scan = layout.decode(layout.encode(LaserScan(Header(frame_id="laser"), scan_time=0.025, ranges=r2p.Array(ranges))))
    data, encode, decode = layout.encode(scan), layout.encode, layout.decode
    store, name = get_typestore(Stores.ROS1_NOETIC), "sensor_msgs/msg/LaserScan"
    theirs = store.deserialize_ros1(data, name)
    assert bytes(store.serialize_ros1(theirs, name)) == data
    packed = seconds(lambda: encode(scan)), seconds(lambda: store.serialize_ros1(theirs, name), NUMBER // 5)
    unpacked = seconds(lambda: decode(data)), seconds(lambda: store.deserialize_ros1(data, name), NUMBER // 5)
    ours, base = (sum(pair) for pair in zip(packed, unpacked, strict=True))
    yield Row(
        f"encode + decode of a LaserScan of {RAYS} ranges",
        f"{packed[0] * 1e6:.2f} + {unpacked[0] * 1e6:.2f} us",
        f"rosbags {packed[1] * 1e6:.2f} + {unpacked[1] * 1e6:.2f} us: {base / ours:.1f}x",
        "5x",
        base >= 5 * ours,
    )


def _cdr() -> Iterator[Row]:
    """A message in ROS 2's serialisation, against rosbags."""
    from rosbags.typesys import Stores, get_typestore

    from r2p.ros.cdr import cdr
    from r2p.ros.classes import RosTypes
    from r2p.ros.library import definitions_of_ros

    imu = RosTypes(2, definitions_of_ros("sensor_msgs/Imu", 2)).load("sensor_msgs/Imu")
    store, name = get_typestore(Stores.LATEST), "sensor_msgs/msg/Imu"
    codec = cdr(imu)
    data = codec.encode(imu(header=Header(frame_id="imu_link")))
    message, theirs = codec.decode(data), store.deserialize_cdr(data, name)
    assert bytes(store.serialize_cdr(theirs, name)) == data
    packed = seconds(lambda: codec.encode(message)), seconds(lambda: store.serialize_cdr(theirs, name), NUMBER // 5)
    unpacked = seconds(lambda: codec.decode(data)), seconds(lambda: store.deserialize_cdr(data, name), NUMBER // 5)
    ours, base = (sum(pair) for pair in zip(packed, unpacked, strict=True))
    yield Row(
        "encode + decode of an Imu for ROS 2 (CDR)",
        f"{packed[0] * 1e6:.2f} + {unpacked[0] * 1e6:.2f} us",
        f"rosbags {packed[1] * 1e6:.2f} + {unpacked[1] * 1e6:.2f} us: {base / ours:.1f}x",
        "4x",
        base >= 4 * ours,
    )


def _lines() -> Iterator[Row]:
    encode = debug.encoder(b"encoder")
    line = encode(PAYLOAD, 0)
    chunk = line * 500
    ours = 1 / seconds(lambda: encode(PAYLOAD, 0))
    bare = 1 / seconds(lambda: PAYLOAD.hex().upper().encode())
    yield Row(
        "debug lines encoded, 32 bytes",
        rate(ours),
        f"bytes.hex of the payload alone {rate(bare)}: {ours / bare:.2f}x",
        "200 k/s",
        ours >= 200e3,
    )
    reader = debug.Reader()
    ours = 500 / seconds(lambda: reader.feed(chunk), 100)
    text = PAYLOAD.hex()
    bare = 1 / seconds(lambda: bytes.fromhex(text))
    yield Row(
        "debug lines decoded, 32 bytes",
        rate(ours),
        f"bytes.fromhex of the payload alone {rate(bare)}: {ours / bare:.2f}x",
        "200 k/s",
        ours >= 200e3,
    )
