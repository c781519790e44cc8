"""`r2p run`: what it loads, its errors, and how it ends."""

from __future__ import annotations

import re
import signal
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from typer.testing import CliRunner

import r2p
from r2p.testing.network import node_in
from r2p.tools.config import settings
from r2p.tools.main import app
from r2p.tools.run import load, parameter_sources
from r2p.tools.session import UsageError
from r2p.tools.types import load_type
from tests.tools.rig import listening, process

if TYPE_CHECKING:
    from collections.abc import Iterator

FOLLOWS = """
import asyncio
from r2p.clock import SteeredClock, clock_of

async def shown(node):
    print("follows:", isinstance(clock_of(), SteeredClock), flush=True)
    await asyncio.Event().wait()
"""
NODES = """
import asyncio, time
import r2p
from r2p.msg import Led

async def blink(node: r2p.Node) -> None:
    leds = node.advertise("leds", Led)
    async for tick in node.every(0.02):
        await leds.publish(Led(led=3))

async def watch(node: r2p.Node) -> None:
    async for led in node.subscribe("leds", Led):
        print(node.module, node.name, node.priority, led, flush=True)

async def once(node: r2p.Node) -> None:
    print("ran", flush=True)

async def crash(node: r2p.Node) -> None:
    raise LookupError("no motor")

async def motor(node: r2p.Node) -> None:
    print("ready", flush=True)
    try:
        await asyncio.Event().wait()
    finally:
        await asyncio.sleep(0)
        print("stopped", flush=True)

async def stubborn(node: r2p.Node) -> None:
    print("ready", flush=True)
    while True:
        try:
            await asyncio.Event().wait()
        except asyncio.CancelledError:
            print("no", flush=True)

async def blocks(node: r2p.Node) -> None:
    print("ready", flush=True)
    time.sleep(3600)

async def a_long_name(node: r2p.Node) -> None:
    pass

def plain(node: r2p.Node) -> None:
    pass

async def bare() -> None:
    pass
"""


@pytest.fixture(autouse=True)
def program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A file with nodes in the working directory; what a test imports is forgotten after it."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", sys.path.copy())
    before = set(sys.modules)
    (tmp_path / "nodes.py").write_text(NODES, encoding="ascii")
    yield
    for name in set(sys.modules) - before:
        del sys.modules[name]


def names(*targets: str) -> list[str]:
    return [each.name for each in load(targets)]


@pytest.mark.parametrize("where", ["nodes.py", "./nodes.py", "nodes"])
def test_functions_are_found(where: str) -> None:
    blink, left = load([f"{where}:blink", f"{where}:blink=left"])
    assert (blink.name, left.name) == ("blink", "left")
    assert blink.function is left.function
    assert names(f"{where}:a_long_name=short") == ["short"]


def test_a_package_and_what_lies_beside_a_file(tmp_path: Path) -> None:
    (tmp_path / "robot").mkdir()
    (tmp_path / "robot" / "__init__.py").touch()
    (tmp_path / "robot" / "arm.py").write_text("from nodes import blink, watch", encoding="ascii")
    (tmp_path / "leg.py").write_text("import nodes\nblink = nodes.blink", encoding="ascii")
    assert names("robot.arm:watch", "leg.py:blink") == ["watch", "blink"]


def test_a_file_may_be_named_like_a_module_that_is_there(tmp_path: Path) -> None:
    (tmp_path / "signal.py").write_text("async def blink(node): ...", encoding="ascii")
    assert names("signal.py:blink") == ["blink"]
    assert signal.SIGINT


@pytest.mark.parametrize(
    ("target", "what_to_do"),
    [
        (
            "nodes.py",
            "which function? it has blink, watch, once, crash, motor, stubborn, blocks, a_long_name, bare: r2p run",
        ),
        ("nodes.py:blnk", "nodes.py has no function blnk; did you mean blink?"),
        ("nodes.py:xyz", "nodes.py has no function xyz; it has blink, "),
        ("nodes.py:plain", "nodes.py:plain is not a node: write `async def plain"),
        ("nodes.py:Led", "nodes.py:Led is not a node"),
        ("nodes.py:bare", "nodes.py: bare() does not take its node: write `async def bare(node: r2p.Node)`"),
        (f"nodes.py:blink={'x' * 65}", "at most 64 characters; use another name: nodes.py:blink=NAME"),
        ("other.py:blink", "there is no file other.py"),
        ("dir/nodes:blink", "there is no file dir/nodes"),
        ("other:blink", "there is no module other here; the name of a file must end with .py"),
        ("nodes.blink", "there is no module nodes.blink"),
        ("empty.py", "which function? it defines no node; write `async def"),
    ],
)
def test_usage_says_what_to_do(tmp_path: Path, target: str, what_to_do: str) -> None:
    (tmp_path / "empty.py").touch()
    with pytest.raises(UsageError, match=re.escape(what_to_do)):
        load([target])


