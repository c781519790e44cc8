"""What is given to zenoh: by the event loop itself, or by a thread while there are very many tokens.

zenoh's router, which is in this process where a session takes connections, holds its tables while it tells a newcomer
of every token, and while it forgets those of one that is gone. That takes time with the square of their number: some
20 ms for a thousand, seconds for twenty thousand. Each call that sends or declares something waits for it. So from
CROWD tokens on a thread makes these calls, one after the other, and the event loop goes on.
"""

import asyncio
import atexit
import contextlib
import queue
import threading
from collections.abc import Callable
from typing import Any, TypeVar
from weakref import WeakSet

from r2p.transports.zenoh import threads

T = TypeVar("T")

CROWD = 1000
"""Tokens from which on a thread sends."""

MOST = 512
"""Packets that wait for the thread."""

MOST_URGENT = 16
"""Those of events and periods, which are of no use when they are late."""


class OutboundThread:
    """The calls of one session that may wait for zenoh, in order. `failed` gets what they raise in the thread."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop = loop
        self._jobs: queue.SimpleQueue[Callable[[], object] | None] = queue.SimpleQueue()
        self._crowded = False
        self._running = False
        self._handed = 0
        self._done = 0
        self.failed: Callable[[Exception], object] = lambda _error: None

    def watch(self, tokens: int) -> None:
        """So many are there; in any thread."""
        self._crowded = tokens >= (CROWD // 2 if self._crowded else CROWD)

    @property
    def waiting(self) -> int:
        """Calls that the thread has yet to make."""
        return self._handed - self._done

    @property
    def by_thread(self) -> bool:
        """Whether the thread makes the calls now."""
        return self._crowded or self._handed != self._done

    @property
    def full(self) -> bool:
        """Whether there is no room for more of what can be sent later, or not at all."""
        return self.waiting >= MOST

    def put(self, send: Callable[..., object], most: int, data: bytes, *, attachment: bytes) -> None:
        """Send a packet of messages. Raises BlockingIOError if `most` calls wait already."""
        if not self.by_thread:
            send(data, attachment=attachment)
        elif self.waiting >= most:
            raise BlockingIOError
        else:
            self._hand_over(lambda: send(data, attachment=attachment))

    def call(self, function: Callable[..., object], *args: Any, **kwargs: Any) -> None:
        """Call it, now or later."""
        if not self.by_thread:
            function(*args, **kwargs)
        else:
            self.call_by_thread(function, *args, **kwargs)

    def call_by_thread(self, function: Callable[..., object], *args: Any, **kwargs: Any) -> None:
        """Have the thread call it: it may take long."""
        self._hand_over(lambda: function(*args, **kwargs))

    def ask(self, function: Callable[[], T], then: Callable[[T | None], object]) -> None:
        """Call it in the thread, and `then` with what it returns, in the loop; with None if it raises."""

        def answer() -> None:
            result: T | None = None
            try:
                result = function()
            finally:
                self._in_loop(then, result)

        self._hand_over(answer)

    def finish(self) -> None:
        """Wait for what was handed over, and end the thread. Not in the loop, which hands over nothing any more."""
        if self._running:
            over: queue.SimpleQueue[None] = queue.SimpleQueue()
            self._hand_over(lambda: over.put(None))
            self._jobs.put(None)
            over.get()

    def _hand_over(self, job: Callable[[], object]) -> None:
        if not self._running:
            self._running = True
            threads.start(self._work)
        self._handed += 1
        self._jobs.put(job)

    def _work(self) -> None:
        while (job := self._jobs.get()) is not None:
            try:
                job()
            except Exception as error:  # noqa: BLE001 - told in the loop; the next one follows
                self._in_loop(self.failed, error)
            self._done += 1

    def _in_loop(self, function: Callable[[Any], object], value: object) -> None:
        with contextlib.suppress(RuntimeError):  # the loop is closed
            self._loop.call_soon_threadsafe(function, value)


# Threads that wait inside of zenoh. None of them may be there any more when Python ends.


_PATIENCE = 2.0
"""Seconds for which the end of the program waits for one of them: who connects to nobody may take longer."""

_threads: "WeakSet[threading.Thread]" = WeakSet()


def start(function: Callable[[], object]) -> None:
    """Run it in a thread of its own, for which nobody waits before the program ends."""
    thread = threading.Thread(target=function, name="r2p zenoh", daemon=True)
    _threads.add(thread)
    thread.start()


@atexit.register
def _join() -> None:
    for thread in list(_threads):
        thread.join(_PATIENCE)
