"""The `r2p` command: a table of commands, each imported only when it is called, so that `r2p --help` is fast.

A group of commands is a module with an `app`, made by `session.group(...)`; a single command is a module with a
function `command` for Typer. `r2p.tools.session` has how they join the network, and how they end.
"""

import errno
import functools
import importlib
import os
import re
import sys
from typing import Any, NoReturn

import typer
from typer.core import TyperGroup

from r2p.errors import Error
from r2p.log_lines import wrapped
from r2p.startup import INTERRUPTED, raise_on_interrupt
from r2p.tools.output import abandon_stdout, notify

GROUPS = {
    "topic": ("r2p.tools.topic", "List, watch, publish and measure topics."),
    "service": ("r2p.tools.service", "List, inspect and call services."),
    "node": ("r2p.tools.node", "List nodes; start, stop and swap them."),
    "param": ("r2p.tools.param", "List, get, set and save parameters of nodes."),
    "imu": ("r2p.tools.imu", "Calibrate inertial sensors."),
    "module": ("r2p.tools.module", "List, stop and restart modules."),
    "app": ("r2p.tools.app", "List, load, remove and start the apps of a firmware module."),
    "msg": ("r2p.tools.msg", "Show message types, and exchange them with C and ROS."),
    "bag": ("r2p.tools.bag", "Record topics to a file, and play, inspect and convert it."),
    "bus": ("r2p.tools.bus", "Inspect an RTCAN bus: load, frames, slots, worst cases. Serve a simulated one."),
    "key": ("r2p.tools.key", "Make a shared key for links."),
    "config": ("r2p.tools.config_show", "Show the settings, and where they come from."),
}
COMMANDS = {
    "run": ("r2p.tools.run", "Run functions as the nodes of a module."),
    "launch": ("r2p.tools.launch", "Start the commands of a file as one group, such as a robot."),
    "gateway": ("r2p.tools.gateway", "Join links to one network: a robot's bus, a debug line, zenoh."),
    "sim": ("r2p.tools.sim.command", "Run an emulated robot, without hardware."),
    "top": ("r2p.tools.top", "Show topics, modules and buses with their figures, as they change."),
    "dash": ("r2p.tools.dash", "Show the network, or a recording, in a browser."),
    "graph": ("r2p.tools.graph", "Show or draw which nodes publish which topics to which nodes."),
    "foxglove": ("r2p.tools.foxglove", "Serve the network to Foxglove and PlotJuggler."),
    "log": ("r2p.tools.log", "Print the log records of all modules."),
    "wait": ("r2p.tools.waiting", "Wait until a topic, node or module is there, for scripts."),
    "doctor": ("r2p.tools.doctor", "Check what this machine has and lacks for r2p, or try a link."),
    "demo": ("r2p.tools.demo", "Show r2p at work, without hardware."),
}

_COMPLETION_VARIABLE = "_R2P_COMPLETE"  # what a shell asks for, and for which shell
_COMPLETION_OPTIONS = ("--install-completion", "--show-completion")
_SHELLS = ("bash", "zsh", "fish", "powershell", "pwsh")

_TEXTS = {
    r"'.*' is not a valid int(eger| range)\.": "write a whole number",
    r"'.*' is not a valid float( range)?\.": "write a number",
    r"\S+ is not in the range x>=(\S+)\.": r"write a number of at least \1",
    r"\S+ is not in the range x<=(\S+)\.": r"write a number of at most \1",
    r"\S+ is not in the range (\S+)<=x<=(\S+)\.": r"write a number from \1 to \2",
}
"""Texts of Typer about values, as patterns, and what r2p says instead."""

LAUNCHER_VARIABLE = "R2P_LAUNCHER"
"""The environment variable by which `r2p launch` gives its process id to the commands that it starts."""


