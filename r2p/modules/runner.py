"""Run a program: on the fastest event loop available, with signals that end everything in order.

The first SIGINT or SIGTERM cancels the program: it ends its nodes, says good-bye on its links, and returns. A second
one ends the process at once, as does the first one if the program is still running GRACE seconds later; the time in
which it saves something (`saving`) does not count.

A program that `run` starts logs to stderr unless it has configured logging. Where nothing catches what `run` raises,
Python prints it as one line: what crashed is in the log already, and a wrong name or URL is not in the stack. What
`run_main` raises is printed without the frames of r2p and asyncio.
"""

import asyncio
import contextlib
import functools
import inspect
import os
import signal
import sys
import threading
from collections import Counter
from collections.abc import Awaitable, Callable, Iterable, Iterator
from types import FrameType, TracebackType
from typing import Any, Self, TypeVar

from r2p.errors import Error, NodeCrashed
from r2p.log_lines import debugging, default_logging, printable, short_traceback
from r2p.modules.module import Module
from r2p.modules.supervisor import NodeFunction, check_function, name_of
from r2p.names import node_name
from r2p.parameters.sources import GivenParameters
from r2p.transports.link import Transport

T = TypeVar("T")

GRACE = 1.8
"""Seconds that a program has to end in order: with the interpreter's own end, the process is gone after two."""
SAVING_MAX = 30.0
"""Seconds that it may take beyond that to save what would be lost."""

_STEP = 0.1  # seconds between two looks whether something is still being saved
_saving: list[None] = []  # an entry for each block of `saving`


def run(
    *functions: NodeFunction | tuple[str, NodeFunction],
    name: str | None = None,
    module: str | None = None,
    via: str | Transport | Iterable[str | Transport] | None = None,
    remap: dict[str, str] | None = None,
    aliases: dict[str, str] | None = None,
    restart: bool = False,
    allow_control: bool = False,
    allow_load: bool | str | os.PathLike[str] = False,
    params_file: str | os.PathLike[str] | None = None,
    params: GivenParameters = None,
) -> None:
    """Run functions as the nodes of one module, until all have ended or a signal ends them.

    A node has the name of its function, or another: `run(line_follower, name="follower")`, and of several
    `run(blink, ("follower", line_follower))`. `module` is the module's name; `via`, `remap`, `aliases`,
    `allow_control`, `allow_load`, `params_file` and `params` are as for `Module`, `restart` as for `Module.start`.

    Meanwhile logging writes to stderr, unless the root logger or the logger `r2p` has handlers: `r2p` from INFO up, all
    other loggers from WARNING up.

    Raises NodeCrashed at the end if a node crashed, and the errors of `Module` and `Module.start`. Where the program
    does not catch that, it prints one line instead of a traceback (R2P_DEBUG=1: all of it), and the exit code is 1.
    """

    async def main() -> None:
        nodes = _named(functions, name)
        host = Module(
            module,
            via=via,
            remap=remap,
            aliases=aliases,
            allow_control=allow_control,
            allow_load=allow_load,
            params_file=params_file,
            params=params,
        )
        async with host:
            for node, function in nodes:
                host.start(function, name=node, restart=restart)
            await host.wait()

    try:
        run_main(main)
    except Error as error:
        _print_shortly(error, one_line=True)
        raise


def _named(
    functions: Iterable[NodeFunction | tuple[str, NodeFunction]], name: str | None
) -> list[tuple[str, NodeFunction]]:
    """Return the functions with the names of their nodes. Raises Error or InvalidName for those that can't run."""
    named = [_pair(each, name) for each in functions]
    for _, function in named:
        check_function(function)
    if not named:
        raise Error("r2p.run has no function to run: pass at least one, as in r2p.run(blink)")
    if name is not None and len(named) != 1:
        raise Error(f"name={name!r} names one function, not {len(named)}: write (name, function) for each")
    nodes = [(node_name(node), function) for node, function in named]
    for node, count in Counter(node for node, _ in nodes).items():
        if count > 1:
            raise Error(f'r2p.run has {count} nodes named {node}: write ("another_name", {node}) for one of them')
    return nodes


