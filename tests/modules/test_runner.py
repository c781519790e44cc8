"""`r2p.run`: programs in processes of their own, ended by what ends programs."""

from __future__ import annotations

import asyncio
import functools
import os
import re
import signal
import subprocess
import sys
import textwrap
import threading
from typing import TYPE_CHECKING, Any, NamedTuple
from unittest import mock

import pytest

import r2p
from r2p.modules.runner import loop_factory, run_main

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="signals as POSIX has them")

PROLOGUE = """
import asyncio, logging, os, signal, sys, threading, time
import r2p, r2p.modules.runner

def ready() -> None:
    print("ready", flush=True)

async def waits(node: r2p.Node) -> None:
    ready()
    try:
        await asyncio.Event().wait()
    finally:
        await asyncio.sleep(0)
        print("cleaned up", flush=True)
"""


class Ended(NamedTuple):
    code: int
    out: str
    err: str


def execute(program: str, *signals: int) -> Ended:
    """Run a program; send it each signal when it has printed one more line."""
    text = PROLOGUE + textwrap.dedent(program)
    environment = {name: value for name, value in os.environ.items() if name != "R2P_VIA"}
    with subprocess.Popen(
        [sys.executable, "-c", text], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment
    ) as process:
        assert process.stdout is not None
        lines = []
        try:
            for number in signals:
                lines.append(process.stdout.readline())
                process.send_signal(number)
            out, err = process.communicate(timeout=60)
        finally:
            process.kill()
        return Ended(process.returncode, "".join(lines) + out, err)


@pytest.mark.processes
def test_it_returns_when_all_nodes_have_ended() -> None:
    ended = execute(
        """
        from r2p.msg import Led

        async def sends(node: r2p.Node) -> None:
            leds = node.advertise("leds", Led)
            await leds.wait_subscriber()
            await leds.publish(Led(led=3))

        async def gets(node: r2p.Node) -> None:
            print(await node.subscribe("lamp", Led).fetch(), node.module)

        r2p.run(sends, gets, module="PC7", remap={"leds": "lamp"})
        print("end")
        """
    )
    assert ended == (0, "Led(led=3, value=0) PC7\nend\n", "")


@pytest.mark.processes
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_everything_in_order(number: int) -> None:
    ended = execute("r2p.run(waits)\nprint('end')", number)
    assert ended == (0, "ready\ncleaned up\nend\n", "")


@pytest.mark.processes
@pytest.mark.parametrize(("first", "second"), [(signal.SIGINT, signal.SIGINT), (signal.SIGINT, signal.SIGTERM)])
def test_a_second_signal_ends_the_process_at_once(first: int, second: int) -> None:
    program = """
        async def hangs(node: r2p.Node) -> None:
            ready()
            try:
                await asyncio.Event().wait()
            finally:
                ready()
                await asyncio.Event().wait()

        sys.modules["r2p.modules.runner"].GRACE = 3600.0
        r2p.run(hangs)
    """
    assert execute(program, first, second).code == -second


@pytest.mark.processes
def test_two_signals_at_the_same_time_end_the_process_at_once() -> None:
    program = """
        async def hangs(node: r2p.Node) -> None:
            both = {signal.SIGINT, signal.SIGTERM}
            signal.pthread_sigmask(signal.SIG_BLOCK, both)
            for each in both:
                os.kill(os.getpid(), each)
            signal.pthread_sigmask(signal.SIG_UNBLOCK, both)
            await asyncio.Event().wait()

        import os, signal
        sys.modules["r2p.modules.runner"].GRACE = 3600.0
        r2p.run(hangs)
    """
    ended = execute(program)
    assert ended.code in (-signal.SIGINT, -signal.SIGTERM)
    assert not ended.err


@pytest.mark.processes
@pytest.mark.parametrize(
    "hang", ["await asyncio.Event().wait()", "time.sleep(3600)", "await asyncio.to_thread(time.sleep, 3600)"]
)
def test_a_program_that_does_not_end_is_ended(hang: str) -> None:
    program = f"""
        async def hangs(node: r2p.Node) -> None:
            ready()
            try:
                {hang}
            finally:
                {hang}

        sys.modules["r2p.modules.runner"].GRACE = 0.05
        r2p.run(hangs)
    """
    assert execute(program, signal.SIGTERM).code == -signal.SIGTERM


@pytest.mark.processes
@pytest.mark.parametrize(("takes", "may_take", "out"), [(0.5, 3600.0, "ready\nsaved\n"), (3600.0, 0.05, "ready\n")])
def test_what_would_be_lost_is_saved_first(takes: float, may_take: float, out: str) -> None:
    """The clean-up takes longer than it may, but for the time in which it saves something."""
    program = f"""
        async def saves(node: r2p.Node) -> None:
            ready()
            try:
                await asyncio.Event().wait()
            finally:
                with runner.saving():
                    time.sleep({takes})
                print("saved", flush=True)
                time.sleep(3600)

        runner = sys.modules["r2p.modules.runner"]
        runner.GRACE, runner.SAVING_MAX = 0.05, {may_take}
        r2p.run(saves)
    """
    ended = execute(program, signal.SIGTERM)
    assert (ended.code, ended.out) == (-signal.SIGTERM, out)