class LazyGroup(TyperGroup):
    """A group that knows its commands by name and help line, and imports the one that is called."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        option, equals, value = args[0].partition("=") if args else ("", "", "")
        shell = value if equals else next(iter(args[1:]), "")
        if option in _COMPLETION_OPTIONS and shell and not shell.startswith("-"):
            _complete_in(ctx, option, shell)
        return super().parse_args(ctx, args)

    def resolve_command(self, ctx: Any, args: list[str]) -> tuple[str | None, Any, list[str]]:
        name, command, rest = super().resolve_command(ctx, args)
        return name, command if name is None else _load(name), rest

    def invoke(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        except typer.BadParameter as error:
            error.message = _plain(error.message)
            error.message = _wrapped_behind(f"Error: {error.format_message()}", error.message)
            raise


def _plain(text: str) -> str:
    """Return what is wrong with a value, in r2p's words."""
    for pattern, plain in _TEXTS.items():
        text = re.sub(pattern, plain, text)
    return text


def _complete_in(ctx: Any, option: str, shell: str) -> None:
    """Install or print the completion of the given shell, and exit. Typer's own options only know the current one."""
    from typer import completion

    if shell not in _SHELLS:
        raise typer.BadParameter(f"{shell!r} is not one of {', '.join(_SHELLS)}", ctx, param_hint=option)
    call = completion.install_callback if option == "--install-completion" else completion.show_callback
    parameter: Any = None  # they do not use it
    call(ctx, parameter, shell)


def _wrapped_behind(shown: str, message: str) -> str:
    """Return an error's message with the line breaks that all of what is shown needs at a terminal."""
    begin = shown.removesuffix(message).rstrip()
    text = wrapped(shown, sys.stderr)
    return text.removeprefix(begin).removeprefix(" ") if text.startswith(begin) else message


app = typer.Typer(
    cls=LazyGroup,
    help="Typed topics from the microcontroller on the robot to the PC in the next town.",
    epilog="Completion is that of the current shell, or of the one named behind the option, such as zsh.",
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def main() -> None:
    """Run the command line: the entry point of the `r2p` script."""
    try:
        raise_on_interrupt()
        _open_missing_streams()
        _complete_or_run()
    except OSError as error:
        if error.errno != errno.ENOSPC:
            raise
        _exit_unwritable(error)
    except KeyboardInterrupt:  # before the command handles signals itself
        raise SystemExit(INTERRUPTED) from None
    except SystemExit as error:
        if isinstance(error.__context__, BrokenPipeError):
            abandon_stdout()
            raise SystemExit(0) from None
        raise
    finally:
        _flush()


def _complete_or_run() -> None:
    """Answer the shell that asks what may come next, or run the command."""
    run = functools.partial(app, prog_name="r2p")
    if os.environ.get(_COMPLETION_VARIABLE, "").startswith("complete_"):
        importlib.import_module("r2p.tools.completion").answer(run)
    else:
        run()


def _open_missing_streams() -> None:
    """Open /dev/null for the standard streams that the shell has closed (`<&-`, `>&-`).

    Otherwise a socket would get their number, and messages for the user would be sent to the network.
    """
    for fd, (name, mode) in enumerate((("stdin", "r"), ("stdout", "w"), ("stderr", "w"))):
        try:
            os.fstat(fd)
        except OSError:
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)  # the lowest free number: fd
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, mode))  # noqa: SIM115, PTH123 - stays open


def _flush() -> None:
    try:
        sys.stdout.flush()
    except BrokenPipeError:
        abandon_stdout()
    except OSError as error:
        _exit_unwritable(error)


def _exit_unwritable(error: OSError) -> NoReturn:
    abandon_stdout()
    notify(f"can't write the output: {error.strerror}")
    raise SystemExit(1) from error


def _show_version(wanted: bool) -> None:
    if wanted:
        import r2p

        typer.echo(f"r2p {r2p.__version__}")
        raise typer.Exit


@app.callback()
def _root(
    version: bool = typer.Option(False, "--version", is_eager=True, callback=_show_version, help="Print the version."),
) -> None:
    """Options of the command itself."""


def _load(name: str) -> Any:
    if name in GROUPS:
        return typer.main.get_command(importlib.import_module(GROUPS[name][0]).app)
    single = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)
    try:
        single.command(name)(importlib.import_module(COMMANDS[name][0]).command)
    except Error as error:  # what it needs of an extra is not installed
        notify(str(error))
        raise SystemExit(1) from error
    return typer.main.get_command(single)


for _name, (_path, _summary) in (GROUPS | COMMANDS).items():
    app.command(_name, help=_summary)(lambda: None)  # `resolve_command` puts the command itself in its place
