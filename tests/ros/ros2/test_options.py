"""The URL, the environment that programs of ROS 2 heed, and the configuration that follows from both."""

import json
from pathlib import Path
from typing import Any

import pytest

import r2p
from r2p.ros.options import RosOptions
from r2p.ros.ros2.options import parse_options, zenoh_config
from r2p.transports.url import parse


def settings(url: str, **environ: str) -> dict[str, Any]:
    config = zenoh_config(parse_options(parse(url), environ))
    keys = ("mode", "connect/endpoints", "listen/endpoints", "scouting/multicast/enabled", "timestamping/enabled")
    return {key: json.loads(config.get_json(key)) for key in keys}


def test_the_router_of_rmw_zenoh_is_the_default() -> None:
    assert settings("ros2:") == {
        "mode": "client",
        "connect/endpoints": ["tcp/localhost:7447"],
        "listen/endpoints": [],
        "scouting/multicast/enabled": False,
        "timestamping/enabled": True,
    }
    assert settings("ros2:tcp/robot:7447,mode=peer")["connect/endpoints"] == ["tcp/robot:7447"]


def test_environment() -> None:
    options = parse_options(parse("ros2:?ns=/robot1"), {"ROS_DOMAIN_ID": "42"})
    assert (options.domain, options.ros) == (42, RosOptions(ns="/robot1"))
    assert parse_options(parse("ros2:?domain=3"), {"ROS_DOMAIN_ID": "x"}).domain == 3
    assert parse_options(parse("ros2:"), {"ROS_DOMAIN_ID": ""}).domain == 0
    override = 'connect/endpoints=["tcp/10.0.0.1:7447"]; mode="peer" ;scouting/multicast/enabled=true'
    given = settings("ros2:", ZENOH_CONFIG_OVERRIDE=override)
    assert (given["connect/endpoints"], given["mode"]) == (
        ["tcp/10.0.0.1:7447"],
        "client",
    )  # others reach too few nodes
    assert given["scouting/multicast/enabled"] is True
    given = settings("ros2:tcp/robot:7447", ZENOH_CONFIG_OVERRIDE=override)
    assert given["connect/endpoints"] == ["tcp/robot:7447"]


def test_a_file_as_that_of_rmw_zenoh(tmp_path: Path) -> None:
    path = tmp_path / "session.json5"
    path.write_text('{mode: "peer", connect: {endpoints: ["tcp/robot:7447"]}, listen: {endpoints: ["tcp/[::1]:0"]}}')
    given = settings("ros2:", ZENOH_SESSION_CONFIG_URI=str(path))
    assert (given["mode"], given["connect/endpoints"], given["listen/endpoints"]) == ("client", ["tcp/robot:7447"], [])
    assert given["timestamping/enabled"] is True
    assert settings(f"ros2:?config={path}&mode=peer")["listen/endpoints"] == ["tcp/[::1]:0"]


@pytest.mark.parametrize(
    ("environ", "reason"),
    [
        ({"ROS_DOMAIN_ID": "abc"}, "ROS_DOMAIN_ID=abc: a domain of ROS is a number from 0 to 232"),
        ({"ZENOH_CONFIG_OVERRIDE": "mode"}, "ZENOH_CONFIG_OVERRIDE: write KEY=VALUE instead of 'mode'"),
        ({"ZENOH_CONFIG_OVERRIDE": "connect/x=1"}, "ros2: ZENOH_CONFIG_OVERRIDE: zenoh rejects this: "),
        ({"ZENOH_SESSION_CONFIG_URI": "/no/such.json5"}, "can't read /no/such.json5: there is no such file"),
    ],
)
def test_mistakes(environ: dict[str, str], reason: str) -> None:
    with pytest.raises(r2p.TransportError) as caught:
        zenoh_config(parse_options(parse("ros2:"), environ))
    assert reason in str(caught.value)
