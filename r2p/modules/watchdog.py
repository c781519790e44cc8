"""The watchdog: logs code that blocks the event loop, while it does so.

A thread asks the loop for a sign of life four times in each LIMIT. When none comes for LIMIT seconds, it logs the stack
in which the loop is stuck, and afterwards how long that took. A block of 100 ms is ten missed periods of a 100 Hz node.

All modules of a loop share one watchdog. It reports at most once a second, with the number of blocks in between, and
each stack only once: later blocks in the same place name its last line.

A process that did not run at all blocked nothing: if the thread did not run either, and nothing in this process used
the processor meanwhile, it was stopped (Ctrl-Z, a debugger, a computer that slept), and the log says that instead.
"""

import asyncio
import logging
import os
import selectors
import sys
import threading
import traceback
from pathlib import Path
from types import FrameType

from r2p.clock import clock_of
from r2p.log_lines import LineLimit
from r2p.units import SECOND

logger = logging.getLogger("r2p.watchdog")

LIMIT = 0.1
"""Seconds for which the loop may be blocked."""

_REPORTS = 1  # a second
_REMEMBERED = 256  # stacks that were logged
_STOPPED_MAX = 1.0  # seconds that the process may be stopped without a line of the log
_IDLE = 0.5  # of a processor: code that blocks by working uses more than that, and a process that waits less

STOPPED = "this process did not run for %.1f s: it was stopped, or the computer slept or was busy"
BLOCKED = "%s has blocked the event loop for over %.0f ms%s:\n%s"
AGAIN = "%s has blocked the event loop for over %.0f ms%s, again in %s"
NOT_RUNNING = "the event loop did not run for over %.0f ms, and no code blocks it: is the computer busy?"

_LOOP_FILES = {each.__file__ for each in (asyncio.base_events, asyncio.events, asyncio.runners)} | {
    str(Path(__file__).with_name("supervisor.py"))
}


_watchdogs: dict[asyncio.AbstractEventLoop, "Watchdog"] = {}
_lock = threading.Lock()


def watch(loop: asyncio.AbstractEventLoop) -> "Watchdog":
    """Return the watchdog of this thread's loop, which runs until each caller has closed it."""
    with _lock:
        watchdog = _watchdogs.get(loop)
        if watchdog is None:
            watchdog = _watchdogs[loop] = Watchdog(loop)
            watchdog.start()
        else:
            watchdog.users += 1
    return watchdog


class Watchdog:
    """Watches the loop of the thread that starts it, for a number of `users`."""

    def __init__(self, loop: asyncio.AbstractEventLoop, limit: float = LIMIT) -> None:
        self.users = 1
        self._loop = loop
        self._limit = limit
        self._clock = clock_of(loop)
        self._alive = threading.Event()
        self._ended = threading.Event()
        self._watched = 0
        self._known: set[str] = set()  # stacks that have been logged
        self._line_limit = LineLimit(_REPORTS)
        self._base: FrameType | None = None  # the caller of a loop that is not written in Python, such as uvloop
        self._thread = threading.Thread(target=self._watch, name="r2p-watchdog", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._watched = threading.get_ident()
        self._base = _runner()
        self._thread.start()

    def close(self) -> None:
        """End the thread, and wait for its end, if this was the last user."""
        with _lock:
            self.users -= 1
            if self.users:
                return
            _watchdogs.pop(self._loop, None)
        self._ended.set()
        self._alive.set()
        self._thread.join()
        self._base = None

    def _watch(self) -> None:
        while not self._pause():
            self._alive.clear()
            asked, used = self._clock.monotonic(), _used()
            try:
                self._loop.call_soon_threadsafe(self._alive.set)
            except RuntimeError:  # the loop is closed
                with _lock:
                    _watchdogs.pop(self._loop, None)
                return
            if self._ended.is_set() or self._alive.wait(self._limit):
                continue
            stopped = self._stopped_for(asked, used, self._limit)
            if stopped and self._alive.wait(self._limit):
                logger.warning(STOPPED, stopped)
                continue
            reported = self._report()
            self._alive.wait()  # close() sets it too
            if reported and not self._ended.is_set():
                took = (self._clock.monotonic() - asked) / 1e6
                logger.warning("the event loop runs again after %.0f ms", took)

    def _pause(self) -> bool:
        """Wait until the next check. Return True if the watchdog ends instead."""
        start, used = self._clock.monotonic(), _used()
        if self._ended.wait(self._limit / 4):
            return True
        if stopped := self._stopped_for(start, used, _STOPPED_MAX):
            logger.warning(STOPPED, stopped)
        return False

    def _stopped_for(self, since: int, used: float, limit: float) -> float:
        """Return the seconds since then, if this thread waited over `limit` too long while the process did not run."""
        passed = (self._clock.monotonic() - since) / SECOND
        return passed if passed > 2 * limit and _used() - used < _IDLE * passed else 0.0

    def _report(self) -> bool:
        """Log where the loop is stuck; return False if the last report is less than a second old."""
        suffix = self._line_limit.suffix("", self._clock.monotonic())
        if suffix is None:
            return False
        frame = sys._current_frames().get(self._watched)  # noqa: SLF001 - documented, for exactly this use
        stack = _own_part(frame) if frame is not None and frame is not self._base else []
        if not stack:
            logger.warning(NOT_RUNNING, self._limit * 1e3)
            return True
        task = asyncio.current_task(self._loop)
        who = f"task {task.get_name()}" if task is not None else "a callback"
        text = "".join(traceback.format_list(stack)).rstrip()
        if text in self._known:
            last = stack[-1]
            logger.warning(AGAIN, who, self._limit * 1e3, suffix, f"{last.filename}:{last.lineno}, {last.name}")
        else:
            if len(self._known) >= _REMEMBERED:
                self._known.clear()
            self._known.add(text)
            logger.warning(BLOCKED, who, self._limit * 1e3, suffix, text)
        return True


def _used() -> float:
    """Return the processor time of this process so far, in seconds."""
    return sum(os.times()[:2])


def _runner() -> FrameType | None:
    """Return the frame that called the running task's: of the event loop, or of its runner."""
    task = asyncio.current_task()
    frame = getattr(task.get_coro(), "cr_frame", None) if task is not None else None
    return frame.f_back if frame is not None else None


def _own_part(frame: FrameType) -> list[traceback.FrameSummary]:
    """Return the part of a stack that belongs to a node or a callback, without the event loop's; may be empty."""
    stack = traceback.extract_stack(frame)
    begin = max((at for at, each in enumerate(stack, 1) if each.filename in _LOOP_FILES), default=0)
    own = stack[begin:]
    if begin and stack[begin - 1].name == "_run_once" and all(each.filename == selectors.__file__ for each in own):
        return []  # it waits for events
    return own
