"""The ways from zenoh's threads into the loop."""

import asyncio
import queue
import threading
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import pytest
import zenoh

from r2p.codecs import PublisherClass
from r2p.transports.link import MESSAGES_PER_TURN
from r2p.transports.stats import LoggedCounter
from r2p.transports.zenoh.session import LoopQueue, SubscriptionReader, ZenohSession

pytestmark = pytest.mark.anyio


async def test_a_flood_lets_others_have_their_turn() -> None:
    taken: list[int] = []
    queue = LoopQueue(asyncio.get_running_loop(), taken.append, LoggedCounter(), most=2 * MESSAGES_PER_TURN + 1)
    for number in range(2 * MESSAGES_PER_TURN + 3):
        queue.put(number)
    assert queue.overflowed == 2
    turns = set()
    while len(taken) < 2 * MESSAGES_PER_TURN + 1:
        await asyncio.sleep(0)
        turns.add(len(taken))
    assert taken == list(range(2 * MESSAGES_PER_TURN + 1))
    assert turns >= {MESSAGES_PER_TURN, 2 * MESSAGES_PER_TURN}
    queue.put(-1)
    await asyncio.sleep(0)
    await asyncio.sleep(0)
    assert taken[-1] == -1


class Channel:
    """Stands for zenoh's, and for the subscriber that has it."""

    def __init__(self) -> None:
        self.handler = self
        self._items: queue.SimpleQueue[Any] = queue.SimpleQueue()

    def put(self, item: Any) -> None:
        self._items.put(item)

    def put_all(self, items: Iterable[Any]) -> None:
        for item in items:
            self.put(item)

    def recv(self) -> Any:
        item = self._items.get()
        if item is None:
            raise zenoh.ZError("undeclared")
        return item

    def try_recv(self) -> Any:
        try:
            return self._items.get_nowait()
        except queue.Empty:
            return None

    def undeclare(self) -> None:
        self._items.put(None)


class Reader:
    """Takes as a stream does: a few at a time, then it looks once more before it waits."""

    def __init__(self, channel: Channel) -> None:
        self.taken: list[Any] = []
        self.more = asyncio.Event()
        self._loop = asyncio.get_running_loop()
        subscriber: Any = channel
        self.reader = SubscriptionReader(subscriber, self._loop, self._arrived)

    def _arrived(self, item: Any) -> None:
        for _ in range(3):
            self.taken.append(item)
            self.more.set()
            item = self.reader.receive()
            if item is None:
                self._loop.call_soon(self._look_again)
                return
        self._loop.call_soon(self._arrived, item)

    def _look_again(self) -> None:
        item = self.reader.receive()
        if item is None:
            self.reader.wait()
        else:
            self._arrived(item)

    async def until(self, count: int) -> None:
        while len(self.taken) < count:
            self.more.clear()
            await self.more.wait()


async def test_a_reader_gives_everything_once_and_in_order_fast_or_slow() -> None:
    channel = Channel()
    reader = Reader(channel)
    for number in range(1, 101):  # each for itself: the thread hands it over
        channel.put(number)
        await reader.until(number)
    feeding = threading.Thread(target=channel.put_all, args=(range(101, 5001),))
    feeding.start()  # a flood: the loop takes them itself
    await reader.until(5000)
    channel.put(5001)
    await reader.until(5001)
    assert reader.taken == list(range(1, 5002))
    feeding.join()
    reader.reader.close()


@pytest.mark.parametrize("taken_meanwhile", [False, True])
async def test_what_was_passed_before_a_reader_waits_comes_before_what_comes_after_it(
    taken_meanwhile: bool,
) -> None:
    subscriber: Any = Channel()
    taken: list[int] = []
    reader = SubscriptionReader(subscriber, asyncio.get_running_loop(), taken.append)  # type: ignore[arg-type]
    for number in (1, 2):
        reader._pass(number, pauses=False)  # type: ignore[arg-type]
    reader.wait()
    if taken_meanwhile:
        taken.append(reader.receive())  # type: ignore[arg-type]
    reader._pass(3, pauses=False)  # type: ignore[arg-type]
    await asyncio.sleep(0)
    reader.wait()
    await asyncio.sleep(0)
    assert taken == [1, 2, 3]
    reader.close()


@pytest.mark.parametrize("waiting", [0, 1, 5])
async def test_the_thread_of_a_reader_ends_with_it(waiting: int) -> None:
    before = set(threading.enumerate())
    channel = Channel()
    subscriber: Any = channel
    arrived: asyncio.Queue[Any] = asyncio.Queue()
    reader = SubscriptionReader(
        subscriber, asyncio.get_running_loop(), arrived.put_nowait
    )  # never ready for a second one
    for number in range(waiting):
        channel.put(number)
    if waiting:
        assert await arrived.get() == 0
    (thread,) = set(threading.enumerate()) - before
    reader.close()
    await asyncio.to_thread(thread.join)
    assert arrived.empty()


@pytest.mark.internal_errors
async def test_what_raises_does_not_stop_what_comes_behind_it() -> None:
    """Neither in the loop nor, before that, in the thread."""
    taken: list[int] = []
    losses, loop, ended = LoggedCounter(), asyncio.get_running_loop(), asyncio.Event()

    def take(item: int) -> None:
        if item == 10:
            ended.set()
        taken.append(10 // item)

    def take_message(message: "int | tuple[bytes, bytes]") -> None:
        take(message if isinstance(message, int) else len(message[1]))

    queue = LoopQueue(loop, take_message, losses, most=9)
    for number in (5, 0, 2, 0, 1):
        queue.put(number)
    await asyncio.sleep(0)
    await asyncio.sleep(0)
    assert (taken, losses) == ([2, 5, 10], {"internal error": 2})

    bare = Zenoh()
    stand_in: Any = bare
    ZenohSession(stand_in, losses.internal_error).listen("key", queue)
    bare.received(Sample(zenoh.ZBytes(b"12345")))
    bare.received(7)
    bare.received(Sample(zenoh.ZBytes(b"1234567890")))
    await ended.wait()
    assert (taken[3:], losses) == ([2, 1], {"internal error": 3})


@dataclass
class Sample:
    """Stands for zenoh's."""

    payload: zenoh.ZBytes
    attachment: None = None


class Zenoh:
    """Stands for zenoh's session: notes what is undeclared, and when it is closed."""

    received: Callable[[object], None]

    def __init__(self) -> None:
        self.calls: list[str] = []

    def declare_subscriber(self, key: str, received: Callable[[object], None], **_options: object) -> "Declared":
        self.received = received
        return Declared(key, self.calls)

    def declare_publisher(self, key: str, **_options: object) -> "Declared":
        return Declared(key, self.calls)

    def close(self) -> None:
        self.calls.append("close")


class Declared:
    """A publisher."""

    def __init__(self, key: str, calls: list[str]) -> None:
        self._key = key
        self._calls = calls

    def undeclare(self) -> None:
        self._calls.append(self._key)


async def test_publishers_are_undeclared_before_their_session_is_closed() -> None:
    """Otherwise zenoh's memory grows with each session."""
    bare = Zenoh()
    stand_in: Any = bare
    session = ZenohSession(stand_in, LoggedCounter().internal_error)
    session.declare_publisher("stays", PublisherClass.NON_REAL_TIME)
    session.undeclare_publisher(session.declare_publisher("ended", PublisherClass.SPORADIC))
    await session.close()
    assert bare.calls == ["ended", "stays", "close"]
