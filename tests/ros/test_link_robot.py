"""Triskar2 on a simulated CAN bus, behind a gateway to ROS 1 and ROS 2 at once, in free virtual time."""

import asyncio
from typing import Any

import pytest

from r2p.ros.topics import ros_class
from r2p.sim.robots.emulated import Triskar2
from tests.ros.fake import FakeRosNetwork

SPEED = 0.2  # m/s
DRIVES = 2.0  # s


@pytest.mark.virtual_time
async def test_ros1_drives_the_robot_and_ros2_sees_it() -> None:
    one, two = FakeRosNetwork(1), FakeRosNetwork(2)
    driver, viewer = one.node("/driver"), two.node("/viewer")
    twist: Any = ros_class("geometry_msgs/Twist", 1)
    forward = twist(linear=type(twist().linear)(x=SPEED))
    seen = viewer.subscribe("/odometry", ros_class("nav_msgs/Odometry", 2))
    driver.advertise("/velocity", twist)
    async with Triskar2("sim:robot", seed=1, outside=[one.transport(), two.transport()]) as robot:
        await robot.ready()
        gateway = robot.modules["GW"]
        await asyncio.sleep(2.0)
        for _ in range(round(DRIVES / 0.05)):
            driver.publish("/velocity", forward)
            await asyncio.sleep(0.05)
        driver.publish("/velocity", twist())
        await asyncio.sleep(1.0)
        pose, losses = robot.pose, [link.losses for link in gateway.links]
        off_ros = {topic for port in gateway.gateway_statistics().ports for topic in port.not_carried}
    stamps = [each.header.stamp.ns for each in seen]
    assert pose[0] == pytest.approx(SPEED * DRIVES, rel=0.1)
    assert seen[-1].pose.pose.position.x == pytest.approx(pose[0], abs=0.02)
    assert stamps == sorted(set(stamps))
    assert not any(each["internal error"] or each["not convertible"] for each in losses)
    assert not off_ros
