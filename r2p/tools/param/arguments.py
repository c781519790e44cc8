"""The arguments of `r2p param`, and their completion from what modules answer."""

import asyncio
import contextlib
from typing import Annotated

import typer

import r2p
from r2p.tools.completion import beginning, modules, on_network, silence
from r2p.tools.param.targets import Infos, meant
from r2p.tools.session import Session, settings
from r2p.tools.types import Types

_ANSWERS = 0.5  # seconds to wait for the answers of modules while a shell completes


def complete_target(ctx: typer.Context, incomplete: str) -> list[str]:
    """Completions for a reference: modules, nodes with parameters, and parameters behind a node and a dot."""

    async def references(session: Session) -> list[str]:
        infos = await _infos(session)
        nodes = [f"{info.module}/{info.node}" for info in infos]
        begun = [info.full_name for info in infos if incomplete.startswith(f"{info.module}/{info.node}.")]
        return begun or [*await modules(session), *nodes]

    return beginning(incomplete, on_network(ctx, references))


def complete_module_with_parameters(ctx: typer.Context, incomplete: str) -> list[str]:
    """Completions for a module that has parameters."""

    async def with_parameters(session: Session) -> list[str]:
        return [info.module for info in await _infos(session)]

    return beginning(incomplete, on_network(ctx, with_parameters))


def complete_name(ctx: typer.Context, incomplete: str) -> list[str]:
    """Completions for the name of a parameter, behind a reference; with --as, of a field of that type."""
    target = ctx.params.get("target")
    if ctx.params.get("as_"):
        return beginning(incomplete, _fields(ctx.params["as_"]))

    async def names(session: Session) -> list[str]:
        infos = await _infos(session)
        return [info.name for info in (meant(infos, target) if target else infos)]

    return beginning(incomplete, on_network(ctx, names))


def complete_assignment(ctx: typer.Context, incomplete: str) -> list[str]:
    """Completions for NAME=VALUE: the name, and the values if they have names."""
    target, name = ctx.params.get("target"), incomplete.partition("=")[0]

    async def values(session: Session) -> list[str]:
        infos = [info for info in meant(await _infos(session), target or "") if info.name == name]
        return [f"{name}={value}" for info in infos for value in _values_of(info)]

    return beginning(incomplete, on_network(ctx, values)) if "=" in incomplete else complete_name(ctx, incomplete)


def _fields(text: str) -> list[str]:
    """Return the names of the fields of a type that the user names."""
    with silence():
        return [field.wire_name for field in r2p.layout(Types(settings()).load(text)).fields]
    return []


def _values_of(info: r2p.ParameterInfo) -> tuple[str, ...]:
    return ("true", "false") if info.kind == "bool" else info.choices


async def _infos(session: Session) -> Infos:
    """Return what the modules answer in a short time; those that do not are left out."""

    async def ask(module: str) -> Infos:
        with contextlib.suppress(r2p.Error, TimeoutError):
            async with asyncio.timeout(_ANSWERS):
                return await session.module.network.parameters(module)
        return []

    views = session.module.network.modules()
    names = [view.name for view in views if view.link and view.instance is not None and view.state != "observer"]
    return [info for found in await asyncio.gather(*map(ask, names)) for info in found]


Target = Annotated[
    str,
    typer.Argument(
        metavar="MODULE/NODE",
        autocompletion=complete_target,
        show_default=False,
        help="Or NODE, MODULE, or one parameter: MODULE/NODE.NAME.",
    ),
]
MaybeTarget = Annotated[
    str | None,
    typer.Argument(
        metavar="MODULE/NODE",
        autocompletion=complete_target,
        show_default=False,
        help="Or NODE, MODULE, or one parameter: MODULE/NODE.NAME; default: all modules.",
    ),
]
ModuleNames = Annotated[
    list[str], typer.Argument(metavar="MODULE", autocompletion=complete_module_with_parameters, show_default=False)
]
Names = Annotated[
    list[str] | None,
    typer.Argument(metavar="NAME", autocompletion=complete_name, show_default=False, help="Only these of them."),
]
Assignments = Annotated[
    list[str] | None,
    typer.Argument(
        metavar="NAME=VALUE",
        autocompletion=complete_assignment,
        show_default=False,
        help="One or several; or NAME VALUE.",
    ),
]
