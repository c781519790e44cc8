"""The session of a command: how it joins the network, waits for discovery, and ends with an exit code.

A command is a coroutine function whose first parameter is a `Session`:

    app = session.group("List and watch things.")

    @session.command(app, "list")
    async def list_(session: Session, ..., format: Format = None) -> None:
        "One line of help."

`command` adds --via, -v and -q, joins as an observer, and maps the end to an exit code: 0 for success (also a closed
pipe), 1 for an error of r2p, 2 for `UsageError`, 3 for `TimedOut`. A signal is a success for a command that is
`endless`, as it can't end in another way, and 130 for all others. The function itself is unchanged, so tests call it
under virtual time, inside `async with join(Settings(via=["memory:lab"])) as session`.

Commands of the bus get a `BusMonitor` instead of a Session (`opening`). Commands that join no network as a tool are
`standalone`, with the option `Via` and `settings()`, or a `service`, such as `run`. What commands need of `config` is
here, too.

Commands wait here: `Session.settle` for announcements, `Session.look_for` for what the user has named before they say
that it is missing, `Session.waiting` with a report, `patience` for messages,
`wait_until` for a condition, and `moments` for the time.
"""

import asyncio
import contextlib
import errno
import functools
import inspect
import math
import os
import signal
import string
from collections.abc import AsyncIterator, Awaitable, Callable, Coroutine, Iterable, Iterator, Mapping
from typing import Any, TypeVar

import typer

import r2p
from r2p.clock import random_of
from r2p.log_lines import printable
from r2p.startup import INTERRUPTED
from r2p.tools.announcements import Announcements
from r2p.tools.config import Settings as Settings
from r2p.tools.config import UsageError as UsageError
from r2p.tools.config import settings as settings
from r2p.tools.options import Quiet, Verbose, Via
from r2p.tools.output import PipeClosed, Unwritable, abandon_stdout, log_to_stderr, notify
from r2p.transports.url import open_transport

B = TypeVar("B", bound=Callable[..., Awaitable[None]])
Opening = Callable[[Settings], contextlib.AbstractAsyncContextManager[Any]]
"""Opens what a command works on instead of a Session."""
Endless = Callable[[Mapping[str, Any]], bool]
"""Says of the arguments and options of a command whether it goes on until a signal ends it."""
Joins = Callable[[Mapping[str, Any]], bool]
"""Says of the arguments and options of a command whether it joins the network."""
Run = Callable[[Callable[[], Coroutine[Any, Any, None]]], object]
"""Runs the main function of a command."""
Check = Callable[[Settings, Mapping[str, Any]], object]
"""Raises UsageError for arguments and options that can't be right, whatever the network has."""

REPORT_WAITING_AFTER = 1.0
"""Seconds that a command waits before it reports what it waits for."""

IN_ONE_PROGRAM = ("memory:", "sim:", "rtcan:virtual:")
"""How the URLs of networks begin that no other program can join."""

_DESCRIPTORS = 12  # free file descriptors that are needed: an event loop, its wake-ups, and a link
_TOO_MANY_FILES = (errno.EMFILE, errno.ENFILE)  # of this process, or of the computer
_POLL = 0.02  # seconds between two checks of a condition
_LINK_UP = 5.0  # seconds to wait for the first link
_GIVE_UP_AFTER = 0.9  # seconds after which a tool ends if it is known of each link why it does not come up


class TimedOut(Exception):
    """Something did not happen in time: exit code 3."""


def check_urls(via: list[str], source: str = "--via") -> None:
    """Raise UsageError for a URL of an unknown transport or with invalid options; open nothing.

    The error names the `source` of the URLs, as a variable or a file is easily forgotten.
    """
    for url in via:
        try:
            open_transport(url)
        except r2p.TransportError as error:
            if isinstance(error.__cause__, ImportError):  # the URL is valid, but this installation lacks a package
                raise
            raise UsageError(str(error) if source == "--via" else f"{source}: {error}") from error


