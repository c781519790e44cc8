"""`r2p app`: list, load, remove and start the apps of a firmware module, by its boot loader.

Each command restarts the module into its loader, unless it is there, and leaves it there: apps run only after
`r2p app run`, `--reboot` or `r2p module reboot`.
"""

import asyncio
import contextlib
import sys
from collections.abc import AsyncIterator, Iterator
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

import r2p
from r2p.loader import AppListing, InstalledApp, LoaderClient, LoaderSilent
from r2p.loader.deploy import Deployment, LoadedApp, remove_app
from r2p.loader.files import read_app
from r2p.loader.image import ENTRY_SIZE, AppFileError, AppImage
from r2p.loader.session import PATIENCE
from r2p.names import module_path
from r2p.tools import session
from r2p.tools.completion import complete_module
from r2p.tools.options import Format, time_option
from r2p.tools.output import Output, notify
from r2p.tools.session import Session, TimedOut, UsageError, wait_until

_APPS_START = 0.6  # seconds after a restart, by when the apps have been started
_SHOWS_LIFE = 5.0  # seconds in which firmware that repeats itself sends something

app = session.group("List, load, remove and start the apps of a firmware module.")

Name = Annotated[str, typer.Argument(metavar="MODULE", autocompletion=complete_module, show_default=False)]
AppName = Annotated[str, typer.Argument(metavar="APP", show_default=False)]
AppNames = Annotated[list[str], typer.Argument(metavar="APP", show_default=False)]
Files = Annotated[
    list[Path],
    typer.Argument(metavar="FILE", help="ELF or Intel HEX, each with its .toml beside it.", show_default=False),
]
MaybeFiles = Annotated[
    list[Path] | None, typer.Argument(metavar="[FILE]", help="With --reload: the other apps.", show_default=False)
]
Reboot = Annotated[bool, typer.Option("--reboot", help="Restart the module at the end: its apps run again.")]
Answer = Annotated[
    float | None, time_option("--timeout", "Give up (exit code 3) without an answer for this long; default: 1 s.")
]
Stack = Annotated[int | None, typer.Option("--stack", metavar="BYTES", help="The stack of an app, 512 at least.")]
AppNamed = Annotated[str | None, typer.Option("--name", metavar="NAME", help="The app's name; default: the file's.")]
Symbols = Annotated[
    Path | None, typer.Option("--symbols", metavar="FILE", help="The ELF file of the module's firmware.")
]


@session.command(app, "list")
async def list_(
    session: Session, module: Name, *, reboot: Reboot = False, timeout: Answer = None, format: Format = None
) -> None:
    """List the apps of a module, in their order in its flash.

    The module restarts into its boot loader: all its nodes end. Sizes are in bytes; ram is what .data and .bss take.
    """
    output = Output(format)
    async with _client(session, module, timeout, reboot=reboot) as client:
        await _enter(session, client)
        listing = await client.list_apps()
        rows = [_row(each, await client.is_enabled(each.name)) for each in listing.apps]
        await output.table(rows, ["app", "enabled", "address", "program", "ram", "stack", "config"])
        if not rows:
            notify(f"{module} has no apps")
        memory = _memory(listing)
        free, begin = memory["flash_free"], memory["next_program"]
        await output.remark(f"free: {free} bytes of flash, where the next program begins at {begin}")


@session.command(app, "info")
async def info(
    session: Session,
    module: Name,
    name: Annotated[str | None, typer.Argument(metavar="[APP]", show_default=False)] = None,
    *,
    reboot: Reboot = False,
    timeout: Answer = None,
    format: Format = None,
) -> None:
    """Show an app's addresses and sizes, or the memory of the module."""
    output = Output(format)
    async with _client(session, module, timeout, reboot=reboot) as client:
        await _enter(session, client)
        listing = await client.list_apps()
        if name is None:
            await output.put({"module": module} | _memory(listing))
            return
        found = _find(listing, name, module)
        await output.put({"module": module} | _record(found, await client.is_enabled(name)))


@session.command(app, "load")
async def load(
    session: Session,
    module: Name,
    files: Files,
    *,
    name: AppNamed = None,
    stack: Stack = None,
    symbols: Symbols = None,
    enable: Annotated[bool, typer.Option("--enable", help="Let them start with the module.")] = False,
    reload: Annotated[bool, typer.Option("--reload", help="In place of all apps that the module has.")] = False,
    reboot: Reboot = False,
    timeout: Answer = None,
    format: Format = None,
) -> None:
    """Load apps into the flash of a module.

    All of them are loaded in one start of its boot loader. What can't work is refused before anything is erased. With
    --reload, apps of the same name keep their config.
    """
    apps = _read(files, name=name, stack=stack, symbols=symbols, enable=enable)
    async with _client(session, module, timeout, reboot=reboot) as client:
        await _enter(session, client)
        with _deployment(client, apps) as deployment:
            loaded = await (deployment.replace() if reload else deployment.add())
        await _put_loaded(Output(format), module, loaded)
    idle = [each.app.name for each in loaded if not each.enabled]
    if idle:
        notify(f"not started yet: r2p app run {module} {' '.join(idle)}")


