"""One node of a network by rospy, of which a process has one: `rospy_end.py PLAN NODE`, run by Debian's Python.

Messages are `std_msgs/UInt8MultiArray`, whose bytes begin with the header of `plans.HEADER`.
"""

from __future__ import annotations

import os
import struct
import sys
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Any

sys.path.insert(0, str(Path(__file__).parents[2]))

import rospy
from std_msgs.msg import UInt8MultiArray

from benchmarks.robot_networks import measuring
from benchmarks.robot_networks.plans import PLANS, NodePlan, Plan, Topic

if TYPE_CHECKING:
    from collections.abc import Callable

_HEADER = struct.Struct("<I4xQ")
_DEPTH = 10


def _publish(publisher: Any, topic: Topic) -> Callable[[object], None]:
    data, counter = bytearray(_HEADER.size + topic.size), 0

    def publish(_: object) -> None:
        nonlocal counter
        counter += 1
        _HEADER.pack_into(data, 0, counter, measuring.now())
        publisher.publish(UInt8MultiArray(data=bytes(data)))

    return publish


def main(plan: Plan, node: NodePlan) -> None:
    recorder = measuring.Recorder(plan, [node.name])
    one = threading.Lock()  # each connection has a thread
    rospy.init_node(node.name, disable_signals=True)

    def receive(message: UInt8MultiArray, topic: str) -> None:
        with one:
            recorder.message(node.name, topic, *_HEADER.unpack_from(message.data))

    for name in node.subscribes:
        rospy.Subscriber(name, UInt8MultiArray, receive, name, queue_size=_DEPTH, buff_size=1 << 20, tcp_nodelay=True)
    for topic in node.publishes:
        publisher = rospy.Publisher(topic.name, UInt8MultiArray, queue_size=_DEPTH, tcp_nodelay=True)
        rospy.Timer(rospy.Duration(topic.period), _publish(publisher, topic))
    ended = threading.Event()
    measuring.serve(recorder, ended.set)
    ended.wait()
    os._exit(0)


if __name__ == "__main__":
    network = PLANS[sys.argv[1]]
    main(network, next(each for each in network.nodes if each.name == sys.argv[2]))
