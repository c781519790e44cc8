"""The threads that wait inside of zenoh: the one that makes the calls of a session, and how all of them end.

The event loop makes the calls of zenoh itself, except while there are very many tokens. zenoh's router, which is in
this process where a session takes connections, holds its tables while it sends every token to a new session, and while
it forgets those of a closed one. That takes time with the square of their number: some 20 ms for a thousand, seconds
for twenty thousand. Each call that sends or declares something waits for it. So from MANY_TOKENS on a thread makes
these calls, one after the other, and the event loop goes on.
"""

import asyncio
import atexit
import concurrent.futures
import contextlib
import queue
import threading
from collections.abc import Callable
from typing import Any, TypeVar
from weakref import WeakSet

from zenoh.handlers import Callback

T = TypeVar("T")

MANY_TOKENS = 1000
"""Tokens from which on the thread makes the calls. It stops when there are fewer than half as many: so a number that
goes up and down does not switch it on and off.
"""

PENDING_MAX = 512
"""Packets that wait for the thread: 8 MB of full ones."""

PENDING_URGENT_MAX = 16
"""Packets of events and periodic messages that wait: as many as zenoh itself queues of them (`config`). More would only
be late.
"""

_JOIN_TIMEOUT_S = 2.0
"""Seconds for which the end of the program waits for a thread: one that connects in vain may take longer."""

_threads: WeakSet[threading.Thread] = WeakSet()
_callback_ends: WeakSet[threading.Event] = WeakSet()


def start_thread(function: Callable[[], object], name: str) -> threading.Thread:
    """Call the function in a thread of its own, which does not keep the program from ending."""
    thread = threading.Thread(target=function, name=f"r2p zenoh {name}", daemon=True)
    _threads.add(thread)
    thread.start()
    return thread


def declare(declaration: Callable[..., T], received: Callable[[Any], object]) -> T:
    """Make a declaration: call it with the handler of its items. `received` is called with each of them, in a thread of
    its own, which does not keep the program from ending.

    That thread is one of zenoh: it sleeps until there is something, where `recv` of a channel wakes up ten times a
    second, and it takes eight times as many items a second beside a busy event loop. Behind 256 items zenoh waits for
    it, with its connection. So `received` only hands the item on.
    """
    ended = threading.Event()
    _callback_ends.add(ended)
    handler = Callback(received, ended.set)
    declared: concurrent.futures.Future[T] = concurrent.futures.Future()

    def run() -> None:
        try:
            declared.set_result(declaration(handler))
        except BaseException as error:  # noqa: BLE001 - a panic of zenoh, too: raised where this was called
            declared.set_exception(as_exception(error))

    start_thread(run, "declaration")  # its child is a daemon like itself
    return declared.result()


def as_exception(error: BaseException) -> Exception:
    """Return an exception from a thread as an error that may be raised, or counted, in the event loop.

    A panic in zenoh's Rust is pyo3's PanicException, a BaseException that code which counts errors would miss.
    """
    if isinstance(error, Exception):
        return error
    wrapped = RuntimeError(f"{type(error).__name__}: {error}")
    wrapped.__cause__ = error
    return wrapped


@atexit.register
def _join() -> None:
    # A daemon thread that is inside of zenoh when Python ends aborts the process.
    for thread in list(_threads):
        thread.join(_JOIN_TIMEOUT_S)
    for ended in list(_callback_ends):
        ended.wait(_JOIN_TIMEOUT_S)


class OutboundThread:
    """Makes the calls of one session that may wait for zenoh, in order: at once, or in a thread.

    `on_error` gets, in the loop, exceptions from the thread.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop, on_error: Callable[[Exception], object]) -> None:
        self._loop = loop
        self._on_error = on_error
        self._jobs: queue.SimpleQueue[Callable[[], object] | None] = queue.SimpleQueue()
        self._many_tokens = False
        self._thread: threading.Thread | None = None
        self._submitted = 0
        self._done = 0

    def set_token_count(self, tokens: int) -> None:
        """Note the number of tokens; in any thread."""
        self._many_tokens = tokens >= (MANY_TOKENS // 2 if self._many_tokens else MANY_TOKENS)

    @property
    def pending_calls(self) -> int:
        """Calls that the thread has yet to make."""
        return self._submitted - self._done

    @property
    def uses_thread(self) -> bool:
        """Return whether the thread makes the calls now, also the last waiting ones, to keep their order."""
        return self._many_tokens or self._submitted != self._done

    @property
    def full(self) -> bool:
        """Return whether too many calls are waiting to add one that can be sent later, or not at all."""
        return self.pending_calls >= PENDING_MAX

    def call(self, function: Callable[[], object]) -> None:
        """Call the function now, or in the thread while that makes the calls."""
        if self.uses_thread:
            self.submit(function)
        else:
            function()

    def submit(
        self,
        function: Callable[[], T],
        *,
        then: Callable[[T | None], object] | None = None,
        max_pending: int | None = None,
    ) -> None:
        """Have the thread call the function. `then` gets, in the loop, its result, or None if it raises.

        Raises BlockingIOError if `max_pending` calls wait already.
        """
        if max_pending is not None and self.pending_calls >= max_pending:
            raise BlockingIOError
        if self._thread is None:
            self._thread = start_thread(self._work, "calls")
        self._submitted += 1
        self._jobs.put(function if then is None else lambda: self._answer(function, then))

    def finish(self) -> None:
        """Wait for all calls, and end the thread. Call it outside of the event loop, which submits nothing then."""
        if self._thread is not None:
            self._jobs.put(None)
            self._thread.join()

    def _answer(self, function: Callable[[], T], then: Callable[[T | None], object]) -> None:
        result: T | None = None
        try:
            result = function()
        finally:
            self._call_in_loop(then, result)

    def _work(self) -> None:
        while (job := self._jobs.get()) is not None:
            try:
                job()
            except BaseException as error:  # noqa: BLE001 - a panic of zenoh, too: without the thread all calls would stop
                self._call_in_loop(self._on_error, as_exception(error))
            finally:
                self._done += 1

    def _call_in_loop(self, function: Callable[[Any], object], value: object) -> None:
        with contextlib.suppress(RuntimeError):  # the loop is closed
            self._loop.call_soon_threadsafe(function, value)
