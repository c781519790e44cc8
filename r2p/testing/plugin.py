"""The pytest plugin behind `@pytest.mark.virtual_time`, `r2p_network` and `exact_bus` (see `r2p.testing`).

pytest loads it in every session of an environment that has r2p: so it imports r2p only when a test needs it.
"""

from __future__ import annotations

import functools
import inspect
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, NoReturn

import pytest

if TYPE_CHECKING:
    import asyncio
    from collections.abc import Callable, Coroutine, Generator, Iterator

    from r2p.testing.exact_bus import ExactBus
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


@pytest.fixture
def exact_bus(request: pytest.FixtureRequest) -> Iterator[ExactBus]:
    """A CAN bus of this test, exact to the bit, for programs that use python-can."""
    try:
        from r2p.testing.exact_bus import ExactBus
    except ImportError:
        pytest.fail("the fixture exact_bus needs python-can: pip install 'r2p[can]'", pytrace=False)
    bus = ExactBus(virtual=_is_virtual(request.node))
    yield bus
    bus.close()


@pytest.hookimpl(tryfirst=True)
def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> bool | None:
    """Run a marked async test; leave other tests to pytest."""
    __tracebackhide__ = True
    marker = pyfuncitem.get_closest_marker("virtual_time")
    if marker is None:
        return None
    hypothesis = getattr(pyfuncitem.obj, "hypothesis", None)
    test = _test_function(pyfuncitem.obj)
    if test is None:
        return None
    if marker.args or not marker.kwargs.keys() <= {"seed", "limit"}:
        pytest.fail("@pytest.mark.virtual_time takes seed= and limit=, by name, and nothing else", pytrace=False)

    @functools.wraps(test)
    def under_virtual_time(*positional: object, **named: object) -> None:
        __tracebackhide__ = True
        try:
            _run(functools.partial(test, *positional, **named), marker)
        except Exception as error:  # noqa: BLE001 - it is raised again
            _raise_shown(error, pyfuncitem.config)

    if hypothesis is not None:
        hypothesis.inner_test = under_virtual_time  # a run of the loop for each example
        return None
    arguments = inspect.signature(test).parameters
    under_virtual_time(**{name: value for name, value in pyfuncitem.funcargs.items() if name in arguments})
    return True


@pytest.hookimpl(specname="pytest_pyfunc_call", wrapper=True)
def pytest_pyfunc_call_unmarked(pyfuncitem: pytest.Function) -> Generator[None, object, object]:
    """Name the mark that an async test of r2p lacks, where no plugin runs it and pytest would name other plugins."""
    try:
        return (yield)
    except (pytest.fail.Exception, pytest.skip.Exception) as outcome:
        if "async def function" not in str(outcome) or not _uses_r2p(pyfuncitem):
            raise
    pytest.fail(
        f"{pyfuncitem.name} is an async test that nothing runs: mark it with @pytest.mark.virtual_time; for real "
        "time and real devices, install pytest-asyncio or anyio, and use its mark",
        pytrace=False,
    )


def _is_virtual(test: pytest.Item) -> bool:
    """Return whether a test runs under virtual time."""
    marked = test.get_closest_marker("virtual_time") is not None
    return marked and isinstance(test, pytest.Function) and _test_function(test.obj) is not None


def _uses_r2p(test: pytest.Function) -> bool:
    """Return whether the test uses the fixture of this plugin, or its module anything of r2p."""
    names = (getattr(each, "__module__", None) or getattr(each, "__name__", "") for each in vars(test.module).values())
    fixtures = {"r2p_network", "exact_bus"}.intersection(test.fixturenames)
    return bool(fixtures) or any(str(name).partition(".")[0] == "r2p" for name in names)


@pytest.hookimpl
def pytest_fixture_setup(fixturedef: pytest.FixtureDef[Any], request: pytest.FixtureRequest) -> None:
    """Fail a marked test with an async fixture that no other plugin runs; leave other fixtures to pytest."""
    function = fixturedef.func
    if not (inspect.iscoroutinefunction(function) or inspect.isasyncgenfunction(function)):
        return
    if request.node.get_closest_marker("virtual_time") is not None:
        name = fixturedef.argname
        pytest.fail(
            f"the fixture {name} is async, but virtual time runs only during the test: make {name} a function with "
            f"@contextlib.asynccontextmanager, and write `async with {name}(...)` in the test",
            pytrace=False,
        )


def _raise_shown(error: Exception, config: pytest.Config) -> NoReturn:
    """Raise the error of a test with a traceback that ends at the test's own code.

    Not with --full-trace, and not for the tests of r2p itself.
    """
    import r2p

    __tracebackhide__ = not isinstance(error, r2p.Deadlock)  # where all are hidden, pytest would add a line about it
    if isinstance(error, r2p.Deadlock):  # it lists where each task waits, the test first
        raise pytest.fail.Exception(f"r2p.Deadlock: {error}", pytrace=False) from None
    if not config.getoption("fulltrace") and Path(r2p.__file__).parents[1] != config.rootpath:
        _shorten(error)
    raise error


def _shorten(error: BaseException) -> None:
    """Remove the frames of r2p and asyncio, unless all are of these."""
    from r2p.log_lines import internal

    kept = [each for each in _entries(error.__traceback__) if not internal(each.tb_frame.f_code.co_filename)]
    trace = None
    for each in reversed(kept):
        trace = TracebackType(trace, each.tb_frame, each.tb_lasti, each.tb_lineno)
    error.__traceback__ = trace or error.__traceback__
    for part in error.exceptions if isinstance(error, BaseExceptionGroup) else ():
        _shorten(part)


def _entries(trace: TracebackType | None) -> Iterator[TracebackType]:
    while trace is not None:
        yield trace
        trace = trace.tb_next


def _test_function(function: object) -> AsyncFunction | None:
    """Return the async function of a test, or None for an ordinary one."""
    hypothesis = getattr(function, "hypothesis", None)
    return _async_function(function if hypothesis is None else hypothesis.inner_test)


def _async_function(function: object) -> AsyncFunction | None:
    """Return the async function itself, even if pytest-asyncio, or this plugin in an earlier run, has wrapped it."""
    for candidate in (function, getattr(function, "__wrapped__", None)):
        if inspect.iscoroutinefunction(candidate):
            return candidate
    return None


def _run(test: Callable[[], Coroutine[Any, Any, object]], marker: pytest.Mark) -> None:
    __tracebackhide__ = True
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

    run(main, **marker.kwargs)
    if unhandled:
        raise ExceptionGroup("exceptions in callbacks, or in tasks that were not awaited", unhandled)
