"""Links over DDS, between programs with r2p; tests/ros/rclpy has those with real ROS 2."""