def test_two_nodes_of_one_name() -> None:
    with pytest.raises(UsageError, match=r"there is already a node blink; use another name: nodes.py:blink=NAME"):
        load(["nodes.py:blink", "nodes.py:watch", "nodes.py:blink"])


@pytest.mark.parametrize("where", ["broken.py", "broken"])
@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("def f():\n    return missing\nf()", "NameError: name 'missing' is not defined"),
        ("import not_there", "ModuleNotFoundError: No module named 'not_there'"),
        ("x = (", "SyntaxError: '(' was never closed"),
    ],
)
def test_errors_in_the_file_come_with_its_lines_and_none_of_ours(
    tmp_path: Path, where: str, text: str, error: str
) -> None:
    file = tmp_path / "broken.py"
    file.write_text(text, encoding="ascii")
    with pytest.raises(r2p.Error) as raised:
        load([f"{where}:blink"])
    lines = str(raised.value).splitlines()
    assert lines[0] == f"can't load {where}:"
    assert lines[-1] == error
    files = [line for line in lines if line.strip().startswith("File ")]
    assert files
    assert all(str(file) in line for line in files)


@pytest.mark.parametrize("allowed", [False, True])
def test_changes_by_ip_links_are_let_in_only_if_the_user_says_so(
    allowed: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object, allow_control: bool, **__: object) -> None:
        raise r2p.Error(f"control: {allow_control}")

    (tmp_path / "nodes.py").write_text(NODES, encoding="ascii")
    monkeypatch.setattr(r2p, "Module", refuse)
    result = CliRunner().invoke(app, ["run", "nodes.py:once", *(["--allow-control"] if allowed else [])])
    assert f"control: {allowed}" in result.output


GUARD = 'runs as soon as the file is loaded: put it under `if __name__ == "__main__":`'


@pytest.mark.virtual_time  # with an event loop, as commands load files
@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("import nodes, r2p\n\nr2p.run(nodes.once)", f"robot.py, line 3 {GUARD}"),
        ("import nodes, r2p\ndef main():\n  r2p.run(nodes.once)\nmain()", f"robot.py, line 4 {GUARD}"),
        ("import asyncio, nodes\nasyncio.run(nodes.once(None))", f"robot.py, line 2 {GUARD}"),
        ("import r2p\nclass M(r2p.Message):\n  a: r2p.u8 = 0\n  b: r2p.u8", "robot.py, line 2: M.b: a field without"),
        ("import r2p\ndef f():\n  r2p.layout(3)\nf()", "robot.py, line 3: 3 is not a message class"),
    ],
)
async def test_what_r2p_refuses_in_a_file_is_one_line_with_its_place(tmp_path: Path, text: str, error: str) -> None:
    (tmp_path / "robot.py").write_text(text, encoding="ascii")
    for target in ("robot.py:blink", "robot:blink"):
        with pytest.raises(UsageError) as raised:
            load([target])
        assert str(raised.value).startswith(error)
    with pytest.raises(UsageError, match=re.escape(error)):
        load_type("robot.py:M")


# As a process


def run(*arguments: str, signals: int = 0, number: int = signal.SIGINT) -> tuple[int, str, str]:
    """`r2p run`; after each of its first `signals` lines it gets a signal. Exit code, output, errors."""
    with process("run", *arguments) as child:
        assert child.stdout is not None
        lines = []
        for _ in range(signals):
            lines.append(child.stdout.readline())
            child.send_signal(number)
        out, err = child.communicate()
    return child.returncode, "".join(lines) + out, err


@pytest.mark.processes
def test_it_says_what_runs_and_ends_with_its_nodes() -> None:
    code, out, err = run("nodes.py:once", "nodes.py:once=again", "--module", "PC7")
    assert (code, out) == (0, "ran\nran\n")
    assert err == "r2p: module PC7 runs once, again; links: none, local only (--via joins a network); Ctrl-C ends it\n"
    assert run("nodes.py:once", "-q")[2] == ""


