"""The nodes of one module: started and ended, one by one or all at once, and swapped.

STOP, REBOOT, the end of the module   ->  end_all: cancel all nodes, also those of a swap, and wait for them
REBOOT                                ->  start_all: the same functions, from their beginning
swap                                  ->  r2p.modules.swap
"""

import asyncio
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import msgspec

from r2p.errors import Error
from r2p.log_lines import get_logger
from r2p.modules.supervisor import NodeFunction, NodeOptions, Supervisor, check_function, name_of
from r2p.modules.swap import NodeSwap, SwapLimits, SwapResult
from r2p.names import node_name
from r2p.runtime.node import Node

if TYPE_CHECKING:
    from r2p.transports.link import Link

logger = get_logger("r2p.module")

_NAME = "name (name=, or FILE:FUNCTION=NAME)"

CLEANUP_WARNING_AFTER = 1.0
"""Seconds after which the log names nodes that are still cleaning up."""


class NodeTable:
    """The nodes of a module by name, also those that have ended.

    `make_node` makes a node of it, `on_gone` is called with the name of each node that has ended for good.
    """

    def __init__(
        self, module: str, make_node: Callable[[str, NodeOptions], Node], on_gone: Callable[[str], object]
    ) -> None:
        self.supervisors: dict[str, Supervisor] = {}
        self.crashes: dict[str, Exception] = {}
        """The errors that have ended nodes."""
        self.changed = asyncio.Event()
        """Set when a node has ended."""
        self.tasks: asyncio.TaskGroup | None = None
        """The owner of the tasks, while the module is open."""
        self._module = module
        self._make_node = make_node
        self._on_gone = on_gone
        self.links: list[Link] = []
        """The module's links, once it is open."""
        self._swaps: dict[NodeSwap, asyncio.Task[SwapResult | Error]] = {}
        self._leaving: list[Supervisor] = []
        """Nodes that were swapped, and still clean up."""
        self._times_ended = 0
        """Calls of `end_all`, after which no restart that waits may start its node."""

    @property
    def running(self) -> bool:
        """Return whether any node runs, or may start again as a swap fails."""
        return bool(self._swaps) or any(each.running for each in self._all())

    def _all(self) -> list[Supervisor]:
        """Return all nodes, also both of each swap."""
        swapped = [each for swap in self._swaps for each in (swap.old, swap.new)]
        return list(dict.fromkeys((*self.supervisors.values(), *swapped, *self._leaving)))

    # All

    async def end_all(self, reason: str) -> None:
        """Cancel all nodes, and wait until each has cleaned up."""
        self._times_ended += 1
        for swap in self._swaps:
            swap.interrupt(reason)
        tasks: list[asyncio.Task[Any]] = [task for each in self._all() if (task := each.cancel()) is not None]
        tasks += self._swaps.values()
        if not tasks:
            return
        _, pending = await asyncio.wait(tasks, timeout=CLEANUP_WARNING_AFTER)
        if pending:
            names = ", ".join(sorted(task.get_name() for task in pending))
            logger.warning("module %s waits for the clean-up of %s", self._module, names)
            await asyncio.wait(pending)

    def start_all(self) -> None:
        """Start all nodes that do not run."""
        for supervisor in self.supervisors.values():
            if not supervisor.running:  # one may have been started meanwhile
                self._start(supervisor)

    # One

    def start(self, function: NodeFunction, args: tuple[object, ...], name: str | None, options: NodeOptions) -> Node:
        """Start a function as a node. Raises as `Module.start`."""
        supervisor = self._supervisor(function, args, name, options)
        name = supervisor.node.name
        if self._is_taken(name):
            raise Error(f"module {self._module} already has a node {name}: give this one another {_NAME}")
        self.supervisors[name] = supervisor
        self._start(supervisor)
        return supervisor.node

    async def stop(self, name: str) -> None:
        """End a node, and wait until it has cleaned up.

        Raises Error if the module has no node of this name, and while the node is being swapped.
        """
        await self._settled(name).stop()

    async def restart(self, name: str) -> Node:
        """End a node if it runs, and start it anew. Raises Error as `stop`."""
        supervisor, times_ended = self._settled(name), self._times_ended
        await supervisor.stop()
        ended = self.tasks is None or self._times_ended != times_ended
        if ended or self.supervisors.get(name) is not supervisor or supervisor.running:
            raise Error(f"node {name} of module {self._module} was replaced or ended while it was restarted")
        self.crashes.pop(name, None)
        self._start(supervisor)
        return supervisor.node

    async def swap(
        self,
        old: str,
        function: NodeFunction,
        args: tuple[object, ...],
        name: str | None,
        limits: SwapLimits,
        options: dict[str, Any],
    ) -> SwapResult:
        """Let a new node take the place of another one, with its options but for these.

        Raises as `Module.swap`. A cancellation of the caller ends the swap while the old node still goes on.
        """
        limits.check()
        before = self._settled(old)
        if not before.running:
            raise Error(f"node {old} of module {self._module} does not run: start the new one instead")
        name = old if name is None else node_name(name)
        if name != old and self._is_taken(name):
            raise Error(f"module {self._module} already has a node {name}: give the new one another {_NAME}")
        new = self._supervisor(function, args, name, msgspec.structs.replace(before.options, **options))
        swap = NodeSwap(before, new, self.links, limits, self._replace)
        self._start(new)
        # In a task of its own: the caller may be the old node, which ends in the swap.
        task = asyncio.get_running_loop().create_task(swap.run(), name=f"{self._module} swap")
        self._swaps[swap] = task
        task.add_done_callback(lambda _task: self._swap_ended(swap))
        try:
            result = await asyncio.shield(task)
        except asyncio.CancelledError:
            if not swap.committed:
                task.cancel()
            raise
        if isinstance(result, Error):
            raise result
        return result

    def _swap_ended(self, swap: NodeSwap) -> None:
        del self._swaps[swap]
        self.changed.set()

    def _replace(self, one: Supervisor, other: Supervisor) -> None:
        """Put a node into the place of another one, which may still clean up."""
        supervisors = [other if each is one else each for each in self.supervisors.values()]
        self.supervisors = {each.node.name: each for each in supervisors}
        self._leaving = [each for each in (*self._leaving, one) if each.running]
        if not other.running:
            self._start(other)

    # For the above

    def _supervisor(
        self, function: NodeFunction, args: tuple[object, ...], name: str | None, options: NodeOptions
    ) -> Supervisor:
        check_function(function, *args)
        chosen = node_name(name) if name is not None else name_of(function, *args)
        return Supervisor(function, args, lambda: self._make_node(chosen, options), options)

    def _settled(self, name: str) -> Supervisor:
        """Return the node of this name. Raises Error if the module has no such node, and while it is being swapped."""
        if name not in self.supervisors:
            known = ", ".join(self.supervisors) or "none"
            raise Error(f"module {self._module} has no node {name}; its nodes: {known}")
        if any(name in swap.names for swap in self._swaps):
            raise Error(f"node {name} of module {self._module} is being swapped: try again")
        return self.supervisors[name]

    def _is_taken(self, name: str) -> bool:
        known = self.supervisors.get(name)
        return (known is not None and known.running) or any(name in swap.names for swap in self._swaps)

    def _start(self, supervisor: Supervisor) -> None:
        if self.tasks is None:
            raise Error(f"module {self._module} is closed")
        supervisor.start(self.tasks, self._node_ended)

    def _node_ended(self, supervisor: Supervisor) -> None:
        if supervisor.error is not None and not supervisor.on_trial:
            self.crashes[supervisor.node.name] = supervisor.error
        self._on_gone(supervisor.node.name)
        self.changed.set()
