"""The main job, as processes: an emulated robot on a simulated bus, `r2p gateway`, a zenoh router, and a PC.

The gateway reaches the robot in two ways: by the debug line, and by a CAN bus (python-can's, over UDP multicast).
"""

from __future__ import annotations

import contextlib
import json
import random
import re
import socket
import struct
import subprocess
import sys
from typing import TYPE_CHECKING, Any

import msgspec
import pytest

from tests.ports import free_port
from tests.tools.rig import PATIENCE, process

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

pytestmark = [
    pytest.mark.processes,
    pytest.mark.skipif(sys.platform != "linux", reason="starts a CAN bus"),
    pytest.mark.xdist_group("main job"),  # one robot, and one gateway for each way to it
]

DRIVE = '''
"""A PC that drives the robot until its odometry says that it has moved."""

import math

import r2p
from r2p.msg import Odometry, Velocity3


async def drive(node: r2p.Node) -> None:
    commands = node.advertise("velocity_cmd", Velocity3, r2p.Sporadic(deadline=0.05))
    start = None
    async for odometry in node.subscribe("odometry", Odometry, queue=1):
        here = odometry.pose.x, odometry.pose.y
        start = start or here
        if math.dist(start, here) > 0.02:
            print(math.dist(start, here))
            return
        await commands.publish(Velocity3(y=0.3))
'''


class Robot(msgspec.Struct):
    """Where it is."""

    line: str
    bus: str


def multicast() -> tuple[str, int] | None:
    """A group that no packet leaves the computer for, and a port of our own; None where IPv6 can't do that."""
    group = f"ff01::{random.randrange(1 << 16):x}:{random.randrange(1 << 16):x}"
    with (
        socket.socket(socket.AF_INET6, socket.SOCK_DGRAM) as there,
        socket.socket(socket.AF_INET6, socket.SOCK_DGRAM) as here,
    ):
        try:
            there.bind(("::", 0))
            there.settimeout(1.0)
            joined = socket.inet_pton(socket.AF_INET6, group) + struct.pack("@I", 0)
            there.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_JOIN_GROUP, joined)
            here.sendto(b"?", (group, there.getsockname()[1]))
            there.recv(1)
        except OSError:
            return None
        return group, there.getsockname()[1]


@pytest.fixture(scope="module")
def robot() -> Iterator[Robot]:
    group, port = multicast() or ("", 0)
    bus = f"rtcan:udp_multicast:{group},slots=50,cycle=100ms" if group else ""
    links = ["--via", "tcp-listen:0,gateways=yes", *(["--via", bus] if bus else [])]
    with contextlib.ExitStack() as stack:
        # To one port Linux brings the packets of all groups, those of other tests, too.
        stack.enter_context(pytest.MonkeyPatch.context()).setenv("CAN_CONFIG", json.dumps({"port": port}))
        child = stack.enter_context(process("sim", "triskar2", *links, patience=4 * PATIENCE))
        assert child.stdout is not None
        line = next(found[1] for line in child.stdout if (found := re.search(r"--via (tcp:\S+)", line)))
        yield Robot(line, bus)


@pytest.fixture(scope="module")
def router() -> Iterator[int]:
    """The port of a zenoh router."""
    port = free_port()
    command = [sys.executable, "-m", "tests.transports.zenoh.router", str(port)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as child:
        assert child.stdout is not None
        assert child.stdout.readline() == b"ready\n"
        yield port


@pytest.fixture(params=["line", "bus"], scope="module")
def path(request: pytest.FixtureRequest, robot: Robot, router: int) -> Iterator[tuple[str, str]]:
    """How the gateway reaches the robot, and the URL by which a PC reaches both."""
    url: str = getattr(robot, request.param)
    if not url:
        pytest.skip("this computer sends no multicast to itself")
    network = f"zenoh:tcp/127.0.0.1:{router},scouting=off,network={request.param}"
    inside = url if request.param == "line" else f"{url},priority=1"  # the bus needs a master
    with process("gateway", "--via", inside, "--via", network, patience=2 * PATIENCE) as child:
        assert child.stderr is not None
        silent, said = [url.partition(",")[0], network.partition(",")[0]], ""
        while silent:
            line = child.stderr.readline()
            said += line
            assert line, f"the gateway has ended: {said}"
            silent = [each for each in silent if f"link {each}: forwards" not in line]
        yield request.param, network


def test_typed_messages_both_ways(path: tuple[str, str], tmp_path: Path) -> None:
    kind, url = path
    (tmp_path / "pc.py").write_text(DRIVE)
    with contextlib.ExitStack() as stack:
        start = [
            ("run", f"{tmp_path}/pc.py:drive", "--module", "PC"),
            ("topic", "echo", "odometry", "--meta"),
            ("topic", "hz", "encoder1", "--once"),
            ("topic", "delay", "odometry", "--once"),
        ]
        pc, echo, hz, delay = (stack.enter_context(process(*each, "--via", url)) for each in start)
        moved, log = pc.communicate()
        assert pc.returncode == 0, log
        assert float(moved) > 0.02
        assert echo.stdout is not None
        for line in map(json.loads, echo.stdout):
            assert line.keys() == {"pose", "velocity", "_"}
            if line["_"]["source"] == "MOTOR2/fwdkin":
                break  # the gateway is told who it is while it forwards already
        assert [(each["stamps"], each["lost_here"]) for each in records(hz)] == [("reception", 0)]
        (measured,) = records(delay)
    where = {"line": "arrival at the first gateway", "bus": "first frame on the bus"}
    assert measured["from"].endswith(f"'s {where[kind]}")
    assert 0 < measured["min"] <= measured["mean"] <= measured["max"]
    assert ("clock_error" in measured) == (kind == "bus")  # which has a time of its own


def test_commands_from_the_shell(path: tuple[str, str]) -> None:
    _, url = path
    command = ("topic", "pub", "velocity_cmd", "w=1", "--type", "Velocity3", "-r", "20")
    with process("topic", "echo", "odometry", "--via", url) as echo, process(*command, "--via", url):
        assert echo.stdout is not None
        assert any(json.loads(line)["velocity"]["w"] > 0.2 for line in echo.stdout)


def records(tool: subprocess.Popen[str]) -> list[Any]:
    out, err = tool.communicate()
    assert tool.returncode == 0, err
    return [json.loads(line) for line in out.splitlines()]
