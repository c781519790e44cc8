"""How our own async tests get their loop.

`@pytest.mark.virtual_time` runs under virtual time: the normal case. `@pytest.mark.anyio` is for what needs real I/O or
real threads: it runs twice, on asyncio's loop and on uvloop's; with `@pytest.mark.one_loop` once.
"""

from __future__ import annotations

import gc
import logging
import os
import signal
import sys
from typing import TYPE_CHECKING, Any

import hypothesis
import pytest

from r2p.testing import plugin
from r2p.transports.zenoh import config

if TYPE_CHECKING:
    from collections.abc import Generator

pytest_plugins = ["pytester"]

# How long an example takes depends on the machine. Each run tries other examples; R2P_EXAMPLES=1000 takes long.
hypothesis.settings.register_profile("r2p", deadline=None, max_examples=int(os.environ.get("R2P_EXAMPLES", "40")))
hypothesis.settings.load_profile("r2p")

_NO_UVLOOP = pytest.mark.skipif(sys.platform == "win32", reason="uvloop is not made for Windows")


def pytest_configure(config: pytest.Config) -> None:
    if not config.pluginmanager.is_registered(plugin):  # not installed: no entry point has named it
        config.pluginmanager.register(plugin, "r2p")
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # a shell's job in the background: nobody would obey Ctrl-C
        signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Collect without the garbage collector, and have it pass over the tests later: they stay until the end."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out uvloop where it is not used, or does not matter."""
    left_out = {item for item in items if _is_on_uvloop(item) and _needs_one_loop(item)}
    config.hook.pytest_deselected(items=left_out)
    items[:] = [item for item in items if item not in left_out]


def _is_on_uvloop(item: pytest.Item) -> bool:
    spec = getattr(item, "callspec", None)
    return spec is not None and bool(spec.params.get("anyio_backend"))


def _needs_one_loop(item: pytest.Item) -> bool:
    return any(item.get_closest_marker(name) is not None for name in ("virtual_time", "one_loop"))


class _Kept(logging.Handler):
    """The errors of a logger."""

    def __init__(self) -> None:
        super().__init__(logging.ERROR)
        self.errors: list[BaseException] = []

    def emit(self, record: logging.LogRecord) -> None:
        if record.exc_info and record.exc_info[1] is not None:
            self.errors.append(record.exc_info[1])


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Generator[None, Any, Any]:
    """Links survive exceptions, and count and log them: tests must not."""
    if item.get_closest_marker("internal_errors"):
        return (yield)
    logger, kept = logging.getLogger("r2p.link"), _Kept()
    logger.addHandler(kept)
    try:
        result = yield
    finally:
        logger.removeHandler(kept)
    if kept.errors:
        raise BaseExceptionGroup("internal errors of links", kept.errors)
    return result


@pytest.fixture(
    scope="module",
    params=[
        pytest.param({}, id="asyncio"),
        pytest.param({"use_uvloop": True}, id="uvloop", marks=_NO_UVLOOP),
    ],
)
def anyio_backend(request: pytest.FixtureRequest) -> tuple[str, dict[str, Any]]:
    return "asyncio", request.param


@pytest.fixture(scope="session", autouse=True)
def patient_zenoh() -> None:
    """Sessions in the tests' process don't lose their connections when a busy machine stops it for a second.

    Their proxies run in the event loop of the test, which then forwards no sign of life. Started programs keep r2p's
    lease, and so do the tests of a hanging one.
    """
    config._NEEDED["transport/link/tx/lease"] = 20_000
