"""Shell completion: what the command answers to shells, and the keys of a user in each of them."""

from __future__ import annotations

import asyncio
import contextlib
import os
import re
import shutil
import sys
import threading
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from typer.testing import CliRunner

import r2p
from r2p.codecs import management
from r2p.msg import Encoder, Led
from r2p.tools import completion
from r2p.tools.main import app
from r2p.tools.session import Settings
from tests.docs.shell import Process
from tests.ports import free_port
from tests.services.common import Add, add
from tests.tools.rig import PATIENCE, VIA, Firmware, robot, tool

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
        ("r2p to", ["topic", "top"]),
        ("r2p topic d", ["delay"]),
        ("r2p topic echo --fie", ["--field"]),
        ("r2p topic echo leds --format j", ["json"]),
        ("r2p topic pub cmd --type Velo", ["Velocity3"]),
        ("r2p topic pub cmd --type r2p.msg:Velo", ["r2p.msg:Velocity3"]),
        ("r2p demo l", ["line"]),
        ("r2p msg import sensor_msgs/Ran", ["sensor_msgs/Range"]),
        ("r2p sim --dr", ["--drive"]),
        ("r2p topic echo robot/e", ["robot/encoder"]),
        ("r2p topic echo --via memory:lab l", []),
        ("r2p launch --ready dr", ["drive"]),
        ("r2p param get IMU1 --firmware PID --as Encoder ", ["delta"]),
        ("r2p param get IMU1 --firmware PID --as Nothing ", []),
    ],
)
def test_words_are_completed(line: str, found: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("r2p.toml").write_text('[types]\n"robot/encoder" = "r2p.msg:Encoder"\n[launch.drive]\ncommand = "sim"\n')
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


@pytest.mark.parametrize("line", ["r2p topic echo le", "r2p node info B", "r2p launch --ready d"])
def test_without_a_valid_r2p_toml_there_are_no_names(
    line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And no traceback between the keys of the user."""
    monkeypatch.chdir(tmp_path)
    Path("r2p.toml").write_text("[types")
    assert completions(line) == []


@pytest.mark.parametrize("url", ["tcp:127.0.0.1:1", "rtcan:no_such_can", "serial:/dev/no_such", "no:"])
def test_a_link_that_can_not_come_up_is_silent(url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(completion, "_LINK_UP", 0.05)
    assert completions(f"r2p module stop --via {url} B") == []


async def drive(node: r2p.Node) -> None:
    node.parameter("kp", 0.5)
    node.parameter("reverse", False)
    node.advertise("encoder", Encoder)
    node.serve("add", Add.Request, Add.Response, add)
    node.subscribe("leds", Led)
    await asyncio.Event().wait()


@pytest.mark.virtual_time
async def test_names_of_the_network() -> None:
    """Tools are not offered, nor the topics of services; nodes without a topic are."""

    async def idle(_node: r2p.Node) -> None:
        pass

    async with robot(drive, idle), robot(drive, name="ARM"), tool() as other:
        other.node.advertise("leds", Led)
        start = asyncio.get_running_loop().time()
        found = {
            source.__name__: await completion.find(Settings([VIA]), source)
            for source in (completion.topics, completion.services, completion.modules, completion.nodes)
        }
        taken = asyncio.get_running_loop().time() - start
    assert found == {
        "topics": ["encoder", "leds", "log"],
        "services": ["add"],
        "modules": ["ARM", "BOT"],
        "nodes": ["ARM/drive", "ARM/log", "BOT/drive", "BOT/idle", "BOT/log"],
    }
    assert taken < 4 * 0.5, "it ends as soon as everything has been announced"


def test_a_level_behind_its_node() -> None:
    assert completions("r2p log --set BOT/drive=de") == ["BOT/drive=debug", "BOT/drive=default"]


@pytest.mark.virtual_time
async def test_firmware_is_listened_to_for_a_second() -> None:
    """Though it has announced only a part by then."""
    firmware = Firmware("IMU1")

    async def announce() -> None:
        for topic in ("tilt", "heading", "altitude", "pressure"):
            await asyncio.sleep(0.3)
            firmware.advertise(topic, 4)
            firmware.send(management.Alive("IMU1", 0))

    announcing = asyncio.create_task(announce())
    found = await completion.find(Settings([VIA]), completion.topics)
    announcing.cancel()
    assert {"heading", "tilt"} <= set(found) < {"tilt", "heading", "altitude", "pressure"}


@pytest.mark.virtual_time
async def test_a_network_that_does_not_answer_is_given_up() -> None:
    loop = asyncio.get_running_loop()
    start = loop.time()
    assert await completion.find(Settings(["memory:nobody"]), completion.topics) == []
    assert loop.time() - start < 2.0


@pytest.mark.parametrize(
    ("parts", "words", "there"),
    [
        ("r2p topic echo en", "r2p topic echo en", ""),
        ("r2p log --via tcp : pi : 9 ", "r2p log --via tcp:pi:9 ", ""),
        ("r2p msg show r2p.msg : Ve", "r2p msg show r2p.msg:Ve", "r2p.msg:"),
        ("r2p msg show r2p.msg :", "r2p msg show r2p.msg:", "r2p.msg:"),
        ("r2p topic pub cmd --type = r2p.msg : Ve", "r2p topic pub cmd --type=r2p.msg:Ve", "r2p.msg:"),
        ("r2p msg list --format = j", "r2p msg list --format=j", ""),
    ],
)
def test_bash_cuts_words_at_colons(parts: str, words: str, there: str) -> None:
    """And replaces only what is behind the last one."""
    environment = {"COMP_WORDS": "\n".join([*parts.split(" "), "behind"]), "COMP_CWORD": str(parts.count(" "))}
    assert completion.join_words(environment) == len(there)
    assert environment == {"COMP_WORDS": words.replace(" ", "\n"), "COMP_CWORD": str(words.count(" "))}


@pytest.fixture
def install(tmp_path: Path) -> Iterator[Callable[[str], Process]]:
    """Install completion from a shell, and return another terminal with it."""
    environment = {"PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}", "HOME": str(tmp_path), "TERM": "dumb"}
    # Without this folder, the first fish reads all manual pages of the system, half a minute of work, as the test ends.
    (tmp_path / ".local/share/fish/generated_completions").mkdir(parents=True)
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


@pytest.fixture
def url() -> Iterator[str]:
    """Where a robot listens, in a thread of its own."""
    port = free_port()
    loop, ended, up = asyncio.new_event_loop(), asyncio.Event(), threading.Event()

    async def main() -> None:
        async with r2p.Module("BOT", via=[f"tcp-listen:127.0.0.1:{port}"]) as module:
            module.start(drive)
            up.set()
            await ended.wait()

    thread = threading.Thread(target=loop.run_until_complete, args=(main(),))
    thread.start()
    try:
        assert up.wait(PATIENCE)
        yield f"tcp:127.0.0.1:{port}"
    finally:
        loop.call_soon_threadsafe(ended.set)
        thread.join()
        loop.close()


@pytest.mark.parametrize(
    ("words", "found"),
    [
        ("get BO", ["BOT", "BOT/drive"]),
        ("info BOT/drive k", ["kp"]),
        ("set BOT/drive reverse=", ["reverse=false", "reverse=true"]),
    ],
)
def test_parameters_are_completed(words: str, found: list[str], url: str) -> None:
    verb, *rest = words.split(" ")
    assert completions(f"r2p param {verb} --via {url} {' '.join(rest)}") == found


def test_no_word_is_offered_that_a_shell_would_run_or_cut() -> None:
    words = ["a/b.c", "a$(reboot)", "a b", "a\n", "a;b", "a`b`", "a\x1b", "a/?", "a/b.c"]
    assert completion.beginning("a", words) == ["a/b.c", "a/?"]


@pytest.mark.processes
@pytest.mark.skipif(sys.platform != "linux", reason="pseudo terminals, and setsid")
@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_a_shell_completes(shell: str, install: Callable[[str], Process], tmp_path: Path, url: str) -> None:
    """Types, topics of the network that is on the line, and files where r2p has no words."""
    if shutil.which(shell) is None and not os.environ.get("CI"):
        pytest.skip(f"needs {shell}: apt install {shell}, or run make system")
    (tmp_path / "blink.py").touch()
    terminal = install(shell)
    if shell == "zsh":
        terminal.type(f"r2p t\t{TO_START}true \r")  # the first Tab loads the completion
    for keys, found in (
        ("topic pub cmd --type r2p.msg:Velo", "topic pub cmd --type r2p.msg:Velocity3"),
        (f"topic echo --via {url} enc", f"topic echo --via {url} encoder"),
        ("run bli", "run blink.py"),
    ):
        terminal.type(f"r2p {keys}\t{TO_START}{SHOWN}\r")
        words = "".join(f"<{word}>" for word in ("r2p", *found.split()))
        terminal.expect(re.compile(f".*{re.escape(words)}", re.DOTALL))
    terminal.type("exit\r")
    terminal.finish(0)
