"""`r2p node`: nodes by what they publish and subscribe."""

from __future__ import annotations

import asyncio
import json

import pytest

import r2p
from r2p.codecs import management
from r2p.msg import Encoder, Led, Velocity3
from r2p.tools.module import list_ as modules
from r2p.tools.node import info, list_
from tests.tools.rig import Firmware, printed, robot, tool

pytestmark = pytest.mark.virtual_time


async def drive(node: r2p.Node) -> None:
    node.advertise("encoder", Encoder, r2p.Periodic(period=0.1, fill=Encoder))
    node.advertise("leds", Led)
    node.subscribe("cmd", Velocity3)
    await asyncio.Event().wait()


async def show(node: r2p.Node) -> None:
    node.subscribe("leds", Led)
    await asyncio.Event().wait()


async def test_list(capsys: pytest.CaptureFixture[str]) -> None:
    async with robot(drive, show), tool() as other, tool() as session:
        other.node.subscribe("leds", Led)
        await list_(session)
        rows = printed(capsys)
        await list_(session, all=True)
        everybody = printed(capsys)
    unknown = dict.fromkeys(("state", "restarts", "age", "cpu"))
    runs = {"state": "running", "restarts": 0, "age": 0.4, "cpu": None}
    assert rows == [
        {"node": "BOT/drive", **runs, "publishes": ["encoder", "leds"], "subscribes": ["cmd"]},
        {"node": "BOT/log", **unknown, "publishes": ["log"], "subscribes": []},
        {"node": "BOT/show", **runs, "publishes": [], "subscribes": ["leds"]},
    ]
    tool_row = {"node": f"{other.module.name}/tool", **unknown, "publishes": [], "subscribes": ["leds"]}
    assert [row | {"age": None} for row in everybody] == [row | {"age": None} for row in [*rows, tool_row]]


async def test_what_firmware_has_is_listed_under_a_question_mark(capsys: pytest.CaptureFixture[str]) -> None:
    async with tool() as session:
        firmware = Firmware("IMU1")
        firmware.advertise("tilt", 4)
        await list_(session)
        unknown = dict.fromkeys(("state", "restarts", "age", "cpu"))
        assert printed(capsys) == [{"node": "?/?", **unknown, "publishes": ["tilt"], "subscribes": []}]
        firmware.alive()
        await list_(session)
        captured = capsys.readouterr()
        assert json.loads(captured.out) == {"node": "IMU1/?", **unknown, "publishes": ["tilt"], "subscribes": []}
        assert "firmware announces one item every 0.5 s, so there may be more topics" in captured.err


async def test_info(capsys: pytest.CaptureFixture[str]) -> None:
    async with robot(drive, show), tool() as session:
        await info(session, "BOT/drive")
        await info(session, "drive")
    one, same = printed(capsys)
    assert one | {"age": None} == same | {"age": None}
    assert one == {
        "node": "BOT/drive",
        "module": "running",
        "link": "memory:lab",
        "state": "running",
        "restarts": 0,
        "age": 0.4,
        "cpu": None,
        "error": None,
        "function": "test_node.py:drive",
        "priority": 0,
        "log_level": None,
        "publishes": [
            {"topic": "encoder", "type": "r2p_msgs/Encoder", "size": 4, "varies": False, "class": "periodic"},
            {"topic": "leds", "type": "r2p_msgs/Led", "size": 5, "varies": False, "class": "nrt"},
        ],
        "subscribes": [{"topic": "cmd", "type": "r2p_msgs/Velocity3", "size": 12, "varies": False}],
    }


async def test_names_that_are_not_one_node() -> None:
    async with robot(drive), robot(drive, name="ARM"), tool() as session:
        with pytest.raises(r2p.Error, match="several nodes drive: choose one of ARM/drive, BOT/drive"):
            await info(session, "drive")
        with pytest.raises(r2p.Error, match="no node ARM/show; nodes found: ARM/drive, ARM/log, BOT/drive, BOT/log"):
            await info(session, "ARM/show")
        with pytest.raises(r2p.Error, match=r"no node ARM/driver; .* did you mean ARM/drive\?$"):
            await info(session, "ARM/driver")
        with pytest.raises(
            r2p.Error, match=r"ARM is a module, which r2p module info shows; its nodes: ARM/drive, ARM/log$"
        ):
            await info(session, "ARM")


async def test_nobody_but_tools(capsys: pytest.CaptureFixture[str]) -> None:
    async with tool() as other, tool() as session:
        other.node.advertise("leds", Led)
        await list_(session)
        await modules(session)
    no_node, *_, no_module = capsys.readouterr().err.splitlines()
    assert no_node == "r2p: no nodes yet on memory:lab, except for those of tools; use --all to include these"
    assert no_module == "r2p: no modules yet on memory:lab, except for those of tools; use --all to include these"


async def test_a_node_is_listed_when_its_module_is_known(capsys: pytest.CaptureFixture[str]) -> None:
    async with tool() as session:
        firmware = Firmware()
        firmware.send(management.Endpoint(management.ROLE_PUBLISHES, 7, "drive", "leds", 1))
        hello = management.Hello("BOT", 7)
        asyncio.get_running_loop().call_later(1.0, firmware.send, hello)
        await list_(session)
    assert [row["node"] for row in printed(capsys)] == ["BOT/drive"]


async def test_a_topic_behind_a_gateway_is_not_the_gateways(capsys: pytest.CaptureFixture[str]) -> None:
    """The module that publishes it may be announced late."""
    async with tool() as session:
        gateway = Firmware()
        gateway.send(management.Hello("GW", 7, management.HELLO_GATEWAY))
        gateway.advertise("tilt", 4)
        await list_(session)
    assert [row["node"] for row in printed(capsys)] == ["?/?"]


async def test_modules_without_nodes_are_named(capsys: pytest.CaptureFixture[str]) -> None:
    async with tool() as session:
        Firmware("IMU1").alive()
        await list_(session)
    assert "no nodes yet on memory:lab (heard 1 module: IMU1); listen longer with --wait 5" in capsys.readouterr().err


async def test_nobody_there(capsys: pytest.CaptureFixture[str]) -> None:
    async with tool() as session:
        await list_(session)
        with pytest.raises(r2p.Error, match="nodes found: none"):
            await info(session, "drive")
    assert "no nodes yet on memory:lab" in capsys.readouterr().err


async def test_a_module_that_is_late_is_waited_for(capsys: pytest.CaptureFixture[str]) -> None:
    async with robot(name="ARM"), tool() as session:
        showing = asyncio.create_task(info(session, "BOT/log"))
        await asyncio.sleep(1.0)
        async with robot():
            await showing
    assert printed(capsys)[0]["node"] == "BOT/log"
