"""The options of r2p gateway for links to ROS, and what its table says of topics that are not there."""

from typing import Any

import pytest

from r2p.msg import Encoder, Velocity3
from r2p.ros.options import QosChange
from r2p.ros.transport import RosTransport
from r2p.tools.gateway import Row, table
from r2p.tools.ros_gateway import RosGatewayOptions, open_links
from r2p.tools.session import Settings, UsageError

VIA = ["tcp-listen:0", "ros2:?ns=/robot1", "ros1:?ros_nodes=yes"]


def test_options_are_those_of_all_links_to_ros() -> None:
    settings = Settings(
        via=VIA, types={"enc": "Encoder", "velocity": "Encoder", "home": "std_msgs/Empty,std_msgs/Empty"}
    )
    given = RosGatewayOptions(["/velocity=Velocity3"], ["imu*=sensor_msgs/msg/Imu"], ["scan=best_effort+depth:1"])
    bus, ros2, ros1 = open_links(settings, given)
    assert bus == VIA[0]
    assert isinstance(ros2, RosTransport)
    assert isinstance(ros1, RosTransport)
    for options in (ros2.options, ros1.options):
        found: dict[str, Any] = dict(options.types)
        assert (found["enc"], found["velocity"]) == (Encoder, Velocity3)  # the option wins over r2p.toml
        assert found["home"].Request.__name__ == "Empty"
        assert options.ros_types == {"imu*": "sensor_msgs/msg/Imu"}
        assert options.qos == {"scan": QosChange(reliable=False, depth=1)}
    assert (ros2.options.ns, ros2.options.ros_nodes) == ("/robot1", False)
    assert (ros1.options.ns, ros1.options.ros_nodes) == ("", True)


@pytest.mark.parametrize(
    ("given", "text"),
    [
        (RosGatewayOptions(types=["leds"]), "--type leds: write it as TOPIC=TYPE"),
        (RosGatewayOptions(types=["leds=Nope"]), "no message class 'Nope'"),
        (RosGatewayOptions(types=["leds=nope/Nope"]), "has a type nope/Nope"),
        (RosGatewayOptions(ros_types=["imu=Imu"]), "'Imu' is not the name of a ROS type, such as sensor_msgs/Imu"),
        (RosGatewayOptions(qos=["scan=fast"]), "--qos scan: 'fast' is not a quality of service: write reliable"),
    ],
)
def test_mistakes_are_named(given: RosGatewayOptions, text: str) -> None:
    with pytest.raises(UsageError, match=text):
        open_links(Settings(via=VIA), given)


@pytest.mark.parametrize(
    ("given", "option"),
    [
        (RosGatewayOptions(types=["a=Led"]), "--type a=Led"),
        (RosGatewayOptions(ros_types=["a=b/C"]), "--ros-type a=b/C"),
        (RosGatewayOptions(qos=["a=depth:1"]), "--qos a=depth:1"),
        (RosGatewayOptions(ros_nodes=True), "--ros-nodes"),
    ],
)
def test_options_without_a_link_to_ros(given: RosGatewayOptions, option: str) -> None:
    with pytest.raises(UsageError, match=f"{option} is for links to ROS, and there is none: add --via ros2:"):
        open_links(Settings(via=VIA[:1]), given)
    assert open_links(Settings(via=VIA[:1]), RosGatewayOptions()) == VIA[:1]


def test_the_table_says_what_is_not_on_ros() -> None:
    lost = {"raw": "type unknown", "enc": "type unknown", "2nd/x": "ROS has no such names"}
    text = table([Row("", "ros2:", "", "alone", 0, 0.0, 0, {}, not_carried=lost)])
    assert text.splitlines()[-2:] == [
        "not on ros2: 2nd/x: ROS has no such names",
        "not on ros2: enc, raw: type unknown",
    ]
