"""Triskar2 on a simulated CAN bus, behind a gateway to ROS 1 and ROS 2: real ROS programs drive it."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from rosbags.typesys import Stores, get_typestore

import r2p
import r2p.sim
from r2p.clock import clock_of
from r2p.msg import Odometry, StampedIMU, Timestamp, Velocity3
from r2p.ros.middleware import RosArrival, RosEndpoint, RosType
from r2p.ros.stamps import STAMP_OF_RECEPTION
from r2p.ros.tf import odometry_tf
from r2p.sim.robots.emulated import Triskar2
from r2p.units import MILLISECOND, SECOND
from tests.ros.ros1 import packages
from tests.ros.ros2.network import joined, router

if TYPE_CHECKING:
    from tests.ros.ros1.programs import Ros1, RospyPeer

pytestmark = [pytest.mark.xdist_group("ros1"), pytest.mark.processes]

ROS2 = get_typestore(Stores.LATEST)
SPEED = 10.0
"""Of virtual time; slower computers take longer for it."""
SLOW = 3.0
"""The same for a robot on a bus of which each bit is simulated."""
LIMIT = 30.0
"""Real seconds after which a test has failed."""
GOAL = 0.3
"""m."""
GAIN, FASTEST, NEAR = 1.2, 0.25, 0.004


async def drive(node: r2p.Node) -> None:
    """The node of drive_peer.py, in r2p."""
    velocity, odometry = (
        node.advertise("velocity", Velocity3),
        node.subscribe("odometry", Odometry, lossy=True, queue=1),
    )
    place = 0.0

    async def follow() -> None:
        nonlocal place
        async for message in odometry:
            place = message.pose.x

    following = asyncio.create_task(follow())
    async for _ in node.every(0.05):
        if abs(GOAL - place) <= NEAR:
            break
        velocity.publish_nowait(Velocity3(x=max(-FASTEST, min(FASTEST, GAIN * (GOAL - place)))))
    following.cancel()
    velocity.publish_nowait(Velocity3())


async def _stopped(robot: Triskar2) -> tuple[float, float, float]:
    """The pose of the robot once it stands still."""
    await asyncio.sleep(1.0)
    return robot.pose


def test_a_rospy_node_in_virtual_time_stops_where_its_twin_in_r2p_does(ros1: Ros1) -> None:
    """Ten times as fast as real time, if the computer is fast enough for that."""

    async def with_r2p() -> tuple[float, float, float]:
        async with Triskar2("memory:robot", seed=1) as robot:
            await robot.ready()
            async with r2p.Module("PC1", via="memory:robot") as pc:
                pc.start(drive)
                await pc.wait()
            return await _stopped(robot)

    async def with_rospy() -> tuple[tuple[float, float, float], float, float]:
        async with Triskar2("memory:robot", seed=1, outside=[f"ros1:{ros1.uri}"]) as robot:
            await robot.ready()
            command = (packages.PYTHON, str(Path(__file__).with_name("drive_peer.py")), str(GOAL))
            process = await asyncio.create_subprocess_exec(
                *command, env=ros1.environment, stdout=asyncio.subprocess.PIPE
            )
            output, _ = await process.communicate()
            simulated, real = map(float, output.split())
            return await _stopped(robot), simulated, real

    pose = r2p.sim.run(with_r2p)
    other, simulated, real = r2p.sim.run(with_rospy, speed=SPEED)
    assert other == pytest.approx(pose, abs=0.01)
    assert pose[0] == pytest.approx(GOAL, abs=0.01)
    assert simulated > real


def test_ros1_and_ros2_drive_a_robot_and_see_it(ros1: Ros1, rospy_peer: RospyPeer) -> None:
    """At once, by one gateway. What comes back has the stamps of the module on the bus that has measured it."""
    measured: dict[float, int] = {}

    async def gyroscope(node: r2p.Node) -> None:
        """Measure the pace of time, and stamp it with the bus's time, which is all that firmware knows."""
        imu = node.advertise("imu", StampedIMU)
        async for _ in node.every(0.1):
            if (time := node.network_time()) is not None:
                measured[float(imu.sent)] = clock_of().now()
                await imu.publish(StampedIMU(Timestamp.from_ns(time), yaw_rate=float(imu.sent)))

    async def main() -> tuple[list[Any], list[Any], list[RosArrival]]:
        async with router() as network, joined(network, "/here") as (ros2, user):
            outside = [f"ros1:{ros1.uri}", f"ros2:{network.endpoint}"]
            async with Triskar2("sim:robot", seed=1, outside=outside) as robot:
                await robot.ready()
                robot.modules["MOTOR2"].start(gyroscope)
                robot.modules["GW"].start(odometry_tf)
                for topic, kind in (("/odometry", "nav_msgs/Odometry"), ("/imu", "sensor_msgs/Imu")):
                    ros2.subscribe(RosEndpoint("/here", topic, RosType(kind, ROS2.hash_rihs01(full(kind)))))
                await rospy_peer.do("subscribe", topic="/odometry", type="nav_msgs/Odometry")
                await rospy_peer.do("subscribe", topic="/tf", type="tf2_msgs/TFMessage")
                arguments = ("--rate", "100", "/velocity", "geometry_msgs/Twist", "{linear: {x: 0.2}}")
                async with asyncio.timeout(SLOW * LIMIT), ros1.running("rostopic", "pub", *arguments):
                    while await asyncio.sleep(0.1, robot.pose[0]) < 0.1:
                        pass
                odometry = await rospy_peer.do("messages", topic="/odometry", count=10)
                transforms = await rospy_peer.do("messages", topic="/tf", count=10)
                assert not any(link.stats.faults[STAMP_OF_RECEPTION] for link in robot.modules["GW"].links)
                return odometry, transforms, user.arrivals

    odometry, transforms, arrivals = r2p.sim.run(main, speed=SLOW)
    for topic in ("/odometry", "/tf"):
        asyncio.run(rospy_peer.do("unsubscribe", topic=topic))
    assert asyncio.run(rospy_peer.do("get_param", name="/use_sim_time")) is None  # later nodes have real time again
    of_ros1 = {stamp(each["message"]["header"]): pose(each["message"]["pose"]) for each in odometry}
    of_tf = {stamp(each["header"]): pose(each) for (each,) in (each["message"]["transforms"] for each in transforms)}
    of_ros2 = [decoded(each, "nav_msgs/Odometry") for each in arrivals if each.topic == b"/odometry"]
    assert len(of_ros1.keys() & of_tf.keys()) > 5
    assert all(of_ros1[each] == of_tf[each] for each in of_ros1.keys() & of_tf.keys())
    assert len({stamp(vars(each.header)) for each in of_ros2} & of_ros1.keys()) > 5
    readings = [decoded(each, "sensor_msgs/Imu") for each in arrivals if each.topic == b"/imu"]
    assert len(readings) > 5
    for each in readings:
        assert stamp(vars(each.header)) == pytest.approx(measured[each.angular_velocity.z], abs=MILLISECOND)


def full(name: str) -> str:
    return name.replace("/", "/msg/")


def decoded(arrival: RosArrival, name: str) -> Any:
    return ROS2.deserialize_cdr(arrival.data, full(name))


def stamp(header: dict[str, Any]) -> int:
    """The stamp of a header in ns, as rospy's or rosbags' names of its parts have it."""
    found = header["stamp"]
    sec, nsec = found.values() if isinstance(found, dict) else (found.sec, found.nanosec)
    return int(sec) * SECOND + int(nsec)


def pose(message: dict[str, Any]) -> Any:
    """The position in a message of odometry, or in a transform."""
    return message["transform"]["translation"] if "transform" in message else message["pose"]["position"]
