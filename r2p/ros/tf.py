"""Transforms between frames of coordinates, `/tf` of ROS, and a node that publishes those of a robot's odometry.

    r2p run r2p.ros.tf:odometry_tf --via ros2:

A robot's modules publish its pose as `odometry`; ROS's tools want it as the transform from `odom` to `base_link`, too.
"""

from collections import Counter
from typing import Annotated

import r2p.msg
from r2p.errors import MessageError
from r2p.messages import Max, Message, Timestamp, f64
from r2p.ros.stamps import StampSource
from r2p.ros.standard import BASE, ODOM, quaternion
from r2p.runtime.node import Node

TRANSFORMS_MAX = 1024


class Vector3(Message, name="geometry_msgs/Vector3"):
    """Three numbers along the axes x, y and z."""

    x: f64 = 0.0
    y: f64 = 0.0
    z: f64 = 0.0


class Quaternion(Message, name="geometry_msgs/Quaternion"):
    """A rotation."""

    x: f64 = 0.0
    y: f64 = 0.0
    z: f64 = 0.0
    w: f64 = 1.0


class Transform(Message, name="geometry_msgs/Transform"):
    """Where a frame is in another one."""

    translation: Vector3 = Vector3()
    """m."""
    rotation: Quaternion = Quaternion()


class TransformStamped(Message, name="geometry_msgs/TransformStamped"):
    """Where the frame `child_frame_id` is in the frame of the header."""

    header: r2p.msg.Header = r2p.msg.Header()
    child_frame_id: Annotated[str, Max(256)] = ""
    transform: Transform = Transform()


class TFMessage(Message, name="tf2_msgs/TFMessage"):
    """Transforms (topics `tf`, and `tf_static` for those that never change, latched)."""

    transforms: Annotated[tuple[TransformStamped, ...], Max(TRANSFORMS_MAX)] = ()


async def odometry_tf(node: Node) -> None:
    """Publish the pose in `odometry` (Odometry) as a transform on `tf`."""
    await _publish_poses(node, r2p.msg.Odometry)


async def stamped_odometry_tf(node: Node) -> None:
    """Publish the pose in `odometry` (StampedOdometry) as a transform on `tf`."""
    await _publish_poses(node, r2p.msg.StampedOdometry)


async def _publish_poses(node: Node, type: type[r2p.msg.Odometry] | type[r2p.msg.StampedOdometry]) -> None:
    frame = node.parameter("frame", ODOM, doc="The frame of the pose")
    child = node.parameter("child_frame", BASE, doc="The frame of the robot")
    transforms = node.advertise("tf", TFMessage)
    poses = node.subscribe("odometry", type, lossy=True)
    stamps = StampSource(type, Counter())
    async for sample in poses.samples():
        try:
            message = transforms_of(sample.message.pose, stamps.find(sample), frame.value, child.value)
        except MessageError:  # of a module whose clock is beyond 2106, or with an infinite angle
            continue
        await transforms.publish(message)


def transforms_of(pose: r2p.msg.Pose3, ns: int, frame: str, child: str) -> TFMessage:
    """Return a pose as the transform from one frame to another at `ns` (UTC).

    Raises MessageError for a time outside of 1970 to 2106, and for an infinite angle.
    """
    header = r2p.msg.Header(stamp=Timestamp.from_ns(ns), frame_id=frame)
    place = Transform(Vector3(pose.x, pose.y), quaternion(Quaternion, 0.0, 0.0, pose.w))
    return TFMessage((TransformStamped(header, child, place),))