def _pair(each: NodeFunction | tuple[str, NodeFunction], name: str | None) -> tuple[str, NodeFunction]:
    if not isinstance(each, tuple):
        return name if name is not None else name_of(each), each
    pair: tuple[object, ...] = each
    if len(pair) != 2 or not isinstance(pair[0], str):
        raise Error(f"{each!r} is not a node: write a function, or (name, function)")
    return each


def _print_shortly(error: Exception, *, one_line: bool) -> None:
    """Let Python print this error, if it ends the program, as one line, or without the frames of r2p and asyncio.

    Hooks of the program stay as they are.
    """
    if sys.excepthook is sys.__excepthook__ and not debugging():
        sys.excepthook = _excepthook
    with contextlib.suppress(AttributeError):  # of this error only: others are the program's
        error.__r2p_one_line__ = one_line  # type: ignore[attr-defined]  # `_excepthook` reads it


def _excepthook(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    one_line = getattr(error, "__r2p_one_line__", None)
    if one_line is None:
        sys.__excepthook__(kind, error, trace)
        return
    text = f"r2p: {error.message if isinstance(error, NodeCrashed) else error}" if one_line else short_traceback(error)
    with contextlib.suppress(OSError):  # stderr is closed
        print(printable(text, "\n\t"), file=sys.stderr, flush=True)  # noqa: T201 - as Python itself


def run_main(main: Callable[[], Awaitable[T]]) -> T | None:
    """Run `main()` on the fastest event loop, and return its result; None if SIGINT or SIGTERM ended it.

    Use it instead of `asyncio.run` for programs that open modules themselves: it logs as `run` does, a NodeCrashed that
    nothing catches is one line, and tracebacks end at the program's own code. Raises Error where an event loop runs
    already, and for the coroutine `main()` instead of the function.
    """
    if inspect.iscoroutine(main):
        main.close()  # else Python warns that it was never awaited
        error = Error(f"r2p.run_main takes the function itself: write r2p.run_main({main.__name__}), without ()")
        _print_shortly(error, one_line=False)
        raise error
    if asyncio._get_running_loop() is not None:  # noqa: SLF001 - as get_running_loop, without its RuntimeError
        raise Error(
            'an event loop runs already: in a file for `r2p run`, call r2p.run under `if __name__ == "__main__":`; '
            "in a coroutine, use `async with r2p.Module(...)`"
        )

    async def guarded() -> T | None:
        if not signals.guard(asyncio.get_running_loop(), asyncio.current_task()):
            return None
        try:
            return await main()
        except asyncio.CancelledError:
            if signals.received:
                return None
            raise

    try:
        with default_logging(), _Signals() as signals, asyncio.Runner(loop_factory=loop_factory()) as runner:
            return runner.run(guarded())
    except Exception as error:
        _print_shortly(error, one_line=isinstance(error, NodeCrashed))  # what crashed is in the log already
        raise


@contextlib.contextmanager
def saving() -> Iterator[None]:
    """Let the program take longer to end after a signal, up to SAVING_MAX, while the block saves what it would lose."""
    _saving.append(None)
    try:
        yield
    finally:
        _saving.pop()


def loop_factory() -> Callable[[], asyncio.AbstractEventLoop] | None:
    """Return uvloop's loop factory, if uvloop is installed; otherwise None, which means asyncio's own."""
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
        """Cancel this task at the first signal. Return False if a signal has already arrived."""
        if task is not None:
            self._cancel = functools.partial(loop.call_soon_threadsafe, task.cancel)
        return not self.received

    def _interrupt(self, number: int, _frame: FrameType | None) -> None:
        # The second signal ends the process. Only this one's handler is reset: with that of another signal which has
        # arrived meanwhile, and waits for Python, it would be ignored.
        signal.signal(number, signal.SIG_DFL)
        if self.received:
            os.kill(os.getpid(), number)
            return
        self.received.append(number)
        self._over.set()
        with contextlib.suppress(RuntimeError):  # the loop is closed: the program has ended by itself
            self._cancel()

    def _enforce(self) -> None:
        self._over.wait()
        left, left_saving = GRACE, SAVING_MAX
        while self.received and not self._ended.wait(step := min(_STEP, GRACE)):
            if _saving and left_saving > 0.0:
                left_saving -= step
            elif (left := left - step) <= 0.0:
                os.kill(os.getpid(), self.received[0])
