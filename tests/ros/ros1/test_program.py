"""A program of its own, started as roslaunch starts one."""

from __future__ import annotations

import asyncio
import sys
from typing import TYPE_CHECKING

import pytest

from tests.ros.ros1.session import running

if TYPE_CHECKING:
    from pathlib import Path

    from tests.ros.ros1.programs import Ros1, RospyPeer

pytestmark = [
    pytest.mark.xdist_group("ros1"),
    pytest.mark.processes,
    pytest.mark.anyio,
    pytest.mark.parametrize("anyio_backend", [("asyncio", {"use_uvloop": True})], ids=["uvloop"]),
]

PROGRAM = """
import r2p
from r2p.msg import String

async def talker(node: r2p.Node) -> None:
    word = node.parameter("word", "nothing")
    chatter = node.advertise("chatter", String)
    async for _ in node.every(0.05):
        await chatter.publish(String(data=word.value))

r2p.run(talker, via="ros1:")
"""


async def test_names_and_parameters_of_the_command_line_and_a_name_that_is_taken(
    ros1: Ros1, rospy_peer: RospyPeer, tmp_path: Path
) -> None:
    file = tmp_path / "talker.py"
    file.write_text(PROGRAM)
    await rospy_peer.do("subscribe", topic="/talk", type="std_msgs/String")
    arguments = ("__name:=left", "__log:=/tmp/x", "chatter:=/talk", "_word:=hello")
    environment = {**ros1.environment, "ROS_NAMESPACE": "/robot1"}
    process = await asyncio.create_subprocess_exec(
        sys.executable, str(file), *arguments, env=environment, stderr=asyncio.subprocess.PIPE
    )
    try:
        while True:
            (heard,) = await rospy_peer.do("messages", topic="/talk")
            if heard["message"] == {"data": "hello"}:
                break
        assert heard["header"]["callerid"] == "/robot1/left"
        assert (await ros1.run("rosparam", "get", "/robot1/left/word")).output.strip() == "hello"
        async with running(ros1.uri, "/robot1/left") as (session, _):
            session.advertise("/robot1/left", "/spin", "std_msgs/String")
            _, error = await asyncio.wait_for(process.communicate(), 60.0)
        assert process.returncode == 1
        assert (
            "/robot1/left is no longer a ROS node: another node has taken its name, at http://127.0.0.1:"
            in error.decode()
        )
    finally:
        if process.returncode is None:
            process.kill()
            await process.communicate()
        await rospy_peer.do("unsubscribe", topic="/talk")
