"""`r2p run`: functions out of files and packages as the nodes of one module."""

import contextlib
import difflib
import importlib
import importlib.util
import inspect
import logging
import sys
import traceback
from collections.abc import Iterable
from pathlib import Path
from types import ModuleType
from typing import Annotated

import msgspec
import typer

import r2p
from r2p.names import NODE_MAX, node_name, topic_name
from r2p.tools.session import Quiet, Usage, Verbose, Via, check_urls, execute, settings

logger = logging.getLogger("r2p.runner")


class Program(msgspec.Struct, frozen=True):
    """A function to run as a node of this name."""

    function: r2p.NodeFunction
    name: str


def command(
    functions: Annotated[
        list[str],
        typer.Argument(
            metavar="FILE:FUNCTION[=NAME]",
            help="blink.py:blink, blink.py:blink=left, package.module:function.",
            show_default=False,
        ),
    ],
    module: Annotated[
        str | None, typer.Option(metavar="NAME", help="The module's name; else from r2p.toml or the host name.")
    ] = None,
    remap: Annotated[
        list[str] | None, typer.Option(metavar="OLD:=NEW", help="Rename a topic for all its nodes (may repeat).")
    ] = None,
    priority: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NODE=N", help="Nodes of higher priority get their messages first; default 0 (may repeat)."
        ),
    ] = None,
    restart: Annotated[bool, typer.Option("--restart", help="Start a node that crashed again, after a pause.")] = False,
    via: Via = None,
    verbose: Verbose = 0,
    quiet: Quiet = 0,
) -> None:
    """Run functions as the nodes of one module, until all have ended or Ctrl-C ends them.

    A node that crashes ends alone, the others run on; the command then exits with 1.
    """

    async def main() -> None:
        chosen = settings(via)
        check_urls(chosen.via)
        programs = load(functions)
        priorities = _priorities(priority or (), programs)
        names = chosen.remap | _renamed(remap or ())
        async with r2p.Module(module or chosen.module, via=chosen.via, remap=names) as host:
            for program in programs:
                host.start(
                    program.function, name=program.name, priority=priorities.get(program.name, 0), restart=restart
                )
            nodes = ", ".join(program.name for program in programs)
            links = ", ".join(chosen.via) or "none, local only (--via joins a network)"
            logger.info("module %s runs %s; links: %s; Ctrl-C ends it", host.name, nodes, links)
            await host.wait()

    execute(main, verbose=verbose, quiet=quiet)


def load(targets: Iterable[str]) -> list[Program]:
    """The functions that these name, as `FILE:FUNCTION[=NAME]` or `package.module:FUNCTION[=NAME]`.

    Raises Usage, which says what to do, and r2p.Error with its traceback when a file can't be executed.
    """
    programs: list[Program] = []
    for target in targets:
        program = _program(target)
        if program.name in (other.name for other in programs):
            raise Usage(f"{target}: there is a node {program.name} already; {_name_it(target)}")
        programs.append(program)
    return programs


def _program(target: str) -> Program:
    path, attribute, name = _split(target)
    function = _function(path, attribute, load_module(path))
    try:
        return Program(function, node_name(name) if name else r2p.name_of(function))
    except r2p.NameTooLong as error:
        raise Usage(f"{target}: a node's name has at most {NODE_MAX} characters; {_name_it(target)}") from error


def _split(target: str) -> tuple[str, str, str]:
    """Path, function (may be empty) and name (may be empty)."""
    where, _, name = target.partition("=")
    path, colon, function = where.rpartition(":")
    return (path, function, name) if colon else (where, "", name)


def _name_it(target: str) -> str:
    return f"give it another: {target.partition('=')[0]}=NAME"


