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
from r2p.ros.cdr import cdr
from r2p.ros.middleware import RosArrival, RosEndpoint, RosType
from r2p.ros.stamps import STAMP_OF_RECEPTION
from r2p.ros.tf import Vector3, odometry_tf
from r2p.sim.robots.emulated import Triskar2
from r2p.units import MILLISECOND, SECOND
from tests.ros.ros1 import packages
from tests.ros.ros2.network import joined, router

if TYPE_CHECKING:
    from collections.abc import Sequence

    from r2p.ros.ros2.middleware import Ros2Middleware
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


class Twist(r2p.Message, name="geometry_msgs/Twist"):
    linear: Vector3 = Vector3()
    angular: Vector3 = Vector3()


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


async def gyroscope(node: r2p.Node, measured: dict[float, int]) -> None:
    """Measure its own number, and stamp it with the time of the bus, which is all that firmware knows."""
    imu = node.advertise("imu", StampedIMU)
    async for _ in node.every(0.1):
        if (time := node.network_time()) is not None:
            measured[float(imu.sent)] = clock_of().now()
            await imu.publish(StampedIMU(Timestamp.from_ns(time), yaw_rate=float(imu.sent)))


def test_ros1_and_ros2_drive_a_robot_and_see_it(ros1: Ros1, rospy_peer: RospyPeer) -> None:
    """At once, by one gateway. What comes back has the stamps of the module on the bus that has measured it."""
    measured: dict[float, int] = {}
    of_ros1: dict[int, Any] = {}
    of_tf: dict[int, Any] = {}

    async def in_ros1(topic: str) -> Any:
        return (await rospy_peer.do("messages", topic=topic))[0]["message"]

    async def drive_from_both(robot: Triskar2, ros2: Ros2Middleware) -> None:
        arguments = ("--rate", "100", "/velocity", "geometry_msgs/Twist", "{linear: {x: 0.2}}")
        async with ros1.running("rostopic", "pub", *arguments):
            while await asyncio.sleep(0.1, robot.pose[0]) < 0.05:
                pass
        kind = full("geometry_msgs/Twist")
        ros2.advertise(RosEndpoint("/here", "/velocity", RosType("geometry_msgs/Twist", ROS2.hash_rihs01(kind))))
        while await asyncio.sleep(0.05, robot.pose[2]) < 0.2:
            turn = Vector3(z=1.0)
            ros2.publish("/here", "/velocity", cdr(Twist).encode(Twist(angular=turn)), clock_of().now())

    async def main() -> list[RosArrival]:
        async with router() as network, joined(network, "/here") as (ros2, user):
            outside = [f"ros1:{ros1.uri}", f"ros2:{network.endpoint}"]
            async with Triskar2("sim:robot", seed=1, outside=outside) as robot, asyncio.timeout(SLOW * LIMIT):
                await robot.ready()
                robot.modules["MOTOR2"].start(gyroscope, measured)
                robot.modules["GW"].start(odometry_tf)
                for topic, kind in (("/odometry", "nav_msgs/Odometry"), ("/imu", "sensor_msgs/Imu")):
                    ros2.subscribe(RosEndpoint("/here", topic, RosType(kind, ROS2.hash_rihs01(full(kind)))))
                await rospy_peer.do("subscribe", topic="/odometry", type="nav_msgs/Odometry")
                await rospy_peer.do("subscribe", topic="/tf", type="tf2_msgs/TFMessage")
                await drive_from_both(robot, ros2)
                while len(of_ros1.keys() & of_tf.keys()) < 5 or len(on(user.arrivals, "/imu")) < 5:
                    message, (transform,) = await in_ros1("/odometry"), (await in_ros1("/tf"))["transforms"]
                    of_ros1[stamp(message["header"])] = message["pose"]["pose"]["position"]
                    of_tf[stamp(transform["header"])] = transform["transform"]["translation"]
                assert not any(link.stats.faults[STAMP_OF_RECEPTION] for link in robot.modules["GW"].links)
                return user.arrivals

    arrivals = r2p.sim.run(main, speed=SLOW)
    for topic in ("/odometry", "/tf"):
        asyncio.run(rospy_peer.do("unsubscribe", topic=topic))
    assert asyncio.run(rospy_peer.do("get_param", name="/use_sim_time")) is None  # later nodes have real time again
    assert all(of_ros1[each] == of_tf[each] for each in of_ros1.keys() & of_tf.keys())
    of_ros2 = [decoded(each, "nav_msgs/Odometry") for each in on(arrivals, "/odometry")]
    seen = {stamp(vars(each.header)): each.pose.pose.position for each in of_ros2}
    both = seen.keys() & of_ros1.keys()
    assert len(both) > 3
    assert {each: seen[each].x for each in both} == {each: of_ros1[each]["x"] for each in both}
    readings = [decoded(each, "sensor_msgs/Imu") for each in on(arrivals, "/imu")]
    for each in readings:
        assert stamp(vars(each.header)) == pytest.approx(measured[each.angular_velocity.z], abs=MILLISECOND)


def on(arrivals: Sequence[RosArrival], topic: str) -> list[RosArrival]:
    """Those of one topic."""
    return [each for each in arrivals if each.topic == topic.encode()]


def full(name: str) -> str:
    return name.replace("/", "/msg/")


def decoded(arrival: RosArrival, name: str) -> Any:
    return ROS2.deserialize_cdr(arrival.data, full(name))


def stamp(header: dict[str, Any]) -> int:
    """The stamp of a header in ns, as rospy's or rosbags' names of its parts have it."""
    found = header["stamp"]
    sec, nsec = found.values() if isinstance(found, dict) else (found.sec, found.nanosec)
    return int(sec) * SECOND + int(nsec)
