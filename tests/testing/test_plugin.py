from __future__ import annotations

from pathlib import Path

import pytest

from r2p.testing import plugin

CHECKOUT = Path(plugin.__file__).parents[2]

REGISTER = """
from r2p.testing import plugin

def pytest_configure(config):
    if not config.pluginmanager.is_registered(plugin):
        config.pluginmanager.register(plugin, "r2p")
"""

HEAD = """
import asyncio
import pytest
from r2p.clock import clock_of, random_of
"""


@pytest.fixture
def project(pytester: pytest.Pytester) -> pytest.Pytester:
    pytester.makeconftest(REGISTER)
    return pytester


def outcomes(project: pytest.Pytester, tests: str) -> dict[str, int]:
    project.makepyfile(HEAD + tests)
    return project.runpytest_inprocess("-p", "no:cacheprovider", "-p", "no:asyncio", "--strict-markers").parseoutcomes()


def test_a_marked_test_runs_under_virtual_time(project: pytest.Pytester) -> None:
    tests = """
@pytest.mark.virtual_time
async def test_hour():
    await asyncio.sleep(3600)
    assert clock_of().monotonic() == 3600 * 10**9

@pytest.mark.virtual_time
async def test_fails():
    await asyncio.sleep(1)
    assert clock_of().monotonic() == 0
"""
    assert outcomes(project, tests) == {"passed": 1, "failed": 1}


def test_a_mark_on_the_module_leaves_ordinary_tests_alone(project: pytest.Pytester) -> None:
    tests = """
pytestmark = pytest.mark.virtual_time

@pytest.fixture
def seconds():
    return 5

class TestClass:
    @pytest.mark.parametrize("factor", [1, 2])
    async def test_async(self, seconds, factor):
        await asyncio.sleep(seconds * factor)
        assert asyncio.get_running_loop().time() == 5 * factor

def test_ordinary(seconds):
    with pytest.raises(RuntimeError):
        asyncio.get_running_loop()
"""
    assert outcomes(project, tests) == {"passed": 3}


def test_the_seed_reaches_the_random_numbers(project: pytest.Pytester) -> None:
    tests = """
import random

@pytest.mark.virtual_time(seed=7)
async def test_seed():
    assert random_of().random() == random.Random(7).random()

@pytest.mark.virtual_time(sede=7)
async def test_misspelt():
    pass
"""
    assert outcomes(project, tests) == {"passed": 1, "failed": 1}


def test_an_exception_that_nobody_awaits_fails_the_test(project: pytest.Pytester) -> None:
    tests = """
@pytest.mark.virtual_time
async def test_callback():
    asyncio.get_running_loop().call_later(1, divmod, 1, 0)
    await asyncio.sleep(2)
"""
    assert outcomes(project, tests) == {"failed": 1}


def test_hypothesis_runs_each_example_in_a_loop_of_its_own(project: pytest.Pytester) -> None:
    tests = """
from hypothesis import given, settings, strategies as st

@pytest.mark.virtual_time
@pytest.mark.parametrize("factor", [1, 2])
@settings(max_examples=5)
@given(seconds=st.integers(1, 1000))
async def test_sleep(factor, seconds):
    assert clock_of().monotonic() == 0
    await asyncio.sleep(seconds * factor)
    assert clock_of().monotonic() == seconds * factor * 10**9

class TestClass:
    @pytest.mark.virtual_time
    @settings(max_examples=5)
    @given(st.integers(1, 3))
    async def test_method(self, seconds):
        await asyncio.sleep(seconds)
        assert clock_of().virtual
"""
    assert outcomes(project, tests) == {"passed": 3}


def test_a_test_that_another_plugin_has_wrapped_is_still_ours(pytester: pytest.Pytester) -> None:
    wrapping = """
import functools

def pytest_itemcollected(item):
    @functools.wraps(item.obj)
    def wrapper(**arguments):
        raise AssertionError("on a real loop")
    item.obj = wrapper
"""
    pytester.makeconftest(REGISTER + wrapping)
    tests = """
@pytest.mark.virtual_time
async def test_hour(tmp_path):
    await asyncio.sleep(3600)
    assert tmp_path.exists()
"""
    assert outcomes(pytester, tests) == {"passed": 1}


