"""The life of a node: start, end, crash, restart.

A node that raises ends alone: its traceback is logged, the others run on, and the module raises the error at its end.
Stopping is cancellation, so `try/finally` in the node's function stops the motor.

Nothing disturbs that clean-up: neither an error in a callback of the node, nor a second reason to end it.
Both wait while an exception, the node's own or a cancellation, is in a `finally`.
"""

import asyncio
import functools
import inspect
import weakref
from collections.abc import Awaitable, Callable, Coroutine
from pathlib import Path
from typing import Any, cast

import msgspec

from r2p.clock import Backoff, in_background, random_of
from r2p.errors import Error, NameTooLong
from r2p.messages.definition import explain_arguments
from r2p.modules.unwinding import cleans_up, ends
from r2p.names import NODE_MAX, node_name
from r2p.parameters.sources import GivenValueError
from r2p.runtime.node import Node

NodeFunction = Callable[..., Awaitable[object]]
"""A function for `Module.start`: `async def blink(node: r2p.Node) -> None`, with the further arguments of `start`."""

_FIRST_RESTART, _LONGEST_RESTART = 0.5, 30.0  # seconds
_STABLE = 60.0  # seconds without a crash after which the pause before a restart is the first one again
_CLEANUP_POLL = 0.01  # seconds until it is checked again whether clean-up is over: coroutines don't announce that
_HANDLER_GRACE = 1.0  # seconds for which an `except` counts as clean-up after a crash; then the node goes on in it


def check_function(function: NodeFunction, *args: object) -> Any:
    """Return the function, or the one in its `functools.partial`.

    Raises Error unless it is a coroutine function that can be called with a node and `args`.
    """
    bare = function.func if isinstance(function, functools.partial) else function
    if not (inspect.iscoroutinefunction(bare) or inspect.iscoroutinefunction(getattr(bare, "__call__", None))):  # noqa: B004 - looked into, not called
        raise Error(_not_a_coroutine_function(bare))
    try:  # without what a decorator wraps: it may add arguments, or leave some out
        inspect.signature(function, follow_wrapped=False).bind(None, *args)
    except (TypeError, ValueError) as error:
        raise Error(_uncallable(bare, args, str(error))) from None
    return bare


def _uncallable(function: Any, args: tuple[object, ...], reason: str) -> str:
    """Return what to write instead of a function that can't be called with its node and these arguments."""
    name: str = getattr(function, "__name__", type(function).__name__)
    parameters = list(inspect.signature(function, follow_wrapped=False).parameters)
    owner = str(getattr(function, "__qualname__", name)).rpartition(".")[0].rpartition(".")[2]
    if parameters[:1] == ["self"]:
        return f"{name} is a method of a class: pass that of an object, {owner}().{name}"
    if not parameters:
        method = owner not in ("", "<locals>")
        return f"{name}() does not take its node: write `async def {name}({'self, ' * method}node: r2p.Node)`"
    if args:
        return f"{name}({', '.join(parameters)}) can't be called with its node and {len(args)} more: {reason}"
    return (
        f"{name}({', '.join(parameters)}) can't be called with only its node: {reason}; pass more with "
        "functools.partial, or behind the function to Module.start"
    )


def _not_a_coroutine_function(function: object) -> str:
    """Return what to write instead of this function or class: classes are what programs for ROS would pass."""
    if inspect.iscoroutine(function):
        function.close()  # else Python warns that it was never awaited
        return f"{function.__name__}() was called: pass the function itself, {function.__name__} without ()"
    if inspect.isasyncgenfunction(function):
        return f"{function.__name__} contains `yield`: a node publishes messages, it does not yield them"
    if isinstance(function, list):
        return "a list is not a coroutine function: pass the functions one by one, or *functions"
    if isinstance(function, type):
        return f"class {function.__name__} is not a coroutine function: pass a method, {function.__name__}().METHOD"
    name = getattr(function, "__name__", None) if inspect.isroutine(function) else None
    return f"{name or repr(function)} is not a coroutine function: write `async def {name or 'blink'}(node: r2p.Node)`"


def describe_function(function: NodeFunction) -> str:
    """Return a function's name, and the file or package it is from, as far as it says: `blink.py:blink`."""
    bare: Any = function.func if isinstance(function, functools.partial) else function
    code = getattr(bare, "__code__", None)
    file = Path(code.co_filename).name if code is not None else getattr(bare, "__module__", "?")
    return f"{file}:{getattr(bare, '__qualname__', type(bare).__name__)}"


