"""Waiting until something appears on the network, a topic, a node or a module; and `r2p wait`, which does so.

The command and the ready conditions of `r2p launch` mean the same by it.
"""

import asyncio
import difflib
from typing import Annotated, Literal, get_args

import typer

import r2p
from r2p.names import module_path, node_name, topic_name
from r2p.tools.completion import complete_awaited
from r2p.tools.options import time_option
from r2p.tools.session import Session, TimedOut, UsageError, joined

Kind = Literal["topic", "node", "module"]
"""The kinds of things to wait for."""
KINDS: tuple[Kind, ...] = get_args(Kind)

_POLL = 0.05  # seconds between two looks at what is known of the network
_QUERY = 1.0  # seconds between two queries: a module that starts later announces itself, but a gateway may forget it


def check_name(kind: Kind, name: str) -> None:
    """Raise InvalidName unless it is a valid name of a topic, a node (`NODE` or `MODULE/NODE`) or a module."""
    if kind == "topic":
        topic_name(name)
    elif kind == "module":
        module_path(name)
    else:
        module, slash, node = name.rpartition("/")
        node_name(node)
        if slash:
            module_path(module)


async def appeared(session: Session, kind: Kind, name: str) -> None:
    """Wait until the topic, node or module is seen on the network; for ever, if need be.

    A topic is seen when another module publishes it or subscribes to it; the subscriptions of tools do not count, as
    `r2p topic echo` subscribes before there is a publisher. A node is seen when it has a topic: `NODE` is a node of any
    module, `MODULE/NODE` of this one. Raises InvalidName.
    """
    check_name(kind, name)
    is_seen = {"topic": _topic_is_seen, "node": _node_is_seen, "module": _module_is_seen}[kind]
    loop = asyncio.get_running_loop()
    next_query = loop.time()
    while not is_seen(session.module.network, name):
        if loop.time() >= next_query:
            session.module.query()
            next_query = loop.time() + _QUERY
        await asyncio.sleep(_POLL)


def _topic_is_seen(network: r2p.NetworkView, name: str) -> bool:
    view = network.topics().get(topic_name(name))
    if view is None:
        return False
    if any(view.published_on):  # "" is this module
        return True
    named = {each.link for each in view.subscribers}
    of_firmware = any(link not in named for link in view.subscribed_on)  # it announces no nodes
    return of_firmware or any(each.link and not _is_tool(each.module) for each in view.subscribers)


def _node_is_seen(network: r2p.NetworkView, name: str) -> bool:
    module, _, node = name.rpartition("/")
    return any(
        each.node == node and each.link and (each.module == module if module else not _is_tool(each.module))
        for view in network.topics().values()
        for each in view.publishers + view.subscribers
    )


def _module_is_seen(network: r2p.NetworkView, name: str) -> bool:
    return any(view.name == name and view.link for view in network.modules())


def _is_tool(module: str) -> bool:
    return module.startswith("_")


async def wait(
    session: Session,
    kind: Annotated[Kind, typer.Argument(metavar="topic|node|module", show_default=False)],
    name: Annotated[
        str,
        typer.Argument(
            metavar="NAME",
            autocompletion=complete_awaited,
            help="A node: NODE or MODULE/NODE.",
            show_default=False,
        ),
    ],
    *,
    timeout: Annotated[float | None, time_option("--timeout", "Give up (exit code 3) after this long.")] = None,
) -> None:
    """Wait until a topic, node or module is on the network, for scripts: exit code 0, or 3 at --timeout.

    It also waits for the link, and prints nothing on stdout.
    """
    check_name(kind, name)
    if not session.settings.via:
        raise UsageError("no network to wait on: give --via tcp:HOST:PORT or set R2P_VIA")
    try:
        with session.waiting(f"{kind} {name}"):
            async with asyncio.timeout(timeout):
                await appeared(session, kind, name)
    except TimeoutError:
        close = difflib.get_close_matches(name, _names(session.module.network, kind), n=1)
        question = f"; did you mean {close[0]}?" if close else ""
        raise TimedOut(f"no {kind} {name} on {session.network_name} within {timeout:g} s{question}") from None


command = joined(wait, keep_trying=True)


def _names(network: r2p.NetworkView, kind: Kind) -> list[str]:
    """Return the names that are on the network."""
    if kind == "topic":
        return list(network.topics())
    if kind == "module":
        return [view.name for view in network.modules() if view.link]
    return [name for module, node in network.nodes() for name in (node, f"{module}/{node}")]