def test_unmarked_async_tests_are_not_touched(project: pytest.Pytester) -> None:
    tests = """
@pytest.mark.anyio
async def test_real(anyio_backend_name):
    assert not clock_of().virtual

@pytest.fixture
def anyio_backend():
    return "asyncio"
"""
    assert outcomes(project, tests) == {"passed": 1}


def output(project: pytest.Pytester, tests: str, *options: str) -> str:
    project.makepyfile("import asyncio, contextlib, pytest, r2p\n" + tests)
    result = project.runpytest_inprocess("-p", "no:cacheprovider", "-p", "no:asyncio", "-p", "no:anyio", *options)
    return "\n".join(result.outlines)


def test_an_async_test_without_the_mark_gets_advice(project: pytest.Pytester) -> None:
    tests = """
async def test_network(r2p_network):
    pass

@pytest.mark.virtual_time
async def test_marked():
    pass
"""
    lines = output(project, tests)
    assert "test_network is an async test that nothing runs: mark it with @pytest.mark.virtual_time" in lines
    assert "1 failed, 1 passed" in lines or "1 passed, 1 failed" in lines


def test_an_async_test_of_something_else_gets_the_advice_of_pytest(project: pytest.Pytester) -> None:
    project.makepyfile("async def test_other(): ...")
    result = project.runpytest_inprocess("-p", "no:cacheprovider", "-p", "no:asyncio", "-p", "no:anyio")
    assert "virtual_time" not in "\n".join(result.outlines)
    assert result.parseoutcomes().get("passed") is None


def test_an_async_fixture_gets_advice(project: pytest.Pytester) -> None:
    tests = """
@pytest.fixture
async def robot(r2p_network):
    async with r2p_network.module("R1") as module:
        yield module

@pytest.mark.virtual_time
async def test_robot(robot):
    pass
"""
    assert "the fixture robot is async, but virtual time runs only during the test" in output(project, tests)


def test_a_mark_with_other_arguments_gets_advice(project: pytest.Pytester) -> None:
    tests = "@pytest.mark.virtual_time(5)\nasync def test_limit(): ..."
    assert "@pytest.mark.virtual_time takes seed= and limit=, by name" in output(project, tests)


MISTAKES = """
from r2p.msg import Led

@pytest.mark.virtual_time
async def test_value(r2p_network):
    async with r2p_network.node("PC1") as node:
        await node.advertise("leds", Led).publish(Led(value=300))

@pytest.mark.virtual_time
async def test_group(r2p_network):
    async with r2p_network.node("PC1") as node, asyncio.TaskGroup() as tasks:
        tasks.create_task(publish(node))

async def publish(node):
    await node.advertise("leds", Led).publish(Led(value=301))

@pytest.mark.virtual_time
async def test_nothing(r2p_network):
    async with r2p_network.node("PC1") as node:
        await node.subscribe("leds", Led).fetch()
"""


def test_tracebacks_end_at_the_code_of_the_test(project: pytest.Pytester) -> None:
    text = output(project, MISTAKES)
    for line in (
        "MessageError: Led.value (u8) takes an integer from 0 to 255, not 300",
        "MessageError: Led.value (u8) takes an integer from 0 to 255, not 301",
        "r2p.Deadlock: virtual time",
        "test_nothing (test_tracebacks_end_at_the_code_of_the_test.py:",
        "in publish",
    ):
        assert line in text
    assert "def publish(self" not in text  # the source of r2p's methods
    assert "taskgroups.py" not in text
    assert "base_events.py" not in text
    assert "traceback entries are hidden" not in text


def test_a_full_trace_has_all_frames(project: pytest.Pytester) -> None:
    assert "def publish(self" in output(project, MISTAKES, "--full-trace")


@pytest.mark.processes
def test_loading_the_plugin_loads_nothing_else(pytester: pytest.Pytester) -> None:
    script = pytester.makepyfile(f"""
import sys
import pytest
sys.path.insert(0, {str(CHECKOUT)!r})
import r2p
before = set(sys.modules)
import r2p.testing.plugin
print(sorted(set(sys.modules) - before))
""")
    assert pytester.runpython(script).outlines == ["['r2p.testing', 'r2p.testing.plugin']"]
