"""Names of ROS 1, arguments of programs, and where the master and this computer are."""

from __future__ import annotations

import socket

import pytest
from hypothesis import given
from hypothesis import strategies as st

from r2p.errors import InvalidName, TransportError
from r2p.ros.graph_names import GraphNames
from r2p.ros.options import RosOptions
from r2p.ros.ros1.environment import RosAddress, find_address, reachable_host, uri_of
from r2p.ros.ros1.names import arguments, is_name, join, namespace_of, resolve
from r2p.ros.ros1.transport import from_url
from r2p.transports.url import parse


@pytest.mark.parametrize(
    ("name", "full"),
    [
        ("/chat", "/chat"),
        ("chat", "/robot/chat"),
        ("a/b/", "/robot/a/b"),
        ("~rate", "/robot/arm/rate"),
        ("/", "/"),
    ],
)
def test_names_are_resolved(name: str, full: str) -> None:
    assert resolve(name, "/robot/arm") == full


@pytest.mark.parametrize("name", ["", "1st", "a-b", "a b", "~", "/a.b", "ü"])
def test_what_is_not_a_name(name: str) -> None:
    assert not is_name(name)
    with pytest.raises(InvalidName, match="is not a name of ROS 1: use letters, digits, _ and /"):
        resolve(name, "/robot/arm")


@given(st.text("/ab", max_size=8), st.text("/ab", max_size=8))
def test_joined_names_are_full_names(namespace: str, name: str) -> None:
    full = join(namespace, name)
    assert full.startswith("/")
    assert full == "/" or not full.endswith("/")
    assert join(namespace_of(full), full) == full


def test_arguments_of_roslaunch() -> None:
    argv = [
        "--fast",
        "__name:=left",
        "__ns:=/robot1",
        "chatter:=/talk",
        "in:=out",
        "_kp:=0.7",
        "_mode:=ON",
        "_l:=[1, 2]",
    ]
    said, others = arguments([*argv, "x:=y:=z"][:-1])
    assert others == ["--fast"]
    assert said.parameters == {"kp": 0.7, "mode": True, "l": [1, 2]}
    options = said.options(RosOptions(), "")
    assert (options.ns, options.node_name) == ("/robot1", "left")
    assert options.remappings == {"/robot1/chatter": "/talk", "/robot1/in": "/robot1/out"}
    assert said.options(RosOptions(ns="/mine"), "/env").ns == "/mine"
    assert arguments([])[0].options(RosOptions(), "env") == RosOptions(ns="/env")


@pytest.mark.parametrize("argument", ["a:=b-c", "a:=", "__name:=/x", "__ns:=a-b"])
def test_wrong_arguments(argument: str) -> None:
    with pytest.raises(ValueError, match=r"a:=|__name:=/x: use letters|a namespace is letters"):
        arguments([argument])[0].options(RosOptions(), "")


def test_remapped_names_both_ways() -> None:
    names = GraphNames(RosOptions(ns="/r", remappings={"/r/chatter": "/talk"}))
    assert (names.to_ros("chatter"), names.from_ros("/talk")) == ("/talk", "chatter")
    assert names.from_ros("/r/chatter") is None
    assert (names.is_inside("/talk"), names.is_inside("/other")) == (True, False)
    assert (names.to_ros("other"), names.from_ros("/r/other")) == ("/r/other", "other")


def test_the_name_of_a_program_is_that_of_its_first_node() -> None:
    names = GraphNames(RosOptions(ns="/r", node_name="left"))
    assert [names.own_node(each, "PC1") for each in ("PC1", "talker", "ears", "talker")] == [
        "/r/left",
        "/r/left",
        "/r/left_ears",
        "/r/left",
    ]
    assert GraphNames(RosOptions()).own_node("talker", "PC1") == "/talker"


# Where things are

LOCAL = "http://localhost:11311"