@session.command(app, "remove")
async def remove(
    session: Session,
    module: Name,
    name: AppName,
    files: MaybeFiles = None,
    *,
    reload: Annotated[bool, typer.Option("--reload", help="Remove all apps, and load the others anew.")] = False,
    stack: Stack = None,
    symbols: Symbols = None,
    reboot: Reboot = False,
    timeout: Answer = None,
    format: Format = None,
) -> None:
    """Remove an app: the last one, or with --reload any.

    With --reload, give the files of all others: all apps are removed, and these are loaded anew. They keep their
    config, and whether they start with the module.
    """
    if bool(files) != reload:
        raise UsageError("give --reload and the files of the other apps, or neither of them")
    apps = _read(files or [], stack=stack, symbols=symbols)
    async with _client(session, module, timeout, reboot=reboot) as client:
        await _enter(session, client)
        if reload:
            with _deployment(client, apps) as deployment:
                loaded = await deployment.replace(without=name)
            await _put_loaded(Output(format), module, loaded)
        else:
            await remove_app(client, name)
        notify(f"{module}: {name} is removed")


@session.command(app, "enable")
async def enable(
    session: Session, module: Name, names: AppNames, *, reboot: Reboot = False, timeout: Answer = None
) -> None:
    """Let apps start with the module, from its next start on."""
    await _enable(session, module, names, enabled=True, reboot=reboot, timeout=timeout)


@session.command(app, "disable")
async def disable(
    session: Session, module: Name, names: AppNames, *, reboot: Reboot = False, timeout: Answer = None
) -> None:
    """Let apps stay in the flash without starting."""
    await _enable(session, module, names, enabled=False, reboot=reboot, timeout=timeout)


async def _enable(
    session: Session, module: str, names: list[str], *, enabled: bool, reboot: bool, timeout: float | None
) -> None:
    async with _client(session, module, timeout, reboot=reboot) as client:
        await _set_enabled(session, client, names, enabled=enabled)


@session.command(app, "run")
async def run(session: Session, module: Name, names: AppNames, *, timeout: Answer = None) -> None:
    """Let apps start with the module, and restart it."""
    async with _client(session, module, timeout) as client:
        await _set_enabled(session, client, names, enabled=True)
        await _reboot(session, client)
        started = asyncio.get_running_loop().time()
        with session.waiting(f"a sign of life of {module}"):
            alive = await wait_until(lambda: _heard_at(session, client) > started + _APPS_START, _SHOWS_LIFE)
    if alive:
        notify(f"{module} runs with {', '.join(names)}")
    else:
        notify(
            f"{module} has been silent since it started its apps. Firmware that repeats nothing is; any other was "
            f"halted by an app, as by too small a stack, and is at each start: start it in boot mode by hand, then "
            f"r2p app disable {module} {' '.join(names)}"
        )


def _heard_at(session: Session, client: LoaderClient) -> float:
    """Return when the module was last heard of; the topics of a link are its own, where no other module is."""
    view = client.view()
    if view is None:
        return 0.0
    ages = [view.age]
    network = session.module.network
    if [each.link for each in network.modules()].count(view.link) == 1:
        topics = [
            each for each in network.topics().values() if {*each.published_on, *each.subscribed_on} == {view.link}
        ]
        ages += [each.age for each in topics if each.age is not None]
    return asyncio.get_running_loop().time() - min(ages)


# The client


@contextlib.asynccontextmanager
async def _client(
    session: Session, module: str, timeout: float | None, *, reboot: bool = False
) -> AsyncIterator[LoaderClient]:
    """Open a client of a module's loader; restart the module at the end, or say that it stays there."""
    module_path(module)
    if not session.settings.via:
        raise UsageError("no network to find the module on: give --via tcp:HOST:PORT or set R2P_VIA")
    await session.settle(wait=0)
    try:
        async with LoaderClient(session.module, module, patience=timeout or PATIENCE) as client:
            try:
                yield client
                if reboot:
                    await _reboot(session, client)
            finally:
                if session.verbose:
                    dropped = "".join(f", {count} dropped ({reason})" for reason, count in client.dropped.items())
                    notify(f"{module}: {client.repeated} messages were repeated{dropped}")
                if client.restarted and client.is_there and client.connected:
                    notify(f"{module} stays in its boot loader; r2p module reboot {module} starts its enabled apps")
    except LoaderSilent as error:
        raise TimedOut(str(error)) from error


async def _enter(session: Session, client: LoaderClient) -> None:
    with session.waiting(f"{client.name} to restart into its boot loader"):
        await client.enter()


async def _reboot(session: Session, client: LoaderClient) -> None:
    with session.waiting(f"{client.name} to restart"):
        await client.leave()


