"""Groups of commands that are imported when they are called, for those that take a while."""

from collections.abc import Callable, Mapping
from typing import Any

import typer
from typer.core import TyperGroup

Register = Callable[[typer.Typer], object]
"""Imports a command, and makes it the only one of a Typer."""


class _LazyCommands(TyperGroup):
    """A group of commands, each imported only when it is called."""

    registers: Mapping[str, Register]

    def load(self, name: str) -> Any:
        """Import a command."""
        single = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)
        self.registers[name](single)
        return typer.main.get_command(single)

    def resolve_command(self, ctx: Any, args: list[str]) -> tuple[str | None, Any, list[str]]:
        name, command, rest = super().resolve_command(ctx, args)
        return name, command if name is None else self.load(name), rest


def lazy_group(help: str, commands: Mapping[str, tuple[str, Register]]) -> typer.Typer:
    """Return a group for `main.GROUPS` that imports a command when it is called: by name, their help and imports.

    For groups of many commands, of which each takes a while to import.
    """
    kind = type("LazyCommands", (_LazyCommands,), {"registers": {name: each for name, (_, each) in commands.items()}})
    app = typer.Typer(
        cls=kind,
        help=help,
        no_args_is_help=True,
        add_completion=False,
        rich_markup_mode=None,
        pretty_exceptions_enable=False,
    )
    app.callback()(lambda: None)
    for name, (summary, _) in commands.items():
        app.command(name, help=summary)(lambda: None)  # `resolve_command` puts the command itself in its place
    return app
