"""`r2p log`: the records of all modules, as they arrive."""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING

import pytest

import r2p
from r2p.codecs import management
from r2p.msg import Log
from r2p.tools.log import Level, log
from r2p.tools.session import Session, Settings, TimedOut
from tests.tools.rig import printed, robot, tool
from tests.transports.conversation import Script, line, manage

if TYPE_CHECKING:
    from collections.abc import AsyncIterator


pytestmark = pytest.mark.virtual_time


async def drive(node: r2p.Node) -> None:
    async for _ in node.every(0.5):
        node.log.info("turns")
        node.log.error("motor %d is hot", 2)


async def plan(node: r2p.Node) -> None:
    async for _ in node.every(0.5):
        node.log.warning("lost\x1b[2J")


@contextlib.asynccontextmanager
async def talkers() -> AsyncIterator[Session]:
    async with robot(drive), robot(plan, name="ARM"), tool() as session:
        yield session


async def test_records_of_all_modules_are_printed(capsys: pytest.CaptureFixture[str]) -> None:
    async with talkers() as session:
        await log(session, count=6)
    records = printed(capsys)
    assert len(records) == 6
    assert {(each["level"], each["module"], each["node"], each["text"]) for each in records} == {
        ("info", "BOT", "drive", "turns"),
        ("error", "BOT", "drive", "motor 2 is hot"),
        ("warning", "ARM", "plan", "lost\x1b[2J"),
    }


@pytest.mark.parametrize("wanted", ["drive", "BOT", "BOT/drive"])
async def test_records_are_chosen_by_node_module_and_level(wanted: str, capsys: pytest.CaptureFixture[str]) -> None:
    async with talkers() as session:
        await log(session, wanted, level=Level.ERROR, count=3)
    assert {each["text"] for each in printed(capsys)} == {"motor 2 is hot"}


async def test_a_terminal_gets_lines_in_colour(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.stdout.isatty", lambda: True)
    monkeypatch.delenv("NO_COLOR", raising=False)
    async with talkers() as session:
        await log(session, "ARM", once=True)
        monkeypatch.setenv("NO_COLOR", "1")
        await log(session, "ARM", once=True)
    coloured, plain = capsys.readouterr().out.splitlines()
    assert coloured.startswith("\x1b[33m")
    assert coloured.endswith(r"WARNING  ARM/plan: lost\x1b[2J" + "\x1b[0m")
    assert plain.endswith(r"WARNING  ARM/plan: lost\x1b[2J")
    assert "\x1b" not in plain


async def test_a_namespace_has_a_log_of_its_own(capsys: pytest.CaptureFixture[str]) -> None:
    remapped = r2p.Module("ARM", via="memory:lab", remap={"log": "robot1/log"})
    async with tool() as session, remapped, asyncio.TaskGroup() as tasks:
        remapped.start(plan)
        tasks.create_task(log(session, "robot1/ARM", once=True))
    assert [each["module"] for each in printed(capsys)] == ["robot1/ARM"]


async def test_records_on_a_line_have_the_right_names_while_announcements_are_late(
    capsys: pytest.CaptureFixture[str],
) -> None:
    script = Script()
    async with r2p.Module("_tool01", via=script, observer=True, watchdog=False) as module:
        session, size = Session(module, Settings(via=["tcp:robot1"])), r2p.layout(Log).size
        printing = asyncio.create_task(log(session, count=3))
        await asyncio.sleep(0.1)
        script.hear(manage(management.Hello("GW", 7, management.HELLO_GATEWAY)))  # nothing else yet
        script.hear(manage(management.Advertise("log", size)) + manage(management.SubscribeResponse("log", size)))
        script.hear(line("log", Log(level=20, module="MOTOR1", node="motor", text="late").encode()))
        endpoint = management.Endpoint(management.ROLE_PUBLISHES, 8, "motor", "encoder3", 1)
        script.hear(manage(management.Hello("MOTOR3", 8, hops=1)) + manage(endpoint))
        script.hear(line("log", Log(level=20, module="MOTOR1", node="motor", text="late").encode()))
        script.hear(line("log", Log(level=20, node="motor", text="of a program that does not name it").encode()))
        await printing
    names = [(each["module"], each["node"]) for each in printed(capsys)]
    assert names == [("MOTOR1", "motor"), ("MOTOR1", "motor"), (None, "motor")]


async def test_silence_is_explained_and_ends_at_the_time_out(capsys: pytest.CaptureFixture[str]) -> None:
    async with robot(), tool() as session:
        with pytest.raises(TimedOut, match="no log record of drive for 3 s"):
            await log(session, "drive", timeout=3.0)
    assert "waiting for a log record of drive (old ones are not kept) on memory:lab" in capsys.readouterr().err