async def _set_enabled(session: Session, client: LoaderClient, names: list[str], *, enabled: bool) -> None:
    await _enter(session, client)
    listing = await client.list_apps()
    for name in names:  # all of them, before any is changed
        _find(listing, name, client.name)
    for name in names:
        changed = await client.enable(name, enabled=enabled)
        state = "starts with the module" if enabled else "does not start with the module"
        notify(f"{client.name}: {name} {state}{'' if changed else ', as before'}")


def _find(listing: AppListing, name: str, module: str) -> InstalledApp:
    found = listing.find(name)
    if found is None:
        raise r2p.Error(f"{module} has no app {name}; it has {', '.join(each.name for each in listing.apps) or 'none'}")
    return found


# Loading


def _read(files: list[Path], **given: Any) -> list[AppImage]:
    """Read the files. Raises UsageError."""
    if given.get("name") is not None and len(files) > 1:
        raise UsageError("--name is for one file: each of several needs a name of its own, in its .toml")
    if given.pop("enable", False):
        given["enabled"] = True
    if (symbols := given.pop("symbols", None)) is not None:
        given["symbols"] = str(symbols.absolute())
    try:
        return [read_app(each, {key: value for key, value in given.items() if value is not None}) for each in files]
    except AppFileError as error:
        raise UsageError(str(error)) from error


@contextlib.contextmanager
def _deployment(client: LoaderClient, apps: list[AppImage]) -> Iterator[Deployment]:
    """Load with a progress bar; when that is interrupted, say what it means for the module."""
    with _progress() as progress:
        deployment = Deployment(client, apps, progress=progress, report=notify)
        try:
            yield deployment
        except asyncio.CancelledError:
            names = ", ".join(each.name for each in apps)
            notify(f"interrupted: {client.name} may lack {names}{deployment.lost}. The same command begins anew")
            raise


@contextlib.contextmanager
def _progress() -> Iterator[Any]:
    """Show a bar for each app at a terminal; elsewhere a line for each quarter."""
    if not sys.stderr.isatty():
        yield _ProgressLines()
        return
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), auto_refresh=False) as bars:
        tasks: dict[str, Any] = {}

        def show(name: str, done: int, total: int) -> None:
            task = tasks.get(name)
            if task is None:
                task = tasks[name] = bars.add_task(name, total=total)
            bars.update(task, completed=done)
            bars.refresh()

        yield show


class _ProgressLines:
    """Prints a line for each quarter of an app."""

    def __init__(self) -> None:
        self._printed: tuple[str, int] = ("", 0)

    def __call__(self, name: str, done: int, total: int) -> None:
        quarter = 4 * done // max(1, total)
        if (name, quarter) != self._printed and (quarter or not done):
            self._printed = name, quarter
            notify(f"{name}: {done} of {total} records")


async def _put_loaded(output: Output, module: str, loaded: list[LoadedApp]) -> None:
    for each in loaded:
        record = {"module": module} | _record(each.app, each.enabled) | {"kept": each.kept, "verified": _verified(each)}
        checked = f"its entry, its flag and {len(each.config)} bytes of config" if each.config else "its entry and flag"
        kept = ", kept from before" if each.kept else ""
        text = (
            f"{each.app.name}: {each.size} bytes at {record['program_address']}; read back: {checked}{kept}; the rest "
            "can't be read, but the loader checked each record"
        )
        await output.put(record, text, wrap=True)


def _verified(loaded: LoadedApp) -> list[str]:
    return ["entry", "enabled", *(["config"] if loaded.config else [])]


# Records


def _row(app: InstalledApp, enabled: bool) -> dict[str, Any]:
    setup = app.setup
    return {
        "app": app.name,
        "enabled": enabled,
        "address": _hex(app.addresses.infoadr),
        "program": setup.pgmlen,
        "ram": setup.bsslen + setup.datalen,
        "stack": setup.stacklen,
        "config": app.outcome.cfglen,
    }


def _record(app: InstalledApp, enabled: bool) -> dict[str, Any]:
    setup, addresses, outcome = app.setup, app.addresses, app.outcome
    return {
        "app": app.name,
        "enabled": enabled,
        "stack": setup.stacklen,
        "entry_address": _hex(addresses.infoadr),
        "program_address": _hex(addresses.pgmadr),
        "program": setup.pgmlen,
        "data_address": _hex(addresses.dataadr),
        "data": setup.datalen,
        "bss_address": _hex(addresses.bssadr),
        "bss": setup.bsslen,
        "main_address": _hex(outcome.mainadr),
        "config_address": _hex(outcome.cfgadr),
        "config": outcome.cfglen,
    }


def _memory(listing: AppListing) -> dict[str, Any]:
    memory = listing.summary
    used = [each for app in listing.apps for each in app.ram]
    return {
        "apps": len(listing.apps),
        "flash": [_hex(memory.pgmstartadr), _hex(memory.pgmendadr)],
        "flash_free": max(0, memory.pgmendadr - memory.freeadr),
        "next_program": _hex(memory.freeadr + ENTRY_SIZE),
        "ram": [_hex(memory.ramstartadr), _hex(memory.ramendadr)],
        "ram_used": sum(map(len, used)),
    }


def _hex(address: int) -> str:
    return f"{address:#010x}"
