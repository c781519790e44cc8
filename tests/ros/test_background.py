"""Results that a thread computes."""

import asyncio
import functools
import threading

import pytest

from r2p.errors import MessageError
from r2p.ros.background import BackgroundResults


@pytest.mark.anyio
async def test_a_thread_computes_once_for_all_topics() -> None:
    changed, done, go = [], asyncio.Event(), threading.Event()

    def note(topic: str) -> None:
        changed.append(topic)
        if len(changed) == 3:
            done.set()

    def compute() -> threading.Thread:
        go.wait()
        return threading.current_thread()

    def fail() -> None:
        raise MessageError("too large")

    results = BackgroundResults(asyncio.get_running_loop(), note)
    assert results.get("a", 1, compute) is None
    assert results.get("b", 1, compute) is None
    assert results.get("c", 2, fail) is None
    assert results.is_busy
    assert results.is_pending("a")
    assert not results.is_pending("d")
    go.set()
    await asyncio.wait_for(done.wait(), 60)
    assert changed == ["a", "b", "c"]
    assert not results.is_busy
    assert results.get("a", 1, compute) not in (None, threading.current_thread())
    assert not results.is_pending("a")
    for _ in range(2):
        with pytest.raises(MessageError, match="too large"):
            results.get("c", 2, fail)
    go.clear()
    results.get("d", 3, compute)
    results.close()
    go.set()
    assert results.get("d", 3, compute) is None
    await asyncio.sleep(0)
    assert changed == ["a", "b", "c"]


@pytest.mark.virtual_time
async def test_under_virtual_time_all_is_there_at_once() -> None:
    results = BackgroundResults(asyncio.get_running_loop(), lambda _: None)
    assert results.get("a", 1, threading.current_thread) is threading.current_thread()
    results.close()


@pytest.mark.anyio
async def test_a_flood_of_results_is_not_computed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("r2p.ros.background._WAITING_MAX", 2)
    go, computed, done = threading.Event(), list[int](), asyncio.Event()
    results = BackgroundResults(asyncio.get_running_loop(), lambda topic: done.set() if topic == "last" else None)

    def compute(number: int) -> int:
        go.wait()
        computed.append(number)
        return number

    for number in range(5):
        results.get("last" if number == 1 else "x", number, functools.partial(compute, number))
    go.set()
    await asyncio.wait_for(done.wait(), 60)
    assert computed == [0, 1]
    results.close()
