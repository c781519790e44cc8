"""How every tool joins the network, talks to people, and ends.

A tool is a coroutine function whose first parameter is a `Session`; `tool()` makes a command of it:

    app = session.group("List and watch things.")

    @session.command(app, "list")
    async def list_(session: Session, ..., format: Format = None) -> None:
        "One line of help."

That adds --via, -v and -q, joins as an observer, and maps how it ends to an exit code: 0 fine (also Ctrl-C, SIGTERM
and a closed pipe), 1 an error of r2p, 2 `Usage`, 3 `TimedOut`. The coroutine function stays what it is, so tests call
it under virtual time, inside of `async with join(Settings(via=["memory:lab"])) as session`. A command outside of a
group is `command = session.tool(body)`; one that joins by itself (as `run` does) takes `settings()` and `execute()`,
with the options `Via`, `Verbose`, `Quiet`.
"""

import asyncio
import contextlib
import errno
import functools
import inspect
import os
import stat
import string
import tomllib
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import msgspec
import typer

import r2p
from r2p.clock import random_of
from r2p.log_lines import printable
from r2p.tools.output import PipeClosed, Unwritable, abandon_stdout
from r2p.tools.terminal import log_to_stderr, say
from r2p.transports.url import duration, open_transport

B = TypeVar("B", bound=Callable[..., Awaitable[None]])

CONFIG = "r2p.toml"
PATIENCE = 1.0
"""Seconds that a tool waits before it says what for."""

_DESCRIPTORS = 12  # that are free: an event loop, its wake-ups, and a link
_SETTLED = 0.3  # seconds without news, after which an r2p peer has told everything
_FIRMWARE = 1.5  # seconds in which a module that repeats itself each half second should have said something
_SETTLED_ON_BUS = 0.6  # ... on a bus, where all speak in turn
_MOST = 8.0  # seconds that a tool listens while there is news: a bus of 1 Mbit/s bears 100 messages a second
_BUSES = ("rtcan", "sim")
_LOOK = 0.05  # seconds between two looks for news
_LOOPBACK = {"": "127.0.0.1", "0.0.0.0": "127.0.0.1", "[::]": "[::1]"}
_LINK_UP = 5.0  # seconds that a look at the network waits for the first link


class Usage(Exception):
    """The user asked for something that can't be: exit code 2."""


class TimedOut(Exception):
    """What was waited for did not come: exit code 3."""


def seconds(text: str) -> float:
    """A duration of more than 0 s from "10ms", "20us" or seconds, for an option's `parser`."""
    try:
        value = duration(text)
    except ValueError as error:
        raise typer.BadParameter(str(error)) from error
    if value <= 0:
        raise typer.BadParameter(f"{text!r}: a time of more than 0 is needed")
    return value


Via = Annotated[
    list[str] | None,
    typer.Option("--via", metavar="URL", help="How to join: tcp:HOST:PORT, serial:DEVICE, ... (may repeat)."),
]
Verbose = Annotated[int, typer.Option("--verbose", "-v", count=True, show_default=False, help="Tell more.")]
Quiet = Annotated[int, typer.Option("--quiet", "-q", count=True, show_default=False, help="Tell less on stderr.")]
Format = Annotated[
    Literal["yaml", "json", "csv"] | None,
    typer.Option("--format", help="Default: for people at a terminal, JSON lines in a pipe."),
]
Timeout = Annotated[
    float | None,
    typer.Option(
        "--timeout", parser=seconds, metavar="TIME", help="Give up (exit 3) when nothing comes for so long: 2, 500ms."
    ),
]
Wait = Annotated[
    float | None,
    typer.Option(
        "--wait", parser=seconds, metavar="TIME", help="Listen for so long; firmware tells one topic each 0.5 s."
    ),
]


class Settings(msgspec.Struct):
    """What the command line, R2P_VIA and r2p.toml say. `types` are "package.module:Class" by topic."""

    via: list[str] = []
    types: dict[str, str] = {}
    remap: dict[str, str] = {}
    module: str | None = None


class _File(msgspec.Struct, forbid_unknown_fields=True):
    """The keys of r2p.toml."""

    via: str | list[str] = []
    module: str | None = None
    types: dict[str, str] = {}
    remap: dict[str, str] = {}