@pytest.mark.processes
def test_it_may_follow_the_time_of_ros(tmp_path: Path) -> None:
    (tmp_path / "clock.py").write_text(FOLLOWS, encoding="ascii")
    assert run(f"{tmp_path}/clock.py:shown", "--sim-time", signals=1)[:2] == (0, "follows: True\n")


@pytest.mark.processes
def test_two_processes_with_remapping_and_priority() -> None:
    with process("run", "nodes.py:blink", "--via", "tcp-listen:0", "--remap", "leds:=lamps") as blink:
        via = listening(blink)
        arguments = ("nodes.py:watch=look", "--module", "PC7", "--via", via)
        names = ("--remap", "leds:=lamps", "--priority", "look=10")
        code, out, err = run(*arguments, *names, signals=1)
    assert code == 0
    assert set(out.splitlines()) == {"PC7 look 10 Led(led=3, value=0)"}
    assert f"module PC7 runs look; links: {via}; Ctrl-C ends it" in err
    assert f"link {via} is up" in err


@pytest.mark.processes
def test_r2p_toml(tmp_path: Path) -> None:
    with process("run", "nodes.py:blink", "--via", "tcp-listen:0") as blink:
        via = listening(blink)
        (tmp_path / "r2p.toml").write_text(f'via = "{via}"\nmodule = "PC8"\n[remap]\nlamps = "leds"', encoding="ascii")
        code, out, _ = run("nodes.py:watch", "--remap", "leds:=leds", signals=1)
    assert code == 0
    assert out.startswith("PC8 watch 0 Led")


@pytest.mark.processes
def test_a_crash_is_told_once_and_the_others_run_on() -> None:
    code, out, err = run("nodes.py:crash", "nodes.py:motor", signals=1)
    assert (code, out) == (1, "ready\nstopped\n")
    assert err.count("Traceback") == err.count("LookupError: no motor\n") - 1 == 1
    assert "/r2p/" not in err
    assert "ExceptionGroup" not in err
    assert err.endswith("r2p: node crash of module " + err.rpartition("of module ")[2])


@pytest.mark.processes
def test_restart_keeps_it_running() -> None:
    with process("run", "nodes.py:crash", "--restart") as child:
        assert child.stderr is not None
        crashes = (line for line in child.stderr if "crash crashed" in line)
        next(crashes)
        next(crashes)
        child.send_signal(signal.SIGTERM)
        child.communicate()
    assert child.returncode == 0


@pytest.mark.processes
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_it_in_order(number: int) -> None:
    code, out, err = run("nodes.py:motor", signals=1, number=number)
    assert (code, out) == (0, "ready\nstopped\n")
    assert "Traceback" not in err


@pytest.mark.processes
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_second_signal_ends_it_at_once(number: int) -> None:
    assert run("nodes.py:stubborn", signals=2, number=number)[:2] == (-number, "ready\nno\n")


@pytest.mark.processes
@pytest.mark.parametrize("node", ["stubborn", "blocks"])
def test_what_does_not_end_is_ended(node: str) -> None:
    assert run(f"nodes.py:{node}", signals=1)[0] == -signal.SIGINT


@pytest.mark.processes
@pytest.mark.parametrize(
    ("arguments", "error"),
    [
        (["nodes.py:missing"], "nodes.py has no function missing"),
        (["nodes.py:blink", "--module", "M" * 65], "has 65 characters, at most 64"),
        (["nodes.py:blink", "--remap", "a=b"], "--remap a=b: write it as OLD:=NEW"),
        (["nodes.py:blink", "--remap", "a:=b-c"], "'-' can't be in a name"),
        (["nodes.py:blink", "--priority", "blnk=1"], "there is no node blnk; the nodes are blink"),
        (["nodes.py:blink", "--priority", "blink=high"], "write it as NODE=N, for example blink=10"),
        ([], "FILE:FUNCTION"),
    ],
)
def test_usage_is_exit_code_2(arguments: list[str], error: str) -> None:
    code, out, err = run(*arguments)
    assert (code, out) == (2, "")
    assert error in err
    assert "Traceback" not in err


