"""Orders from the network to a module: STOP, REBOOT, and BOOTLOAD, which a program on a PC refuses."""

import asyncio
import logging
from collections.abc import Awaitable, Callable

from r2p.printable import get_logger
from r2p.protocols.events import Command

logger = get_logger("r2p.module")

_APART = 1.0
"""Seconds between two lines of the log about one kind of order."""


class Orders:
    """Those of one module. `refused` counts the ones that were not obeyed, by name."""

    def __init__(
        self,
        module: str,
        refused: dict[str, int],
        stop: Callable[[], Awaitable[None]],
        reboot: Callable[[], Awaitable[None]],
    ) -> None:
        self.tasks: asyncio.TaskGroup | None = None
        """The owner of the module's tasks while it is open: without it nothing is obeyed."""
        self._module = module
        self._refused = refused
        self._stop = stop
        self._reboot = reboot
        self._logged: dict[tuple[int, Command], float] = {}
        self._latest: Command | None = None
        self._obeying: asyncio.Task[None] | None = None

    def take(self, command: Command) -> None:
        """An order has come in."""
        self._log(logging.WARNING, command, "module %s: %s from the network", self._module, command.name)
        if self.tasks is None:
            return
        if command is Command.BOOTLOAD:
            count = self._refused[command.name] = self._refused.get(command.name, 0) + 1
            text = "module %s is a program on a PC, it has no boot loader: BOOTLOAD refused (%d so far)"
            self._log(logging.ERROR, command, text, self._module, count)
            return
        self._latest = command
        if self._obeying is None or self._obeying.done():
            self._obeying = self.tasks.create_task(self._obey(), name=f"{self._module} orders")

    def _log(self, level: int, command: Command, text: str, *args: object) -> None:
        """Each kind of order at most once a second."""
        now = asyncio.get_running_loop().time()
        if now >= self._logged.get((level, command), -_APART) + _APART:
            self._logged[level, command] = now
            logger.log(level, text, *args)

    async def _obey(self) -> None:
        """One order at a time; of those that come meanwhile the last one counts."""
        while self._latest is not None and self.tasks is not None:
            order, self._latest = self._latest, None
            await (self._stop() if order is Command.STOP else self._reboot())
