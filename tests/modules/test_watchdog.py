"""The watchdog, in real time: each test blocks the loop until the watchdog has said so, at most PATIENCE seconds."""

from __future__ import annotations

import asyncio
import logging
import threading
import time
from typing import TYPE_CHECKING, cast

import pytest

import r2p
from r2p.log_lines import LineLimit
from r2p.modules.watchdog import Watchdog
from r2p.transports.link import Hub, Transport
from tests.bench import local

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from r2p.clock import Clock

PATIENCE = 30.0


class Reports(logging.Handler):
    """Collects what the watchdog logs, and says when something came."""

    def __init__(self) -> None:
        super().__init__()
        self.texts: list[str] = []
        self.came = threading.Event()
        self.again = threading.Event()

    def emit(self, record: logging.LogRecord) -> None:
        self.texts.append(record.getMessage())
        (self.again if self.came.is_set() else self.came).set()


@pytest.fixture
def reports() -> Iterator[Reports]:
    handler = Reports()
    logger = logging.getLogger("r2p.watchdog")
    logger.addHandler(handler)
    yield handler
    logger.removeHandler(handler)


async def greedy(node: r2p.Node, came: threading.Event) -> None:
    assert came.wait(PATIENCE)


class Opening(Transport):
    """Says whether the watchdog watches while it is opened, when it may import a library for long."""

    watched: bool | None = None

    async def run(self, hub: Hub, opened: Callable[[], object]) -> None:
        self.watched = watches()
        opened()


def watches() -> bool:
    return "r2p-watchdog" in {each.name for each in threading.enumerate()}


@pytest.mark.anyio
async def test_it_watches_as_soon_as_the_transports_are_open() -> None:
    transport = Opening()
    async with r2p.Module("A", via=transport):
        assert watches()
    assert transport.watched is False
    assert not watches()


@pytest.mark.anyio
async def test_the_stack_of_a_node_that_blocks_the_loop_is_logged_while_it_does(reports: Reports) -> None:
    async with local() as module:
        module.start(greedy, reports.came)
        await module.wait()
        assert await asyncio.to_thread(reports.again.wait, PATIENCE)
    assert "task PC1/greedy has blocked the event loop for over 100 ms" in reports.texts[0]
    assert reports.texts[0].splitlines()[2].strip() == "assert came.wait(PATIENCE)", "nothing of what runs the node"
    assert "the event loop runs again after" in reports.texts[1]


@pytest.mark.anyio
async def test_a_callback_that_blocks_is_logged_too(reports: Reports) -> None:
    watchdog = Watchdog(asyncio.get_running_loop(), limit=0.01)
    watchdog.start()
    asyncio.get_running_loop().call_soon(reports.came.wait, PATIENCE)
    await asyncio.sleep(0)
    await asyncio.sleep(0)
    watchdog.close()
    told = reports.texts[0].splitlines()
    assert told[0] == "a callback has blocked the event loop for over 10 ms:"
    assert "threading.py" in told[-2]


@pytest.mark.anyio
async def test_a_loop_that_only_waits_is_not_blamed(reports: Reports) -> None:
    watchdog = Watchdog(asyncio.get_running_loop())
    watchdog.start()
    watchdog._ended.set()
    watchdog._line_limit = LineLimit(1001)

    def look() -> None:
        for _ in range(1000):  # once the loop has come to where it waits for this thread
            watchdog._report()
            if "none of its code runs" in reports.texts[-1]:
                return

    await asyncio.to_thread(look)
    assert reports.texts[-1].startswith("the event loop did not run for over 100 ms, and no code")


class Jumping:
    """A clock that leaves out `seconds` at its second look."""

    def __init__(self, seconds: float) -> None:
        self._jump = round(seconds * 1e9)
        self._looks = 0

    def monotonic(self) -> int:
        self._looks += 1
        return time.monotonic_ns() + self._jump * (self._looks > 1)