def _check_descriptors() -> None:
    """Raise r2p.Error if too few files may be open for an event loop: asyncio's own error would be obscure."""
    opened: list[int] = []
    try:
        for _ in range(_DESCRIPTORS):
            opened.append(os.open(os.devnull, os.O_RDONLY))  # noqa: PERF401 - what was opened must be closed
    except OSError as error:
        raise r2p.Error(f"{error.strerror}: r2p needs at least {_DESCRIPTORS} more (ulimit -n 1024)") from error
    finally:
        for each in opened:
            os.close(each)


@contextlib.contextmanager
def call_after(seconds: float, call: Callable[[], object]) -> Iterator[None]:
    """Call `call` if the block takes longer than this."""
    timer = asyncio.get_running_loop().call_later(seconds, call)
    try:
        yield
    finally:
        timer.cancel()


@contextlib.asynccontextmanager
async def patience(
    missing: str, timeout: float | None, advice: Callable[[], str] = lambda: ""
) -> AsyncIterator[Callable[[], None]]:
    """Raise TimedOut in the block if nothing is received for `timeout` seconds; `missing` says so: "no message of x".

    The block gets a function to call for each message. `advice` returns what to add: "; did you mean y?".
    """
    loop = asyncio.get_running_loop()
    try:
        async with asyncio.timeout(timeout) as limit:

            def received() -> None:
                if timeout is not None and not limit.expired():
                    limit.reschedule(loop.time() + timeout)

            yield received
    except TimeoutError:
        raise TimedOut(f"{missing} for {timeout:g} s{advice()}") from None


async def wait_until(condition: Callable[[], bool], timeout: float) -> bool:
    """Wait until the condition is true; return False if it is not after `timeout` seconds."""
    loop = asyncio.get_running_loop()
    end = loop.time() + timeout
    while not condition():
        if loop.time() >= end:
            return False
        await asyncio.sleep(_POLL)
    return True


_INSTANT = 1e-9  # s: two instants of a clock differ by at least so much, their difference is off by less


async def moments(duration: float | None, period: float) -> AsyncIterator[float]:
    """Yield the seconds since the start, once in each period, and after `duration` seconds; None: without an end."""
    loop = asyncio.get_running_loop()
    start = loop.time()
    time = 0.0
    while duration is None or duration - time > _INSTANT:
        await asyncio.sleep(period if duration is None else min(period, duration - time))
        time = loop.time() - start
        yield time


