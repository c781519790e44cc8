"""A rospy node that drives a robot to a place and stops there, by ROS's time; run by Debian's Python.

    drive_peer.py GOAL

It prints the ROS time and the real time that this took, in s.
"""

import sys
import time

import rospy
from geometry_msgs.msg import Twist
from nav_msgs.msg import Odometry

GAIN = 1.2
"""1/s."""
FASTEST = 0.25
"""m/s."""
NEAR = 0.004
"""m."""

_place = [0.0]


def _arrived(message: Odometry) -> None:
    _place[0] = message.pose.pose.position.x


def main() -> None:
    goal = float(sys.argv[1])
    rospy.init_node("drive")
    publisher = rospy.Publisher("/velocity", Twist, queue_size=1, tcp_nodelay=True)
    rospy.Subscriber("/odometry", Odometry, _arrived, queue_size=1, tcp_nodelay=True)
    rate = rospy.Rate(20)
    while not rospy.get_time():  # before the first message of /clock
        rospy.rostime.wallsleep(0.005)
    began, began_really = rospy.get_time(), time.monotonic()
    while abs(goal - _place[0]) > NEAR:
        velocity = Twist()
        velocity.linear.x = max(-FASTEST, min(FASTEST, GAIN * (goal - _place[0])))
        publisher.publish(velocity)
        rate.sleep()
    publisher.publish(Twist())
    sys.stdout.write(f"{rospy.get_time() - began} {time.monotonic() - began_really}\n")


if __name__ == "__main__":
    main()
