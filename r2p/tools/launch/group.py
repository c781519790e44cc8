"""A group of commands: starts them in order, restarts those that fail, and stops them in reverse order.

Nothing here knows processes, networks or signals: `Start` starts a command and `WaitReady` waits for its condition, so
tests run a group under virtual time.
"""

import asyncio
import logging
import signal
from collections.abc import Awaitable, Callable, Iterable

import msgspec

from r2p.clock import Backoff, random_of
from r2p.tools.launch.entries import Entry
from r2p.tools.session import REPORT_WAITING_AFTER, call_after

logger = logging.getLogger("r2p.launch")

USAGE = 2
"""The exit code of a command line that is not valid: a restart does not help."""
TIMED_OUT = 3
SIGNALLED = 128
"""The exit code of a command that a signal ended is this plus the number of the signal, as in a shell."""

_FIRST_RESTART, _LONGEST_RESTART = 0.5, 30.0  # seconds
_STABLE = 60.0  # seconds without a failure after which the pause before a restart is the first one again
_SIGNALLED = {SIGNALLED + signal.SIGTERM, SIGNALLED + signal.SIGINT}  # a command that has just started, or was too slow


class RunningCommand(msgspec.Struct):
    """A command that has been started: `ended` is its exit code; `send` sends it a signal, unless it has ended."""

    ended: asyncio.Future[int]
    send: Callable[[int], object]


Start = Callable[[Entry], RunningCommand]
WaitReady = Callable[[Entry], Awaitable[None]]


class _Member:
    """An entry of the group, and its command while it runs."""

    def __init__(self, entry: Entry) -> None:
        self.entry = entry
        self.ready = asyncio.Event()
        self.command: RunningCommand | None = None


class Group:
    """Runs entries until all have ended, or `stop` is called."""

    def __init__(self, entries: Iterable[Entry], start: Start, wait_ready: WaitReady) -> None:
        self.exit_code = 0
        """Exit code of the first command that failed for good."""
        self._members = {entry.name: _Member(entry) for entry in entries}
        self._start = start
        self._wait_ready = wait_ready
        self._started: list[_Member] = []
        self._tasks: list[asyncio.Task[None]] = []
        self._stopping = False

    async def run(self) -> int:
        """Start all commands, and return the exit code when they have ended; call it once.

        Raises what `start` and `wait_ready` raise, in an exception group, after all commands have been stopped.
        """
        try:
            async with asyncio.TaskGroup() as tasks:
                for member in self._members.values():
                    self._tasks.append(tasks.create_task(self._supervise(member), name=member.entry.name))
        finally:
            await self._stop_all()
        return self.exit_code

    def stop(self, why: str) -> None:
        """Stop all commands in reverse order; `run` returns when they have ended."""
        if not self._stopping:
            self._stopping = True
            names = [member.entry.name for member in reversed(self._started) if member.command is not None]
            logger.info("%s: stopping %s", why, ", ".join(names) or "the launch")
            for task in self._tasks:
                task.cancel()

    def kill(self) -> None:
        """End all commands at once, without a chance to clean up."""
        for member in self._started:
            if member.command is not None and not member.command.ended.done():
                member.command.send(signal.SIGKILL)
                self._failed(SIGNALLED + signal.SIGKILL)

    async def _supervise(self, member: _Member) -> None:
        """Run one entry from its turn to its end."""
        for name in member.entry.after:
            await self._members[name].ready.wait()
        async with asyncio.TaskGroup() as tasks:
            readiness = tasks.create_task(self._become_ready(member))
            code = await self._keep_running(member)
            readiness.cancel()
        self._end(member, code)

    async def _become_ready(self, member: _Member) -> None:
        entry = member.entry
        loop = asyncio.get_running_loop()
        started = loop.time()
        try:
            async with asyncio.timeout(entry.ready_timeout):
                with call_after(
                    REPORT_WAITING_AFTER, lambda: logger.info("waiting for %s: %s", entry.name, entry.condition)
                ):
                    await self._wait_ready(entry)
                    if entry.ends:
                        await loop.create_future()  # `_end` says whether it is ready
        except TimeoutError:
            logger.error("%s is not ready after %g s: %s", entry.name, entry.ready_timeout, entry.condition)
            self._failed(TIMED_OUT)
            self.stop(f"{entry.name} is not ready")
            return
        member.ready.set()
        if entry.condition != "started":
            logger.info("%s is ready after %.1f s: %s", entry.name, loop.time() - started, entry.condition)

    async def _keep_running(self, member: _Member) -> int:
        """Run a command, and again as its restart policy says; returns its last exit code."""
        entry = member.entry
        loop = asyncio.get_running_loop()
        backoff = Backoff(random_of(loop), first=_FIRST_RESTART, longest=_LONGEST_RESTART)
        self._started.append(member)
        while True:
            started = loop.time()
            member.command = command = self._start(entry)
            await asyncio.wait([command.ended])  # unlike `await command.ended`, leaves the future alone when cancelled
            code = command.ended.result()
            member.command = None
            if entry.restart == "never" or code == USAGE or (code == 0 and entry.restart == "on-failure"):
                return code
            if loop.time() - started > _STABLE:
                backoff.reset()
            delay = backoff.delay()
            logger.warning("%s ended with %s; it starts again in %.1f s", entry.name, describe(code), delay)
            await asyncio.sleep(delay)

    def _end(self, member: _Member, code: int) -> None:
        """Act on the end of a command that is not started again."""
        entry = member.entry
        if code:
            logger.error("%s ended with %s", entry.name, describe(code))
            self._failed(code)
        else:
            logger.info("%s has ended", entry.name)
        if not member.ready.is_set():
            if code == 0 and entry.ends:
                member.ready.set()
            else:
                self._failed(1)
                self.stop(f"{entry.name} ended before it was ready ({entry.condition})")
        if entry.required:
            self.stop(f"{entry.name} is required")

    async def _stop_all(self) -> None:
        for member in reversed(self._started):
            if member.command is not None:
                await self._stop(member.entry, member.command)

    async def _stop(self, entry: Entry, command: RunningCommand) -> None:
        """Stop one command: by SIGTERM, and by SIGKILL if it has not ended in time."""
        if not command.ended.done():
            command.send(signal.SIGTERM)
            await asyncio.wait([command.ended], timeout=entry.stop_timeout)
        if not command.ended.done():
            logger.error("%s has not ended %g s after SIGTERM: killed", entry.name, entry.stop_timeout)
            command.send(signal.SIGKILL)
            await asyncio.wait([command.ended])
        code = command.ended.result()
        if code in _SIGNALLED:
            logger.warning("%s was ended by %s, without its own clean-up", entry.name, describe(code))
        elif code:
            logger.error("%s ended with %s", entry.name, describe(code))
            self._failed(code)

    def _failed(self, code: int) -> None:
        self.exit_code = self.exit_code or code


def describe(code: int) -> str:
    """Return what an exit code means, for messages."""
    if code <= SIGNALLED:
        return f"exit code {code}"
    try:
        return signal.Signals(code - SIGNALLED).name
    except ValueError:
        return f"exit code {code}"