def settings(via: list[str] | None = None, directory: Path | None = None, *, tool: bool = False) -> Settings:
    """The settings; precedence for `via`: argument, R2P_VIA, r2p.toml in the directory (default: working directory).

    The last two tell how the robot's program joins. Where that listens, a `tool` beside it connects to it.
    Raises Usage for an r2p.toml that can't be read, or that other users may write.
    """
    file = _read(directory)
    from_file = [file.via] if isinstance(file.via, str) else file.via
    shared = os.environ.get("R2P_VIA", "").split() or from_file
    return Settings(via or [_beside(url) if tool else url for url in shared], file.types, file.remap, file.module)


def check_urls(via: list[str]) -> None:
    """Raises Usage for a URL that names no transport, or not as that takes it; it opens nothing."""
    for url in via:
        try:
            open_transport(url)
        except r2p.TransportError as error:
            if isinstance(error.__cause__, ImportError):  # the URL is right, and this installation lacks something
                raise
            raise Usage(str(error)) from error


def _beside(url: str) -> str:
    """The URL by which a tool on the same machine reaches a program with this one."""
    scheme, _, address = url.partition(":")
    if scheme != "tcp-listen":
        return url
    host, colon, port = address.rpartition(":")
    if not colon or not port.isdecimal():  # no port: the usual one, or nothing but a port
        return f"tcp:127.0.0.1:{address}" if address.isdecimal() else f"tcp:{_LOOPBACK.get(address, address)}"
    return f"tcp:{_LOOPBACK.get(host, host)}:{port}"


def _read(directory: Path | None) -> _File:
    try:
        path = (directory or Path.cwd()) / CONFIG
    except FileNotFoundError:  # the working directory has been removed
        return _File()
    try:
        with path.open(encoding="utf-8") as file:
            check_owned(path, os.fstat(file.fileno()))
            return msgspec.convert(tomllib.loads(file.read()), _File)
    except FileNotFoundError:
        return _File()
    except RecursionError as error:
        raise Usage(f"{path}: it is nested too deeply") from error
    except msgspec.ValidationError as error:
        raise Usage(f"{path}: {error}; it knows {', '.join(_File.__struct_fields__)}") from error
    except (OSError, ValueError) as error:  # unreadable, or no TOML
        raise Usage(f"{path}: {error}") from error


def check_owned(path: Path, status: os.stat_result) -> None:
    """Raises Usage for a configuration that another user, who is not root, may write: it can name code to run."""
    if os.name != "posix":
        return
    owners = {0, os.geteuid()}
    if os.geteuid() == 0:  # by way of sudo, whoever has called that
        owners.add(int(os.environ.get("SUDO_UID", "0")))
    if status.st_uid not in owners:
        raise Usage(f"{path} belongs to another user, and it can name code to run: chown it, or work elsewhere")
    if status.st_mode & stat.S_IWOTH or (status.st_mode & stat.S_IWGRP and not _is_private(status)):
        raise Usage(f"{path} can be written by other users, and it can name code to run: chmod go-w {path}")


def _is_private(status: os.stat_result) -> bool:
    """Whether the group of a file is its owner's own, of the same name and without other members."""
    import grp
    import pwd

    try:
        group, owner = grp.getgrgid(status.st_gid), pwd.getpwuid(status.st_uid).pw_name
    except KeyError:
        return False
    return group.gr_name == owner and set(group.gr_mem) <= {owner}


def _check_descriptors() -> None:
    """Raises r2p.Error where so few files may be open that not even an event loop can run."""
    opened: list[int] = []
    try:
        for _ in range(_DESCRIPTORS):
            opened.append(os.open(os.devnull, os.O_RDONLY))  # noqa: PERF401 - what was opened is closed
    except OSError as error:
        raise r2p.Error(f"{error.strerror}: r2p needs {_DESCRIPTORS} more at least (ulimit -n 1024)") from error
    finally:
        for each in opened:
            os.close(each)


@contextlib.contextmanager
def later(seconds: float, call: Callable[[], object]) -> Iterator[None]:
    """Call it if the block takes so long."""
    timer = asyncio.get_running_loop().call_later(seconds, call)
    try:
        yield
    finally:
        timer.cancel()


