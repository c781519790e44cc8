"""The watchdog: tells which code blocks the event loop, while it blocks it.

A thread asks the loop for a sign of life, four times in each LIMIT. Where none comes for LIMIT seconds, it logs the
stack that the loop is stuck in, once, and afterwards how long it took. One block of 100 ms is ten missed periods of a
100 Hz node: worth a log line.
"""

import asyncio
import logging
import sys
import threading
import traceback
from pathlib import Path
from types import FrameType

from r2p.clock import clock_of

logger = logging.getLogger("r2p.watchdog")

LIMIT = 0.1
"""Seconds that the loop may be blocked."""

_RUNS_IT = {each.__file__ for each in (asyncio.base_events, asyncio.events, asyncio.runners)} | {
    str(Path(__file__).with_name("supervisor.py"))
}


class Watchdog:
    """Watches the loop of the thread that starts it."""

    def __init__(self, loop: asyncio.AbstractEventLoop, limit: float = LIMIT) -> None:
        self._loop = loop
        self._limit = limit
        self._clock = clock_of(loop)
        self._alive = threading.Event()
        self._ended = threading.Event()
        self._watched = 0
        self._thread = threading.Thread(target=self._watch, name="r2p-watchdog", daemon=True)

    def start(self) -> None:
        """Watch from now on."""
        self._watched = threading.get_ident()
        self._thread.start()

    def close(self) -> None:
        """End the thread, and wait for its end."""
        self._ended.set()
        self._alive.set()
        self._thread.join()

    def _watch(self) -> None:
        while not self._ended.wait(self._limit / 4):
            self._alive.clear()
            asked = self._clock.monotonic()
            try:
                self._loop.call_soon_threadsafe(self._alive.set)
            except RuntimeError:  # the loop is closed
                return
            if not self._ended.is_set() and not self._alive.wait(self._limit):
                self._report()
                self._wait_out(asked)

    def _report(self) -> None:
        task = asyncio.current_task(self._loop)
        who = f"task {task.get_name()}" if task is not None else "a callback"
        frame = sys._current_frames().get(self._watched)  # noqa: SLF001 - documented, for exactly this use
        stack = _own_part(frame) if frame is not None else "(no stack)"
        logger.warning("%s has blocked the event loop for over %.0f ms:\n%s", who, self._limit * 1e3, stack)

    def _wait_out(self, asked: int) -> None:
        self._alive.wait()  # close() sets it too
        if not self._ended.is_set():
            logger.warning("the event loop runs again after %.0f ms", (self._clock.monotonic() - asked) / 1e6)


def _own_part(frame: FrameType) -> str:
    """The stack from where a node or a callback begins; what runs it is always the same."""
    stack = traceback.extract_stack(frame)
    begin = max((at for at, each in enumerate(stack, 1) if each.filename in _RUNS_IT), default=0)
    return "".join(traceback.format_list(stack[begin:] or stack)).rstrip()