class Session:
    """A command on the network: its module, its node, and what it waits for."""

    def __init__(self, module: r2p.Module, settings: Settings, *, name: str = "tool", verbose: int = 0) -> None:
        self.module = module
        self.announcements = Announcements(module)
        self.settings = settings
        self.verbose = verbose
        self._name = name

    @functools.cached_property
    def node(self) -> r2p.Node:
        """A node to publish and subscribe with; it exists as long as the session."""
        return self.module.start(_idle, name=self._name)

    @property
    def network_name(self) -> str:
        """The network that the command is on, for messages."""
        return ", ".join(self.settings.via) or "this tool alone"

    def columns(self, first: str, *others: str) -> list[str]:
        """Return the columns of a table of names; with -v also `alias`."""
        return [first, "alias", *others] if self.verbose else [first, *others]

    def report_none(self, things: str, *, hidden: bool = False) -> None:
        """Report that there are no topics, nodes or modules; `hidden`: only those of tools, which are not shown."""
        if hidden:
            notify(f"no {things} yet on {self.network_name}, except for those of tools; use --all to include these")
        else:
            notify(self.none_yet(things))

    def none_yet(self, things: str) -> str:
        """Say that there are no such things on the network, which modules were heard, and what to try."""
        text = f"no {things} yet on {self.network_name}"
        if not self.settings.via:
            return text
        names = sorted({view.name for view in self.module.network.modules() if view.link and view.state != "observer"})
        heard = f"heard {len(names)} {'module' if len(names) == 1 else 'modules'}"
        if names:
            return f"{text} ({heard}: {', '.join(names)}); listen longer with --wait 5"
        received = sum(link.stats.bytes_received for link in self.module.links)
        heard += f", received {received} bytes" if received else ""
        if not received and all(url.startswith(IN_ONE_PROGRAM) for url in self.settings.via):
            return f"{text} ({heard}): such a network is inside one program; tcp-listen: and tcp: join two"
        return f"{text} ({heard}); try r2p doctor --via {self.settings.via[0]}"

    @contextlib.contextmanager
    def waiting(self, what: str | Callable[[], str]) -> Iterator[None]:
        """Report what the block waits for if it takes more than a second; a function is called for the text then."""

        def report() -> None:
            notify(f"waiting for {what if isinstance(what, str) else what()} on {self.network_name}")

        with call_after(REPORT_WAITING_AFTER, report):
            yield

    def unannounced(self, known: Iterable[r2p.Endpoint], links: Iterable[str]) -> dict[str, str]:
        """Return the links without a known endpoint, each with the only module that may be meant, or `?`."""
        covered, found = {each.link for each in known}, {}
        for link in (each for each in self.module.links if each.name in set(links) - covered):
            names = link.possible_senders()
            found[link.name] = names.pop() if len(names) == 1 else "?"
        return found

    async def settle(self, wait: float | None = None, *, of: str = "topics") -> None:
        """Listen until the other modules have announced what they have, or for `wait` seconds.

        r2p modules are queried and answer at once, gateways for the modules behind them; firmware repeats one
        announcement at a time. Where more may come, the user is informed; `of` is the plural for that message. Raises
        r2p.TransportError if no link comes up.
        """
        if not self.settings.via:
            return
        with self.waiting("a link"):
            if not await wait_until(lambda: any(link.up for link in self.module.links), _LINK_UP):
                raise r2p.TransportError(f"no connection on {self.network_name}")
        if wait is not None:
            await asyncio.sleep(wait)
            return
        self.module.query()
        settled = await self.announcements.settled()
        if self.announcements.have_firmware() and (not settled or self.announcements.expects_more()):
            notify(f"firmware announces one item every 0.5 s, so there may be more {of}: listen longer with --wait 5")
        elif not settled:
            notify(f"announcements kept arriving, so there may be more {of}: listen longer with --wait 20")

    async def fail_unless_connected(self) -> None:
        """Return when a link is up; wait for ever where none is tried, as when this tool listens for connections.

        Raises r2p.TransportError when it has been known for a moment of each link why it does not come up.
        """
        loop = asyncio.get_running_loop()
        failed_at: float | None = None
        while not any(link.up for link in self.module.links):
            if not self.module.links or not all(link.unreachable_reason for link in self.module.links):
                failed_at = None
            elif failed_at is None:
                failed_at = loop.time()
            elif loop.time() - failed_at >= _GIVE_UP_AFTER:
                raise r2p.TransportError(f"no connection on {self.network_name}")
            await asyncio.sleep(_POLL)

    async def fail_without_key(self) -> None:
        """Raise r2p.TransportError when the other end of each link has refused it for its key; the log says why."""
        events = self.module.events()
        while not self.module.links or not all(link.key_refused for link in self.module.links):
            await anext(events)
        raise r2p.TransportError(f"no connection on {self.network_name}")

    async def look_for(self, is_known: Callable[[], bool]) -> bool:
        """Query, and wait until something that the user has named is known; False if it can be said to be missing.

        That takes longer than `settled`: on a busy computer a module may answer late, after others or as the first.
        """
        self.module.query()
        heard = asyncio.create_task(self.announcements.heard_all())
        try:
            await wait_until(lambda: is_known() or heard.done(), math.inf)
        finally:
            heard.cancel()
        return is_known()


def alias_or_none(name: str, alias: Callable[[str], str]) -> str | None:
    """Return what travels for a name on RTCAN and debug lines; None: the name itself."""
    found = alias(name)
    return None if found == name else found


async def _idle(node: r2p.Node) -> None:
    """Run until cancelled: the command itself publishes and subscribes with this node."""
    await asyncio.get_running_loop().create_future()


@contextlib.asynccontextmanager
async def join(
    settings: Settings, *, name: str = "tool", verbose: int = 0, alone: bool = False
) -> AsyncIterator[Session]:
    """Join the network as an observer, a module named `_` and six random characters; `name` is that of its node.

    `alone`: open no link, whatever the settings have.
    """
    if not (settings.via or alone):
        notify("no network: this tool sees only itself; give --via tcp:HOST:PORT or set R2P_VIA")
    alphabet = string.ascii_lowercase + string.digits
    check_urls(settings.via, settings.via_source)
    module_name = "_" + "".join(random_of(asyncio.get_running_loop()).choices(alphabet, k=6))
    aliases = settings.aliases
    via = [] if alone else settings.via
    async with r2p.Module(module_name, via=via, aliases=aliases, observer=True, watchdog=False) as module:
        yield Session(module, settings, name=name, verbose=verbose)


