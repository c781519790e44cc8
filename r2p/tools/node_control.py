"""`r2p node start`, `stop`, `restart` and `swap`: change the nodes of a module that runs with --allow-load."""

from collections.abc import Awaitable
from pathlib import Path
from typing import Annotated, TypeVar

import typer

import r2p
from r2p.names import module_path, node_name
from r2p.tools.completion import complete_module, complete_node_of_module, complete_node_or_module
from r2p.tools.node_states import find_module, find_node, is_module
from r2p.tools.options import CLASS_NAMES, Format
from r2p.tools.output import Output, notify
from r2p.tools.session import Session, TimedOut, UsageError

T = TypeVar("T")

NodePath = Annotated[
    str,
    typer.Argument(
        metavar="MODULE/NODE",
        autocompletion=complete_node_or_module,
        help="NODE alone if the name is unique; or MODULE NODE, in two arguments.",
        show_default=False,
    ),
]
NodeName = Annotated[
    str | None, typer.Argument(metavar="NODE", autocompletion=complete_node_of_module, show_default=False)
]
Target = Annotated[
    str,
    typer.Argument(
        metavar="FILE:FUNCTION[=NAME]",
        help="A file of the module's computer, relative to its --load-dir.",
        show_default=False,
    ),
]
Send = Annotated[
    bool, typer.Option("--send", help="Send FILE from this computer; only to a module whose link has a key.")
]


class _Code:
    """The function that a target names, and the file to send."""

    def __init__(self, target: str, *, send: bool) -> None:
        where, _, self.name = target.partition("=")
        file, _, self.function = where.rpartition(":")
        if not (file and self.function):
            raise UsageError(f"{target}: write it as FILE:FUNCTION[=NAME], for example blink.py:blink")
        if self.name:
            node_name(self.name)
        if not file.endswith(".py"):
            raise UsageError(f"{file}: give a file, whose name ends with .py; packages can't be loaded at run time")
        self.sent = Path(file) if send else None
        if self.sent is not None and not self.sent.is_file():
            raise UsageError(f"there is no file {file} on this computer")
        self.file = file if self.sent is None else self.sent.name
        self._done = self._total = 0

    def progress(self, done: int, total: int) -> None:
        """Note how many bytes have been sent."""
        self._done, self._total = done, total

    def awaited(self, what: str) -> str:
        """Say what a command waits for: `what`, or that the file is sent."""
        if self._done < self._total:
            return f"{self.file} to be sent ({self._done} of {self._total} bytes)"
        return what


async def start(
    session: Session,
    module: Annotated[
        str,
        typer.Argument(
            metavar="MODULE[/NAME]",
            autocompletion=complete_module,
            help="NAME is that of the new node; default: that of its function.",
            show_default=False,
        ),
    ],
    target: Target,
    *,
    send: Send = False,
    restart: Annotated[bool, typer.Option("--restart", help="Restart the node after a crash, after a pause.")] = False,
    priority: Annotated[int, typer.Option(metavar="N", help="Nodes of higher priority get their messages first.")] = 0,
) -> None:
    """Start a node in a module that runs with --allow-load."""
    code = _Code(target, send=send)
    nodes = await _find_place(session, module, code)
    module = nodes.module
    starting = nodes.start(
        code.file,
        code.function,
        code.name,
        code=code.sent,
        priority=priority,
        restart=restart,
        progress=code.progress,
    )
    with session.waiting(lambda: code.awaited(f"{module} to start {code.file}:{code.function}")):
        name = await _answered(starting)
    notify(f"{module}: node {name} runs")


async def stop(session: Session, module: NodePath, node: NodeName = None) -> None:
    """End one node, and wait for its clean-up; the others run on. Start it again with restart."""
    nodes, name = await find_node(session, module, node)
    with session.waiting(f"the end of {name}"):
        await _answered(nodes.stop(name))
    notify(f"{nodes.module}: node {name} has ended")