@pytest.mark.processes
def test_a_crash_is_logged_once_and_is_one_line_at_the_end_also_after_a_signal() -> None:
    program = """
        async def broken(node: r2p.Node) -> None:
            node.log.info("on")
            logging.getLogger("r2p.link").warning("link is down")
            raise ValueError("no motor")

        try:
            r2p.run(broken, waits, module="PC1")
        except r2p.NodeCrashed as error:
            print(*error.exceptions)
            raise
    """
    ended = execute(program, signal.SIGINT)
    assert (ended.code, ended.out) == (1, "ready\ncleaned up\nno motor\n")
    timeless = re.sub(r"^\d\d:\d\d:\d\d\.\d\d\d ", "", ended.err, flags=re.MULTILINE)
    lines = [each for each in timeless.splitlines() if "event loop" not in each]  # a computer may be slow now
    assert lines[:4] == [
        "INFO    PC1/broken: on",
        "WARNING r2p: link is down",
        "ERROR   PC1/broken: node broken crashed: ValueError: no motor",
        "Traceback (most recent call last):",
    ]
    assert lines[-2:] == ["ValueError: no motor", "r2p: node broken of module PC1 crashed"]
    assert [line.split(",")[0] for line in lines if "File " in line] == ['  File "<string>"']


@pytest.mark.processes
def test_restart_goes_on_after_a_crash() -> None:
    program = """
        import itertools
        runs = itertools.count()

        async def broken(node: r2p.Node) -> None:
            if next(runs) == 0:
                raise ValueError("no motor")
            print("again")

        sys.modules["r2p.modules.supervisor"]._FIRST_RESTART = 0.01
        r2p.run(broken, restart=True)
    """
    assert execute(program)[:2] == (0, "again\n")


def handlers() -> list[object]:
    return [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]


def test_a_signal_ends_run_main_and_the_handlers_are_as_before() -> None:
    async def main() -> None:
        os.kill(os.getpid(), signal.SIGTERM)
        await asyncio.Event().wait()

    before = handlers()
    run_main(main)
    assert handlers() == before


def test_run_main_gives_the_result_and_raises_what_main_raises() -> None:
    async def fine() -> int:
        await asyncio.sleep(0)
        return 3

    async def broken() -> None:
        raise LookupError

    async def cancelled() -> None:
        raise asyncio.CancelledError

    before = handlers()
    assert run_main(fine) == 3
    with pytest.raises(LookupError):
        run_main(broken)
    with pytest.raises(asyncio.CancelledError):
        run_main(cancelled)
    assert handlers() == before


@pytest.mark.virtual_time
async def test_a_program_in_a_program_is_an_error() -> None:
    with pytest.raises(r2p.Error, match=r"an event loop runs already: .* `async with r2p.Module\(...\)`"):
        r2p.run(wink)


def test_run_main_works_in_a_thread() -> None:
    async def main() -> None:
        await asyncio.sleep(0)
        done.append(handlers())

    done: list[list[object]] = []
    before = handlers()
    thread = threading.Thread(target=run_main, args=(main,))
    thread.start()
    thread.join()
    assert done == [before]


def test_a_program_runs_on_uvloop_where_there_is_one(monkeypatch: pytest.MonkeyPatch) -> None:
    async def main() -> str:
        return type(asyncio.get_running_loop()).__module__

    pytest.importorskip("uvloop")
    assert run_main(main) == "uvloop"
    monkeypatch.setitem(sys.modules, "uvloop", None)
    assert loop_factory() is None
    assert str(run_main(main)).startswith("asyncio")


async def line_follower(node: r2p.Node) -> None:
    print(node.name)  # noqa: T201


async def wink(node: r2p.Node) -> None:
    print(node.name)  # noqa: T201


async def too_long(node: r2p.Node) -> None: ...


LONG = too_long
LONG.__name__ = "line_follower_" * 5
SHORT = ("line_follower_" * 5)[:64].rstrip("_")


def test_nodes_get_their_names(capsys: pytest.CaptureFixture[str]) -> None:
    r2p.run(line_follower, name="follower", via=[])
    r2p.run(wink, ("left", wink), ("follow", line_follower), via=[])
    assert capsys.readouterr().out.split() == ["follower", "wink", "left", "follow"]


async def talk() -> None:
    """Lack the node."""


async def silent(node: r2p.Node) -> AsyncIterator[None]:
    """Yield, as a node can't."""
    yield


class Robot:
    async def drive(self, node: r2p.Node) -> None:
        """Be a node."""

    async def stop(self) -> None:
        """Lack the node."""


