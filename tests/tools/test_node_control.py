"""`r2p node start`, `stop`, `restart`, `swap`, and `r2p log --set`."""

from __future__ import annotations

import asyncio
import math
import sys
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING

import pytest

import r2p
from r2p.modules.node_control import NodeControl
from r2p.modules.node_messages import NodeInfo, NodeList
from r2p.tools import node_control
from r2p.tools.log import Level, log
from r2p.tools.node import info, list_
from r2p.tools.output import Output
from r2p.tools.session import Settings, TimedOut, UsageError, join
from tests.tools.rig import VIA, printed, tool
from tests.tools.test_output import Terminal

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterator
    from pathlib import Path

virtual_time = pytest.mark.virtual_time

NODES = """
import asyncio
import r2p
from r2p.msg import Led


async def blink(node):
    node.advertise("leds", Led, r2p.Periodic(0.02, Led))
    node.advertise("events", Led)
    await asyncio.Event().wait()


async def broken(node):
    raise ValueError("no port")
"""


@pytest.fixture
def directory(tmp_path: Path) -> Iterator[Path]:
    (tmp_path / "robot_nodes.py").write_text(NODES)
    path = list(sys.path)
    yield tmp_path
    sys.path[:] = path
    sys.modules.pop("robot_nodes", None)


@asynccontextmanager
async def bot(directory: Path) -> AsyncIterator[r2p.Module]:
    async with r2p.Module("BOT", via=VIA, allow_load=directory) as module:
        yield module


@virtual_time
async def test_from_start_to_end(directory: Path, capsys: pytest.CaptureFixture[str]) -> None:
    async with bot(directory) as module, tool() as session:
        await node_control.start(session, "BOT", "robot_nodes.py:blink=left")
        await node_control.swap(session, "BOT", "left", "robot_nodes.py:blink")
        await node_control.restart(session, "BOT", "left")
        assert module.nodes["left"].running
        await node_control.stop(session, "BOT", "left")
        captured = capsys.readouterr()
        assert captured.err.splitlines() == [
            "r2p: BOT: node left runs",
            "r2p: BOT: node left runs again",
            "r2p: BOT: node left has ended",
        ]
        assert captured.out == (
            '{"module": "BOT", "node": "left", "topics": [{"topic": "leds", "class": "periodic", "pause": 0.02, '
            '"period": 0.02}, {"topic": "events", "class": "nrt", "pause": null, "period": null}], '
            '"cleaned_up": true}\n'
        )


