"""`r2p param set`, `load`, `reset` and `save`."""

from __future__ import annotations

import asyncio
import contextlib
import re
import tomllib
from pathlib import Path

import pytest
from typer.testing import CliRunner

import r2p
from r2p.tools.main import app
from r2p.tools.param.changing import load, reset, save, set_
from r2p.tools.session import TimedOut, UsageError
from tests.bench import hold
from tests.tools.param.test_reading import Mode, drive, turn
from tests.tools.rig import printed, robot, tool

pytestmark = pytest.mark.virtual_time


@pytest.mark.parametrize(
    "words",
    [
        ["BOT/drive", "kp=0.7", "mode=FAST"],
        ["drive", "kp=7e-1", "mode=FAST"],
        ["BOT", "mode=FAST", "kp=0.7"],
        ["BOT", "drive.mode=FAST", "drive.kp=0.7"],
    ],
)
async def test_set_several(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    async with robot(drive) as module, tool() as session:
        await set_(session, words[0], words[1:])
        assert (module.parameters["drive", "kp"].value, module.parameters["drive", "mode"].value) == (0.7, Mode.FAST)
    rows = {row["name"]: (row["module"], row["node"], row["before"], row["value"]) for row in printed(capsys)}
    assert rows == {"kp": ("BOT", "drive", 0.5, 0.7), "mode": ("BOT", "drive", "SLOW", "FAST")}


@pytest.mark.parametrize(
    "words",
    [
        ["BOT/drive", "kp", "0.7"],
        ["BOT/drive.kp", "0.7"],
        ["BOT/drive/kp", "0.7"],
        ["drive.kp=0.7"],
        ["BOT/drive.kp=0.7"],
    ],
)
async def test_set_one(words: list[str], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stdout.isatty", lambda: True)
    async with robot(drive, turn) as module, tool() as session:
        await set_(session, words[0], words[1:])
        assert module.parameters["drive", "kp"].value == 0.7
    assert capsys.readouterr().out == "BOT/drive.kp = 0.7 V/(rad/s) (was 0.5)\n"


@pytest.mark.parametrize(
    ("words", "error", "text"),
    [
        (
            ["BOT/drive", "kp=11", "top=3"],
            r2p.ParameterError,
            r"BOT/drive.kp = 11.0: it takes 10.0 V/\(rad/s\) or less",
        ),
        (["BOT/drive", "top=3", "kp=abc"], r2p.ParameterError, "BOT/drive.kp = 'abc': it takes a float"),
        (["BOT/drive", "top=3", "mode=WILD"], r2p.ParameterError, "BOT/drive.mode = .* it takes one of SLOW, FAST"),
        (["BOT/drive", "top=3", "serial=x"], r2p.ParameterError, "BOT/drive.serial is read-only"),
        (["BOT/drive", "top=3", "kpp=1"], r2p.Error, r"BOT/drive has no parameter kpp; did you mean kp\?"),
        (
            ["BOT", "top=3", "kp=1"],
            UsageError,
            "several parameters of BOT are kp: choose one of BOT/drive.kp, BOT/turn",
        ),
        (["BOT/drive", "top=3", "top=4"], UsageError, "BOT/drive.top is set twice"),
        (["BOT/drive", "1"], UsageError, "BOT/drive has several parameters, and 1 is one value: write r2p param set"),
        (["BOT/drive"], UsageError, "no value: write r2p param set MODULE/NODE NAME=VALUE"),
        (["BOT/drive", "top=3", "kp", "1"], UsageError, "top=3 kp 1: write r2p param set"),
        (["BOT/drive.kp=1", "top=3"], UsageError, "BOT/drive.kp=1 is a parameter with its value"),
        (["BOT/drive", "--tpo", "3"], UsageError, "there is no option --tpo"),
        (["ARM/drive", "top=3"], TimedOut, "there is no module ARM on memory:lab; modules found: BOT"),
    ],
)
async def test_what_is_refused_changes_nothing(words: list[str], error: type[Exception], text: str) -> None:
    async with robot(drive, turn) as module, tool() as session:
        before = {name: each.value for name, each in module.parameters.items()}
        with pytest.raises(error, match=text):
            await set_(session, words[0], words[1:])
        assert {name: each.value for name, each in module.parameters.items()} == before


@pytest.mark.parametrize(("others", "late"), [(["ARM"], 1.2), ([], 3.0)])
async def test_a_module_that_is_late_is_waited_for(others: list[str], late: float) -> None:
    """As on a busy computer: it answers after the others, or is the only one."""
    async with contextlib.AsyncExitStack() as stack:
        for name in others:
            await stack.enter_async_context(robot(turn, name=name))
        session = await stack.enter_async_context(tool())
        setting = asyncio.create_task(set_(session, "BOT/drive", ["kp=0.7"]))
        await asyncio.sleep(late)
        module = await stack.enter_async_context(robot(drive))
        await setting
        assert module.parameters["drive", "kp"].value == 0.7


async def test_a_node_that_two_modules_have_must_be_named_with_its_module() -> None:
    async with robot(turn), robot(turn, name="ARM"), tool() as session:
        with pytest.raises(UsageError, match="turn is in several modules: choose one of ARM/turn, BOT/turn"):
            await reset(session, "turn")
        with pytest.raises(
            UsageError, match=r"several parameters of turn are kp: choose one of ARM/turn\.kp, BOT/turn"
        ):
            await set_(session, "turn", ["kp=1"])


async def test_a_reset_of_several_nodes_is_all_or_nothing() -> None:
    async def fixed(node: r2p.Node) -> None:
        node.parameter("kp", 1.0, read_only=True)
        await hold(node)

    async with robot(drive, fixed) as module, tool() as session:
        module.parameters.set({("drive", "kp"): 0.7})
        with pytest.raises(r2p.ParameterError, match=r"BOT/fixed\.kp is read-only"):
            await reset(session, "BOT", ["kp"])
        assert module.parameters["drive", "kp"].value == 0.7


async def test_save_and_reset(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "params.toml"
    async with r2p.Module("BOT", via=["memory:lab"], params_file=path) as module:
        module.start(drive)
        async with tool() as session:
            await set_(session, "BOT/drive", ["kp=0.7", "top=2"])
            await save(session, ["BOT"])
            assert tomllib.loads(path.read_text())["params"] == {"BOT": {"drive": {"kp": 0.7, "top": 2.0}}}
            await reset(session, "BOT/drive", ["kp"])
            assert module.parameters["drive", "kp"].value == 0.5
            await reset(session, "BOT")
            assert module.parameters["drive", "top"].value == float("inf")
            with pytest.raises(r2p.ParameterError, match="read-only"):
                await reset(session, "BOT/drive", ["serial"])
            with pytest.raises(UsageError, match="a module saves all of its parameters: write r2p param save BOT"):
                await save(session, ["BOT/drive"])
    assert "BOT: parameters saved" in capsys.readouterr().err


async def test_several_modules_save_or_none_if_one_is_not_there(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files = {name: tmp_path / f"{name}.toml" for name in ("BOT", "ARM")}
    async with contextlib.AsyncExitStack() as stack:
        for name, path in files.items():
            module = await stack.enter_async_context(r2p.Module(name, via=["memory:lab"], params_file=path))
            module.start(drive)
        session = await stack.enter_async_context(tool())
        for name in files:
            await set_(session, f"{name}/drive", ["kp=0.7"])
        with pytest.raises(TimedOut, match="there is no module ARMM"):
            await save(session, ["BOT", "ARMM"])
        assert not any(path.exists() for path in files.values())
        await save(session, ["BOT", "ARM"])
    assert [tomllib.loads(path.read_text())["params"][name] for name, path in files.items()] == [
        {"drive": {"kp": 0.7}}
    ] * 2
    assert capsys.readouterr().err.endswith("r2p: BOT: parameters saved\nr2p: ARM: parameters saved\n")


async def test_a_module_without_a_file_says_what_to_do() -> None:
    async with robot(drive), tool() as session:
        with pytest.raises(
            r2p.ParameterError, match="BOT has no file for parameters: start it with `r2p run --params-"
        ):
            await save(session, ["BOT"])
        with pytest.raises(TimedOut, match=r"there is no module BOTT on memory:lab; .* did you mean BOT\?"):
            await save(session, ["BOTT"])


GAINS = """
[params.BOT.drive]
kp = 1
serial = "a\\u001bb"
limits = {left = [5, 6]}
[params.BOT.turn]
kp = 3.0
"""


async def test_load(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A file with tables as in r2p.toml; what is read-only and as it was does not count."""
    path = tmp_path / "gains.toml"
    path.write_text(GAINS)
    async with robot(drive, turn) as module, tool() as session:
        await load(session, path, "BOT/drive")
        values = module.parameters
        assert (values["drive", "kp"].value, values["drive", "limits.left"].value) == (1.0, (5, 6))
        assert values["turn", "kp"].value == 2.0
        await load(session, path)
        assert values["turn", "kp"].value == 3.0
    assert re.findall("BOT: .*", capsys.readouterr().err) == ["BOT: 2 parameters set", "BOT: 3 parameters set"]


@pytest.mark.parametrize(
    ("text", "target", "error", "message"),
    [
        (
            "[params.BOT.drive]\nkp = 1\nkpp = 2",
            None,
            r2p.Error,
            "BOT has no parameter drive.kpp; did you mean drive.kp",
        ),
        ("[params.BOT.drive]\nkp = 99\ntop = 2", None, r2p.ParameterError, "BOT/drive.kp = 99: it takes 10.0"),
        ("[params.BOT.drive]\nkp = 1\nserial = 'x'", None, r2p.ParameterError, "BOT/drive.serial is read-only"),
        (
            "[params.ARM.drive]\nkp = 1",
            None,
            TimedOut,
            "has parameters of ARM, which has none on the network; modules w",
        ),
        ("[params.ARM.drive]\nkp = 1", "BOT", UsageError, "has no parameters of BOT"),
        ("[params]", None, UsageError, r"has no parameters: write a table \[params.MODULE.node\] for each node"),
        ("[param", None, UsageError, r"gains\.toml: Expected"),
        ("[params]\nkp = 1", None, UsageError, r"gains\.toml: \[params.kp\]: write a table"),
    ],
)
async def test_a_file_that_does_not_fit_changes_nothing(
    text: str, target: str | None, error: type[Exception], message: str, tmp_path: Path
) -> None:
    path = tmp_path / "gains.toml"
    path.write_text(text)
    async with robot(drive) as module, tool() as session:
        with pytest.raises(error, match=message):
            await load(session, path, target)
        assert module.parameters["drive", "kp"].value == 0.5


async def test_a_missing_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "gains.toml").touch()
    async with tool() as session:
        with pytest.raises(UsageError, match=r"there is no file gain\.toml"):
            await load(session, Path("gain.toml"))
        with pytest.raises(UsageError, match=r"the file comes first: r2p param load gains\.toml BOT"):
            await load(session, Path("BOT"), "gains.toml")


@pytest.mark.parametrize(
    ("arguments", "code", "text"),
    [
        (["set", "BOT/drive", "kp", "-0.5"], 2, "no network to look for parameters on"),
        (["set", "BOT/drive", "--kp"], 2, "no network"),
        (["list", "--raw", "0:1"], 2, "--raw is for the parameters of firmware: give --firmware APP, too"),
        (["get"], 2, "Missing argument 'MODULE/NODE'"),
    ],
)
def test_command_lines(arguments: list[str], code: int, text: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A negative number is a value."""
    monkeypatch.delenv("R2P_VIA", raising=False)
    result = CliRunner().invoke(app, ["param", *arguments], prog_name="r2p")
    assert result.exit_code == code
    assert text in result.output
