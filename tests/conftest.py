"""How our own async tests get their loop.

`@pytest.mark.virtual_time` runs under virtual time: the normal case. `@pytest.mark.anyio` is for what needs real I/O or
real threads: it runs twice, on asyncio's loop and on uvloop's.
"""

from __future__ import annotations

import signal
import sys
from typing import Any

import pytest

from r2p.testing import plugin

pytest_plugins = ["pytester"]

_NO_UVLOOP = pytest.mark.skipif(sys.platform == "win32", reason="uvloop is not made for Windows")


def pytest_configure(config: pytest.Config) -> None:
    if not config.pluginmanager.is_registered(plugin):  # not installed: no entry point has named it
        config.pluginmanager.register(plugin, "r2p")
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # a shell's job in the background: nobody would obey Ctrl-C
        signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(
    scope="module",
    params=[
        pytest.param({}, id="asyncio"),
        pytest.param({"use_uvloop": True}, id="uvloop", marks=_NO_UVLOOP),
    ],
)
def anyio_backend(request: pytest.FixtureRequest) -> tuple[str, dict[str, Any]]:
    return "asyncio", request.param
