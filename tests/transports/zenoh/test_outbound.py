"""The calls that may wait for zenoh: made at once, or by a thread while there are very many tokens."""

import asyncio
import threading
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest

from r2p.protocols.flow_control import SendWindow
from r2p.runtime.sample import Sample, Source
from r2p.transports.stats import LinkStats
from r2p.transports.zenoh.publish import PublisherCache, TxStream
from r2p.transports.zenoh.threads import CROWD, MOST_URGENT, OutboundThread
from tests.transports.zenoh.test_publish import ORIGIN

pytestmark = pytest.mark.anyio


class Busy:
    """Stands for zenoh: its calls wait until it is free."""

    def __init__(self) -> None:
        self.free = threading.Event()
        self.calls: list[Any] = []
        self.threads: set[int] = set()

    def call(self, what: object, *, attachment: bytes = b"") -> object:
        self.free.wait()
        self.calls.append(what)
        self.threads.add(threading.get_ident())
        return what


def outbound() -> OutboundThread:
    return OutboundThread(asyncio.get_running_loop())


async def idle(out: OutboundThread) -> None:
    while out.waiting:  # noqa: ASYNC110 - the thread is about to be done
        await asyncio.sleep(0)


async def test_with_few_tokens_every_call_is_made_at_once() -> None:
    out, busy = outbound(), Busy()
    busy.free.set()
    out.watch(CROWD - 1)
    out.call(busy.call, 1)
    out.put(busy.call, 1, b"2", attachment=b"")
    out.finish()
    assert busy.calls == [1, b"2"]
    assert busy.threads == {threading.get_ident()}


async def test_what_may_take_long_is_called_by_the_thread_and_what_follows_stays_behind_it() -> None:
    out, busy = outbound(), Busy()
    out.call_by_thread(busy.call, 1)
    out.call(busy.call, 2)
    assert busy.calls == []
    busy.free.set()
    await idle(out)
    out.call(busy.call, 3)
    out.finish()
    assert busy.calls == [1, 2, 3]
    assert len(busy.threads) == 2


async def test_with_many_a_thread_makes_them_in_order_and_the_loop_goes_on() -> None:
    out, busy = outbound(), Busy()
    out.watch(CROWD)
    answer: asyncio.Future[object] = asyncio.get_running_loop().create_future()
    for number in range(3):
        out.call(busy.call, number)
    out.put(busy.call, 9, b"data", attachment=b"")
    out.ask(lambda: busy.call("asked"), answer.set_result)
    out.watch(0)
    out.call(busy.call, "behind them")
    assert (busy.calls, out.waiting) == ([], 6)
    busy.free.set()
    assert await answer == "asked"
    await idle(out)
    assert busy.calls == [0, 1, 2, b"data", "asked", "behind them"]
    assert threading.get_ident() not in busy.threads
    out.call(busy.call, "at once")
    assert busy.calls[-1] == "at once"
    await asyncio.to_thread(out.finish)


async def test_what_does_not_fit_is_counted() -> None:
    out, busy, stats = outbound(), Busy(), LinkStats()
    out.watch(CROWD)
    lane = TxStream(SendWindow(), urgent=True)
    lane.prepare(Source("PC1", "talk"), ORIGIN, _putting(out, busy))
    for sequence in range(1, MOST_URGENT + 4):
        lane.flow.serial += 1
        lane.waiting.append(Sample(b"x", Source("PC1", "talk"), 1, sequence=sequence))
        lane.send(stats, ConnectionError, batching=True)
    assert (stats.sent, dict(stats.lost)) == (MOST_URGENT, {"send buffer full": 3})
    assert lane.flow.serial == MOST_URGENT  # so the next one that is sent leaves no gap to count once more
    busy.free.set()
    await asyncio.to_thread(out.finish)
    assert len(busy.calls) == MOST_URGENT


def _putting(out: OutboundThread, busy: Busy) -> Callable[..., None]:
    def put(data: bytes, *, attachment: bytes) -> None:
        out.put(busy.call, MOST_URGENT, data, attachment=attachment)

    return put


async def test_what_fails_in_the_thread_is_told_and_the_next_call_is_made() -> None:
    out, busy = outbound(), Busy()
    failed: asyncio.Future[Exception] = asyncio.get_running_loop().create_future()
    answer: asyncio.Future[object] = asyncio.get_running_loop().create_future()
    out.failed = failed.set_result
    busy.free.set()
    out.watch(CROWD)
    out.ask(lambda: [][0], answer.set_result)
    out.call(busy.call, "next")
    assert isinstance(await failed, IndexError)
    assert await answer is None
    await asyncio.to_thread(out.finish)
    assert busy.calls == ["next"]


async def test_it_takes_half_the_crowd_to_go_back() -> None:
    out, busy = outbound(), Busy()
    busy.free.set()
    out.watch(CROWD)
    out.watch(CROWD - 1)
    out.call(busy.call, "by the thread")
    await idle(out)
    out.watch(CROWD // 2 - 1)
    out.call(busy.call, "at once")
    await asyncio.to_thread(out.finish)
    assert len(busy.threads) == 2


async def test_whether_messages_reach_a_subscriber_is_asked_in_the_thread() -> None:
    out, busy, senders = outbound(), Busy(), PublisherCache()
    session: Any = SimpleNamespace(outbound=out, publisher=lambda *_: Publisher(busy))
    senders.connect(session, "r2p/lab/topic/")
    assert not senders.reach("leds")
    senders.publisher("leds", 1)
    out.watch(CROWD)
    assert not senders.reach("leds")
    assert not senders.reach("leds")
    assert out.waiting == 1
    busy.free.set()
    await idle(out)
    await asyncio.sleep(0)
    assert senders.reach("leds")
    await asyncio.to_thread(out.finish)


class Publisher:
    """One that takes its time to say whom it reaches."""

    def __init__(self, busy: Busy) -> None:
        self._busy = busy

    @property
    def matching_status(self) -> Any:
        self._busy.free.wait()
        return SimpleNamespace(matching=True)
