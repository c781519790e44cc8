"""The command itself: help, mistakes, and what it loads for them."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

from r2p.tools.main import COMMANDS, GROUPS, app
from r2p.transports.url import BUILT_IN


@pytest.mark.parametrize("arguments", [[], ["--help"], ["-h"]])
def test_help_lists_all_commands(arguments: list[str]) -> None:
    text = CliRunner().invoke(app, arguments).output
    assert re.findall(r"^  (\w+)  ", text.partition("Commands:")[2], re.MULTILINE) == [*GROUPS, *COMMANDS]


@pytest.mark.parametrize("name", [*GROUPS, *COMMANDS])
def test_every_command_has_help(name: str) -> None:
    result = CliRunner().invoke(app, [name, "--help"])
    assert result.exit_code == 0, result.output
    assert f"{name} " in result.output
    assert "..." not in result.output.partition("Commands:")[2], "a summary is cut off"


@pytest.mark.parametrize(
    ("arguments", "hint"),
    [
        (["topci"], "Did you mean 'topic'"),
        (["topic", "ehco"], "Did you mean 'echo'?"),
        (["topic", "echo"], "Missing"),
        (["topic", "echo", "a//c"], "topic name 'a//c': a part of it is empty: use letters, digits and underscores"),
        (["topic", "list", "--format", "xml"], "Invalid value for '--format': 'xml' is not one of 'yaml'"),
        (["topic", "hz", "leds", "-n", "x"], "Invalid value for '--count' / '-n': write a whole number\n"),
        (["topic", "hz", "leds", "-n", "0"], "Invalid value for '--count' / '-n': write a number of at least 1\n"),
        (["topic", "hz", "leds", "--once", "-n", "5"], "--once is -n 1, not -n 5: leave out one of them"),
        (
            ["run", "r2p.sim:run", "--remap", "a:=b", "--remap", "a:=c"],
            "--remap renames a twice, to b and to c: leave out one of them",
        ),
        (["bus", "admit", "imu:1@1s", "--slots", "65"], "'--slots': write a number from 2 to 64\n"),
        (["bus", "admit", "imu:1@1MHz"], "'1MHz': write a rate as in 200Hz"),
    ],
)
def test_mistakes_are_usage_errors(arguments: list[str], hint: str) -> None:
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 2
    assert hint in result.stderr


@pytest.mark.parametrize("program", ["r2p", "-m"])
def test_ctrl_c_while_the_command_is_imported_ends_it_in_silence(program: str, tmp_path: Path) -> None:
    (tmp_path / "msgspec.py").write_text(
        "import os, signal\n\nos.kill(os.getpid(), signal.SIGINT)\nprint('survived')\n"
    )
    script = tmp_path / "bin" / "r2p"
    script.parent.mkdir()
    script.write_text("from r2p.tools.main import main\n\nmain()\n")
    arguments = [str(script)] if program == "r2p" else ["-m", "r2p"]
    path = os.pathsep.join([str(tmp_path), str(Path(__file__).parents[2])])
    ended = subprocess.run(
        [sys.executable, *arguments], env=os.environ | {"PYTHONPATH": path}, capture_output=True, check=False
    )
    assert (ended.returncode, ended.stdout, ended.stderr) == (130, b"", b"")


@pytest.mark.parametrize("command", ["echo", "pub"])
def test_a_wrong_type_is_reported_before_links_are_opened(command: str) -> None:
    result = CliRunner().invoke(app, ["topic", command, "leds", "--type", "Lde", "--via", "tcp:127.0.0.1:1"])
    assert result.exit_code == 2
    assert "r2p.msg has no message class 'Lde'; did you mean r2p.msg:Led?" in result.stderr
    assert "link tcp:" not in result.stderr


@pytest.mark.parametrize(
    "arguments",
    [
        ["topic", "list"],
        ["gateway", "--via", "memory:a"],
        ["run", str(Path(__file__).parents[2] / "examples" / "blink.py:blink")],
        ["sim"],
    ],
)
def test_a_wrong_url_is_a_usage_error(arguments: list[str]) -> None:
    result = CliRunner().invoke(app, [*arguments, "--via", "nonsense:b"])
    assert result.exit_code == 2
    assert "unknown transport 'nonsense'" in result.stderr


def test_a_usage_error_at_a_terminal_breaks_between_words(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "40")
    monkeypatch.setattr("sys.stderr.isatty", lambda: True)
    with pytest.raises(typer.BadParameter) as caught:
        app(["topic", "echo", "a//c"], standalone_mode=False)
    lines = f"Error: {caught.value.format_message()}".splitlines()
    assert len(lines) > 2
    assert max(map(len, lines)) <= 40
    assert " ".join(line.strip() for line in lines).startswith("Error: Invalid value for 'TOPIC'")


def test_so_is_one_of_a_bus() -> None:
    result = CliRunner().invoke(app, ["bus", "load", "--via", "rtcan:can0,nonsense=1"])
    assert result.exit_code == 2
    assert "has no option 'nonsense'" in result.stderr


def test_a_wrong_url_in_the_environment_is_one_too(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("R2P_VIA", "tcp:")
    assert CliRunner().invoke(app, ["node", "list"]).exit_code == 2


def test_a_transport_that_this_installation_can_not_load_is_no_usage_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(BUILT_IN, "serial", "r2p.no_such_module:Transport")
    result = CliRunner().invoke(app, ["topic", "list", "--via", "serial:/dev/null"])
    assert result.exit_code == 1
    assert "can't be used here" in result.stderr


@pytest.mark.processes
@pytest.mark.skipif(not Path("/dev/full").exists(), reason="a device of Linux")
@pytest.mark.parametrize("arguments", [("--help",), ("topic", "--help"), ("doctor",)])
def test_output_that_can_not_be_written_is_an_error_of_one_line(arguments: tuple[str, ...]) -> None:
    program = f"import sys; sys.argv = ['r2p', *{list(arguments)}]; from r2p.tools.main import main; main()"
    command = [sys.executable, "-c", program]
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, timeout=60)
    assert done.returncode == 1
    assert done.stderr == "r2p: can't write the output: No space left on device\n"


@pytest.mark.processes
@pytest.mark.skipif(sys.platform == "win32", reason="closes descriptors as a shell of Unix does")
def test_closed_standard_streams_are_no_trouble() -> None:
    shell = ["sh", "-c", '"$@" <&- >&- 2>&-', "sh", sys.executable, "-c", "from r2p.tools.main import main; main()"]
    arguments = ["topic", "echo", "leds", "--via", "tcp-listen:0", "--timeout", "10ms"]
    assert subprocess.run([*shell, *arguments], timeout=60).returncode == 3


def test_version() -> None:
    assert re.fullmatch(r"r2p \d+\.\d+\.\d+\n", CliRunner().invoke(app, ["--version"]).output)


def _loaded(*arguments: str) -> set[str]:
    """Return the modules that a command has imported at its end."""
    program = (
        "import contextlib, sys; from r2p.tools.main import app\n"
        f"with contextlib.suppress(SystemExit): app({arguments!r})\n"
        "print('loaded', *sys.modules)"
    )
    text = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout
    return set(text.partition("loaded ")[2].split())


@pytest.mark.processes
def test_help_loads_no_command_and_no_library_that_it_does_not_need() -> None:
    loaded = _loaded("--help")
    assert "r2p.tools.main" in loaded
    assert not loaded & {"yaml", "rich", "serial", "r2p.tools.session", "r2p.tools.topic", "r2p.tools.run"}


@pytest.mark.processes
def test_commands_on_other_links_load_nothing_of_ros_or_recordings() -> None:
    loaded = _loaded("topic", "echo", "leds", "--via", "tcp-listen:0", "--timeout", "10ms")
    assert "r2p.transports.tcp" in loaded
    assert not [each for each in loaded if each.startswith(("r2p.ros", "r2p.recording", "mcap"))]