async def restart(session: Session, module: NodePath, node: NodeName = None) -> None:
    """End one node and start its function again.

    It runs the code that was loaded for it: to run a changed file, swap it.
    """
    nodes, name = await find_node(session, module, node)
    with session.waiting(f"the end of {name}"):
        await _answered(nodes.restart(name))
    notify(f"{nodes.module}: node {name} runs again")


async def swap(
    session: Session,
    module: Annotated[
        str,
        typer.Argument(
            metavar="MODULE[/OLD]",
            autocompletion=complete_node_or_module,
            help="The node to replace; OLD may be an argument of its own, or stand alone if the name is unique.",
            show_default=False,
        ),
    ],
    old: Annotated[
        str,
        typer.Argument(
            metavar="OLD|FILE:FUNCTION[=NAME]",
            autocompletion=complete_node_of_module,
            help="OLD behind MODULE alone. A file of the module's computer, relative to its --load-dir.",
            show_default=False,
        ),
    ],
    target: Annotated[str | None, typer.Argument(metavar="FILE:FUNCTION[=NAME]", show_default=False)] = None,
    *,
    send: Send = False,
    partial: Annotated[
        bool, typer.Option("--partial", help="Accept a new node that publishes or serves less than the old one.")
    ] = False,
    format: Format = None,
) -> None:
    """Let a new node take the place of another one.

    What they publish goes on without a gap. The file is loaded anew, so a changed one takes effect. The new node has
    the name of the old one unless NAME is given. If it crashes or is not ready in time, the old one goes on. The pause
    of each topic is printed: of a periodic one, from the last message of the old node to the first one of the new node.
    """
    output = Output(format)
    node = old if target is not None else None
    code = _Code(old if target is None else target, send=send)
    nodes, name = await find_node(session, module, node)
    module = nodes.module
    swapping = nodes.swap(
        name, code.file, code.function, code.name, code=code.sent, partial=partial, progress=code.progress
    )
    with session.waiting(lambda: code.awaited(f"{module} to swap {name}")):
        result = await _answered(swapping)
    if not result.cleaned_up:
        notify(f"the old node still cleans up: it hangs, and can't publish any more; see the log of {module}")
    record = {
        "module": module,
        "node": result.node,
        "topics": [
            {"topic": each.topic, "class": CLASS_NAMES[each.publisher_class]} | _times(each) for each in result.topics
        ],
        "cleaned_up": result.cleaned_up,
    }
    lines = [f"{module}: node {result.node} runs {code.file}:{code.function}", *map(_line, result.topics)]
    await output.put(record, "\n".join(lines))


def _times(topic: r2p.TopicPause) -> dict[str, float | None]:
    return {"pause": topic.pause, "period": topic.period}


def _line(topic: r2p.TopicPause) -> str:
    if topic.pause is None:
        return f"  {topic.topic}: nothing published yet"
    text = f"  {topic.topic}: pause of {_ms(topic.pause)}"
    if topic.period is None:
        return text
    missed = max(0, round(topic.pause / topic.period) - 1)
    return f"{text}, {missed or 'no'} period{'s' * (missed > 1)} of {_ms(topic.period)} missed"


def _ms(seconds: float) -> str:
    return f"{seconds * 1e3:.4g} ms"


async def _find_place(session: Session, module: str, code: _Code) -> r2p.RemoteNodes:
    """Return the nodes of `MODULE`, or of the one of `MODULE/NAME`, and note NAME."""
    module_path(module)
    above, _, name = module.rpartition("/")
    if not above or await is_module(session, module) or not await is_module(session, above):
        return await find_module(session, module)
    if code.name not in {"", name}:
        raise UsageError(f"one node has one name: {module} or ={code.name}")
    code.name = node_name(name)
    return session.module.network.nodes_of(above)


async def _answered(change: Awaitable[T]) -> T:
    """Wait for the answer of a module. Raises TimedOut if it does not come."""
    try:
        return await change
    except TimeoutError as error:
        raise TimedOut(str(error)) from error