def counts_without_end(given: Mapping[str, Any]) -> bool:
    """Return whether a command with these arguments and options goes on for ever: it takes -n or --once, but got none.

    All commands that watch or repeat something take -n; those without it have an end of their own.
    """
    return "count" in given and given["count"] is None and not given.get("once")


def _check_count(given: Mapping[str, Any]) -> None:
    if given.get("once") and given.get("count") not in (None, 1):
        raise UsageError(f"--once is -n 1, not -n {given['count']}: leave out one of them")


def command(
    app: typer.Typer,
    name: str,
    *,
    opening: Opening | None = None,
    endless: Endless = counts_without_end,
    check: Check | None = None,
    joins: Joins = lambda _given: True,
    takes_numbers: bool = False,
) -> Callable[[B], B]:
    """Make a command of `app` from the coroutine function that this decorates, and return the function unchanged.

    The function takes a Session first, or what `opening` opens, then its own arguments and options. If it
    `takes_numbers`, unknown options such as -0.5 are arguments, which it has to check.
    """
    context = {"ignore_unknown_options": True} if takes_numbers else None

    def register(body: B) -> B:
        app.command(name, context_settings=context)(
            joined(body, opening=opening, endless=endless, check=check, joins=joins)
        )
        return body

    return register


def joined(
    body: Callable[..., Awaitable[None]],
    *,
    opening: Opening | None = None,
    endless: Endless = counts_without_end,
    keep_trying: bool = False,
    check: Check | None = None,
    joins: Joins = lambda _given: True,
    loop: Callable[..., Run | None] | None = None,
) -> Callable[..., None]:
    """Make a command for `main.COMMANDS` of a coroutine function that takes a Session, or what `opening` opens.

    `check` comes before any link is opened, whose warnings would stand above its error. `loop` is as in `standalone`.
    Unless it is to `keep_trying`, the command fails as soon as no link can come up. Where it does not join (`joins`),
    its session has no links.
    """
    node = body.__name__.strip("_")

    def run(*, via: list[str] | None, verbose: int, quiet: int, **given: Any) -> None:
        async def main() -> None:
            chosen = settings(via, tool=True)
            _check_count(given)
            if check is not None:
                check(chosen, given)
            if opening is None:
                opens: contextlib.AbstractAsyncContextManager[Any] = join(
                    chosen, name=node, verbose=verbose, alone=not joins(given)
                )
            else:
                opens = opening(chosen)
            async with opens as opened:
                if opening is not None or keep_trying:
                    await body(opened, **given)
                else:
                    await while_connected(opened, body(opened, **given))

        replaced = None if loop is None else loop(**given)
        execute(main, verbose=verbose, quiet=quiet, endless=endless(given), run=replaced)

    return _with_options(run, body, session=True)


def standalone(
    body: Callable[..., Awaitable[None]],
    *,
    endless: bool | Endless = False,
    loop: Callable[..., Run | None] | None = None,
) -> Callable[..., None]:
    """Make a command for `main.COMMANDS` of a coroutine function that joins no network as a tool; it adds -v and -q.

    `endless`: whether it goes on until a signal ends it, or a function that says so of its arguments. `loop` returns
    what replaces `r2p.run_main`, for the command's arguments.
    """

    def run(*, verbose: int, quiet: int, **given: Any) -> None:
        replaced = None if loop is None else loop(**given)
        is_endless = endless(given) if callable(endless) else endless
        execute(functools.partial(body, **given), verbose=verbose, quiet=quiet, endless=is_endless, run=replaced)

    return _with_options(run, body, session=False)


def service(
    body: Callable[..., Awaitable[None]], *, loop: Callable[..., Run | None] | None = None
) -> Callable[..., None]:
    """Make a command as `standalone` does, which goes on until a signal ends it."""
    return standalone(body, endless=True, loop=loop)