@pytest.mark.parametrize(
    ("functions", "name", "kind", "text"),
    [
        ([LONG], None, r2p.NameTooLong, f"pass name='{SHORT}', or ('{SHORT}', {LONG.__name__}) to r2p.run"),
        ([wink, ("L" * 65, wink)], None, r2p.NameTooLong, "has 65 characters, at most 64 are possible: shorten it"),
        ([wink], "", r2p.InvalidName, "node name ''"),
        ([wink, wink], None, r2p.Error, '2 nodes named wink: write ("another_name", wink) for one'),
        ([wink, line_follower], "x", r2p.Error, "name='x' names one function, not 2: write (name, function)"),
        ([], None, r2p.Error, "has no function to run"),
        ([mock.Mock], None, r2p.Error, "class Mock is not a coroutine function: pass a method, Mock().METHOD"),
        ([lambda node: None], None, r2p.Error, "<lambda> is not a coroutine function: write `async def "),
        ([(wink, "x")], None, r2p.Error, "is not a node: write a function, or (name, function)"),
        ([talk], None, r2p.Error, "talk() does not take its node: write `async def talk(node: r2p.Node)`"),
        ([("talk", talk)], None, r2p.Error, "talk() does not take its node"),
        ([wink, functools.partial(talk)], None, r2p.Error, "talk() does not take its node"),
        ([Robot.drive], None, r2p.Error, "drive is a method of a class: pass that of an object, Robot().drive"),
        (
            [Robot().stop],
            None,
            r2p.Error,
            "stop() does not take its node: write `async def stop(self, node: r2p.Node)`",
        ),
        ([[wink, line_follower]], None, r2p.Error, "a list is not a coroutine function: pass the functions one by one"),
        ([silent], None, r2p.Error, "silent contains `yield`: a node publishes messages"),
        ([print], None, r2p.Error, "print is not a coroutine function: write `async def print(node: r2p.Node)`"),
    ],
)
def test_what_can_not_run_is_one_line(
    functions: list[Any],
    name: str | None,
    kind: type[Exception],
    text: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(sys, "excepthook", sys.__excepthook__)
    with pytest.raises(kind) as caught:
        r2p.run(*functions, name=name, via=[])
    assert text in str(caught.value)
    sys.excepthook(caught.type, caught.value, caught.tb)
    assert capsys.readouterr().err == f"r2p: {caught.value}\n"
    sys.excepthook(LookupError, LookupError("other"), None)
    assert capsys.readouterr().err == "LookupError: other\n"


def test_a_function_that_was_called_is_passed_without_brackets() -> None:
    with pytest.raises(r2p.Error, match=r"talk\(\) was called: pass the function itself, talk without \(\)"):
        r2p.run(talk())  # type: ignore[arg-type]
    with pytest.raises(r2p.Error, match=r"takes the function itself: write r2p.run_main\(talk\), without \(\)"):
        run_main(talk())  # type: ignore[arg-type]


def test_a_traceback_of_run_main_ends_at_the_code_of_the_program(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    async def main() -> None:
        r2p.Module("PC1").start(wink)

    monkeypatch.setattr(sys, "excepthook", sys.__excepthook__)
    with pytest.raises(r2p.Closed) as caught:
        run_main(main)
    sys.excepthook(caught.type, caught.value, caught.tb)
    lines = capsys.readouterr().err.splitlines()
    assert all(__file__ in line for line in lines if "File " in line)
    assert lines[-1] == "r2p.errors.Closed: module PC1 is not open: use it in an `async with` block"


def test_a_hook_of_the_program_stays_and_debugging_keeps_the_traceback(monkeypatch: pytest.MonkeyPatch) -> None:
    hook = mock.Mock()
    monkeypatch.setattr(sys, "excepthook", hook)
    with pytest.raises(r2p.NameTooLong):
        r2p.run(LONG)
    assert sys.excepthook is hook
    monkeypatch.setattr(sys, "excepthook", sys.__excepthook__)
    monkeypatch.setenv("R2P_DEBUG", "1")
    with pytest.raises(r2p.NameTooLong):
        r2p.run(LONG)
    assert sys.excepthook is sys.__excepthook__


@pytest.mark.processes
def test_the_example_of_the_package(tmp_path: Path) -> None:
    """The program at the top of the design, until it has printed two messages."""
    program = """
        from r2p.msg import Led

        async def blink(node: r2p.Node) -> None:
            leds = node.advertise("leds", Led)
            on = False
            async for _ in node.every(0.01):
                on = not on
                await leds.publish(Led(led=3, value=int(on)))

        async def watch(node: r2p.Node) -> None:
            async for led in node.subscribe("leds", Led, queue=5):
                print(led, flush=True)

        r2p.run(blink, watch)
    """
    ended = execute(program, 0, signal.SIGINT)
    assert ended.code == 0
    assert ended.out.splitlines()[:2] == ["Led(led=3, value=1)", "Led(led=3, value=0)"]
