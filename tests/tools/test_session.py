"""How tools join, wait, and end."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import itertools
import logging
import os
import re
import signal
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import pytest
import typer
from typer.testing import CliRunner

import r2p
from r2p.msg import Led
from r2p.tools import main as command_line
from r2p.tools import options, session
from r2p.tools.output import PipeClosed
from r2p.tools.session import Session, Settings, TimedOut, UsageError, execute, join
from tests.ports import free_port
from tests.tools.rig import Firmware, process, robot, tool

if TYPE_CHECKING:
    from collections.abc import Iterator


@pytest.fixture(autouse=True)
def _as_found(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[None]:
    """No R2P_VIA, no r2p.toml; and whatever a command did, the loggers are as they were."""
    monkeypatch.delenv("R2P_VIA", raising=False)
    monkeypatch.chdir(tmp_path)
    logger = logging.getLogger("r2p")
    before = logger.handlers[:], logger.propagate, logger.level
    yield
    assert (logger.handlers, logger.propagate, logger.level) == before


def test_too_few_files_may_be_open(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def full(*_: object) -> int:
        raise OSError(errno.EMFILE, "Too many open files")

    async def main() -> None:
        raise AssertionError

    async def exhausted() -> None:
        full()

    with pytest.raises(typer.Exit):
        execute(exhausted)
    monkeypatch.setattr(os, "open", full)
    with pytest.raises(typer.Exit) as ended:
        execute(main)
    assert ended.value.exit_code == 1
    first, second = capsys.readouterr().err.splitlines()
    assert first == "r2p: [Errno 24] Too many open files"
    assert second == "r2p: Too many open files: r2p needs at least 12 more (ulimit -n 1024)"


# On the network


@pytest.mark.virtual_time
async def test_a_tool_is_an_observer_under_a_name_of_its_own() -> None:
    async with robot() as module, tool() as one, tool() as other:
        await asyncio.sleep(1)
        seen = {view.name: view.state for view in module.network.modules() if view.link}
    assert seen == {one.module.name: "observer", other.module.name: "observer"}
    assert re.fullmatch("_[a-z0-9]{6}", one.module.name)


@pytest.mark.virtual_time
async def test_without_a_network_it_says_so(capsys: pytest.CaptureFixture[str]) -> None:
    async with join(Settings()) as alone:
        await alone.settle()
    captured = capsys.readouterr()
    assert "no network" in captured.err
    assert "--via" in captured.err
    assert captured.out == ""


@pytest.mark.virtual_time
async def test_a_long_wait_says_what_for(capsys: pytest.CaptureFixture[str]) -> None:
    async with tool() as session:
        with session.waiting("good news"):
            await asyncio.sleep(0.9)
        assert capsys.readouterr().err == ""
        with session.waiting(lambda: "news"):
            await asyncio.sleep(1.1)
        assert capsys.readouterr().err == "r2p: waiting for news on memory:lab\n"


async def leds(node: r2p.Node) -> None:
    """Publishes."""
    publisher = node.advertise("leds", Led)
    async for _ in node.every(0.1):
        await publisher.publish(Led())


@pytest.mark.virtual_time
async def test_it_settles_as_soon_as_the_others_have_told_everything(capsys: pytest.CaptureFixture[str]) -> None:
    async with robot(leds), tool() as session:
        start = asyncio.get_running_loop().time()
        await session.settle()
        assert asyncio.get_running_loop().time() - start < 1.0
        assert set(session.module.network.topics()) == {"leds", "log"}
    assert capsys.readouterr().err == ""


async def many(node: r2p.Node) -> None:
    for number in range(50):
        node.advertise(f"t{number}", Led)
    await asyncio.get_running_loop().create_future()


@pytest.mark.virtual_time
async def test_it_looks_at_the_modules_once_and_not_for_each_topic(monkeypatch: pytest.MonkeyPatch) -> None:
    looks = 0
    modules = r2p.NetworkView.modules

    def look(network: r2p.NetworkView) -> list[r2p.ModuleView]:
        nonlocal looks
        looks += 1
        return modules(network)

    monkeypatch.setattr(r2p.NetworkView, "modules", look)
    async with robot(many), tool() as session:
        await session.settle()
        assert len(session.module.network.topics()) > 50
    assert 0 < looks < 30


@pytest.mark.virtual_time
@pytest.mark.parametrize("late", [0.1, 0.8, 1.3])
async def test_on_a_bus_it_waits_for_those_behind_a_gateway(late: float, capsys: pytest.CaptureFixture[str]) -> None:
    """A new module on the bus learns of them when the gateway repeats itself, every 1.5 s."""
    names = {f"M{number}" for number in range(6)}
    async with contextlib.AsyncExitStack() as stack:
        options = r2p.BridgeOptions()
        vias = ["memory:behind", "sim:lab,slots=20,cycle=20ms"]
        await stack.enter_async_context(r2p.Module("GW", via=vias, bridge=options, watchdog=False))
        for name in sorted(names):
            module = await stack.enter_async_context(r2p.Module(name, via="memory:behind", watchdog=False))
            module.start(leds)
        await asyncio.sleep(10 + late)
        session = await stack.enter_async_context(join(Settings(via=["sim:lab,slots=20,cycle=20ms"])))
        await session.settle()
        assert names <= {view.name for view in session.module.network.modules()}
        assert {module for module, node in session.module.network.nodes() if node == "leds"} == names
    assert "there may be more" not in capsys.readouterr().err


@pytest.mark.virtual_time
async def test_who_tells_for_ever_is_not_heard_to_the_end(capsys: pytest.CaptureFixture[str]) -> None:
    async def busy(node: r2p.Node) -> None:
        for number in itertools.count():
            node.advertise(f"t{number}", Led)
            await asyncio.sleep(0.2)

    async with robot(busy), tool() as session:
        await session.settle(of="nodes")
    assert "there may be more nodes" in capsys.readouterr().err


@pytest.mark.virtual_time
async def test_where_firmware_is_heard_there_may_be_more(capsys: pytest.CaptureFixture[str]) -> None:
    async with tool() as session:
        imu = Firmware()
        asyncio.get_running_loop().call_later(0.5, imu.advertise, "imu", 26)
        asyncio.get_running_loop().call_later(1.0, imu.alive)
        await session.settle()
        assert set(session.module.network.topics()) == {"imu"}
    assert "there may be more" in capsys.readouterr().err


@pytest.mark.virtual_time
async def test_it_listens_as_long_as_it_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    async with tool() as session:
        start = asyncio.get_running_loop().time()
        await session.settle(7)
        assert asyncio.get_running_loop().time() - start == pytest.approx(7)
    assert capsys.readouterr().err == ""


@pytest.mark.virtual_time
async def test_no_link_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    async with tool() as session:
        for link in session.module.links:
            link.on_down("unplugged")
        with pytest.raises(r2p.TransportError, match="no connection on memory:lab"):
            await session.settle()


@pytest.mark.virtual_time
async def test_a_tool_ends_soon_where_no_link_can_come_up() -> None:
    async with tool() as session:
        (link,) = session.module.links
        link.on_down("unplugged")
        start = asyncio.get_running_loop().time()
        with pytest.raises(TimeoutError):
            async with asyncio.timeout(30.0):
                await session.fail_unless_connected()  # it may come up yet
        link.unreachable("refused")
        with pytest.raises(r2p.TransportError, match="no connection on memory:lab"):
            await session.fail_unless_connected()
        assert asyncio.get_running_loop().time() - start == pytest.approx(30.9, abs=0.1)
        link.on_up()
        await session.fail_unless_connected()


@pytest.mark.processes
def test_the_command_goes_on_trying_where_others_give_up() -> None:
    via = f"tcp:127.0.0.1:{free_port()}"
    with process("wait", "module", "BOT", "--timeout", "1.5", "--via", via) as child:
        _, err = child.communicate()
    assert child.returncode == 3
    assert "Connection refused" in err
    assert f"no module BOT on {via} within 1.5 s" in err
    with process("topic", "echo", "leds", "--via", via) as child:
        _, err = child.communicate()
    assert child.returncode == 1
    assert err.endswith(f"r2p: no connection on {via}\n")


# Ends


@pytest.mark.parametrize(
    ("error", "code", "text"),
    [
        (None, 0, ""),
        (PipeClosed(), 0, ""),
        (r2p.TypeMismatch("two layouts"), 1, "r2p: two layouts\n"),
        (r2p.NodeCrashed("1 node(s) crashed", [ValueError("x")]), 1, "r2p: 1 node(s) crashed\n"),
        (UsageError("not like this"), 2, "not like this"),
        (r2p.NameTooLong("too long"), 2, "too long"),
        (TimedOut("nothing came"), 3, "r2p: nothing came\n"),
    ],
    ids=str,
)
@pytest.mark.parametrize("grouped", [False, True])
def test_every_end_has_its_exit_code(error: Exception | None, code: int, text: str, *, grouped: bool) -> None:
    async def main() -> None:
        if error is not None:
            raise ExceptionGroup("a task failed", [error]) if grouped else error

    app = session.group("Test.")
    app.command("end")(lambda: execute(main))
    result = CliRunner().invoke(app, ["end"])
    assert result.exit_code == code
    assert text in result.stderr
    assert bool(result.stderr) == bool(text)
    assert result.stdout == ""


def test_a_bug_is_not_hidden() -> None:
    async def main() -> None:
        raise ExceptionGroup("", [r2p.Error("mine"), ZeroDivisionError("yours")])

    with pytest.raises(ExceptionGroup):
        execute(main)


def test_what_a_coroutine_function_asks_for_becomes_options() -> None:
    app = session.group("Test.")
    seen = []

    @session.command(app, "try")
    async def try_(session: Session, topic: str, *, count: Annotated[int, typer.Option("--count", "-n")] = 1) -> None:
        """Try it."""
        seen.append((topic, count, session.network_name, session.verbose, session.node.name))

    runner = CliRunner()
    result = runner.invoke(app, ["try", "leds", "-n", "3", "--via", "memory:a", "--via", "memory:b", "-v"])
    assert result.exit_code == 0, result.output
    assert seen == [("leds", 3, "memory:a, memory:b", 1, "try")]
    assert "Try it." in runner.invoke(app, ["try", "--help"]).stdout
    assert runner.invoke(app, ["try"]).exit_code == 2


def test_a_bad_file_is_a_usage_error(tmp_path: Path) -> None:
    (tmp_path / "r2p.toml").write_text("via = 5")
    app = session.group("Test.")

    @session.command(app, "try")
    async def try_(session: Session) -> None:
        """Try it."""

    assert CliRunner().invoke(app, ["try"]).exit_code == 2


@pytest.mark.parametrize(("verbose", "quiet", "shown"), [(0, 0, "iwe"), (1, 0, "diwe"), (0, 1, "we"), (0, 2, "e")])
def test_log_records_go_to_stderr(verbose: int, quiet: int, shown: str, capsys: pytest.CaptureFixture[str]) -> None:
    async def main() -> None:
        logger = logging.getLogger("r2p.link")
        logger.debug("d")
        logger.info("i")
        logger.warning("w")
        logging.getLogger("r2p.PC1.blink").error("e")

    execute(main, verbose=verbose, quiet=quiet)
    lines = {"d": "r2p: d", "i": "r2p: i", "w": "r2p: warning: w", "e": "PC1/blink: error: e"}
    captured = capsys.readouterr()
    assert captured.err.splitlines() == [lines[letter] for letter in shown]
    assert captured.out == ""


@pytest.mark.parametrize("text", ["0", "-1s", "5x", "", "nan"])
def test_a_time_is_more_than_nothing(text: str) -> None:
    with pytest.raises(typer.BadParameter):
        options.seconds(text)


@pytest.mark.parametrize(
    ("given", "code"), [({}, 130), ({"count": None}, 0), ({"count": 3}, 130), ({"count": None, "once": True}, 130)]
)
def test_a_signal_fails_a_command_that_was_not_done(given: dict[str, object], code: int) -> None:
    """So `r2p wait ... && ...` does not go on; a command without `count`, like `wait`, has an end of its own."""

    async def body(session: Session, **given: object) -> None:
        os.kill(os.getpid(), signal.SIGTERM)
        await asyncio.Event().wait()

    run = session.joined(body)
    if code:
        with pytest.raises(typer.Exit) as ended:
            run(via=["memory:lab"], verbose=0, quiet=0, **given)
        assert ended.value.exit_code == code
    else:
        run(via=["memory:lab"], verbose=0, quiet=0, **given)


@pytest.mark.parametrize(
    ("arguments", "body", "code"),
    [
        (["doctor"], "doctor.measure", 130),
        (["doctor", "--via", "tcp:robot"], "doctor.try_links", 130),
        (["launch", "--ready", "imu"], "launch.wait_once", 130),
        (["demo"], "demo.simulate", 130),
        (["sim", "--fast"], "sim.command.simulate", 130),
        (["sim", "--duration", "1"], "sim.command.simulate", 130),
        (["sim"], "sim.command.simulate", 0),
        (["gateway", "--via", "memory:a", "--via", "memory:b"], "gateway.serve", 0),
        (["topic", "pub", "leds", "-", "--type", "Led"], "topic.pub._Publication.publish_lines", 130),
        (["topic", "pub", "leds", "led=1", "--type", "Led"], "topic.pub._Publication.publish", 0),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_a_signal_is_a_success_only_for_commands_without_an_end(
    arguments: list[str], body: str, code: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The end comes from within: a function of the command sends the signal, and waits."""

    async def interrupted(*_: object, **__: object) -> None:
        os.kill(os.getpid(), signal.SIGTERM)
        await asyncio.Event().wait()

    Path("r2p.toml").write_text('[launch.imu]\ncommand = "sim"', encoding="ascii")
    monkeypatch.setattr(f"r2p.tools.{body}", interrupted)
    assert CliRunner().invoke(command_line.app, arguments).exit_code == code
