"""Both ends of performance_test's sweep by rclpy: `send` or `receive`, with an order a line on its input.

`receive` answers `count` with what came since, as JSON; `send` takes size, rate and seconds, and answers with `sent`.
"""

import array
import json
import struct
import sys
import threading
import time
from typing import Any

import rclpy
from std_msgs.msg import UInt8MultiArray

_STAMP = struct.Struct("<Q")
_TOPIC = "array"
_DEPTH = 10


def receive(node: Any) -> None:
    latencies: list[float] = []

    def arrived(message: UInt8MultiArray) -> None:
        latencies.append((time.monotonic_ns() - _STAMP.unpack_from(message.data)[0]) / 1e9)

    node.create_subscription(UInt8MultiArray, _TOPIC, arrived, _DEPTH)
    threading.Thread(target=rclpy.spin, args=(node,), daemon=True).start()
    for _ in sys.stdin:
        came, latencies[:] = latencies[:], []
        print(json.dumps(came), flush=True)


def send(node: Any) -> None:
    publisher = node.create_publisher(UInt8MultiArray, _TOPIC, _DEPTH)
    while not publisher.get_subscription_count():
        time.sleep(0.05)
    print("ready", flush=True)
    for line in sys.stdin:
        size, rate, seconds = map(float, line.split())
        padding, sent, began = bytes(int(size) - _STAMP.size), 0, time.perf_counter()
        while (now := time.perf_counter() - began) < seconds:
            time.sleep(max(sent / rate - now, 0))
            sent += 1
            message = UInt8MultiArray()
            message.data = array.array("B", _STAMP.pack(time.monotonic_ns()) + padding)
            publisher.publish(message)
        print("sent", flush=True)


if __name__ == "__main__":
    rclpy.init()
    {"send": send, "receive": receive}[sys.argv[1]](rclpy.create_node(sys.argv[1]))
