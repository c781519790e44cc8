"""`r2p run`: run functions from files and packages as the nodes of one module.

`load` finds the functions; `load_module` imports the user's files and packages, with errors that say what to do and
tracebacks without the frames of r2p.
"""

import asyncio
import contextlib
import difflib
import functools
import importlib
import importlib.util
import inspect
import logging
import socket
import sys
import traceback
from collections.abc import Iterable
from pathlib import Path
from types import CodeType, FrameType, ModuleType
from typing import Annotated

import msgspec
import typer

import r2p
from r2p.codecs.parameters import Origin
from r2p.log_lines import internal
from r2p.names import NODE_MAX, module_name_from, node_name
from r2p.parameters.sources import ParameterSource, from_options, of_module, read_file
from r2p.tools.config import Settings
from r2p.tools.options import Param, Params, ParamsFile, Via, parse_remap
from r2p.tools.output import notify
from r2p.tools.session import Run, UsageError, check_urls, run_virtually, service, settings

logger = logging.getLogger("r2p.runner")

_Functions = Annotated[
    list[str] | None,
    typer.Argument(
        metavar="FILE:FUNCTION[=NAME]",
        help="blink.py:blink, blink.py:blink=left, or package.module:function.",
        show_default=False,
    ),
]
_Priority = Annotated[
    list[str] | None,
    typer.Option(metavar="NODE=N", help="Nodes of higher priority get their messages first; default 0 (repeatable)."),
]
_AllowLoad = Annotated[
    bool, typer.Option("--allow-load", help="Let r2p node start, end and swap nodes here, with code in --load-dir.")
]
_LoadDir = Annotated[
    Path | None,
    typer.Option(metavar="DIR", help="Where the code for --allow-load is; default: the working directory."),
]


_SimTime = Annotated[
    bool, typer.Option("--sim-time", help="Follow the /clock of ROS, such as a simulator's (use_sim_time).")
]


class Program(msgspec.Struct, frozen=True):
    """A function to run as a node of this name."""

    function: r2p.NodeFunction
    name: str


def _loop(*, sim_time: bool, **_others: object) -> Run | None:
    return functools.partial(run_virtually, follow=True) if sim_time else None


@functools.partial(service, loop=_loop)
async def command(
    functions: _Functions = None,
    module: Annotated[
        str | None, typer.Option(metavar="NAME", help="The module's name; default: from r2p.toml or the host name.")
    ] = None,
    remap: Annotated[
        list[str] | None, typer.Option(metavar="OLD:=NEW", help="Rename a topic for all its nodes (repeatable).")
    ] = None,
    priority: _Priority = None,
    restart: Annotated[bool, typer.Option("--restart", help="Restart a crashed node, after a pause.")] = False,
    allow_control: Annotated[
        bool, typer.Option("--allow-control", help="Let other modules change this one by IP links without a key, too.")
    ] = False,
    params_file: ParamsFile = None,
    params: Params = None,
    param: Param = None,
    allow_load: _AllowLoad = False,
    load_dir: _LoadDir = None,
    sim_time: _SimTime = False,  # read by `_loop`
    via: Via = None,
) -> None:
    """Run functions as the nodes of one module, until all have ended, or Ctrl-C.

    A crash ends only that node; the command then exits with 1. With --allow-load it runs until Ctrl-C, also without
    functions: nodes may be started later.
    """
    if not functions and not allow_load:
        raise UsageError("which function? r2p run blink.py:blink; with --allow-load, nodes can be started later")
    if load_dir is not None and not allow_load:
        raise UsageError("--load-dir says where the code for --allow-load is: give that, too")
    chosen = settings(via)
    check_urls(chosen.via, chosen.via_source)
    names = chosen.remap | parse_remap(remap or ())
    programs = load(functions or ())
    priorities = _parse_priorities(priority or (), programs)
    name = module or chosen.module or module_name_from(socket.gethostname())
    async with r2p.Module(
        name,
        via=chosen.via,
        remap=names,
        aliases=chosen.aliases,
        allow_control=allow_control,
        params_file=params_file or chosen.params_file,
        params=parameter_sources(name, chosen, params or (), param or ()),
        allow_load=load_dir or allow_load,
    ) as host:
        for program in programs:
            host.start(program.function, name=program.name, priority=priorities.get(program.name, 0), restart=restart)
        nodes = ", ".join(program.name for program in programs) or "no node yet (r2p node start)"
        links = ", ".join(chosen.via) or "none, local only (--via joins a network)"
        logger.info("module %s runs %s; links: %s; Ctrl-C ends it", host.name, nodes, links)
        await host.wait()