@pytest.mark.parametrize(
    ("master", "environ", "special", "address"),
    [
        ("", {}, {}, RosAddress(LOCAL, "", "0.0.0.0")),
        ("", {"ROS_MASTER_URI": "http://robot:11411/"}, {}, RosAddress("http://robot:11411", "", "0.0.0.0")),
        ("robot", {"ROS_MASTER_URI": "http://no:1"}, {}, RosAddress("http://robot:11311", "", "0.0.0.0")),
        ("http://[::1]:2", {}, {}, RosAddress("http://[::1]:2", "", "0.0.0.0")),
        ("", {"ROS_MASTER_URI": "http://no:1"}, {"master": "yes:2"}, RosAddress("http://yes:2", "", "0.0.0.0")),
        ("", {"ROS_IP": "10.0.0.7", "ROS_HOSTNAME": "pc"}, {}, RosAddress(LOCAL, "pc", "0.0.0.0")),
        ("", {"ROS_IP": "10.0.0.7"}, {"ip": "10.0.0.8"}, RosAddress(LOCAL, "10.0.0.8", "0.0.0.0")),
        ("", {"ROS_IP": "127.0.0.1"}, {}, RosAddress(LOCAL, "127.0.0.1", "127.0.0.1")),
        ("", {"ROS_HOSTNAME": "localhost"}, {}, RosAddress(LOCAL, "localhost", "127.0.0.1")),
        ("", {"ROS_IP": "fe80::1"}, {}, RosAddress(LOCAL, "fe80::1", "::")),
    ],
)
def test_addresses(master: str, environ: dict[str, str], special: dict[str, str], address: RosAddress) -> None:
    assert find_address(master, environ, special) == address


@pytest.mark.parametrize(
    ("master", "environ", "error"),
    [
        ("https://robot:1", {}, r"the URL 'https://robot:1' is not where a master may be: write http://HOST:11311"),
        ("robot:port", {}, "the URL 'robot:port' is not where"),
        ("", {"ROS_MASTER_URI": "http://:1"}, "ROS_MASTER_URI 'http://:1' is not where"),
        ("", {"ROS_IP": "http://10.0.0.7"}, "ROS_IP 'http://10.0.0.7': write a host or an IP address alone"),
        ("", {"ROS_HOSTNAME": "robot:11311"}, "ROS_HOSTNAME 'robot:11311': write a host"),
    ],
)
def test_what_is_not_an_address(master: str, environ: dict[str, str], error: str) -> None:
    with pytest.raises(TransportError, match=error):
        find_address(master, environ, {})


def test_the_host_for_others(monkeypatch: pytest.MonkeyPatch) -> None:
    """With a master on this computer, others still need an address of its network."""
    assert reachable_host("10.0.0.7") == "10.0.0.7"

    class Udp(socket.socket):
        def connect(self, address: object) -> None:
            raise OSError("Network is unreachable")

    monkeypatch.setattr(socket, "socket", Udp)
    assert reachable_host("127.0.0.1") == "127.0.0.1"
    assert reachable_host("") == "127.0.0.1"
    assert uri_of("rosrpc", "::1", 7) == "rosrpc://[::1]:7"


def test_urls(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.argv", ["talker.py", "__name:=left", "a:=b"])
    monkeypatch.setenv("ROS_NAMESPACE", "/robot1")
    options = from_url(parse("ros1:robot:11311,ros_nodes=yes")).options
    assert options == RosOptions(ns="/robot1", ros_nodes=True, node_name="left", remappings={"/robot1/a": "/robot1/b"})
    monkeypatch.setattr("sys.argv", ["/usr/bin/r2p", "run", "--remap", "a:=b"])
    assert from_url(parse("ros1:,ns=/r")).options == RosOptions(ns="/r")
    monkeypatch.setattr("sys.argv", ["talker.py", "__name:=a/b"])
    with pytest.raises(TransportError, match=r"ros1:: __name:=a/b: use letters, digits and _"):
        from_url(parse("ros1:"))
