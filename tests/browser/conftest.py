"""One browser, and one emulated robot with its page, for the whole run; the tests that use them are all in one worker.

They end with these tests: a robot that goes on takes a fifth of a core from all others.

Coroutines here run in the browser's thread.
"""

from __future__ import annotations

import inspect
import os
import re
from typing import TYPE_CHECKING

import pytest

from tests.browser import install, rig
from tests.tools.rig import process

if TYPE_CHECKING:
    from collections.abc import Generator

    from playwright.async_api import Browser

RUN = 900.0  # seconds after which a forgotten robot is ended: what it prints until then fits its pipe


@pytest.hookimpl(tryfirst=True)
def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> bool | None:
    if not inspect.iscoroutinefunction(pyfuncitem.obj):
        return None
    arguments = {name: pyfuncitem.funcargs[name] for name in pyfuncitem._fixtureinfo.argnames}
    thread = pyfuncitem.funcargs["loop_thread"]
    assert isinstance(thread, rig.LoopThread)
    thread.run(pyfuncitem.obj(**arguments))
    return True


@pytest.fixture(scope="package")
def loop_thread() -> Generator[rig.LoopThread, None, None]:
    thread = rig.LoopThread()
    yield thread
    thread.close()


@pytest.fixture(scope="package")
def browser(loop_thread: rig.LoopThread) -> Generator[Browser, None, None]:
    program = install.find()
    if isinstance(program, str):
        if os.environ.get("CI"):
            pytest.fail(program)
        pytest.skip(program)
    with loop_thread.opened(rig.browser(program)) as started:
        yield started


@pytest.fixture(scope="package")
def robot(browser: Browser) -> Generator[str, None, None]:
    """The URL of the emulated robot, which drives along squares."""
    with process("sim", "--drive", "--allow-control", "--via", "tcp-listen:0", patience=RUN) as child:
        assert child.stdout is not None
        yield next(found[1] for line in child.stdout if (found := re.search(r"--via (tcp:\S+)", line)))


@pytest.fixture(scope="package")
def dash(loop_thread: rig.LoopThread, robot: str) -> Generator[rig.Dash, None, None]:
    """The robot's page, which may do all."""
    with loop_thread.opened(rig.serve(robot, publish=True, control=True)) as served:
        yield served
