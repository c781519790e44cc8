"""`r2p param set`, `load`, `reset` and `save`: commands that change something.

What one command changes in one module is all or nothing there.
"""

import contextlib
import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

import r2p
from r2p.parameters.sources import TABLE, read_tables, read_toml
from r2p.tools.module import unknown_module
from r2p.tools.options import Format
from r2p.tools.output import Output, notify
from r2p.tools.param import firmware as on_firmware
from r2p.tools.param.arguments import Assignments, MaybeTarget, ModuleNames, Names, Target
from r2p.tools.param.firmware import App, As, Raw, Reboot
from r2p.tools.param.targets import Infos, find, find_modules, of_name, one_module, references, similar, with_name
from r2p.tools.param.texts import assignment, brief, plain, put_all, shown
from r2p.tools.session import Session, TimedOut, UsageError

_NUMBER = re.compile(r"-\.?[0-9]|-inf", re.IGNORECASE)
_HOW = "write r2p param set MODULE/NODE NAME=VALUE, with as many NAME=VALUE as you like"

Value = tuple[r2p.ParameterInfo, Any]
"""A parameter, and the value that it is to get."""


async def set_(
    session: Session,
    target: Target,
    assignments: Assignments = None,
    *,
    firmware: App = None,
    as_: As = None,
    raw: Raw = None,
    reboot: Reboot = False,
    format: Format = None,
) -> None:
    """Set parameters of a module: all of them, or none.

    The module must let it in: over TCP and zenoh with --allow-control or a key. With --firmware APP, fields of an app
    in the flash of firmware are set, and read back.
    """
    output = Output(format)
    words = [*(assignments or [])]
    if firmware is not None:
        async with on_firmware.config_area(session, target, firmware, as_, raw, reboot=reboot) as area:
            await on_firmware.set_(area, output, words)
        return
    on_firmware.check_unused(as_, raw, reboot=reboot)
    reference, pairs = _assigned(target, words)
    infos = await find(session, reference)
    values = _values(infos, reference, pairs)
    await _set(session, one_module([info for info, _ in values], reference), values)
    rows = [
        brief(info) | {"value": plain(value), "before": plain(info.value), "unit": info.unit} for info, value in values
    ]
    texts = [f"{assignment(info, value)} (was {shown(info, info.value)})" for info, value in values]
    await put_all(output, rows, texts)


async def load(
    session: Session,
    file: Annotated[Path, typer.Argument(metavar="FILE", show_default=False, help="As r2p param dump prints it.")],
    target: MaybeTarget = None,
) -> None:
    """Set what a file of dump has, or a part of it.

    Of each module all of them or, if one is refused, none. Read-only ones that have their value already are left out.
    """
    tables = _read(file, target)
    infos = await find(session, target)
    loaded = [_of_file(file, infos, target, module, values) for module, values in tables.items()]
    if target is not None and not any(values for _, values in loaded):
        raise UsageError(f"{file} has no parameters of {target}")
    for module, values in loaded:
        if values:
            await _set(session, module, values)
            notify(f"{module}: {len(values)} parameter{'' if len(values) == 1 else 's'} set")


async def reset(session: Session, target: Target, names: Names = None) -> None:
    """Undo what was set and saved.

    Parameters get the values that the module would start with without its saved file. The file itself changes with the
    next `r2p param save`. Read-only parameters stay.
    """
    infos = await find(session, target, names or [])
    module, network = one_module(infos, target), session.module.network
    # Those that are read-only and named are left to the module to refuse.
    chosen = [info for info in infos if not info.read_only or names or len(infos) == 1]
    with _answered(session, module):
        if target == module and not names:
            await network.reset_parameters(module)
        else:
            await network.set_parameters(module, dict.fromkeys((info.node, info.name) for info in chosen))
    count = len(chosen)
    notify(f"{module}: {count} parameter{'' if count == 1 else 's'} reset; the file of the module changes with save")


async def save(session: Session, modules: ModuleNames) -> None:
    """Have modules save what was set.

    Each writes to the file that it was started with (`r2p run --params-file`), for its next start.
    """
    for module in modules:
        await _check_module(session, module)
    for module in modules:
        with _answered(session, module):
            await session.module.network.save_parameters(module)
        notify(f"{module}: parameters saved")


async def _check_module(session: Session, module: str) -> None:
    """Raise UsageError for a node, TimedOut for a module that is not there, before any module saves."""
    modules = await find_modules(session, module)
    if module in modules:
        return
    begun = [each for each in modules if module.startswith(f"{each}/")]
    if begun:
        raise UsageError(f"a module saves all of its parameters: write r2p param save {begun[0]}")
    raise TimedOut(unknown_module(session, module))


