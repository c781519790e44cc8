"""The life of a node: start, end, crash, restart.

A node that raises ends alone: its traceback is logged, the others run on, and the module raises what happened when it
ends. Stopping is cancellation, so `try/finally` in the node's function stops the motor.

Nothing disturbs that clean-up: neither a function that the node gave away and that fails meanwhile, nor a second reason
to end it. Whatever comes while an exception, the node's own or a cancellation, is in a `finally` waits for its end.
"""

import asyncio
import contextlib
import functools
import inspect
import threading
import weakref
from collections.abc import Awaitable, Callable, Coroutine
from typing import Any, cast

from r2p.clock import Backoff, in_background, random_of
from r2p.errors import Error, NameTooLong
from r2p.messages import Timestamp
from r2p.modules.unwinding import cleans_up, ends
from r2p.msg import Log
from r2p.names import NODE_MAX, node_name
from r2p.runtime.node import Node
from r2p.runtime.topic import TopicSpace

NodeFunction = Callable[..., Awaitable[object]]
"""What `Module.start` runs: `async def blink(node: r2p.Node) -> None`; more arguments are given to `start`."""

_FIRST_RESTART, _LONGEST_RESTART = 0.5, 30.0  # seconds
_LOOK = 0.01  # seconds after which it is looked at again whether clean-up is over
_HANDLER = (
    1.0  # seconds for which an `except` is taken for clean-up after a crash; then it is what the node goes on with
)
_STABLE = 60.0  # seconds after which a crash is the first one again


def check_function(function: NodeFunction) -> None:
    """Raise Error for what can't run as a node."""
    bare = function.func if isinstance(function, functools.partial) else function
    if not (inspect.iscoroutinefunction(bare) or inspect.iscoroutinefunction(getattr(bare, "__call__", None))):  # noqa: B004 - looked into, not called
        raise Error(f"{function!r} is no coroutine function: write `async def name(node: r2p.Node) -> None`")


def name_of(function: NodeFunction) -> str:
    """The node name that a function gives: its own.

    Raises NameTooLong or InvalidName if that does not fit the wire, and Error for what can't run as a node.
    """
    check_function(function)
    bare = function.func if isinstance(function, functools.partial) else function
    name = getattr(bare, "__name__", type(bare).__name__)
    if len(name) > NODE_MAX:
        raise NameTooLong(
            f"function name {name!r} is no node name, those have at most {NODE_MAX} characters: give name="
        )
    return node_name(name)


class Supervisor:
    """Runs one function as a node, again after a crash if it is told to."""

    def __init__(
        self, function: NodeFunction, args: tuple[object, ...], make_node: Callable[[], Node], *, restart: bool
    ) -> None:
        self.node = make_node()
        self.error: Exception | None = None
        """What the node raised, if that ended it."""
        self.restarts = 0
        self._function = function
        self._args = args
        self._make_node = make_node
        self._restart = restart
        self._task: asyncio.Task[None] | None = None
        self._attempt: _Attempt | None = None
        self._stopping = False

    @property
    def running(self) -> bool:
        return self._task is not None and not self._task.done()

    def start(self, tasks: asyncio.TaskGroup, ended: Callable[["Supervisor"], None]) -> None:
        """Start it, or start it again from the beginning; `ended` is called when it has ended for good."""
        if self._task is not None:
            self.node = self._make_node()
        self.error = None
        self._stopping = False
        name = f"{self.node.module}/{self.node.name}"
        self._task = task = asyncio.get_running_loop().create_task(self._run(), name=name)
        task.add_done_callback(lambda _task: self._ended(ended))
        tasks.create_task(self._guard(task), name=f"{name} guard")

    def cancel(self) -> asyncio.Task[None] | None:
        """Ask it to end, once: its clean-up is not disturbed. Its task comes back if it still runs."""
        if self._task is None or self._task.done():
            return None
        if not self._stopping:
            self._stopping = True
            if self._attempt is not None:
                self._attempt.end()
            else:
                self._task.cancel()
        return self._task

    async def stop(self) -> None:
        """Cancel it, and wait for its end."""
        task = self.cancel()
        if task is not None:
            await asyncio.wait([task])

    async def _guard(self, task: asyncio.Task[None]) -> None:
        """Stand for the node in its module's task group, which cancels again and again while it comes to its end."""
        cancelled: asyncio.CancelledError | None = None
        while not task.done():
            try:
                await asyncio.wait([task])
            except asyncio.CancelledError as error:
                cancelled = error
                self.cancel()
        if not task.cancelled():
            task.result()
        if cancelled is not None:
            raise cancelled

    def _ended(self, tell: Callable[["Supervisor"], None]) -> None:
        self.node.close()  # a task that is cancelled before its first step never comes to do it
        tell(self)

    async def _run(self) -> None:
        loop = asyncio.get_running_loop()
        backoff = Backoff(random_of(loop), first=_FIRST_RESTART, longest=_LONGEST_RESTART)
        while True:
            started = loop.time()
            error = await self._try()
            if error is None:
                return
            self.node.log.error("node %s crashed: %s: %s", self.node.name, type(error).__name__, error, exc_info=error)
            if self._stopping or not self._restart:
                error.add_note(f"in node {self.node.name} of module {self.node.module}")
                self.error = error
                return
            if loop.time() - started > _STABLE:
                backoff.reset()
            await asyncio.sleep(backoff.delay())
            self.restarts += 1
            self.node = self._make_node()

    async def _try(self) -> Exception | None:
        """Run the function to its end; what it raised."""
        task = asyncio.current_task()
        assert task is not None
        try:  # arguments that do not fit raise here, before there is a coroutine
            # Only coroutine functions are let in (check_function), and those give coroutines.
            body = cast("Coroutine[Any, Any, object]", self._function(self.node, *self._args))
        except Exception as error:  # noqa: BLE001 - the user's code may raise anything
            self.node.close()
            return error
        self._attempt = attempt = _Attempt(self.node, task, body)
        self.node.enter()
        try:
            await body
        except asyncio.CancelledError as error:
            if attempt.error is None and task.cancelling():
                raise
            return attempt.result(_from_inside(error))
        except Exception as error:  # noqa: BLE001 - the user's code may raise anything
            return attempt.result(error)
        finally:
            self._attempt = None
            attempt.close()
            self.node.close()
        return attempt.result(None)