def run_virtually(main: Callable[[], Coroutine[Any, Any, None]], **options: Any) -> None:
    """Run a command under virtual time, with the options of `r2p.sim.run`: for the argument `run` of `execute`."""
    from r2p import sim  # a tenth of a second that other commands need not wait for

    before = signal.signal(signal.SIGTERM, signal.default_int_handler)  # as Ctrl-C, which Python raises itself
    try:
        sim.run(main, **options)
    finally:
        signal.signal(signal.SIGTERM, before)


def _with_options(run: Callable[..., None], body: Callable[..., object], *, session: bool) -> Callable[..., None]:
    """Give `run` the name, the help and the options of `body` without its `session`, and the common options."""
    own = list(inspect.signature(body, eval_str=True).parameters.values())
    given = [*own[1:], *_COMMON] if session else [*own, *_COMMON[1:]]
    parameters = [each.replace(kind=inspect.Parameter.KEYWORD_ONLY) for each in given]
    function: Any = run
    function.__name__ = body.__name__
    function.__doc__ = body.__doc__
    function.__annotations__ = {each.name: each.annotation for each in parameters}
    function.__signature__ = inspect.Signature(parameters)
    return run


async def while_connected(session: Session, body: Awaitable[None]) -> None:
    """Run a command on the network. Raises r2p.TransportError if no link can come up."""
    async with asyncio.TaskGroup() as tasks:
        watching = [tasks.create_task(session.fail_unless_connected()), tasks.create_task(session.fail_without_key())]
        await body
        for each in watching:
            each.cancel()


_COMMON = [
    inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation)
    for name, annotation, default in (("via", Via, None), ("verbose", Verbose, 0), ("quiet", Quiet, 0))
]


def group(help: str) -> typer.Typer:
    """Return a group of commands for `main.GROUPS`."""
    app = typer.Typer(
        help=help, no_args_is_help=True, add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False
    )
    app.callback()(lambda: None)  # makes it a group even of one command
    return app


def execute(
    main: Callable[[], Awaitable[object]],
    *,
    verbose: int = 0,
    quiet: int = 0,
    endless: bool = False,
    run: Run | None = None,
) -> None:
    """Run a command until it ends or a signal ends it, and exit with its code. `run` replaces `r2p.run_main`.

    A signal means success only for an `endless` command. All others exit with 130, as they were not done: so
    `r2p wait ... && ...` does not go on.
    """
    done = False

    async def to_its_end() -> None:
        nonlocal done
        await main()
        done = True

    with log_to_stderr(verbose - quiet):
        try:
            _check_descriptors()
            (run or r2p.run_main)(to_its_end)
            if not (done or endless):  # `run_main` returns after a signal
                raise typer.Exit(INTERRUPTED)
        except KeyboardInterrupt:  # from a `run` that leaves signals to Python
            raise typer.Exit(0 if endless else INTERRUPTED) from None
        except typer.Exit:
            raise
        except (Exception, BaseExceptionGroup) as error:  # noqa: BLE001 - sorted out by _explain, or raised again
            _explain(error)


def _explain(error: BaseException) -> None:
    """Print the errors that ended a command, and exit with their code; a bug is raised again."""
    leaves = list(_leaves(error))
    for leaf in leaves:
        if isinstance(leaf, PipeClosed):
            abandon_stdout()
            return
        if isinstance(leaf, UsageError | r2p.InvalidName):  # invalid names always come from the command line
            raise typer.BadParameter(printable(str(leaf), "\n")) from leaf
        if isinstance(leaf, TimedOut):
            notify(str(leaf))
            raise typer.Exit(3) from leaf
    if not all(
        isinstance(leaf, r2p.Error | Unwritable) or getattr(leaf, "errno", 0) in _TOO_MANY_FILES for leaf in leaves
    ):
        raise error
    for leaf in leaves:
        notify(leaf.message if isinstance(leaf, r2p.NodeCrashed) else str(leaf))
    raise typer.Exit(1) from error


def _leaves(error: BaseException) -> Iterator[BaseException]:
    """Yield the errors in nested groups. Errors of nodes count as one, because their details have been logged."""
    if isinstance(error, BaseExceptionGroup) and not isinstance(error, r2p.NodeCrashed):
        for each in error.exceptions:
            yield from _leaves(each)
    else:
        yield error
