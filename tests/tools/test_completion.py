"""Shell completion: what the command answers to shells, and the keys of a user in each of them."""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from typer.testing import CliRunner

from r2p.tools.main import app
from tests.docs.shell import Process

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

TO_START = "\x01"  # Ctrl-A
SHOWN = r"printf '\074%s\076' "  # prints its arguments as <argument>, and is not itself what it prints


def completions(line: str) -> list[str]:
    """What `r2p` offers a shell for the last word."""
    environment = {"_R2P_COMPLETE": "complete_bash", "COMP_WORDS": line, "COMP_CWORD": str(len(line.split(" ")) - 1)}
    result = CliRunner().invoke(app, [], prog_name="r2p", env=environment)
    assert (result.exit_code, result.stderr) == (0, "")
    return result.stdout.split()


@pytest.mark.parametrize(
    ("line", "found"),
    [
        ("r2p to", ["topic"]),
        ("r2p topic d", ["delay"]),
        ("r2p topic echo --fie", ["--field"]),
        ("r2p topic echo leds --format j", ["json"]),
        ("r2p topic pub cmd --type Velo", ["Velocity3"]),
        ("r2p topic pub cmd --type r2p.msg:Velo", ["r2p.msg:Velocity3"]),
        ("r2p demo l", ["line"]),
        ("r2p sim --sq", ["--square"]),
        ("r2p topic echo robot/e", ["robot/encoder"]),
    ],
)
def test_words_are_completed(line: str, found: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("r2p.toml").write_text('[types]\n"robot/encoder" = "r2p.msg:Encoder"\n')
    assert completions(line) == found


@pytest.mark.parametrize(
    ("arguments", "code", "text"),
    [
        (["--show-completion", "zsh"], 0, "#compdef r2p"),
        (["--show-completion=fish"], 0, "complete --command r2p"),
        (["--show-completion", "tcsh"], 2, "'tcsh' is not one of bash, zsh, fish"),
    ],
)
def test_the_shell_may_be_named(arguments: list[str], code: int, text: str) -> None:
    result = CliRunner().invoke(app, arguments, prog_name="r2p")
    assert result.exit_code == code
    assert text in result.output


def test_without_a_valid_r2p_toml_there_are_no_topics(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """And no traceback between the keys of the user."""
    monkeypatch.chdir(tmp_path)
    Path("r2p.toml").write_text("[types")
    assert completions("r2p topic echo le") == []


@pytest.fixture
def install(tmp_path: Path) -> Iterator[Callable[[str], Process]]:
    """Install completion from a shell, and return another terminal with it."""
    environment = {"PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}", "HOME": str(tmp_path), "TERM": "dumb"}
    with contextlib.ExitStack() as stack:

        def run(command: str) -> Process:
            process = Process(command, tmp_path, environment)
            stack.callback(process.close)
            return process

        def install(shell: str) -> Process:
            shown = re.compile(rf"{shell} completion installed in .*", re.DOTALL)
            run(f"{shell} -c 'r2p --install-completion; true'").finish(0, shown)
            return run(f"setsid --ctty --wait {shell} -i")

        yield install


@pytest.mark.processes
@pytest.mark.skipif(sys.platform != "linux", reason="pseudo terminals, and setsid")
@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_a_shell_completes(shell: str, install: Callable[[str], Process], tmp_path: Path) -> None:
    """The types for an option of a group that is loaded when it is needed, and files where r2p has no words."""
    if shutil.which(shell) is None and not os.environ.get("CI"):
        pytest.skip(f"needs {shell}: apt install {shell}, or run make system")
    (tmp_path / "blink.py").touch()
    terminal = install(shell)
    if shell == "zsh":
        terminal.type(f"r2p t\t{TO_START}true \r")  # the first Tab loads the completion
    for keys, found in (("topic pub cmd --type Velo", "topic pub cmd --type Velocity3"), ("run bli", "run blink.py")):
        terminal.type(f"r2p {keys}\t{TO_START}{SHOWN}\r")
        words = "".join(f"<{word}>" for word in ("r2p", *found.split()))
        terminal.expect(re.compile(f".*{re.escape(words)}", re.DOTALL))
    terminal.type("exit\r")
    terminal.finish(0)
