"""Shell completion: of names that the network knows, which are topics, services, nodes and modules, and of types.

A function `complete_...` is what Typer calls for an argument or option, with what was typed so far. Names of the
network come from a look at it of about a second (`find`), by --via on the line, R2P_VIA or r2p.toml. Nothing is ever
printed: without an answer there are no completions, and what is wrong is said when the command runs.

The process that a shell starts for completions runs `answer`.
"""

import asyncio
import contextlib
import io
import logging
import os
import re
import signal
import sys
from collections.abc import Awaitable, Callable, Iterable, Iterator, MutableMapping

import typer

from r2p.codecs.services import REQUESTS, is_of_service
from r2p.tools.config import find as find_config
from r2p.tools.config import read as read_config
from r2p.tools.node_states import node_lists, r2p_modules
from r2p.tools.session import IN_ONE_PROGRAM, Session, Settings, join, settings, wait_until
from r2p.tools.types import STANDARD, Types, standard_types, type_name

Source = Callable[[Session], Awaitable[Iterable[str]]]
"""Returns names that a network has."""

_LINK_UP = 1.0  # seconds to wait for a link
_LISTEN = 0.9  # seconds to listen for announcements at most; r2p modules answer at once
_ANSWERS = 0.5  # seconds to wait for the answers of modules
_LIMIT = 3.0  # seconds after which the process ends: a host name may take longer to look up, and can't be interrupted
_UNSAFE = re.compile(r"[^\w./:?=,@+-]")  # in words of a network: shells replace, run or cut at it
_BREAKS = re.compile(r"[:=@]+")  # a word of its own in bash, even between two parts of one


async def find(settings: Settings, source: Source) -> list[str]:
    """Return the names that are found on the network in a short time, sorted."""
    async with join(settings, name="completion") as session:
        if not await wait_until(lambda: any(link.up for link in session.module.links), _LINK_UP):
            return []
        session.module.query()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(_LISTEN):
                await session.announcements.settled()
        return sorted(set(await source(session)))


def complete_topic(ctx: typer.Context, incomplete: str) -> list[str]:
    """Completions for a topic: those that r2p.toml names, and those of the network."""
    return beginning(incomplete, [*_stated(incomplete), *on_network(ctx, topics)])


def complete_service(ctx: typer.Context, incomplete: str) -> list[str]:
    """Completions for a service."""
    return beginning(incomplete, on_network(ctx, services))


def complete_module(ctx: typer.Context, incomplete: str) -> list[str]:
    """Completions for a module."""
    return beginning(incomplete, on_network(ctx, modules))


def complete_node(ctx: typer.Context, incomplete: str) -> list[str]:
    """Completions for a node: MODULE/NODE, or NODE where that is what the user has begun."""
    return _node_beginning(incomplete, on_network(ctx, nodes))


def complete_node_of_module(ctx: typer.Context, incomplete: str) -> list[str]:
    """Completions for a node of the module that stands before it."""
    module = ctx.params.get("module")

    async def own(session: Session) -> list[str]:
        return [name.rpartition("/")[2] for name in await nodes(session) if name.rpartition("/")[0] == module]

    return beginning(incomplete, on_network(ctx, own))


def complete_node_or_module(ctx: typer.Context, incomplete: str) -> list[str]:
    """Completions for a node, or a module."""

    async def both(session: Session) -> list[str]:
        return [*await modules(session), *await nodes(session)]

    return _node_beginning(incomplete, on_network(ctx, both))


def complete_awaited(ctx: typer.Context, incomplete: str) -> list[str]:
    """Completions for what `r2p wait KIND` waits for."""
    by_kind = {"topic": complete_topic, "node": complete_node, "module": complete_module}
    complete = by_kind.get(ctx.params.get("kind") or "")
    return complete(ctx, incomplete) if complete else []


def complete_entry(ctx: typer.Context, incomplete: str) -> list[str]:
    """Completions for an entry of the file of `r2p launch`."""
    with silence():
        path = ctx.params.get("file") or find_config()
        return beginning(incomplete, read_config(path).launch if path else ())
    return []


def complete_type(incomplete: str) -> list[str]:
    """Completions for a type: bare and full names, and the names in r2p.msg behind its name and a colon."""
    classes = standard_types()
    if ":" in incomplete:
        return beginning(incomplete, [f"{STANDARD}:{cls.__name__}" for cls in classes])
    with silence():
        classes += Types(settings()).named
    bare = [cls.__name__ for cls in standard_types()]
    return beginning(incomplete, bare + [type_name(cls) for cls in classes])


