"""Orders from the network to a module: STOP, REBOOT, and BOOTLOAD, which a program on a PC refuses."""

import asyncio
import logging
from collections.abc import Awaitable, Callable

from r2p.line_limit import LineLimit
from r2p.printable import get_logger
from r2p.protocols.events import Command

logger = get_logger("r2p.module")

_LINES = 1
"""Lines of the log in a second about one kind of order."""

_SECOND = 1_000_000_000


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
        self._limit = LineLimit(_LINES)
        self._latest: Command | None = None
        self._obeying: asyncio.Task[None] | None = None

    def take(self, command: Command) -> None:
        """An order has come in."""
        self._log(logging.WARNING, f"module {self._module}: {command.name} from the network")
        if self.tasks is None:
            return
        if command is Command.BOOTLOAD:
            count = self._refused[command.name] = self._refused.get(command.name, 0) + 1
            text = f"module {self._module} is a program on a PC, it has no boot loader: BOOTLOAD refused"
            self._log(logging.ERROR, text, f" ({count} so far)")
            return
        self._latest = command
        if self._obeying is None or self._obeying.done():
            self._obeying = self.tasks.create_task(self._obey(), name=f"{self._module} orders")

    def _log(self, level: int, text: str, detail: str = "") -> None:
        """What others can make happen any number of times a second."""
        more = self._limit.suffix(text, int(asyncio.get_running_loop().time() * _SECOND))
        if more is not None:
            logger.log(level, "%s%s%s", text, detail, more)

    async def _obey(self) -> None:
        """One order at a time; of those that come meanwhile the last one counts."""
        while self._latest is not None and self.tasks is not None:
            order, self._latest = self._latest, None
            await (self._stop() if order is Command.STOP else self._reboot())
