"""The life of a node: start, end, crash, restart.

A node that raises ends alone: its traceback is logged, the others run on, and the module raises what happened when it
ends. Stopping is cancellation, so `try/finally` in the node's function stops the motor.
"""

import asyncio
from collections.abc import Awaitable, Callable

from r2p.clock import random_of
from r2p.errors import NameTooLong
from r2p.names import NODE_MAX, node_name
from r2p.node import Node
from r2p.transports.backoff import Backoff

NodeFunction = Callable[..., Awaitable[object]]

_FIRST_RESTART, _LONGEST_RESTART = 0.5, 30.0  # seconds
_STABLE = 60.0  # seconds after which a crash is the first one again


def name_of(function: NodeFunction) -> str:
    """The node name that a function gives: its own, if it fits the wire."""
    name = getattr(function, "__name__", type(function).__name__)
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
        self._outside: Exception | None = None

    @property
    def running(self) -> bool:
        return self._task is not None and not self._task.done()

    def start(self, tasks: asyncio.TaskGroup, ended: Callable[[], None]) -> None:
        """Start it, or start it again from the beginning; `ended` is called when it has ended for good."""
        if self._task is not None:
            self.node = self._make_node()
        self.error = None
        self._task = tasks.create_task(self._run(), name=f"{self.node.module}/{self.node.name}")
        self._task.add_done_callback(lambda _task: ended())

    async def stop(self) -> None:
        """Cancel it, and wait for its end."""
        if self._task is not None:
            self._task.cancel()
            await asyncio.wait([self._task])

    async def _run(self) -> None:
        loop = asyncio.get_running_loop()
        backoff = Backoff(random_of(loop), first=_FIRST_RESTART, longest=_LONGEST_RESTART)
        while True:
            started = loop.time()
            error = await self._attempt()
            if error is None:
                return
            self.node.log.error("node %s crashed: %s: %s", self.node.name, type(error).__name__, error, exc_info=error)
            if not self._restart:
                error.add_note(f"in node {self.node.name} of module {self.node.module}")
                self.error = error
                return
            if loop.time() - started > _STABLE:
                backoff.reset()
            await asyncio.sleep(backoff.delay())
            self.restarts += 1
            self.node = self._make_node()

    async def _attempt(self) -> Exception | None:
        """Run the function to its end; what it raised."""
        node, task = self.node, asyncio.current_task()
        self._outside = None

        def crash(error: Exception) -> None:
            if self._outside is None and task is not None:
                self._outside = error
                task.cancel()

        node.crashed = crash
        node.enter()
        try:
            await self._function(node, *self._args)
        except asyncio.CancelledError:
            if self._outside is None or task is None:
                raise
            task.uncancel()
            return self._outside
        except Exception as error:  # noqa: BLE001 - the user's code may raise anything
            return error
        finally:
            node.close()
        return self._outside
