"""`r2p log --set NODE=LEVEL`: set from which level on nodes log, while they run."""

import logging
from collections.abc import Iterable, Iterator

import r2p
from r2p.tools.node_states import find_module, node_lists, r2p_modules
from r2p.tools.output import notify
from r2p.tools.session import Session, TimedOut, UsageError

LEVELS: dict[str, int | None] = {
    "debug": logging.DEBUG,
    "info": logging.INFO,
    "warning": logging.WARNING,
    "error": logging.ERROR,
    "critical": logging.CRITICAL,
    "default": None,
}

_ALL = "*"


async def set_levels(session: Session, given: Iterable[str]) -> None:
    """Set the levels in texts `NODE=LEVEL`, `MODULE/NODE=LEVEL` or `MODULE/*=LEVEL`, and say for which nodes.

    Raises UsageError for another text, TimedOut for an unknown module, and r2p.Error for an unknown node.
    """
    if not session.settings.via:
        raise UsageError("no network to look for nodes on: give --via tcp:HOST:PORT or set R2P_VIA")
    for module, node, level in [_parse(each) for each in given]:  # all of them before anything is set
        if not module:
            await session.settle()
            module = await _module_of(session, node)
        nodes = await find_module(session, module)
        try:
            names = await nodes.set_log_level("" if node == _ALL else node, LEVELS[level])
        except TimeoutError as error:
            raise TimedOut(str(error)) from error
        paths = ", ".join(f"{module}/{name}" for name in names) or "no node: the module has none"
        notify(f"{paths}: {_outcome(level)}")


def _outcome(level: str) -> str:
    if level == "default":
        return "the log level is that of its start again"
    return f"logs from {level.upper()} up, until its module ends, or `--set NODE=default`"


def _parse(text: str) -> tuple[str, str, str]:
    path, found, level = text.rpartition("=")
    module, _, node = path.rpartition("/")
    if not (found and node):
        raise UsageError(f"--set {text}: write it as NODE=LEVEL, for example blink=debug, or ROBOT1/*=debug")
    if level.lower() not in LEVELS:
        raise UsageError(f"--set {text}: the level is one of {', '.join(LEVELS)}, not {level}")
    if node == _ALL and not module:
        raise UsageError(f"--set {text}: of which module? Write MODULE/*={level}")
    return module, node, level.lower()


async def _module_of(session: Session, node: str) -> str:
    """Return the only module that has a node. Raises r2p.Error if there is none, or there are several."""
    lists = await node_lists(session, r2p_modules(session))
    modules = list(_with_node(lists, node))
    if len(modules) == 1:
        return modules[0]
    if modules:
        raise r2p.Error(
            f"there are several nodes {node}: choose one of {', '.join(f'{each}/{node}' for each in modules)}"
        )
    known = ", ".join(f"{module}/{each.node}" for module, found in lists.items() for each in found.nodes)
    raise r2p.Error(f"there is no node {node} whose log level can be set; nodes found: {known or 'none'}")


def _with_node(lists: dict[str, r2p.NodeList], node: str) -> Iterator[str]:
    return (module for module, found in lists.items() if any(each.node == node for each in found.nodes))
