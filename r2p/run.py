"""Running a program: the fastest event loop there is, and signals that end everything in order.

The first SIGINT or SIGTERM cancels the program, which ends its nodes, says good-bye on its links, and returns. A second
one ends the process at once, and so does a program that has not ended GRACE seconds after the first.
"""

import asyncio
import contextlib
import os
import signal
import threading
from collections.abc import AsyncIterator, Awaitable, Callable, Iterable
from typing import TypeVar

from r2p.module import Module
from r2p.supervisor import NodeFunction
from r2p.transports.link import Transport

T = TypeVar("T")

GRACE = 2.0
"""Seconds that a program has to end in order."""


def run(
    *functions: NodeFunction,
    module: str | None = None,
    via: str | Transport | Iterable[str | Transport] | None = None,
    remap: dict[str, str] | None = None,
    restart: bool = False,
) -> None:
    """Run functions as the nodes of one module, until all have ended or a signal ends them.

    Parameters as for `Module` and `Module.start`. Raises NodeCrashed at the end if a node crashed.
    """

    async def main() -> None:
        async with Module(module, via=via, remap=remap) as host:
            for function in functions:
                host.start(function, restart=restart)
            await host.wait()

    run_main(main)


def run_main(main: Callable[[], Awaitable[T]]) -> T | None:
    """Run `main()` on the fastest event loop; None if a signal ended it."""

    async def guarded() -> T | None:
        async with _signals() as interrupted:
            try:
                return await main()
            except asyncio.CancelledError:
                if interrupted.is_set():
                    return None
                raise

    with asyncio.Runner(loop_factory=loop_factory()) as runner:
        return runner.run(guarded())


def loop_factory() -> Callable[[], asyncio.AbstractEventLoop] | None:
    """uvloop's, where it is installed; else None, asyncio's own."""
    try:
        import uvloop
    except ImportError:
        return None
    return uvloop.new_event_loop


@contextlib.asynccontextmanager
async def _signals() -> AsyncIterator[threading.Event]:
    """Let the first SIGINT or SIGTERM cancel the current task, and set the event."""
    loop = asyncio.get_running_loop()
    task = asyncio.current_task()
    interrupted = threading.Event()
    ended = threading.Event()
    numbers = (signal.SIGINT, signal.SIGTERM)

    def interrupt(number: int) -> None:
        interrupted.set()
        for each in numbers:
            loop.remove_signal_handler(each)
            signal.signal(each, signal.SIG_DFL)
        threading.Thread(target=_end_process, args=(number, ended), name="r2p-grace", daemon=True).start()
        if task is not None:
            task.cancel()

    if threading.current_thread() is not threading.main_thread() or not hasattr(signal, "SIGTERM"):
        yield interrupted
        return
    before = {number: signal.getsignal(number) for number in numbers}
    for number in numbers:
        loop.add_signal_handler(number, interrupt, number)
    try:
        yield interrupted
    finally:
        ended.set()
        for number in numbers:
            loop.remove_signal_handler(number)
            signal.signal(number, before[number])


def _end_process(number: int, ended: threading.Event) -> None:
    if not ended.wait(GRACE):
        os.kill(os.getpid(), number)
