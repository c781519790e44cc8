"""The calls that may wait for zenoh, made at once, or by a thread while there are very many tokens; and its threads."""

import asyncio
import queue
import subprocess
import sys
import threading
from collections.abc import Callable
from functools import partial
from types import SimpleNamespace
from typing import Any

import pytest
import zenoh

from benchmarks.zenoh import bare_config
from r2p.protocols.flow_control import SendWindow
from r2p.runtime.sample import PublisherClass, Sample, Source
from r2p.transports.stats import LinkStats
from r2p.transports.zenoh.publish import PublisherCache, TxStream
from r2p.transports.zenoh.session import _in_thread
from r2p.transports.zenoh.threads import MANY_TOKENS, PENDING_URGENT_MAX, OutboundThread, declare
from tests.transports.cables import GUARD
from tests.transports.zenoh.test_publish import ORIGIN

pytestmark = pytest.mark.anyio

BEHIND = 256
"""Items that may wait for a callback of zenoh."""


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


def unexpected(error: Exception) -> None:
    raise error


def outbound(on_error: Callable[[Exception], object] = unexpected) -> OutboundThread:
    return OutboundThread(asyncio.get_running_loop(), on_error)


def putting(out: OutboundThread, busy: Busy) -> Callable[..., None]:
    """What sends the packets of events."""
    publisher = SimpleNamespace(put=busy.call)
    session: Any = SimpleNamespace(outbound=out, declare_publisher=lambda *_, large: publisher)
    publishers = PublisherCache()
    publishers.connect(session, "r2p/lab/topic/")
    return publishers.put("leds", PublisherClass.SPORADIC)


async def idle(out: OutboundThread) -> None:
    while out.pending_calls:  # noqa: ASYNC110 - the thread is about to be done
        await asyncio.sleep(0)


async def test_with_few_tokens_every_call_is_made_at_once() -> None:
    out, busy = outbound(), Busy()
    busy.free.set()
    out.set_token_count(MANY_TOKENS - 1)
    out.call(partial(busy.call, 1))
    putting(out, busy)(b"2", attachment=b"")
    out.finish()
    assert busy.calls == [1, b"2"]
    assert busy.threads == {threading.get_ident()}


async def test_what_may_take_long_is_called_by_the_thread_and_what_follows_stays_behind_it() -> None:
    out, busy = outbound(), Busy()
    out.submit(partial(busy.call, 1))
    out.call(partial(busy.call, 2))
    assert busy.calls == []
    busy.free.set()
    await idle(out)
    out.call(partial(busy.call, 3))
    out.finish()
    assert busy.calls == [1, 2, 3]
    assert len(busy.threads) == 2


async def test_with_many_a_thread_makes_them_in_order_and_the_loop_goes_on() -> None:
    out, busy = outbound(), Busy()
    out.set_token_count(MANY_TOKENS)
    answer: asyncio.Future[object] = asyncio.get_running_loop().create_future()
    for number in range(3):
        out.call(partial(busy.call, number))
    putting(out, busy)(b"data", attachment=b"")
    out.submit(lambda: busy.call("asked"), then=answer.set_result)
    out.set_token_count(0)
    out.call(partial(busy.call, "behind them"))
    assert (busy.calls, out.pending_calls) == ([], 6)
    busy.free.set()
    assert await answer == "asked"
    await idle(out)
    assert busy.calls == [0, 1, 2, b"data", "asked", "behind them"]
    assert threading.get_ident() not in busy.threads
    out.call(partial(busy.call, "at once"))
    assert busy.calls[-1] == "at once"
    await asyncio.to_thread(out.finish)


async def test_what_does_not_fit_is_counted() -> None:
    out, busy, stats = outbound(), Busy(), LinkStats()
    out.set_token_count(MANY_TOKENS)
    stream = TxStream(SendWindow(), urgent=True)
    stream.prepare(Source("PC1", "talk"), ORIGIN, putting(out, busy))
    for sequence in range(1, PENDING_URGENT_MAX + 4):
        stream.window.serial += 1
        stream.samples.append(Sample(b"x", Source("PC1", "talk"), 1, sequence=sequence))
        stream.send(stats, batching=True)
    assert (stats.sent, dict(stats.lost)) == (PENDING_URGENT_MAX, {"send buffer full": 3})
    assert stream.window.serial == PENDING_URGENT_MAX  # so the next one that is sent leaves no gap to count once more
    busy.free.set()
    await asyncio.to_thread(out.finish)
    assert len(busy.calls) == PENDING_URGENT_MAX


