"""Running a program: on the fastest event loop there is, with signals that end everything in order.

The first SIGINT or SIGTERM cancels the program: it ends its nodes, says good-bye on its links, and returns. A second
one ends the process at once; so does the first one, if the program has not ended GRACE seconds later.
"""

import asyncio
import contextlib
import functools
import os
import signal
import threading
from collections.abc import Awaitable, Callable, Iterable
from types import FrameType
from typing import Any, Self, TypeVar

from r2p.modules.module import Module
from r2p.modules.supervisor import NodeFunction
from r2p.transports.link import Transport

T = TypeVar("T")

GRACE = 1.8
"""Seconds that a program has to end in order: with the interpreter's own end, the process is gone after two."""


def run(
    *functions: NodeFunction,
    module: str | None = None,
    via: str | Transport | Iterable[str | Transport] | None = None,
    remap: dict[str, str] | None = None,
    restart: bool = False,
) -> None:
    """Run functions as the nodes of one module, until all have ended or a signal ends them.

    `via` and `remap` are as for `Module`, which `module` is the name of; `restart` is as for `Module.start`. Raises
    NodeCrashed at the end if a node crashed, and what `Module` and `Module.start` raise.
    """

    async def main() -> None:
        async with Module(module, via=via, remap=remap) as host:
            for function in functions:
                host.start(function, restart=restart)
            await host.wait()

    run_main(main)


def run_main(main: Callable[[], Awaitable[T]]) -> T | None:
    """Run `main()` on the fastest event loop, and return its result; None if SIGINT or SIGTERM ended it."""

    async def guarded() -> T | None:
        if not signals.guard(asyncio.get_running_loop(), asyncio.current_task()):
            return None
        try:
            return await main()
        except asyncio.CancelledError:
            if signals.received:
                return None
            raise

    with _Signals() as signals, asyncio.Runner(loop_factory=loop_factory()) as runner:
        return runner.run(guarded())


def loop_factory() -> Callable[[], asyncio.AbstractEventLoop] | None:
    """uvloop's, where it is installed; otherwise None, which means asyncio's own."""
    try:
        import uvloop
    except ImportError:
        return None
    return uvloop.new_event_loop


class _Signals:
    """Lets the first SIGINT or SIGTERM cancel a task, until the loop is closed and all its threads have ended.

    The handlers are Python's, not the loop's, so that they also work while a node blocks the loop. Only the main thread
    gets signals: in any other thread this does nothing.
    """

    def __init__(self) -> None:
        self.received: list[int] = []
        self._over = threading.Event()
        self._ended = threading.Event()
        self._cancel: Callable[[], object] = lambda: None
        self._before: dict[int, Any] = {}

    def __enter__(self) -> Self:
        if threading.current_thread() is threading.main_thread():
            # A thread: nodes may block the main one.
            threading.Thread(target=self._enforce, name="r2p-grace", daemon=True).start()
            self._before = {
                number: signal.signal(number, self._interrupt) for number in (signal.SIGINT, signal.SIGTERM)
            }
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
        self._ended.set()
        self._over.set()

    def guard(self, loop: asyncio.AbstractEventLoop, task: asyncio.Task[object] | None) -> bool:
        """Cancel this task at the first signal. False if one has come already."""
        if task is not None:
            self._cancel = functools.partial(loop.call_soon_threadsafe, task.cancel)
        return not self.received

    def _interrupt(self, number: int, _frame: FrameType | None) -> None:
        for each in self._before:
            signal.signal(each, signal.SIG_DFL)  # the second signal ends the process
        self.received.append(number)
        self._over.set()
        with contextlib.suppress(RuntimeError):  # the loop is closed: the program has ended by itself
            self._cancel()

    def _enforce(self) -> None:
        self._over.wait()
        if self.received and not self._ended.wait(GRACE):
            os.kill(os.getpid(), self.received[0])
