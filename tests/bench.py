"""What the tests of the runtime share: modules without a network, nodes that only hold things, and time to settle."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, TypeVar

import r2p
from r2p.msg import Led

if TYPE_CHECKING:
    from collections.abc import AsyncIterable, Awaitable, Callable
    from typing import Self

T = TypeVar("T")

MS = 1_000_000
SECOND = 1_000_000_000


def local(name: str = "PC1") -> r2p.Module:
    """A module without links."""
    return r2p.Module(name, via=[])


def joined(name: str) -> r2p.Module:
    """A module on the in-memory network `lab`."""
    return r2p.Module(name, via="memory:lab")


async def hold(node: r2p.Node) -> None:
    """A node that does nothing until it is stopped: the test uses its topics."""
    await asyncio.Event().wait()


def pair(module: r2p.Module) -> tuple[r2p.Node, r2p.Node]:
    """A node that publishes, and one that subscribes."""
    return module.start(hold, name="pub"), module.start(hold, name="sub")


def elapsed(module: r2p.Module) -> float:
    """Seconds on the clock of its loop."""
    return module.space.loop.time()


async def settle(seconds: float = 1e-6) -> None:
    """Let everything happen that can happen at this instant (virtual time: all that is ready runs first)."""
    await asyncio.sleep(seconds)


class Turns:
    """Counts the turns of the event loop while it is open."""

    def __init__(self) -> None:
        self.count = 0
        self._handle: asyncio.Handle | None = None

    def __enter__(self) -> Self:
        self._turn()
        return self

    def __exit__(self, *_: object) -> None:
        assert self._handle is not None
        self._handle.cancel()

    def _turn(self) -> None:
        self.count += 1
        self._handle = asyncio.get_running_loop().call_soon(self._turn)


def led(number: int) -> Led:
    return Led(led=number)


def numbers(messages: list[Led]) -> list[int]:
    return [message.led for message in messages]


def drain(subscriber: r2p.Subscriber[Led]) -> list[int]:
    """The numbers that wait in a queue; takes them out without making room known to anybody."""
    waiting = [Led.decode(sample.data).led for sample in subscriber.queue]
    subscriber.queue.clear()
    return waiting


class Recorder:
    """A callback that remembers what it was called with."""

    def __init__(self, then: Callable[[], object] = lambda: None) -> None:
        self.calls: list[r2p.Missed] = []
        self._then = then

    def __call__(self, missed: r2p.Missed) -> None:
        self.calls.append(missed)
        self._then()

    @property
    def reasons(self) -> list[str]:
        return [missed.reason for missed in self.calls]


async def collect(messages: AsyncIterable[T], got: list[T]) -> None:
    """Read until the subscription is closed, or the reader cancelled."""
    async for message in messages:
        got.append(message)  # noqa: PERF401 - one by one: what was read before the cancellation counts


async def crashes(main: Callable[[], Awaitable[object]]) -> list[Exception]:
    """The errors of the nodes that crashed in `main`."""
    try:
        await main()
    except r2p.NodeCrashed as crashed:
        return list(crashed.exceptions)
    return []
