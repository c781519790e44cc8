"""Nodes of a network by rclpy, in one process, with one executor: `rclpy_end.py PLAN NODE...`, run by rclpy's Python.

Messages are `std_msgs/UInt8MultiArray`, whose bytes begin with the header of `plans.HEADER`.
"""

from __future__ import annotations

import array
import contextlib
import functools
import struct
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

sys.path.insert(0, str(Path(__file__).parents[2]))

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from std_msgs.msg import UInt8MultiArray

from benchmarks.robot_networks import measuring
from benchmarks.robot_networks.plans import PLANS, NodePlan, Plan, Topic

if TYPE_CHECKING:
    from collections.abc import Callable

_HEADER = struct.Struct("<I4xQ")
_DEPTH = 10


def _publish(publisher: Any, topic: Topic) -> Callable[[], None]:
    data, counter = bytearray(_HEADER.size + topic.size), 0

    def publish() -> None:
        nonlocal counter
        counter += 1
        _HEADER.pack_into(data, 0, counter, measuring.now())
        message = UInt8MultiArray()
        message.data = array.array("B", data)
        publisher.publish(message)

    return publish


def _receive(recorder: measuring.Recorder, node: str, topic: str, message: UInt8MultiArray) -> None:
    recorder.message(node, topic, *_HEADER.unpack_from(message.data))


def _make(plan: NodePlan, recorder: measuring.Recorder) -> Any:
    node = rclpy.create_node(plan.name, start_parameter_services=False)
    for topic in plan.publishes:
        publisher = node.create_publisher(UInt8MultiArray, topic.name, _DEPTH)
        node.create_timer(topic.period, _publish(publisher, topic))
    for name in plan.subscribes:
        callback = functools.partial(_receive, recorder, plan.name, name)
        node.create_subscription(UInt8MultiArray, name, callback, _DEPTH)
    return node


def main(plan: Plan, names: list[str]) -> None:
    recorder = measuring.Recorder(plan, names)
    rclpy.init()
    executor = SingleThreadedExecutor()
    for each in plan.nodes:
        if each.name in names:
            executor.add_node(_make(each, recorder))
    measuring.serve(recorder, rclpy.shutdown)
    with contextlib.suppress(ExternalShutdownException):
        executor.spin()


if __name__ == "__main__":
    main(PLANS[sys.argv[1]], sys.argv[2:])
