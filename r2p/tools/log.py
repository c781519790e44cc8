"""`r2p log`: the log records of all modules as they arrive.

Each r2p module publishes what its nodes log, from INFO up, on the topic `log`; behind a gateway with a prefix that is
`robot1/log`. Nothing keeps these records, so only new ones are shown.
"""

import asyncio
import enum
import logging
from collections.abc import Callable
from typing import Annotated, Any

import typer

import r2p
from r2p.msg import Log
from r2p.names import LOG
from r2p.tools.completion import complete_node_or_module
from r2p.tools.log_levels import complete_level, set_levels
from r2p.tools.options import Count, Format, Once, Timeout
from r2p.tools.output import Output, notify
from r2p.tools.session import Session, joined, patience
from r2p.units import MILLISECOND, SECOND

QUEUE = 1024
"""Records that wait for a slow terminal or pipe; beyond that the oldest are lost, and counted."""

_LOOK = 0.5  # seconds between two looks for the log topics of further namespaces


class Level(enum.Enum):
    """The levels of records, lowest first; the values are what users write."""

    DEBUG = "debug"
    INFO = "info"
    WARNING = "warning"
    ERROR = "error"
    CRITICAL = "critical"

    @property
    def number(self) -> int:
        return logging.getLevelNamesMapping()[self.name]


_COLOURS = {Level.DEBUG: 2, Level.WARNING: 33, Level.ERROR: 31, Level.CRITICAL: 31}  # faint, yellow, red
_CLOCK = logging.Formatter()


async def log(
    session: Session,
    node: Annotated[
        str | None,
        typer.Argument(
            metavar="NODE|MODULE",
            autocompletion=complete_node_or_module,
            help="Only of this node (NODE or MODULE/NODE), or module.",
            show_default=False,
        ),
    ] = None,
    *,
    set: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="NODE=LEVEL",
            autocompletion=complete_level,
            help="Set from which level on NODE, MODULE/NODE or MODULE/* logs, and end; default: as at its start.",
        ),
    ] = None,
    level: Annotated[Level, typer.Option("--level", "-l", help="Only records of this level and above.")] = Level.INFO,
    follow: Annotated[
        bool, typer.Option("--follow", "-f", help="Go on until Ctrl-C: the default, as there are no old records.")
    ] = True,
    count: Count = None,
    once: Once = False,
    timeout: Timeout = None,
    format: Format = None,
) -> None:
    """Print the log records of all modules as they arrive: time, level, module/node, text.

    Modules publish their records from INFO up, or from the level that was set by --set, until they end. Nothing keeps
    old ones. Ctrl-C ends it.
    """
    if set:
        await set_levels(session, set)
        return
    await _Printer(session, Output(format), node or "", level).run(1 if once else count, timeout)


command = joined(log)


class _Printer:
    """Prints the records of all log topics on the network."""

    def __init__(self, session: Session, output: Output, wanted: str, level: Level) -> None:
        self._session = session
        self._output = output
        self._wanted = wanted
        self._level = level
        self._subscribers: dict[str, r2p.Subscriber[Log]] = {}
        self._left: int | None = None
        self._first = asyncio.Event()
        self._last = asyncio.Event()

    async def run(self, count: int | None, timeout: float | None) -> None:
        """Print `count` records (None: until cancelled). Raises TimedOut after `timeout` seconds without a record."""
        what = f"log record of {self._wanted}" if self._wanted else "log record"
        missing = f"no {what}"
        self._left = count
        try:
            async with self._output.while_read(), patience(missing, timeout) as received, asyncio.TaskGroup() as tasks:
                looking = tasks.create_task(self._subscribe_to_all(tasks, received))
                with self._session.waiting(f"a {what} (old ones are not kept)"):
                    await self._first.wait()
                await self._last.wait()
                looking.cancel()
                for subscriber in self._subscribers.values():
                    subscriber.close()
        finally:
            lost = sum(each.lost for each in self._subscribers.values())
            if lost:
                notify(f"{lost} log records lost: the output was too slow")

    async def _subscribe_to_all(self, tasks: asyncio.TaskGroup, received: Callable[[], None]) -> None:
        """Subscribe to the log, and to that of each namespace as soon as it is known."""
        self._session.module.query()  # for the log topics of namespaces
        while True:
            known = {LOG, *(name for name in self._session.module.network.topics() if name.endswith(f"/{LOG}"))}
            for name in known - self._subscribers.keys():
                subscriber = self._session.node.subscribe(name, Log, queue=QUEUE, lossy=True)
                self._subscribers[name] = subscriber
                tasks.create_task(self._print(subscriber, name.removesuffix(LOG), received))
            await asyncio.sleep(_LOOK)

    async def _print(self, subscriber: r2p.Subscriber[Log], namespace: str, received: Callable[[], None]) -> None:
        async for sample in subscriber.samples():
            record = sample.message
            if not isinstance(record, Log):
                continue
            module = _module_of(record, sample.source.module, namespace)
            if self._left == 0 or record.level < self._level.number or not self._is_wanted(module, record.node):
                continue
            received()
            self._first.set()
            if self._left is not None:
                self._left -= 1
            await self._put(module, record, record.stamp.ns or sample.stamp)
            if self._left == 0:
                self._last.set()

    def _is_wanted(self, module: str, node: str) -> bool:
        return self._wanted in {"", node, module, f"{module}/{node}"}

    async def _put(self, module: str, record: Log, stamp: int) -> None:
        level = _level_of(record.level)
        values: dict[str, Any] = {
            "stamp": stamp,
            "level": level.value,
            "module": module or None,
            "node": record.node or None,
            "text": record.text,
        }
        where = "/".join(part for part in (module or "?", record.node) if part)
        text = f"{clock_text(stamp)} {level.name:<8} {where}: {record.text}"
        await self._output.put(values, text, colour=_COLOURS.get(level), wrap=True)


def _module_of(record: Log, sender: str, namespace: str) -> str:
    """Return the name of a record's module on this network; empty: unknown.

    The record has its name on the robot. `sender` has the robot's prefix, where the link carries who sent a message.
    """
    module = sender if sender.endswith(record.module) else record.module
    return namespace + module if module and "/" not in module else module


def _level_of(number: int) -> Level:
    """Return the level of a record: the highest that its number reaches."""
    return next((each for each in reversed(Level) if number >= each.number), Level.DEBUG)


def clock_text(stamp: int) -> str:
    """Return an instant (ns) as the time of day here."""
    record = logging.makeLogRecord({"created": stamp / SECOND})
    return f"{_CLOCK.formatTime(record, '%H:%M:%S')}.{stamp // MILLISECOND % 1000:03}"
