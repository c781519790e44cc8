"""Commands to modules and nodes, confirmed: for `r2p module` and the page of `r2p dash`.

A command may get lost, so it is repeated until what the module announces confirms it.
"""

import asyncio
import contextlib
from itertools import pairwise
from typing import Literal

from r2p.codecs.management import FLAG_BOOT, FLAG_REBOOTED, FLAG_STOPPED
from r2p.errors import Error
from r2p.modules.graph import ModuleView
from r2p.modules.module import Module
from r2p.names import module_alias
from r2p.protocols.discovery.events import Command, ModuleChanged
from r2p.runtime.events import LinkNotice, ModuleEvent

TIMEOUT = 10.0
"""Seconds in which a command must be confirmed: firmware with many topics sends ALIVE that rarely."""

_REPEAT = 1.0  # seconds between two commands
_LOOK = 0.05  # seconds between two looks at a module, whose ALIVE need not change anything
_PROMPT = 0.2  # seconds: firmware sends ALIVE 10 ms after a command to restart


class CommandProgress:
    """What a module has announced since a command was sent to it: its flags, in order."""

    def __init__(self, command: Command, view: ModuleView | None, name: str) -> None:
        """`view`: the module before the command; None: it is not known yet. `name`: its name, or its alias."""
        self.name = name if view is None else view.name
        """The name of the module; until it is known that may be an alias."""
        self.denied = ""
        """Why a gateway does not forward the command."""
        self.flags: list[int] = [] if view is None else [_flags(view)]
        self._command = command

    def note(self, event: ModuleEvent) -> None:
        """Note a change of the module's flags, and that a gateway denies the command."""
        match event:
            case ModuleChanged(info=info) if self.name in (info.name, module_alias(info.name)):
                self.name = info.name
                self.flags.append(info.flags)
            case LinkNotice(kind=kind, text=text) if kind == f"{self._command.name} denied":
                self.denied = text

    def is_confirmed(self, view: ModuleView | None, since: float) -> bool:
        """Return whether the flags show that the module has obeyed; its newest `view`, and seconds `since` the command.

        Firmware that was rebooted before shows a reboot only by an ALIVE right after the command.
        """
        if not self.flags:
            return False
        match self._command:
            case Command.STOP:
                return bool(self.flags[-1] & FLAG_STOPPED)
            case Command.BOOTLOAD:
                return bool(self.flags[-1] & FLAG_BOOT)
            case _:
                return self._has_rebooted(view, since)

    def _has_rebooted(self, view: ModuleView | None, since: float) -> bool:
        if not _restarted(self.flags[-1]):
            return False
        if any(_restarted(after) and not _restarted(before) for before, after in pairwise(self.flags)):
            return True
        if view is None or view.instance is not None:
            return False
        return 0 <= since - view.age < _PROMPT


def _restarted(flags: int) -> bool:
    return flags & (FLAG_REBOOTED | FLAG_STOPPED | FLAG_BOOT) == FLAG_REBOOTED


def _flags(view: ModuleView) -> int:
    state = {"stopped": FLAG_STOPPED, "boot": FLAG_BOOT}.get(view.state, 0)
    return state | (FLAG_REBOOTED if view.rebooted else 0)


def find_module(module: Module, name: str) -> ModuleView | None:
    """Return another module of the network, as it was last seen on any link."""
    views = [view for view in module.network.modules() if view.link and view.name == name]
    return min(views, key=lambda view: view.age, default=None)


async def send_command(module: Module, command: Command, name: str, timeout: float = TIMEOUT) -> None:
    """Send a command to a module that is known, until it confirms it.

    Raises Error for a module that is not known, can't obey, or that a gateway does not let commands pass to; and
    TimeoutError if it does not confirm.
    """
    view = find_module(module, name)
    if view is None:
        raise Error(f"there is no other module {name} on the network")
    if view.kind == "ROS":
        raise Error(f"{name} is a ROS node, which knows no {command.name}: use the commands of ROS")
    try:
        async with asyncio.timeout(timeout):
            await _repeat(module, command, name, CommandProgress(command, view, name))
    except TimeoutError:
        text = f"{name} did not confirm {command.name} in {timeout:g} s; if a gateway is in between, it must have "
        raise TimeoutError(text + "--allow-control") from None


async def _repeat(module: Module, command: Command, name: str, progress: CommandProgress) -> None:
    """Send a command each second until it is confirmed. Raises Error if a gateway denies it."""
    loop, events = asyncio.get_running_loop(), module.events()
    while True:
        module.command(command, name)
        sent_at = loop.time()
        while (since := loop.time() - sent_at) < _REPEAT:
            if progress.denied:
                raise Error(progress.denied)
            if progress.is_confirmed(find_module(module, name), since):
                return
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(_LOOK):
                    progress.note(await anext(events))


async def order_node(module: Module, name: str, node: str, order: Literal["start", "stop", "restart"]) -> None:
    """Start, stop or restart a node of a module.

    Raises Error if the module refuses, or the node runs that is to start; and TimeoutError without an answer.
    """
    nodes = module.network.nodes_of(name)
    if order == "stop":
        await nodes.stop(node)
        return
    if order == "start":
        listed = await nodes.fetch()
        if any(each.node == node and each.running for each in listed.nodes):
            raise Error(f"node {node} of {name} runs already")
    await nodes.restart(node)


async def order_module(module: Module, name: str, order: Literal["stop", "start", "reboot"]) -> None:
    """Stop a module's nodes, start those of a stopped module, or restart it.

    Raises Error if there is no such module or it does not obey, and TimeoutError if it does not confirm.
    """
    view = find_module(module, name)
    if order == "start" and view is not None and view.state == "running":
        raise Error(f"module {name} runs already")
    await send_command(module, Command.STOP if order == "stop" else Command.REBOOT, name)
