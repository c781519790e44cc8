"""Transforms on /tf."""

import asyncio

import pytest

import r2p
from r2p.msg import Odometry, Pose3
from r2p.ros.library import ros1_md5, ros2_hash
from r2p.ros.tf import TFMessage, TransformStamped, odometry_tf
from r2p.testing.network import node_in
from tests.ros.fake import FakeRosNetwork
from tests.ros.recorded import recorded


def test_ros_has_these_types() -> None:
    md5s = {case["type"]: case["md5"] for case in recorded(1)["type_md5s"]}
    assert ros1_md5(TFMessage) == md5s["tf2_msgs/TFMessage"]
    assert ros1_md5(TransformStamped) == md5s["geometry_msgs/TransformStamped"]
    assert ros2_hash(TransformStamped).startswith("RIHS01_")


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.virtual_time
async def test_the_pose_of_a_robot_is_a_transform(version: int) -> None:
    network = FakeRosNetwork(version)
    transforms = network.node("/rviz").subscribe("/tf", TFMessage)
    async with r2p.Module("PC1", via=network.transport()) as module, node_in(module) as robot:
        module.start(odometry_tf)
        odometry = robot.advertise("odometry", Odometry)
        await odometry.wait_subscriber()
        stamp = robot.now()
        await odometry.publish(Odometry(Pose3(w=float("inf"))))  # is left out
        await odometry.publish(Odometry(Pose3(1.0, 2.0, 3.14159265)))
        await asyncio.sleep(0.1)
    ((transform,),) = [each.transforms for each in transforms]
    header, place = transform.header, transform.transform
    assert (header.stamp.ns, header.frame_id, transform.child_frame_id) == (stamp, "odom", "base_link")
    assert (place.translation.x, place.translation.y, place.rotation.z) == pytest.approx((1.0, 2.0, 1.0))