def parameter_sources(
    module: str, chosen: Settings, files: Iterable[Path], options: Iterable[str]
) -> list[ParameterSource]:
    """Return where first values of parameters come from; of several files, the last one wins. Raises UsageError."""
    try:
        tables = [(path, read_file(path, module)) for path in files]
        for path in (path for path, table in tables if not table.values):
            notify(f"{path} has no parameters of {module}: their tables are [params.{module}.node]")
        return [
            of_module(module, chosen.params, Origin.CONFIG, "r2p.toml"),
            *(table for _, table in reversed(tables)),
            from_options(options),
        ]
    except r2p.ParameterError as error:
        raise UsageError(str(error)) from error


def load(targets: Iterable[str]) -> list[Program]:
    """Return the functions of targets: `FILE:FUNCTION[=NAME]` or `package.module:FUNCTION[=NAME]`.

    Raises UsageError, which says what to do, and r2p.Error with a traceback for an error in a file.
    """
    programs: list[Program] = []
    for target in targets:
        program = _program(target)
        if program.name in (other.name for other in programs):
            raise UsageError(f"{target}: there is already a node {program.name}; {_rename_hint(target)}")
        programs.append(program)
    return programs


def _program(target: str) -> Program:
    where, _, name = target.partition("=")
    path, _, attribute = where.rpartition(":") if ":" in where else (where, "", "")
    function = _function(path, attribute, load_module(path))
    try:
        return Program(function, node_name(name) if name else r2p.name_of(function))
    except r2p.NameTooLong as error:
        raise UsageError(f"{target}: a node name has at most {NODE_MAX} characters; {_rename_hint(target)}") from error


def _rename_hint(target: str) -> str:
    return f"use another name: {target.partition('=')[0]}=NAME"


def _function(path: str, attribute: str, module: ModuleType) -> r2p.NodeFunction:
    if not attribute:
        raise UsageError(f"{path}: which function? {_choice(path, module)}")
    function: r2p.NodeFunction | None = getattr(module, attribute, None)
    if function is None:
        close = difflib.get_close_matches(attribute, _functions(module), n=1)
        hint = f"did you mean {close[0]}?" if close else _choice(path, module)
        raise UsageError(f"{path} has no function {attribute}; {hint}")
    try:
        with contextlib.suppress(r2p.InvalidName):  # the target may give it another name
            r2p.name_of(function)
    except r2p.Error as error:
        if inspect.iscoroutinefunction(function):  # but its arguments are wrong
            raise UsageError(f"{path}: {error}") from error
        raise UsageError(f"{path}:{attribute} is not a node: write `async def {attribute}(node: r2p.Node)`") from error
    return function


def _choice(path: str, module: ModuleType) -> str:
    names = _functions(module)
    if not names:
        return "it defines no node; write `async def blink(node: r2p.Node) -> None`"
    return f"it has {', '.join(names)}: r2p run {path}:{names[0]}"


def _functions(module: ModuleType) -> list[str]:
    """Return the names of the coroutine functions that a module defines itself."""
    return [
        name
        for name, value in vars(module).items()
        if inspect.iscoroutinefunction(value) and value.__module__ == module.__name__
    ]