@pytest.mark.processes
def test_a_file_that_does_not_load_is_exit_code_1(tmp_path: Path) -> None:
    (tmp_path / "broken.py").write_text("x = 1 / 0", encoding="ascii")
    code, _, err = run("broken.py:blink")
    assert code == 1
    assert err.startswith("r2p: can't load broken.py:\nTraceback (most recent call last):\n  File")
    assert err.endswith("ZeroDivisionError: division by zero\n")


GAINS = """
import r2p

async def speed(node: r2p.Node) -> None:
    kp, ki = node.parameter("kp", 0.5), node.parameter("ki", 1)
    print(kp.value, ki.value, flush=True)

async def arm(node: r2p.Node) -> None:
    node.parameter("kp", 1)
"""


@pytest.mark.virtual_time
@pytest.mark.parametrize(
    ("strongest", "value", "origin"),
    [
        ("code", 0.5, "code"),
        ("saved", 1.0, "saved file"),
        ("config", 2.0, "r2p.toml"),
        ("file", 4.0, "--params"),
        ("option", 5.0, "--param"),
        ("node option", 6.0, "--param"),
    ],
)
async def test_where_the_first_value_of_a_parameter_comes_from(
    tmp_path: Path, strongest: str, value: float, origin: str
) -> None:
    """Each source wins over all that are weaker, which are there as well."""
    sources = ["code", "saved", "config", "file", "option", "node option"]
    there = sources[: sources.index(strongest) + 1]
    (tmp_path / "saved.toml").write_text("format = 1\n" + "[params.PC1.speed]\nkp = 1\n" * ("saved" in there))
    table = "[params.PC1.speed]\nkp = 2\n[params.PC2.speed]\nkp = 9\n" * ("config" in there)
    (tmp_path / "r2p.toml").write_text(f'params_file = "saved.toml"\n{table}')
    files = [tmp_path / "one.toml", tmp_path / "two.toml"] if "file" in there else []
    for number, path in enumerate(files):
        path.write_text(f"[params.PC1.speed]\nkp = {number + 3}\n")
    options = ["kp=5"] * ("option" in there) + ["speed.kp=6.0"] * ("node option" in there)
    chosen = settings()
    module = r2p.Module("PC1", params_file=chosen.params_file, params=parameter_sources("PC1", chosen, files, options))
    async with module, node_in(module, name="speed") as node:
        kp = node.parameter("kp", 0.5)
        assert (kp.value, kp.origin) == (value, origin)


@pytest.mark.parametrize(
    ("files", "options", "reason"),
    [
        (["none.toml"], [], "there is no file none.toml"),
        (["nodes.py"], [], "nodes.py: "),
        (["empty.toml"], [], r"empty.toml has no parameters: write a table \[params.MODULE.node\]"),
        ([], ["kp"], "--param kp: write it as NAME=VALUE or NODE.NAME=VALUE"),
        ([], ["a b=1"], "--param a b=1: write it as NAME=VALUE"),
        ([], [".kp=1"], "--param .kp=1: write it as NAME=VALUE"),
    ],
)
def test_options_of_parameters_that_mean_nothing(
    tmp_path: Path, files: list[str], options: list[str], reason: str
) -> None:
    (tmp_path / "empty.toml").touch()
    with pytest.raises(UsageError, match=reason):
        parameter_sources("PC1", settings(), map(Path, files), options)


def test_a_file_for_other_modules_is_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (path := tmp_path / "gains.toml").write_text("[params.PC2.speed]\nkp = 1\n")
    assert parameter_sources("PC1", settings(), [path], [])
    assert f"{path} has no parameters of PC1: their tables are [params.PC1.node]" in " ".join(
        capsys.readouterr().err.split()
    )


@pytest.mark.processes
def test_options_reach_the_nodes_and_a_value_that_does_not_fit_is_an_error_of_its_node(tmp_path: Path) -> None:
    (tmp_path / "gains.py").write_text(GAINS)
    (tmp_path / "tuned.toml").write_text("[params.PC1.speed]\nki = 3")
    code, out, err = run(
        *("gains.py:speed", "gains.py:arm", "--module", "PC1", "--params", "tuned.toml"),
        *("--param", "speed.kp=7", "--param", "arm.kp=fast", "--params-file", "saved.toml"),
    )
    assert (code, out) == (1, "7.0 3\n")
    assert "node arm can't start: PC1/arm.kp = 'fast': it takes an int (from --param)" in err
    assert "node arm of module PC1 did not start" in err
    assert "Traceback" not in err  # no mistake of the program