class Session:
    """A tool on the network: its module, and its voice (stderr; stdout is for output alone)."""

    def __init__(self, module: r2p.Module, settings: Settings, *, name: str = "tool", verbose: int = 0) -> None:
        self.module = module
        self.settings = settings
        self.verbose = verbose
        self._name = name

    @functools.cached_property
    def node(self) -> r2p.Node:
        """A node to publish and subscribe with; it lives as long as the session."""
        return self.module.start(_live, name=self._name)

    @property
    def where(self) -> str:
        """The network that it is on, in words."""
        return ", ".join(self.settings.via) or "this tool alone"

    def say(self, text: str) -> None:
        """Tell the user."""
        say(text)

    @contextlib.contextmanager
    def waiting(self, what: str | Callable[[], str]) -> Iterator[None]:
        """While the block waits: after a second, say what for (a function is asked then)."""

        def tell() -> None:
            self.say(f"waiting for {what if isinstance(what, str) else what()} on {self.where}")

        with later(PATIENCE, tell):
            yield

    def only_module(self, link: str) -> str:
        """The name of the module at the other end of a link; "?" if there is not just one."""
        views = self.module.network.modules()
        names = {view.name for view in views if view.link == link and view.state != "observer"}
        return names.pop() if len(names) == 1 else "?"

    async def settle(self, wait: float | None = None, *, of: str = "topics") -> None:
        """Listen to the network until the others have told what they have, or for `wait` seconds.

        `of` is what it listens for, in words. r2p modules are asked and answer at once, gateways for those behind
        them; firmware repeats itself step by step. Where there may be more to come, that is said. Raises
        r2p.TransportError if no link comes up.
        """
        if not self.settings.via:
            return
        await self._link_up()
        if wait is not None:
            await asyncio.sleep(wait)
            return
        self.module.query()
        told = await self._told()
        if self._hears_firmware() and (not told or self._expects_more()):
            self.say(f"firmware tells one thing each half second: there may be more {of}, listen longer with --wait 5")
        elif not told:
            self.say(f"there was news to the end: there may be more {of}, listen longer with --wait 20")

    async def _told(self) -> bool:
        """Wait until nobody has news any more; False if that was given up."""
        on_bus = any(url.partition(":")[0] in _BUSES for url in self.settings.via)
        quiet = _SETTLED_ON_BUS if on_bus else _SETTLED
        loop = asyncio.get_running_loop()
        start = news_at = loop.time()
        known = 0
        while (now := loop.time()) - start < _MOST:
            if now - news_at > quiet and (now - start > _FIRMWARE or not self._expects_more()):
                return True
            await asyncio.sleep(_LOOK)
            if (count := self._known()) != known:
                known, news_at = count, loop.time()
        return False

    async def _link_up(self) -> None:
        loop = asyncio.get_running_loop()
        end = loop.time() + _LINK_UP
        with self.waiting("a link"):
            while not any(link.up for link in self.module.links):
                if loop.time() > end:
                    raise r2p.TransportError(f"no connection on {self.where}")
                await asyncio.sleep(_LOOK)

    def _known(self) -> int:
        topics = self.module.network.topics().values()
        endpoints = sum(len(view.publishers) + len(view.subscribers) for view in topics)
        return len(topics) + endpoints + len(self.module.network.modules())

    def _expects_more(self) -> bool:
        """Whether there is a link on which no r2p module is heard that would answer at once, or nothing but modules.

        A module has topics; a gateway passes those of others on only after it has looked for other gateways.
        """
        told = self._answering() & self._heard()
        return any(link.up and link.name not in told for link in self.module.links)

    def _answering(self) -> set[str]:
        return {view.link for view in self.module.network.modules() if view.instance is not None}

    def _hears_firmware(self) -> bool:
        """Whether somebody is heard who does not answer."""
        modules = self.module.network.modules()
        return any(view.instance is None for view in modules) or bool(self._heard() - self._answering())

    def may_have_firmware(self) -> bool:
        """Whether firmware was heard, or may be at the other end of a link on which no r2p module is."""
        there = {view.link for view in self.module.network.modules() if view.instance is None}
        silent = {link.name for link in self.module.links if link.up and link.passes_probes} - self._answering()
        return bool(there | silent)

    def _heard(self) -> set[str]:
        """Links on which there are topics."""
        views = self.module.network.topics().values()
        return {link for view in views for link in view.published_on + view.subscribed_on if link}


async def _live(node: r2p.Node) -> None:
    """The node of a tool: what it opens is used elsewhere."""
    await asyncio.get_running_loop().create_future()