def _parse_priorities(priority: Iterable[str], programs: list[Program]) -> dict[str, int]:
    names = [program.name for program in programs]
    priorities: dict[str, int] = {}
    for each in priority:
        name, _, number = each.partition("=")
        if name not in names:
            raise UsageError(f"--priority {each}: there is no node {name}; the nodes are {', '.join(names)}")
        try:
            priorities[name] = int(number)
        except ValueError as error:
            raise UsageError(f"--priority {each}: write it as NODE=N, for example {name}=10") from error
    return priorities


def load_module(where: str) -> ModuleType:
    """Import `FILE.py` or `package.module`, once.

    A file can import its neighbours, a package what is in the working directory, as with `python` itself. Raises
    UsageError if it does not exist, for what r2p refuses in it, and if it runs a program; r2p.Error with the traceback
    for other errors in it.
    """
    if where.endswith(".py") or "/" in where:
        return _load_file(where)
    try:
        _add_to_path(Path.cwd())
    except FileNotFoundError as error:
        raise UsageError("the working directory does not exist any more: change to another one") from error
    try:
        return importlib.import_module(where)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{where}.".startswith(f"{error.name}."):
            raise _broken(where, error) from error
        hint = f"did you mean {where}.py?" if Path(f"{where}.py").exists() else "the name of a file must end with .py"
        raise UsageError(f"there is no module {error.name} here; {hint}") from error
    except Exception as error:
        raise _broken(where, error) from error


def _load_file(where: str) -> ModuleType:
    path = Path(where)
    if not path.is_file():
        raise UsageError(f"there is no file {where}")
    path = path.resolve()
    for known in list(sys.modules.values()):
        if getattr(known, "__file__", None) == str(path):
            return known
    # A file named json.py must not replace the module that others have imported.
    name = path.stem if path.stem not in sys.modules else f"_r2p_{path.stem}"
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise UsageError(f"{where} is not a Python file: its name must end with .py")
    module = importlib.util.module_from_spec(spec)
    _add_to_path(path.parent)
    sys.modules[name] = module  # before it is executed, as `import` does: its dataclasses look it up
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        del sys.modules[name]
        raise _broken(where, error) from error
    return module


def _add_to_path(directory: Path) -> None:
    if str(directory) not in sys.path:
        sys.path.insert(0, str(directory))


def _broken(where: str, error: Exception) -> Exception:
    """Return what to raise for an error of the user's code while it is loaded.

    An error of r2p says what to do, so its place is enough. Others come with their traceback.
    """
    frames = list(traceback.walk_tb(error.__traceback__))
    own = [(frame.f_code, line) for frame, line in frames if not _loads(frame) and not internal(_file(frame))]
    if own and frames[-1][0].f_code in _RUNNERS:
        _close_coroutines(frames[-1][0])
        place = _place(*next(each for each in reversed(own) if each[0].co_name == "<module>"))
        return UsageError(f'{place} runs as soon as the file is loaded: put it under `if __name__ == "__main__":`')
    if own and isinstance(error, r2p.Error):
        return UsageError(f"{_place(*own[-1])}: {error}")
    trace = error.__traceback__
    while trace is not None and _loads(trace.tb_frame):
        trace = trace.tb_next
    text = "".join(traceback.format_exception(type(error), error, trace))
    return r2p.Error(f"can't load {where}:\n{text.rstrip()}")


_RUNNERS = (r2p.run_main.__code__, asyncio.run.__code__, asyncio.Runner.run.__code__)
"""What raises where an event loop runs already: that of this command."""


def _loads(frame: FrameType) -> bool:
    return _file(frame).startswith((__file__, str(importlib.__file__), "<frozen importlib"))


def _file(frame: FrameType) -> str:
    return frame.f_code.co_filename


def _place(code: CodeType, line: int) -> str:
    """Return `FILE, line N`, relative to the working directory where the file is in it."""
    path = Path(code.co_filename)
    return f"{path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path}, line {line}"


def _close_coroutines(frame: FrameType) -> None:
    """Close what the program would have run: otherwise Python warns that it was never awaited."""
    for value in frame.f_locals.values():
        if inspect.iscoroutine(value):
            value.close()