def name_of(function: NodeFunction, *args: object) -> str:
    """Return the default name of a function's node: the function's own name.

    Raises NameTooLong or InvalidName if that is not a valid node name, and Error if it is not a coroutine function that
    takes a node and `args`.
    """
    bare = check_function(function, *args)
    name = getattr(bare, "__name__", type(bare).__name__)
    if len(name) > NODE_MAX:
        short = name[:NODE_MAX].rstrip("_")
        raise NameTooLong(
            f"node name {name!r} has {len(name)} characters, at most {NODE_MAX} are possible: pass name={short!r}, or "
            f"({short!r}, {name}) to r2p.run"
        )
    return node_name(name)


class NodeOptions(msgspec.Struct, frozen=True):
    """The options of `Module.start`: `remap` renames topics, `restart` starts the node again after a crash."""

    priority: int = 0
    remap: dict[str, str] = {}
    restart: bool = False


class Supervisor:
    """Runs one function as a node; with the option `restart` again after each crash."""

    def __init__(
        self, function: NodeFunction, args: tuple[object, ...], make_node: Callable[[], Node], options: NodeOptions
    ) -> None:
        self.node = make_node()
        self.options = options
        self.source = describe_function(function)
        """The function and where it is from, for users."""
        self.started_at: float | None = None
        """The start of this run (loop time)."""
        self.on_trial = False
        """True for a node that is to replace another one: a crash ends it until it has."""
        self.error: Exception | None = None
        """The exception that ended the node, if one did."""
        self.restarts = 0
        """Number of restarts after a crash."""
        self._function = function
        self._args = args
        self._make_node = make_node
        self._task: asyncio.Task[None] | None = None
        self._attempt: _Attempt | None = None
        self._stopping = False
        self._begun = False

    @property
    def never_ran(self) -> bool:
        """Return whether the node was started, but did not get to its first step."""
        return self._task is not None and not self._begun

    @property
    def running(self) -> bool:
        return self._task is not None and not self._task.done()

    def start(self, tasks: asyncio.TaskGroup, ended: Callable[["Supervisor"], None]) -> None:
        """Start the node, or start it anew; `ended` is called when it has ended for good."""
        if self._task is not None:
            self.node = self._make_node()
        self.error = None
        self._stopping = False
        name = f"{self.node.module}/{self.node.name}"
        self._task = task = asyncio.get_running_loop().create_task(self._run(), name=name)
        task.add_done_callback(lambda _task: self._ended(ended))
        tasks.create_task(self._guard(task), name=f"{name} guard")

    def cancel(self) -> asyncio.Task[None] | None:
        """Ask the node to end, without disturbing its clean-up; return its task if it still runs."""
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
        """Cancel the node, and wait for its end."""
        task = self.cancel()
        if task is not None:
            await asyncio.wait([task])

    async def _guard(self, task: asyncio.Task[None]) -> None:
        """Represent the node in its module's task group, which may cancel several times: the node is cancelled once."""
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

    def _ended(self, ended: Callable[["Supervisor"], None]) -> None:
        self.node.close()  # again: a task that is cancelled before its first step does not get to it
        ended(self)

    def _log_error(self, error: Exception) -> None:
        if isinstance(error, GivenValueError):  # no mistake of the program, whose traceback would not help
            self.node.log.error("node %s can't start: %s", self.node.name, error)
            return
        self.node.log.error("node %s crashed: %s: %s", self.node.name, type(error).__name__, error, exc_info=error)

    async def _run(self) -> None:
        self._begun = True
        loop = asyncio.get_running_loop()
        backoff = Backoff(random_of(loop), first=_FIRST_RESTART, longest=_LONGEST_RESTART)
        while True:
            started = self.started_at = loop.time()
            error = await self._try()
            if error is None:
                return
            explain_arguments(error)
            self._log_error(error)
            if self._stopping or self.on_trial or not self.options.restart:
                error.add_note(f"in node {self.node.name} of module {self.node.module}")
                self.error = error
                return
            if loop.time() - started > _STABLE:
                backoff.reset()
            await asyncio.sleep(backoff.delay())
            self.restarts += 1
            self.node = self._make_node()

    async def _try(self) -> Exception | None:
        """Run the function to its end; return its exception, if any."""
        task = asyncio.current_task()
        assert task is not None
        try:  # wrong arguments that `check_function` could not see raise here, before there is a coroutine
            # Only coroutine functions get here (check_function), and those return coroutines.
            body = cast("Coroutine[Any, Any, object]", self._function(self.node, *self._args))
        except Exception as error:  # noqa: BLE001 - the user's code may raise anything
            self.node.close()
            return error
        self._attempt = attempt = _Attempt(self.node, task, body)
        self.node.started()
        try:
            await body
            self.node.returned()
        except asyncio.CancelledError as error:
            if attempt.error is None and task.cancelling():
                raise
            return attempt.result(_from_inside(error))
        except Exception as error:  # noqa: BLE001 - the user's code may raise anything
            return attempt.result(error)
        finally:
            self._attempt = None
            attempt.close()
            await _ended(self.node.end_handlers())
            self.node.close()
        return attempt.result(None)