@contextlib.asynccontextmanager
async def join(settings: Settings, *, name: str = "tool", verbose: int = 0) -> AsyncIterator[Session]:
    """Join the network as an observer, a module named `_` and six random characters; `name` is its node's."""
    if not settings.via:
        say("local only: this tool sees nothing but itself; give --via tcp:HOST:PORT, or set R2P_VIA")
    alphabet = string.ascii_lowercase + string.digits
    check_urls(settings.via)
    module_name = "_" + "".join(random_of(asyncio.get_running_loop()).choices(alphabet, k=6))
    async with r2p.Module(module_name, via=settings.via, observer=True, watchdog=False) as module:
        yield Session(module, settings, name=name, verbose=verbose)


def command(app: typer.Typer, name: str) -> Callable[[B], B]:
    """Decorate a coroutine function that takes a Session first, then its own arguments and options: it stays as it is,
    and `app` gets the command made of it.
    """

    def register(body: B) -> B:
        app.command(name)(tool(body))
        return body

    return register


def tool(body: Callable[..., Awaitable[None]]) -> Callable[..., None]:
    """The command made of such a coroutine function."""
    name = body.__name__.strip("_")

    def run(**given: Any) -> None:
        via, verbose, quiet = (given.pop(name) for name in _COMMON)

        async def main() -> None:
            async with join(settings(via, tool=True), name=name, verbose=verbose) as session:
                await body(session, **given)

        execute(main, verbose=verbose, quiet=quiet)

    own = list(inspect.signature(body, eval_str=True).parameters.values())[1:]
    parameters = [each.replace(kind=inspect.Parameter.KEYWORD_ONLY) for each in (*own, *_COMMON.values())]
    function: Any = run
    function.__name__ = body.__name__
    function.__doc__ = body.__doc__
    function.__annotations__ = {each.name: each.annotation for each in parameters}
    function.__signature__ = inspect.Signature(parameters)
    return run


_COMMON = {
    name: inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation)
    for name, annotation, default in (("via", Via, None), ("verbose", Verbose, 0), ("quiet", Quiet, 0))
}


def group(help: str) -> typer.Typer:
    """A group of commands for `main.GROUPS`."""
    app = typer.Typer(
        help=help, no_args_is_help=True, add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False
    )
    app.callback()(_no_options)  # makes it a group even of one command
    return app


def _no_options() -> None:
    """A group has no options of its own."""


def execute(
    main: Callable[[], Awaitable[object]],
    *,
    verbose: int = 0,
    quiet: int = 0,
    run: Callable[[Callable[[], Awaitable[object]]], object] | None = None,
) -> None:
    """Run a command until it ends or a signal ends it; errors become exit codes. `run`: how, else `r2p.run_main`."""
    with log_to_stderr(verbose - quiet):
        try:
            _check_descriptors()
            (run or r2p.run_main)(main)
        except (Exception, BaseExceptionGroup) as error:  # noqa: BLE001 - sorted out by _explain, or raised again
            _explain(error)


def _explain(error: BaseException) -> None:
    """Tell what ended a command, and exit as it deserves; a bug is raised again."""
    leaves = list(_leaves(error))
    for leaf in leaves:
        if isinstance(leaf, PipeClosed):
            abandon_stdout()
            return
        if isinstance(leaf, Usage | r2p.InvalidName):  # names that did not come from a person raise nothing
            raise typer.BadParameter(printable(str(leaf), "\n")) from leaf
        if isinstance(leaf, TimedOut):
            say(str(leaf))
            raise typer.Exit(3) from leaf
    if not all(isinstance(leaf, r2p.Error | Unwritable) or _is_exhausted(leaf) for leaf in leaves):
        raise error
    for leaf in leaves:
        say(leaf.message if isinstance(leaf, r2p.NodeCrashed) else str(leaf))
    raise typer.Exit(1) from error


def _is_exhausted(error: BaseException) -> bool:
    """Whether there were too many open files, in this process or on this computer."""
    return isinstance(error, OSError) and error.errno in (errno.EMFILE, errno.ENFILE)


def _leaves(error: BaseException) -> Iterator[BaseException]:
    """The errors in nested groups; what nodes raised is one error, its details have been logged."""
    if isinstance(error, BaseExceptionGroup) and not isinstance(error, r2p.NodeCrashed):
        for each in error.exceptions:
            yield from _leaves(each)
    else:
        yield error
