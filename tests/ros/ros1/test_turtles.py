"""The turtles of the examples on a real ROS 1 network: two programs, and a command that knows none of their types."""

from __future__ import annotations

import asyncio
import runpy
from typing import TYPE_CHECKING, Any

import pytest

import r2p
from r2p.testing.network import node_in
from tests.docs.blocks import ROOT

if TYPE_CHECKING:
    from tests.ros.ros1.programs import Ros1

EXAMPLES = ROOT / "examples"

pytestmark = [
    pytest.mark.xdist_group("ros1"),
    pytest.mark.anyio,
    pytest.mark.parametrize("anyio_backend", [("asyncio", {"use_uvloop": True})], ids=["uvloop"]),
]


@pytest.fixture(autouse=True)
def _ros_network(ros1: Ros1, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_MASTER_URI", ros1.uri)
    monkeypatch.setenv("ROS_IP", "127.0.0.1")
    monkeypatch.syspath_prepend(EXAMPLES)


def _example(name: str) -> dict[str, Any]:
    return runpy.run_path(str(EXAMPLES / f"{name}.py"))


async def test_a_client_draws_and_rostopic_drives(ros1: Ros1) -> None:
    turtles, client = _example("turtles"), _example("turtle_client")
    async with (
        asyncio.timeout(30),
        r2p.Module("SIM1", via="ros1:") as simulator,
        r2p.Module("PC1", via="ros1:") as program,
        r2p.Module("_abcdef", via="ros1:", observer=True) as tool,
        node_in(tool, name="echo") as echo,
    ):
        simulator.start(turtles["turtlesim"])
        program.start(client["star"])
        poses = echo.subscribe("leo/pose", None)
        while (pose := await _decoded(tool, await poses.fetch())).linear_velocity == 0:
            pass
        assert type(pose).__name__ == "Pose"
        pub = ("-1", "/turtle1/cmd_vel", "geometry_msgs/Twist", "{linear: {x: 1.5}}")
        async with ros1.running("rostopic", "pub", *pub):
            driven = echo.subscribe("turtle1/pose", None)
            while (await _decoded(tool, await driven.fetch())).linear_velocity != 1.5:
                pass


async def _decoded(module: r2p.Module, data: bytes) -> Any:
    """A message of a topic whose type only its definition tells."""
    cls = await module.network.message_type(module.network.topics()["leo/pose"].fingerprint or b"")
    assert cls is not None
    return r2p.layout(cls).decode(data)