class _Attempt:
    """One run of a node's function: how it is ended, and what went wrong outside of it, in a `fill` or a callback."""

    def __init__(self, node: Node, task: asyncio.Task[None], body: Coroutine[Any, Any, object]) -> None:
        self.error: Exception | None = None
        self._node = node
        self._task = task
        self._body = body
        self._loop = task.get_loop()
        self._timer: asyncio.TimerHandle | None = None
        self._cancelled = False
        node.crashed = self.crash
        self._waits: Callable[[], object] = lambda: None
        self._unwound = False
        node.unwinds = self._unwinds

    def crash(self, error: Exception) -> None:
        if self._node.ending:
            self._node.log.error("node %s crashed while it ended: %r", self._node.name, error, exc_info=error)
        elif asyncio.current_task() is self._task:
            raise error
        else:
            self.error = error
            self.end()

    def end(self) -> None:
        """Cancel the function. What it cleans up already, for whatever reason, is not disturbed: that comes first."""
        self._node.end()
        if self._timer is None:
            self._cancel(self._loop.time())

    def _unwinds(self) -> bool:
        """Whether the function is in its clean-up. It stays where it is for as long as its task waits for one future.

        That is asked at each tick of a periodic publisher, and much slower to find out than to remember.
        """
        waits = getattr(self._task, "_fut_waiter", None)  # asyncio's own
        if waits is None or self._waits() is not waits:
            self._unwound = ends(self._body)
            self._waits = weakref.ref(waits) if waits is not None else lambda: None
        return self._unwound

    def _cancel(self, since: float) -> None:
        """Cancel the function, which was to end at `since` (loop time), once it cleans nothing up any more."""
        self._timer = None
        failed = self.error is not None or self._task.cancelling() > 0
        if cleans_up(self._body, handlers=failed and self._loop.time() - since < _HANDLER):
            self._timer = self._loop.call_later(_LOOK, self._cancel, since)
            in_background(self._timer)  # a clean-up that waits for ever is a deadlock all the same
        else:
            self._cancelled = True
            self._task.cancel()

    def close(self) -> None:
        """The function has ended."""
        if self._timer is not None:
            self._timer.cancel()

    def result(self, error: Exception | None) -> Exception | None:
        """What ended the node: the error outside came first, and brought the other one about."""
        if self.error is None:
            return error
        if self._cancelled:
            self._task.uncancel()
        elif error is not None:  # which came first, and was being dealt with
            log = self._node.log
            log.error("node %s crashed while it ended: %r", self._node.name, self.error, exc_info=self.error)
            return error
        return self.error


def _from_inside(cancelled: asyncio.CancelledError) -> Error:
    """Nobody cancelled the node, but something that it awaited: it would end without a word."""
    error = Error("something that the node awaited was cancelled")
    error.__cause__ = cancelled
    return error


# The topic `log`: what the nodes of a module log goes to whoever subscribes it, at most RATE records a second.


TOPIC = "log"
RATE = 50
"""Records a second, and records that may come at once."""

_SECOND = 1_000_000_000
_TEXT = 128


class LogTopic:
    """Publishes log records; those beyond the rate are counted in `suppressed`, and the next one says so."""

    def __init__(self, space: TopicSpace, remap: dict[str, str] | None = None) -> None:
        self.suppressed = 0
        self._space = space
        self._thread = threading.get_ident()
        self._node = Node("log", space, remap=remap)
        self._publisher = self._node.advertise(TOPIC, Log)
        self._credit = float(RATE)
        self._at = space.clock.monotonic()

    def publish(self, level: int, node: str, text: str) -> None:
        """Publish one record a line; never waits, and never fails. From any thread."""
        if threading.get_ident() != self._thread:
            with contextlib.suppress(RuntimeError):  # the loop is closed
                self._space.loop.call_soon_threadsafe(self.publish, level, node, text)
            return
        for line in text.splitlines():
            self._publish_line(level, node, line)

    def close(self) -> None:
        """Publish no more."""
        self._node.close()

    def _publish_line(self, level: int, node: str, line: str) -> None:
        if self._node.closed or not self._admit():
            self.suppressed += 1
            return
        if self.suppressed:
            line = f"({self.suppressed} suppressed) {line}"
            self.suppressed = 0
        text = line.encode("ascii", "replace").replace(b"\0", b"?")[:_TEXT].decode()
        stamp = Timestamp.from_ns(self._space.clock.now())
        level = min(max(level, 0), 255)
        self._publisher.publish_nowait(Log(stamp=stamp, level=level, node=node[:NODE_MAX], text=text))

    def _admit(self) -> bool:
        now = self._space.clock.monotonic()
        self._credit = min(float(RATE), self._credit + (now - self._at) * RATE / _SECOND)
        self._at = now
        if self._credit < 1.0:
            return False
        self._credit -= 1.0
        return True