class _Attempt:
    """One run of a node's function: ends it, and keeps an error from outside of it, such as a `fill` or a callback."""

    def __init__(self, node: Node, task: asyncio.Task[None], body: Coroutine[Any, Any, object]) -> None:
        self.error: Exception | None = None
        self._node = node
        self._task = task
        self._body = body
        self._loop = task.get_loop()
        self._timer: asyncio.TimerHandle | None = None
        self._cancelled = False
        self._awaited: Callable[[], object] = lambda: None  # what the task waited for when it was last looked at
        self._was_unwinding = False
        node.crash_handler = self.crash
        node.is_unwinding = self._is_unwinding

    def crash(self, error: Exception) -> None:
        """End the function with an error of a `fill` or a callback of the node."""
        if self._node.ending:
            self._node.log.error("node %s crashed while it ended: %r", self._node.name, error, exc_info=error)
        elif asyncio.current_task() is self._task:
            raise error  # through the node's own code, as any other error of its calls
        else:
            self.error = error
            self.end()

    def end(self) -> None:
        """Cancel the function, after the clean-up that it may be in already."""
        self._node.end()
        if self._timer is None:
            self._cancel(self._loop.time())

    def _is_unwinding(self) -> bool:
        """Return whether the function is in its clean-up.

        Each tick of a periodic publisher asks this, and the answer takes long. So it is kept while the task waits for
        the same future: the function does not move meanwhile.
        """
        future = getattr(self._task, "_fut_waiter", None)  # asyncio's own
        if future is None or self._awaited() is not future:
            self._was_unwinding = ends(self._body)
            self._awaited = weakref.ref(future) if future is not None else lambda: None
        return self._was_unwinding

    def _cancel(self, since: float) -> None:
        """Cancel the function, whose end was requested at `since` (loop time), or look again while it cleans up."""
        self._timer = None
        failed = self.error is not None or self._task.cancelling() > 0
        if cleans_up(self._body, handlers=failed and self._loop.time() - since < _HANDLER_GRACE):
            self._timer = self._loop.call_later(_CLEANUP_POLL, self._cancel, since)
            in_background(self._timer)  # under virtual time, a clean-up that waits for ever still is a deadlock
        else:
            self._cancelled = True
            self._task.cancel()

    def close(self) -> None:
        """Stop looking: the function has ended."""
        if self._timer is not None:
            self._timer.cancel()

    def result(self, error: Exception | None) -> Exception | None:
        """Return the error that ended the node: one from outside came first, and caused the function's own."""
        if self.error is None:
            return error
        if self._cancelled:
            self._task.uncancel()
        elif error is not None:  # it came before the error outside, and its clean-up was under way
            log = self._node.log
            log.error("node %s crashed while it ended: %r", self._node.name, self.error, exc_info=self.error)
            return error
        return self.error


async def _ended(handlers: list[asyncio.Task[None]]) -> None:
    """Wait until the handlers of a node's services have cleaned up, and hand on a cancellation afterwards."""
    cancelled: asyncio.CancelledError | None = None
    while pending := [each for each in handlers if not each.done()]:
        try:
            await asyncio.wait(pending)
        except asyncio.CancelledError as error:
            cancelled = error
    if cancelled is not None:
        raise cancelled


def _from_inside(cancelled: asyncio.CancelledError) -> Error:
    """Return an error for a node that awaited something cancelled: otherwise the node would end silently."""
    error = Error("something that the node awaited was cancelled")
    error.__cause__ = cancelled
    return error
