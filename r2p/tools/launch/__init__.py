"""`r2p launch`: start the commands of a file as one group, or write units for systemd that do.

The command is here, and how it waits for conditions. `entries` checks the file, `group` supervises the commands
(without processes, so that tests run it under virtual time), `processes` starts them, and `systemd` writes units.
"""

import asyncio
import contextlib
import os
import signal
from collections.abc import Awaitable, Callable, Iterator
from pathlib import Path
from typing import Annotated

import typer

from r2p.tools.completion import complete_entry
from r2p.tools.config import Settings, UsageError, did_you_mean, find, read, settings
from r2p.tools.config_show import File
from r2p.tools.launch import systemd as units
from r2p.tools.launch.entries import Entry, parse_entries
from r2p.tools.launch.group import Group, RunningCommand, logger
from r2p.tools.launch.processes import LinePrinter, make_environment, start
from r2p.tools.options import Quiet, Verbose, Via
from r2p.tools.output import PipeClosed, Unwritable
from r2p.tools.session import TimedOut, check_urls, execute, join
from r2p.tools.waiting import appeared

_POLL = 0.1  # seconds between two tries to connect to a port
_GOODBYE = 0.5  # seconds that the server has to end such a connection


def command(
    file: File = None,
    ready: Annotated[
        str | None,
        typer.Option(
            metavar="NAME", autocompletion=complete_entry, help="Start nothing, but wait until this entry is ready."
        ),
    ] = None,
    systemd: Annotated[bool, typer.Option("--systemd", help="Start nothing, but write units for systemd.")] = False,
    output: Annotated[Path, typer.Option("--output", "-o", metavar="DIR", help="Where --systemd writes.")] = Path(),
    via: Via = None,
    verbose: Verbose = 0,
    quiet: Quiet = 0,
) -> None:
    """Start the commands of [launch.NAME] as one group in the foreground, and stop them in reverse order on Ctrl-C.

    The exit code is that of the first command that failed, or 3 if one was not ready in time.
    """
    codes: list[int] = []

    async def main() -> None:
        path = (file or find() or Path("r2p.toml")).absolute()
        entries = parse_entries(path, read(path))
        chosen = settings(via, path, tool=True)
        check_network(path, entries, chosen)
        if systemd:
            units.write(path, entries, output, via)
        elif ready is not None:
            await wait_once(entries, ready, chosen)
        else:
            codes.append(await launch(path, entries, chosen, via))

    starts = ready is None and not systemd  # only then the group handles signals itself
    execute(main, verbose=verbose, quiet=quiet, endless=starts, run=_run if starts else None)
    if any(codes):
        raise typer.Exit(codes[0])


def _run(main: Callable[[], Awaitable[object]]) -> None:
    """Run without the time limit that `r2p.run_main` sets after a signal: commands have `stop_timeout` of their own."""

    async def run() -> None:
        await main()

    asyncio.run(run())


async def launch(path: Path, entries: list[Entry], settings: Settings, via: list[str] | None) -> int:
    """Run the group until all commands have ended, or signals stop it; returns the exit code."""
    if os.name != "posix":
        raise UsageError("r2p launch needs Linux or macOS: start the commands one by one")
    loop = asyncio.get_running_loop()

    def stop() -> None:
        with contextlib.suppress(RuntimeError):  # the loop is closed
            loop.call_soon_threadsafe(group.stop, "the output is closed")

    printer = LinePrinter([entry.name for entry in entries], stop)
    environment = make_environment(path, via)

    def start_command(entry: Entry) -> RunningCommand:
        return start(entry, path.parent, environment, printer)

    group = Group(entries, start_command, lambda entry: wait_ready(entry, settings))
    logger.info("%s: %s; Ctrl-C stops them", path.name, ", ".join(entry.name for entry in entries))
    with _signals(group):
        code = await group.run()
    if isinstance(printer.error, BrokenPipeError):
        raise PipeClosed
    if printer.error is not None:
        raise Unwritable(f"can't write the output: {printer.error.strerror}")
    return code


@contextlib.contextmanager
def _signals(group: Group) -> Iterator[None]:
    """Stop the group at the first signal, and kill its commands at the second."""
    received: list[str] = []

    def handle(name: str) -> None:
        received.append(name)
        if len(received) == 1:
            group.stop(name)
        else:
            group.kill()

    loop = asyncio.get_running_loop()
    numbers = [signal.SIGINT, signal.SIGTERM]
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:  # nohup ignores it
        numbers.append(signal.SIGHUP)
    for number in numbers:
        loop.add_signal_handler(number, handle, number.name)
    try:
        yield
    finally:
        for number in numbers:
            loop.remove_signal_handler(number)


def check_network(path: Path, entries: list[Entry], settings: Settings) -> None:
    """Raise UsageError for a condition that needs a network, if none is named, or its URL is not valid."""
    for entry in entries:
        if entry.seen and not settings.via:
            raise UsageError(
                f"{path}: [launch.{entry.name}] ready: no network to look for {entry.condition} on; "
                "set via at the top of the file, or R2P_VIA"
            )
    check_urls(settings.via, settings.via_source)


async def wait_once(entries: list[Entry], name: str, settings: Settings) -> None:
    """Wait until the entry of that name, which runs elsewhere, is ready. Raises TimedOut."""
    by_name = {entry.name: entry for entry in entries}
    if name not in by_name:
        raise UsageError(f"--ready {name}: there is no such entry; {did_you_mean(name, by_name, 'entries')}")
    entry = by_name[name]
    try:
        async with asyncio.timeout(entry.ready_timeout):
            await wait_ready(entry, settings)
    except TimeoutError:
        raise TimedOut(f"{name} is not ready after {entry.ready_timeout:g} s: {entry.condition}") from None


async def wait_ready(entry: Entry, settings: Settings) -> None:
    """Wait until the ports of an entry accept connections, and all that it is to show is on the network."""
    for host, port in entry.ports:
        await _wait_for_port(host, port)
    if entry.seen:
        async with join(settings, name="launch") as session:
            for kind, name in entry.seen:
                await appeared(session, kind, name)


async def _wait_for_port(host: str, port: int) -> None:
    while True:
        try:
            reader, writer = await asyncio.open_connection(host, port)
        except OSError:
            await asyncio.sleep(_POLL)
        else:
            break
    with contextlib.suppress(OSError, TimeoutError):  # end in order: the server would log a reset as a broken link
        async with asyncio.timeout(_GOODBYE):
            writer.write_eof()
            await reader.read()
    writer.close()