def _function(path: str, attribute: str, module: ModuleType) -> r2p.NodeFunction:
    if not attribute:
        raise Usage(f"{path}: which function? {_choice(path, module)}")
    function: r2p.NodeFunction | None = getattr(module, attribute, None)
    if function is None:
        close = difflib.get_close_matches(attribute, _functions(module), n=1)
        hint = f"did you mean {close[0]}?" if close else _choice(path, module)
        raise Usage(f"{path} has no function {attribute}; {hint}")
    try:
        with contextlib.suppress(r2p.InvalidName):  # it may be given another one
            r2p.name_of(function)
    except r2p.Error as error:
        raise Usage(f"{path}:{attribute} is no node: write `async def {attribute}(node: r2p.Node)`") from error
    return function


def _choice(path: str, module: ModuleType) -> str:
    names = _functions(module)
    if not names:
        return "it has no node; write `async def blink(node: r2p.Node) -> None`"
    return f"it has {', '.join(names)}: r2p run {path}:{names[0]}"


def _functions(module: ModuleType) -> list[str]:
    """The coroutine functions that a module defines itself."""
    return [
        name
        for name, value in vars(module).items()
        if inspect.iscoroutinefunction(value) and value.__module__ == module.__name__
    ]


def _renamed(remap: Iterable[str]) -> dict[str, str]:
    names: dict[str, str] = {}
    for each in remap:
        old, found, new = each.partition(":=")
        if not found:
            raise Usage(f"--remap {each}: write it as OLD:=NEW, for example encoder:=encoder1")
        names[topic_name(old)] = topic_name(new)
    return names


def _priorities(priority: Iterable[str], programs: list[Program]) -> dict[str, int]:
    names = [program.name for program in programs]
    priorities: dict[str, int] = {}
    for each in priority:
        name, _, number = each.partition("=")
        if name not in names:
            raise Usage(f"--priority {each}: there is no node {name}; the nodes are {', '.join(names)}")
        try:
            priorities[name] = int(number)
        except ValueError as error:
            raise Usage(f"--priority {each}: write it as NODE=N, for example {name}=10") from error
    return priorities


# Importing the user's files and packages, with errors that tell what to do and tracebacks without our own frames.


def load_module(where: str) -> ModuleType:
    """The module that `FILE.py` or `package.module` names; imported once, however often it is named.

    A file finds what lies beside it, a package what lies in the working directory, as with `python` itself. Raises
    Usage if there is no such thing, and r2p.Error with the traceback if it can't be executed.
    """
    if where.endswith(".py") or "/" in where:
        return _load_file(where)
    try:
        _look_in(Path.cwd())
    except FileNotFoundError as error:
        raise Usage("the working directory does not exist any more: go to another one") from error
    try:
        return importlib.import_module(where)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{where}.".startswith(f"{error.name}."):
            raise _broken(where, error) from error
        hint = f"did you mean {where}.py?" if Path(f"{where}.py").exists() else "a file's name ends with .py"
        raise Usage(f"there is no module {error.name} here; {hint}") from error
    except Exception as error:
        raise _broken(where, error) from error


def _load_file(where: str) -> ModuleType:
    path = Path(where)
    if path.is_file():
        path = path.resolve()
    else:
        raise Usage(f"there is no file {where}")
    for known in list(sys.modules.values()):
        if getattr(known, "__file__", None) == str(path):
            return known
    name = path.stem if path.stem not in sys.modules else f"_r2p_{path.stem}"
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise Usage(f"{where} is no Python file: its name has to end with .py")
    module = importlib.util.module_from_spec(spec)
    _look_in(path.parent)
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        del sys.modules[name]
        raise _broken(where, error) from error
    return module


def _look_in(directory: Path) -> None:
    if str(directory) not in sys.path:
        sys.path.insert(0, str(directory))


def _broken(where: str, error: Exception) -> r2p.Error:
    frame = error.__traceback__
    while frame is not None and _is_ours(frame.tb_frame.f_code.co_filename):
        frame = frame.tb_next
    text = "".join(traceback.format_exception(type(error), error, frame))
    return r2p.Error(f"can't load {where}:\n{text.rstrip()}")


def _is_ours(filename: str) -> bool:
    return filename in {__file__, importlib.__file__} or filename.startswith("<frozen importlib")
