"""`r2p log --set NODE=LEVEL`: set from which level on nodes log, while they run."""

import logging
from collections.abc import Iterable

import typer

from r2p.tools.completion import beginning, complete_node
from r2p.tools.node_states import find_module, module_of
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


def complete_level(ctx: typer.Context, incomplete: str) -> list[str]:
    """Completions for NODE=LEVEL: the node, and behind it the level."""
    node, found, _ = incomplete.partition("=")
    return beginning(incomplete, [f"{node}={level}" for level in LEVELS]) if found else complete_node(ctx, incomplete)


async def set_levels(session: Session, given: Iterable[str]) -> None:
    """Set the levels in texts `NODE=LEVEL`, `MODULE/NODE=LEVEL` or `MODULE/*=LEVEL`, and say for which nodes.

    Raises UsageError for another text, TimedOut for an unknown module, and r2p.Error for an unknown node.
    """
    if not session.settings.via:
        raise UsageError("no network to look for nodes on: give --via tcp:HOST:PORT or set R2P_VIA")
    for module, node, level in [_parse(each) for each in given]:  # all of them before anything is set
        if not module:
            module = await module_of(session, node)
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
