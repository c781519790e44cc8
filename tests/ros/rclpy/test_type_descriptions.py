"""What rclpy's nodes answer when they are asked for their types."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from r2p.ros.definitions import parse
from r2p.ros.hashes import TypeDescriptions
from r2p.ros.type_descriptions import NAME, definition_in, service

if TYPE_CHECKING:
    from tests.ros.rclpy.peer import RclpyPeer

pytestmark = [pytest.mark.xdist_group("rclpy"), pytest.mark.processes]


def test_definitions_in_the_answers_of_a_node(rclpy_peer: RclpyPeer) -> None:
    kind = "type_description_interfaces/srv/GetTypeDescription"
    assert rclpy_peer.ask("type_hash", type=kind) == service().checksum
    rclpy_peer.ask("node", name="describer")
    for number, name in enumerate(("sensor_msgs/msg/Imu", "test_msgs/msg/BoundedSequences", "std_msgs/msg/Empty")):
        rclpy_peer.ask("advertise", node="describer", topic=f"/topic{number}", type=name)
        checksum = rclpy_peer.ask("type_hash", type=name)
        request = {"type_name": name, "type_hash": checksum, "include_type_sources": True}
        answer = rclpy_peer.ask("call", node="describer", service=f"/describer/{NAME}", type=kind, request=request)
        text = definition_in(bytes.fromhex(answer["data"]))
        assert TypeDescriptions(parse(name, text)).hash(name) == checksum
    request["type_hash"] = "RIHS01_" + "0" * 64
    answer = rclpy_peer.ask("call", node="describer", service=f"/describer/{NAME}", type=kind, request=request)
    assert definition_in(bytes.fromhex(answer["data"])) == ""
