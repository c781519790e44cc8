"""ROS 2 over zenoh: the formats and the middleware of rmw_zenoh."""
