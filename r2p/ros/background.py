"""Results that take milliseconds of computing, from a thread: a gateway must not keep a bus waiting for them.

Making the class of a large type, its code and its hash takes up to 50 ms, and a robot has many types. A thread shares
the processor, so the event loop goes on meanwhile. Under virtual time everything is computed at once.
"""

import asyncio
from collections.abc import Callable, Hashable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar, cast

from r2p.clock import clock_of
from r2p.errors import MessageError

T = TypeVar("T")

_RESULTS_MAX = 16_384
_WAITING_MAX = 4096


class BackgroundResults:
    """Results by key; `changed(topic)` is called in the event loop when one is there that was asked for."""

    def __init__(self, loop: asyncio.AbstractEventLoop, changed: Callable[[str], None]) -> None:
        self._loop = loop
        self._changed = changed
        self._is_virtual = clock_of(loop).virtual
        self._results: dict[Hashable, Any] = {}
        self._waiting: dict[Hashable, dict[str, None]] = {}
        self._thread: ThreadPoolExecutor | None = None
        self._closed = False

    def get(self, topic: str, key: Hashable, compute: Callable[[], T]) -> T | None:
        """Return the result of a function, for a topic; None while it is being computed.

        The function raises MessageError only, which is its result as well.
        """
        if key not in self._results:
            if self._closed:
                return None
            if not self._is_virtual:
                self._start(topic, key, compute)
                return None
            self._keep(key, _result_of(compute))
        found = self._results[key]
        if isinstance(found, MessageError):
            raise found.with_traceback(None)
        return cast("T", found)

    @property
    def is_busy(self) -> bool:
        """Whether a result is being computed."""
        return bool(self._waiting)

    def is_pending(self, topic: str) -> bool:
        """Return whether a result for a topic is being computed."""
        return any(topic in topics for topics in self._waiting.values())

    def close(self) -> None:
        """Stop: what is being computed is not used."""
        self._closed = True
        self._waiting.clear()
        if self._thread is not None:
            self._thread.shutdown(wait=False, cancel_futures=True)

    def _start(self, topic: str, key: Hashable, compute: Callable[[], object]) -> None:
        if key in self._waiting:
            self._waiting[key][topic] = None
            return
        if len(self._waiting) >= _WAITING_MAX:
            return  # a node that changes its types all the time: the next change of the topic begins anew
        if self._thread is None:
            self._thread = ThreadPoolExecutor(1, thread_name_prefix="r2p-ros")
        self._waiting[key] = {topic: None}
        future = self._loop.run_in_executor(self._thread, _result_of, compute)
        future.add_done_callback(lambda done: self._computed(key, done))

    def _computed(self, key: Hashable, done: "asyncio.Future[Any]") -> None:
        if self._closed or done.cancelled():
            return
        self._keep(key, done.result())
        for topic in self._waiting.pop(key, ()):
            self._changed(topic)

    def _keep(self, key: Hashable, result: object) -> None:
        if len(self._results) >= _RESULTS_MAX:
            self._results.clear()
        self._results[key] = result


def _result_of(compute: Callable[[], object]) -> object:
    try:
        return compute()
    except MessageError as error:
        return error