# What a network has


async def topics(session: Session) -> list[str]:
    """Return the names of all topics except for those of services."""
    known = session.module.network.topics()
    return [name for name in known if not is_of_service(name, known)]


async def services(session: Session) -> list[str]:
    """Return the names of all services."""
    known = session.module.network.topics()
    names = [name for name in known if name.endswith(REQUESTS) and is_of_service(name, known)]
    return [name.removesuffix(REQUESTS) for name in names]


async def modules(session: Session) -> list[str]:
    """Return the names of all modules except for tools."""
    views = session.module.network.modules()
    return [view.name for view in views if view.link and view.state != "observer"]


async def nodes(session: Session) -> list[str]:
    """Return `MODULE/NODE` of all nodes except for those of tools."""
    announced = [f"{module}/{node}" for module, node in session.module.network.nodes() if not module.startswith("_")]
    lists = await node_lists(session, r2p_modules(session), within=_ANSWERS)  # also those without topics
    return [*announced, *(f"{module}/{each.node}" for module, found in lists.items() for each in found.nodes)]


def on_network(ctx: typer.Context, source: Source) -> list[str]:
    """Return what is on the network that the command line, R2P_VIA or r2p.toml names; empty without a network."""
    with silence():
        chosen = settings(list(ctx.params.get("via") or ()), tool=True)
        if not all(url.startswith(IN_ONE_PROGRAM) for url in chosen.via):
            return asyncio.run(find(chosen, source))
    return []


def _stated(incomplete: str) -> list[str]:
    """Return the topics that r2p.toml names."""
    with silence():
        return list(settings().types)
    return []


@contextlib.contextmanager
def silence() -> Iterator[None]:
    """Suppress all errors and log records: they would stand between the user's keys."""
    disabled = logging.root.manager.disable
    logging.disable()
    try:
        with contextlib.suppress(Exception, BaseExceptionGroup):
            yield
    finally:
        logging.disable(disabled)


# What the shell gets


def beginning(incomplete: str, names: Iterable[str]) -> list[str]:
    """Return the names that begin like this, each once; none that a shell would not take as it is."""
    return [name for name in dict.fromkeys(names) if name.startswith(incomplete) and not _UNSAFE.search(name)]


def _node_beginning(incomplete: str, paths: list[str]) -> list[str]:
    """Return the paths that begin like this, else the bare names of nodes that do."""
    return beginning(incomplete, paths) or beginning(incomplete, [path.rpartition("/")[2] for path in paths])


def answer(complete: Callable[[], object]) -> None:
    """Let Typer answer the shell that has started this process: in silence, and in a short time."""
    if not os.environ.get("R2P_DEBUG"):
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
    if hasattr(signal, "setitimer"):
        signal.signal(signal.SIGALRM, lambda *_: os._exit(0))
        signal.setitimer(signal.ITIMER_REAL, _LIMIT)
    there = join_words(os.environ) if "COMP_WORDS" in os.environ else 0
    answered = io.StringIO()
    try:
        with contextlib.redirect_stdout(answered):
            complete()
    finally:
        sys.stdout.writelines(line[there:] for line in answered.getvalue().splitlines(keepends=True))


def join_words(environment: MutableMapping[str, str]) -> int:
    """Put together what bash has cut: `tcp`, `:` and `pi` are `tcp:pi`, and `--format`, `=`, `json` one option.

    Returns the number of characters at the beginning of each completion that bash does not replace.
    """
    parts = environment["COMP_WORDS"].split("\n")[: int(environment["COMP_CWORD"]) + 1]
    words: list[str] = []
    for before, part in zip(["", *parts], parts, strict=False):
        if words and (_BREAKS.fullmatch(part) or _BREAKS.fullmatch(before)):
            words[-1] += part
        else:
            words.append(part)
    environment.update(COMP_WORDS="\n".join(words), COMP_CWORD=str(len(words) - 1))
    last = _BREAKS.sub("", parts[-1])
    value = words[-1].partition("=")[2] if words[-1].startswith("-") else words[-1]
    return max(0, len(value) - len(last)) if words[-1] != parts[-1] else 0