@virtual_time
async def test_a_node_in_one_argument(directory: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """As in `r2p node info`: MODULE/NODE, or NODE if one module has it."""
    async with (
        bot(directory) as module,
        r2p.Module("ARM", via=VIA, allow_load=directory) as arm,
        tool() as session,
    ):
        await node_control.start(session, "BOT/left", "robot_nodes.py:blink")
        await node_control.start(session, "ARM", "robot_nodes.py:blink")
        await node_control.swap(session, "BOT/left", "robot_nodes.py:blink=right")
        await node_control.restart(session, "right")
        assert [*module.nodes] == ["right"]
        await node_control.stop(session, "BOT/right")
        await node_control.stop(session, "ARM/blink")
        assert [module.nodes["right"].running, arm.nodes["blink"].running] == [False, False]
        await node_control.start(session, "BOT/blink", "robot_nodes.py:blink=blink")
        capsys.readouterr()
        with pytest.raises(
            UsageError, match="BOT is a module: name one of its nodes as MODULE/NODE; it has: BOT/right"
        ):
            await node_control.stop(session, "BOT")
        with pytest.raises(r2p.Error, match=r"no node blnk in an r2p module; nodes .*; did you mean blink\?"):
            await node_control.stop(session, "blnk")
        with pytest.raises(r2p.Error, match="several nodes blink: choose one of ARM/blink, BOT/blink"):
            await node_control.restart(session, "blink")
        with pytest.raises(UsageError, match="one node has one name: BOT/left or =right"):
            await node_control.start(session, "BOT/left", "robot_nodes.py:blink=right")
        with pytest.raises(UsageError, match=r"blink: write it as FILE:FUNCTION"):
            await node_control.swap(session, "BOT", "blink")
        with pytest.raises(TimedOut, match="there is no module LEG/left"):
            await node_control.start(session, "LEG/left", "robot_nodes.py:blink")


@virtual_time
async def test_a_crash_is_listed_with_its_error(directory: Path, capsys: pytest.CaptureFixture[str]) -> None:
    module = r2p.Module("BOT", via=VIA, allow_load=directory)
    async with tool() as session:
        await module.__aenter__()
        await node_control.start(session, "BOT", "robot_nodes.py:broken")
        await node_control.start(session, "BOT", "robot_nodes.py:blink")
        await node_control.stop(session, "BOT", "blink")
        await list_(session)
        rows = {row["node"]: row for row in printed(capsys)}
        assert (rows["BOT/blink"]["state"], rows["BOT/broken"]["state"]) == ("ended", "crashed")
        assert rows["BOT/broken"]["age"] is None
        await info(session, "BOT/broken")
        (broken,) = printed(capsys)
        assert broken["error"] == "ValueError: no port"
        assert broken["function"] == "robot_nodes.py:broken"
        with pytest.raises(r2p.NodeCrashed):
            await module.__aexit__(None, None, None)


@virtual_time
async def test_a_module_that_says_what_can_not_be_is_listed(
    directory: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    wrong = NodeInfo(node="blink", running=True, age=math.inf)
    monkeypatch.setattr(NodeControl, "list", lambda _self: NodeList(cpu=-math.inf, nodes=(wrong,)))
    async with bot(directory), tool() as session:
        await list_(session)
        row = next(each for each in printed(capsys) if each["node"] == "BOT/blink")
        assert (row["state"], row["age"], row["cpu"]) == ("running", None, None)


@virtual_time
async def test_the_pause_as_people_read_it(directory: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = Terminal()
    monkeypatch.setattr(node_control, "Output", lambda chosen: Output(chosen, terminal))
    async with bot(directory), tool() as session:
        await node_control.start(session, "BOT", "robot_nodes.py:blink")
        await node_control.swap(session, "BOT", "blink", "robot_nodes.py:blink=right")
    assert terminal.getvalue().splitlines() == [
        "BOT: node right runs robot_nodes.py:blink",
        "  leds: pause of 20 ms, no period of 20 ms missed",
        "  events: nothing published yet",
    ]


@virtual_time
async def test_what_can_not_be(directory: Path) -> None:
    async with bot(directory), r2p.Module("PC1", via=VIA) as other, tool() as session:
        for target, text in (
            ("robot_nodes.py", r"write it as FILE:FUNCTION\[=NAME\], for example blink.py:blink"),
            ("robot_nodes:blink", r"give a file, whose name ends with \.py; packages can't be loaded at run time"),
        ):
            with pytest.raises(UsageError, match=text):
                await node_control.start(session, "BOT", target)
        with pytest.raises(UsageError, match=r"there is no file robot_nodes\.py on this computer"):
            await node_control.start(session, "BOT", "robot_nodes.py:blink", send=True)
        with pytest.raises(r2p.Error, match=r"only from links with a key, and its memory has none \(\?key=FILE\)"):
            await node_control.start(session, "BOT", f"{directory}/robot_nodes.py:blink", send=True)
        with pytest.raises(TimedOut, match="there is no module ARM on memory:lab; modules found: BOT, PC1"):
            await node_control.stop(session, "ARM", "blink")
        with pytest.raises(r2p.Error, match=r"^BOT has no node blink; its nodes: none"):
            await node_control.stop(session, "BOT", "blink")
        with pytest.raises(
            r2p.Error, match=r"PC1 refuses to start, end and swap nodes for other modules: start it with"
        ):
            await node_control.stop(session, "PC1", "blink")
        await node_control.start(session, "BOT", "robot_nodes.py:blink")
        with pytest.raises(r2p.Error, match="BOT: the new node crashed: ValueError: no port; blink goes on"):
            await node_control.swap(session, "BOT", "blink", "robot_nodes.py:broken")
        assert other.nodes == {}
    async with join(Settings(via=[])) as session:
        with pytest.raises(UsageError, match="no network to look for a module on"):
            await node_control.stop(session, "BOT", "blink")


@virtual_time
async def test_log_levels(capsys: pytest.CaptureFixture[str]) -> None:
    async def talk(node: r2p.Node) -> None:
        async for _ in node.every(0.1):
            node.log.debug("detail")

    async with r2p.Module("BOT", via=VIA) as one, r2p.Module("ARM", via=VIA) as two, tool() as session:
        for module in (one, two):
            module.start(talk)
        one.start(talk, name="other")
        await log(session, set=["other=debug", "ARM/*=error"])
        assert capsys.readouterr().err.splitlines() == [
            "r2p: BOT/other: logs from DEBUG up, until its module ends, or `--set NODE=default`",
            "r2p: ARM/talk: logs from ERROR up, until its module ends, or `--set NODE=default`",
        ]
        await log(session, level=Level.DEBUG, once=True)
        (record,) = printed(capsys)
        assert (record["module"], record["node"], record["text"]) == ("BOT", "other", "detail")
        await info(session, "BOT/other")
        assert printed(capsys)[0]["log_level"] == "debug"
        await log(session, set=["BOT/other=default"])
        assert "BOT/other: the log level is that of its start again" in capsys.readouterr().err
        for text, error in (
            ("talk", "write it as NODE=LEVEL, for example blink=debug"),
            ("talk=loud", "the level is one of debug, info, warning, error, critical, default, not loud"),
            ("*=debug", r"of which module\? Write MODULE/\*=debug"),
        ):
            with pytest.raises(UsageError, match=error):
                await log(session, set=["BOT/other=debug", text])
        assert one.nodes["other"].node.log.threshold == 20  # nothing was set before the error
        with pytest.raises(r2p.Error, match="several nodes talk: choose one of ARM/talk, BOT/talk"):
            await log(session, set=["talk=debug"])
        with pytest.raises(r2p.Error, match=r"no node walk .*; nodes found: ARM/talk, BOT/talk, BOT/other"):
            await log(session, set=["walk=debug"])
        with pytest.raises(r2p.ServiceError, match="module BOT has no node walk; its nodes: talk, other"):
            await log(session, set=["BOT/walk=debug"])


def test_over_the_debug_line_on_an_ip_network_with_permission(
    directory: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    async def try_both() -> None:
        for allowed in (False, True):
            async with r2p.Module("BOT", via="tcp-listen:0", allow_load=directory, allow_control=allowed) as module:
                (_, address), *_ = module.addresses
                async with join(Settings(via=[f"tcp:{address}"])) as session:
                    if not allowed:
                        with pytest.raises(r2p.ServiceError, match="--allow-control"):
                            await node_control.start(session, "BOT", "robot_nodes.py:blink")
                        assert not module.nodes
                        continue
                    await node_control.start(session, "BOT", "robot_nodes.py:blink")
                    await node_control.swap(session, "BOT", "blink", "robot_nodes.py:blink")
                    await list_(session)
                    rows = {row["node"]: row for row in printed(capsys)[1:]}
                    assert rows["BOT/blink"]["cpu"] >= 0.0
                    assert rows["BOT/blink"]["state"] == "running"

    asyncio.run(try_both())