# What is to be set


def _assigned(target: str, words: list[str]) -> tuple[str, list[tuple[str, str]]]:
    """Return the reference, and names (empty: what the reference means) with texts. Raises UsageError."""
    for word in words:
        if word.startswith("-") and not _NUMBER.match(word):
            raise UsageError(f"there is no option {word}")
    reference, found, text = target.partition("=")
    if found:  # MODULE/NODE.NAME=VALUE
        if words:
            raise UsageError(f"{target} is a parameter with its value: {_HOW}")
        return reference, [("", text)]
    pairs = [word.partition("=") for word in words]
    if words and all(found and name for name, found, _ in pairs):
        return target, [(name, text) for name, _, text in pairs]
    if len(words) == 1 and "=" not in words[0]:
        return target, [("", words[0])]
    if len(words) == 2 and "=" not in words[0]:
        return target, [(words[0], words[1])]
    raise UsageError(f"no value: {_HOW}" if not words else f"{' '.join(words)}: {_HOW}")


def _values(infos: Infos, reference: str, pairs: list[tuple[str, str]]) -> list[Value]:
    """Return the parameters with the values that the texts stand for. Raises ParameterError for other texts."""
    values: dict[str, Value] = {}
    for name, text in pairs:
        chosen = of_name(infos, name) if name else infos
        if not name and len(infos) > 1:
            raise UsageError(f"{reference} has several parameters, and {text} is one value: {_HOW}")
        if not chosen:
            raise r2p.Error(f"{reference} has no parameter {name}{similar(name, (i.name for i in infos), 'it has')}")
        if len(chosen) > 1:
            choices = ", ".join(info.full_name for info in chosen)
            raise UsageError(f"several parameters of {reference} are {name}: choose one of {choices}")
        if chosen[0].full_name in values:
            raise UsageError(f"{chosen[0].full_name} is set twice: leave out one of them")
        values[chosen[0].full_name] = chosen[0], chosen[0].parse(text)
    return list(values.values())


def _read(file: Path, target: str | None) -> dict[str, Mapping[tuple[str, str], object]]:
    """Return the tables of a file, by module. Raises UsageError for one that can't be read or has none."""
    if not file.exists():
        swapped = target is not None and Path(target).exists()
        hint = f"; the file comes first: r2p param load {target} {file}" if swapped else ""
        raise UsageError(f"there is no file {file}{hint}")
    try:
        tables = read_tables(read_toml(file).get(TABLE, {}))
    except r2p.ParameterError as error:
        text = str(error)
        raise UsageError(text if str(file) in text else f"{file}: {text}") from error
    if not any(tables.values()):
        raise UsageError(f"{file} has no parameters: write a table [{TABLE}.MODULE.node] for each node")
    return {module: values for module, values in tables.items() if values}


def _of_file(
    file: Path, infos: Infos, target: str | None, module: str, values: Mapping[tuple[str, str], object]
) -> tuple[str, list[Value]]:
    """Return the module of the network that a table of a file is for, and what of it the reference means."""
    name = with_name(module, dict.fromkeys(info.module for info in infos))
    if name is None:
        if target is not None:
            return module, []
        known = similar(module, (info.module for info in infos), "modules with parameters")
        raise TimedOut(f"{file} has parameters of {module}, which has none on the network{known}")
    by_name = {(info.node, info.name): info for info in infos if info.module == name}
    chosen = []
    for (node, own), value in values.items():
        if target is not None and target not in references(name, node, own):
            continue
        info = by_name.get((node, own))
        if info is None:
            known = similar(f"{node}.{own}", (f"{info.node}.{info.name}" for info in by_name.values()), "it has")
            raise r2p.Error(f"{file}: {name} has no parameter {node}.{own}{known}")
        wanted = tuple(value) if isinstance(value, list) else value
        if not (info.read_only and info.value == wanted):
            chosen.append((info, wanted))
    return name, chosen


# Asking the module


async def _set(session: Session, module: str, values: Iterable[Value]) -> None:
    with _answered(session, module):
        changes = {(info.node, info.name): value for info, value in values}
        await session.module.network.set_parameters(module, changes)


@contextlib.contextmanager
def _answered(session: Session, module: str) -> Iterator[None]:
    """Report that an answer of the module is awaited; that it does not come is a TimedOut."""
    try:
        with session.waiting(f"the answer of {module}"):
            yield
    except TimeoutError as error:
        raise TimedOut(str(error)) from error
