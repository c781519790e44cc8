"""The pytest plugin behind `@pytest.mark.virtual_time` and the fixture `r2p_network` (see `r2p.testing`).

pytest loads it in every session of an environment that has r2p: so it imports r2p only when a test needs it.
"""

from __future__ import annotations

import functools
import inspect
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    import asyncio
    from collections.abc import Callable, Coroutine

    from r2p.testing.network import Network

    AsyncFunction = Callable[..., Coroutine[Any, Any, object]]


def pytest_configure(config: pytest.Config) -> None:
    text = "virtual_time(*, seed=0, limit=None): run this async test under virtual time (r2p.sim.run)"
    config.addinivalue_line("markers", text)


@pytest.fixture
def r2p_network() -> Network:
    """An in-memory network for the modules of this test."""
    from r2p.testing.network import Network

    return Network()


@pytest.hookimpl(tryfirst=True)
def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> bool | None:
    """Run a marked async test; leave other tests to pytest."""
    marker = pyfuncitem.get_closest_marker("virtual_time")
    if marker is None:
        return None
    hypothesis = getattr(pyfuncitem.obj, "hypothesis", None)
    test = _async_function(pyfuncitem.obj if hypothesis is None else hypothesis.inner_test)
    if test is None:
        return None

    @functools.wraps(test)
    def under_virtual_time(*positional: object, **named: object) -> None:
        _run(functools.partial(test, *positional, **named), marker)

    if hypothesis is not None:
        hypothesis.inner_test = under_virtual_time  # a run of the loop for each example
        return None
    arguments = inspect.signature(test).parameters
    under_virtual_time(**{name: value for name, value in pyfuncitem.funcargs.items() if name in arguments})
    return True


def _async_function(function: object) -> AsyncFunction | None:
    """Return the async function itself, even if pytest-asyncio, or this plugin in an earlier run, has wrapped it."""
    for candidate in (function, getattr(function, "__wrapped__", None)):
        if inspect.iscoroutinefunction(candidate):
            return candidate
    return None


def _run(test: Callable[[], Coroutine[Any, Any, object]], marker: pytest.Mark) -> None:
    import asyncio

    from r2p.sim import run

    unhandled: list[Exception] = []

    def keep(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        loop.default_exception_handler(context)
        if isinstance(error := context.get("exception"), Exception):
            unhandled.append(error)

    async def main() -> None:
        asyncio.get_running_loop().set_exception_handler(keep)
        await test()

    run(main, *marker.args, **marker.kwargs)
    if unhandled:
        raise ExceptionGroup("exceptions in callbacks, or in tasks that were not awaited", unhandled)