async def test_what_fails_in_the_thread_is_told_and_the_next_call_is_made() -> None:
    failed: asyncio.Future[Exception] = asyncio.get_running_loop().create_future()
    out, busy = outbound(failed.set_result), Busy()
    answer: asyncio.Future[object] = asyncio.get_running_loop().create_future()
    busy.free.set()
    out.set_token_count(MANY_TOKENS)
    out.submit(lambda: [][0], then=answer.set_result)
    out.call(partial(busy.call, "next"))
    assert isinstance(await failed, IndexError)
    assert await answer is None
    await asyncio.to_thread(out.finish)
    assert busy.calls == ["next"]


class Panic(BaseException):
    """As pyo3's PanicException, which is no Exception either."""


def panic() -> None:
    raise Panic("poisoned")


async def test_a_panic_of_zenoh_does_not_end_the_thread() -> None:
    failed: asyncio.Future[Exception] = asyncio.get_running_loop().create_future()
    out, busy = outbound(failed.set_result), Busy()
    busy.free.set()
    out.set_token_count(MANY_TOKENS)
    out.call(panic)
    out.call(partial(busy.call, "next"))
    async with asyncio.timeout(GUARD):
        assert str(await failed) == "Panic: poisoned"
        await asyncio.to_thread(out.finish)
    assert (busy.calls, out.pending_calls) == (["next"], 0)


async def test_a_panic_of_zenoh_is_raised_where_its_result_is_awaited() -> None:
    async with asyncio.timeout(GUARD):
        with pytest.raises(RuntimeError, match="Panic: poisoned"):
            await _in_thread(panic)


async def test_it_takes_half_the_crowd_to_go_back() -> None:
    out, busy = outbound(), Busy()
    busy.free.set()
    out.set_token_count(MANY_TOKENS)
    out.set_token_count(MANY_TOKENS - 1)
    out.call(partial(busy.call, "by the thread"))
    await idle(out)
    out.set_token_count(MANY_TOKENS // 2 - 1)
    out.call(partial(busy.call, "at once"))
    await asyncio.to_thread(out.finish)
    assert len(busy.threads) == 2


async def test_whether_messages_reach_a_subscriber_is_asked_in_the_thread() -> None:
    out, busy, publishers = outbound(), Busy(), PublisherCache()
    session: Any = SimpleNamespace(outbound=out, declare_publisher=lambda *_, **_options: Publisher(busy))
    publishers.connect(session, "r2p/lab/topic/")
    assert not publishers.reaches("leds")
    publishers._publisher("leds", PublisherClass.NON_REAL_TIME)
    out.set_token_count(MANY_TOKENS)
    assert not publishers.reaches("leds")
    assert not publishers.reaches("leds")
    assert out.pending_calls == 1
    busy.free.set()
    await idle(out)
    await asyncio.sleep(0)
    assert publishers.reaches("leds")
    await asyncio.to_thread(out.finish)


class Publisher:
    """One that takes its time to say whom it reaches."""

    def __init__(self, busy: Busy) -> None:
        self._busy = busy

    @property
    def matching_status(self) -> Any:
        self._busy.free.wait()
        return SimpleNamespace(matching=True)


PROGRAM = """
import sys
from r2p.transports.zenoh import threads
threads.start_thread(lambda: print(sys.stdin.read()), "test")
"""


@pytest.mark.processes
def test_the_program_waits_for_its_threads() -> None:
    """Python that ends while a thread is inside of zenoh would abort the process."""
    done = subprocess.run([sys.executable, "-c", PROGRAM], input="heard", capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("heard\n", "")


@pytest.mark.one_loop
async def test_what_zenoh_calls_back_gets_more_than_fits_and_ends_with_the_session() -> None:
    tokens, received = 3 * BEHIND, queue.SimpleQueue[threading.Thread]()
    with zenoh.open(bare_config("peer", "listen", 0, shm=False)) as session:
        kept = [session.liveliness().declare_token(f"token/{number}") for number in range(tokens)]
        subscribe = partial(session.liveliness().declare_subscriber, "token/*", history=True)
        declared = await asyncio.to_thread(declare, subscribe, lambda _: received.put(threading.current_thread()))
        threads = {await asyncio.to_thread(received.get) for _ in kept}
        (thread,) = threads
        assert thread.daemon, "a program that does not close its session would not end"
    await asyncio.to_thread(thread.join)
    del declared


async def test_what_can_not_be_declared_raises_where_it_was_called() -> None:
    def refuse(_handler: object) -> None:
        raise zenoh.ZError("closed")

    with pytest.raises(zenoh.ZError, match="closed"):
        declare(refuse, print)
