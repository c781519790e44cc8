"""Networks of robots that others measure with, run by r2p, rclpy and rospy: `benchmarks/irobot.py` has the rows.

`plans` and `measuring` need the standard library only: the Pythons of rclpy and rospy have no r2p.
"""
