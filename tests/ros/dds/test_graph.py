"""Names in DDS, and the graph that follows from what DDS and other participants report."""

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from r2p.protocols.discovery.directory import TABLE_MAX
from r2p.ros.dds.graph import DdsEndpoint, DdsGraph, OwnNode, announce
from r2p.ros.dds.names import checksum_in, dds_topic, ros_topic, ros_type, user_data
from r2p.ros.middleware import Qos
from r2p.ros.type_names import dds_type

PEER, SCAN, POSE = b"p" * 16, b"s" * 16, b"o" * 16


def endpoint(gid: bytes, topic: str, handle: int = 1) -> DdsEndpoint:
    return DdsEndpoint(gid, PEER, handle, topic, "sensor_msgs::msg::dds_::LaserScan_", "RIHS01_ab", Qos())


def test_names() -> None:
    assert (dds_topic("/robot1/scan"), dds_type("sensor_msgs/LaserScan")) == (
        "rt/robot1/scan",
        "sensor_msgs::msg::dds_::LaserScan_",
    )
    assert (
        dds_type("test_msgs/action/Fibonacci_FeedbackMessage") == "test_msgs::action::dds_::Fibonacci_FeedbackMessage_"
    )
    for name in ("sensor_msgs/LaserScan", "test_msgs/action/Fib_Goal"):
        assert ros_type(dds_type(name)) == name
    assert [ros_topic(name) for name in ("rt/scan", "rq/scanRequest", "DCPSTopic", "rt", "rt/")] == [
        "/scan",
        "",
        "",
        "",
        "",
    ]
    assert [ros_type(name) for name in ("A", "a::b", "a::idl::dds_::B_", "a::msg::dds_::_")] == [""] * 4
    assert checksum_in(user_data("RIHS01_ab") + b"\0") == "RIHS01_ab"
    assert checksum_in(b"enclave=/;\xff") == ""


def test_endpoints_belong_to_the_nodes_that_participants_announce() -> None:
    graph = DdsGraph()
    graph.add(endpoint(SCAN, "rt/scan", 7), writes=True)
    graph.add(endpoint(POSE, "rt/pose", 8), writes=False)
    graph.add(endpoint(b"x" * 16, "rq/homeRequest", 9), writes=False)
    assert graph.writer_of(7) == ("", SCAN)
    assert graph.announced(announce(PEER, {"/robot1/lidar": OwnNode(writers=[SCAN]), "/nav": OwnNode(readers=[POSE])}))
    found = graph.ros_graph()
    assert found.nodes == {"/robot1/lidar", "/nav"}
    assert [(each.node, each.topic, each.type, each.gid) for each in found.publishers] == [
        ("/robot1/lidar", "/scan", "sensor_msgs/LaserScan", SCAN)
    ]
    assert [(each.node, each.topic) for each in found.subscribers] == [("/nav", "/pose")]
    assert graph.writer_of(7) == ("/robot1/lidar", SCAN)
    graph.remove(SCAN)
    assert (graph.ros_graph().publishers, graph.writer_of(7)) == (frozenset(), ("", b""))
    graph.remove_participant(PEER)
    assert graph.ros_graph().nodes == frozenset()


@given(st.binary(max_size=100))
def test_bytes_from_the_network_never_raise(data: bytes) -> None:
    graph = DdsGraph()
    for head in (b"", b"\0\1\0\0", b"\0\1\0\0" + PEER + b"\1\0\0\0"):
        graph.announced(head + data)
    checksum_in(data)


def test_what_others_announce_is_bounded() -> None:
    graph = DdsGraph()
    for number in range(TABLE_MAX + 5):
        gid = number.to_bytes(16, "big")
        graph.add(msgspec.structs.replace(endpoint(gid, "rt/scan", number), participant=gid), writes=True)
        graph.announced(announce(gid, {f"/n{number}": OwnNode()}))
    found = graph.ros_graph()
    assert (len(found.publishers), len(found.nodes)) == (TABLE_MAX, TABLE_MAX)


def test_participants_that_are_made_up_take_no_room_for_good(monkeypatch: pytest.MonkeyPatch) -> None:
    """Anyone may send the message of any participant; real ones have endpoints."""
    monkeypatch.setattr("r2p.ros.dds.graph.ENTRIES_MAX", 20)
    graph = DdsGraph()
    graph.add(endpoint(SCAN, "rt/scan", 7), writes=True)
    for number in range(100):
        made_up = OwnNode(writers=[bytes([number, each]) + bytes(14) for each in range(3)])
        assert graph.announced(announce(bytes([number]) * 16, {f"/n{number}": made_up}))
        assert (len(graph._nodes) <= 5, len(graph._owners) <= 15) == (True, True)
    assert graph.announced(announce(PEER, {"/lidar": OwnNode(writers=[SCAN])}))
    large = announce(b"l" * 16, {f"/{number}": OwnNode() for number in range(19)})
    assert not graph.announced(large)
    assert not graph.announced(large + bytes(1 << 20))
    assert graph.ros_graph().nodes == {"/lidar"}
    assert graph.announced(announce(PEER, {f"/{number}": OwnNode() for number in range(20)}))