@pytest.mark.anyio
@pytest.mark.parametrize(("seconds", "busy"), [(8.0, 0.0), (8.0, 8.0), (0.5, 0.0)])
async def test_a_process_that_was_stopped_says_so(
    reports: Reports, monkeypatch: pytest.MonkeyPatch, seconds: float, busy: float
) -> None:
    watchdog = Watchdog(asyncio.get_running_loop(), limit=0.001)
    clock = Jumping(seconds)
    watchdog._clock = cast("Clock", clock)
    monkeypatch.setattr("r2p.modules.watchdog._used", lambda: busy * (clock._looks > 1))
    assert not watchdog._pause()
    expected = ["this process did not run for 8.0 s: it was stopped, or the computer slept or was busy"]
    assert reports.texts == (expected if seconds > busy + 1 else [])


@pytest.mark.anyio
async def test_what_was_going_on_when_the_process_was_stopped_is_not_blamed(
    reports: Reports, monkeypatch: pytest.MonkeyPatch
) -> None:
    watchdog = Watchdog(asyncio.get_running_loop(), limit=0.001)

    class Sign(threading.Event):
        """Of a loop that comes round at the second look, and then it is over."""

        looks = 0

        def wait(self, timeout: float | None = None) -> bool:
            self.looks += 1
            if self.looks > 1:
                watchdog._ended.set()
            return self.looks > 1

    watchdog._alive = Sign()
    monkeypatch.setattr(watchdog, "_stopped_for", lambda _since, _used, limit: 8.0 * (limit == 0.001))
    await asyncio.to_thread(watchdog._watch)
    (told,) = reports.texts
    assert told.startswith("this process did not run for")


@pytest.mark.anyio
async def test_closing_ends_the_thread_also_while_the_loop_is_blocked(reports: Reports) -> None:
    watchdog = Watchdog(asyncio.get_running_loop(), limit=0.01)
    watchdog.start()
    assert reports.came.wait(PATIENCE)  # blocked from here on, as seen by the watchdog
    watchdog.close()
    assert not any(thread.name == "r2p-watchdog" for thread in threading.enumerate())
    assert len(reports.texts) == 1


@pytest.mark.anyio
@pytest.mark.parametrize("watched", [True, False])
async def test_a_module_has_a_watchdog_unless_it_says_no(watched: bool) -> None:
    async with r2p.Module("PC1", via=[], watchdog=watched):
        assert any(thread.name == "r2p-watchdog" for thread in threading.enumerate()) == watched
    assert not any(thread.name == "r2p-watchdog" for thread in threading.enumerate())


@pytest.mark.anyio
async def test_all_modules_of_a_loop_share_one_watchdog() -> None:
    def threads() -> int:
        return sum(thread.name == "r2p-watchdog" for thread in threading.enumerate())

    async with r2p.Module("A", via=[]):
        async with r2p.Module("B", via=[]), r2p.Module("C", via=[]):
            assert threads() == 1
        assert threads() == 1
    assert threads() == 0
    async with r2p.Module("A", via=[]):
        assert threads() == 1


@pytest.mark.anyio
async def test_one_report_a_second_and_each_stack_once(reports: Reports) -> None:
    """Clock and blocks are made up: `_report` is called as the thread would, from within two places."""
    watchdog = Watchdog(asyncio.get_running_loop())
    clock = Steps()
    watchdog._clock = cast("Clock", clock)
    watchdog._watched = threading.get_ident()

    def one() -> bool:
        return watchdog._report()

    def other() -> bool:
        return watchdog._report()

    told = []
    for step, block in ((0, one), (100, one), (500, other), (1000, one), (1999, one), (2000, other)):
        clock.ms = step
        told.append(block())
    assert told == [True, False, False, True, False, True]
    first, again, second = reports.texts
    assert "in one\n" in first
    assert again.splitlines() == [again]
    assert "ms (2 more since the last such line), again in " in again
    assert "in other\n" in second
    assert "(1 more since" in second


class Steps:
    """A clock that stands where it is put."""

    ms = 0

    def monotonic(self) -> int:
        return self.ms * 1_000_000
