"""The entries of [launch.NAME], checked before anything is started."""

import re
import shlex
from collections.abc import Iterable
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from typing import Literal, get_args

import msgspec

import r2p
from r2p.clock import duration
from r2p.tools.config import ConfigFile, LaunchTable, UsageError, did_you_mean
from r2p.tools.main import COMMANDS, GROUPS
from r2p.tools.waiting import KINDS, Kind, check_name

Restart = Literal["never", "on-failure", "always"]
RESTARTS: tuple[Restart, ...] = get_args(Restart)

_PORT_MAX = 65535
_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_-]*")  # it is part of the name of a unit
_CONDITIONS = "started, ended, topic NAME, node MODULE/NODE, module NAME, or port HOST:PORT"


class Entry(msgspec.Struct, frozen=True, kw_only=True):
    """A command to run: its arguments, what it waits for, and when it counts as ready.

    `after` names the entries that must be ready before it starts. It is ready when it has started, or has `ends`:
    ended with exit code 0; and all `ports` (host, port) accept connections, and all that is in `seen` is on the
    network. Times are in seconds.
    """

    name: str
    arguments: tuple[str, ...]
    after: tuple[str, ...] = ()
    ends: bool = False
    ports: tuple[tuple[str, int], ...] = ()
    seen: tuple[tuple[Kind, str], ...] = ()
    restart: Restart = "never"
    required: bool = False
    environment: dict[str, str] = {}
    ready_timeout: float = 30.0
    stop_timeout: float = 5.0

    @property
    def condition(self) -> str:
        """Return the ready condition as text, for messages."""
        ports = [f"port {host}:{port}" for host, port in self.ports]
        return ", ".join(["ended"] * self.ends + ports + [f"{kind} {name}" for kind, name in self.seen]) or "started"


def parse_entries(path: Path, file: ConfigFile) -> list[Entry]:
    """Return the entries of a file in its order. Raises UsageError, which names the file, the entry and the key."""
    if not file.launch:
        raise UsageError(f"{path} has no table [launch.NAME]: add one for each command to start")
    entries: list[Entry] = []
    try:
        for name, table in file.launch.items():
            entries.append(_parse_entry(name, table, [each.name for each in entries[-1:]]))
        _check_order(entries)
        _check_modules(entries, file.module)
    except ValueError as error:
        raise UsageError(f"{path}: {error}") from error
    return entries


def _parse_entry(name: str, table: LaunchTable, before: list[str]) -> Entry:
    """Return one entry; `before` is the one before it, if any."""
    try:
        if not _NAME.fullmatch(name):
            raise ValueError("use letters, digits, - and _ in its name")
        conditions = [_parse_condition(each) for each in _listed(table.ready)]
        ends = ("ended", "") in conditions
        restart = _parse_restart(table.restart)
        if ends and restart == "always":
            raise ValueError("never ends with restart = 'always': use another ready, or restart = 'on-failure'")
        return Entry(
            name=name,
            arguments=tuple(_parse_command(table.command)),
            after=tuple(before if table.after is None else _listed(table.after)),
            ends=ends,
            ports=tuple(_parse_port(where) for kind, where in conditions if kind == "port"),
            seen=tuple((known, where) for known in KINDS for kind, where in conditions if kind == known),
            restart=restart,
            required=table.required,
            environment=table.env,
            ready_timeout=_parse_time("ready_timeout", table.ready_timeout),
            stop_timeout=_parse_time("stop_timeout", table.stop_timeout),
        )
    except (ValueError, r2p.Error) as error:
        raise ValueError(f"[launch.{name}] {error}") from error


def _listed(value: str | list[str]) -> list[str]:
    return [value] if isinstance(value, str) else value


def _parse_command(command: str | list[str]) -> list[str]:
    """Return the arguments of `r2p`; a text is split as by a shell."""
    try:
        words = shlex.split(command) if isinstance(command, str) else command
    except ValueError as error:
        raise ValueError(f"command: {error}") from error
    words = words[1:] if words[:1] == ["r2p"] else words
    known = (GROUPS | COMMANDS).keys() - {"launch"}  # launched again, the file would start itself for ever
    if not words:
        raise ValueError("command is empty: write a command of r2p, such as run robot.py:blink")
    if words[0] not in known:
        raise ValueError(
            f"command: r2p has no command {words[0]} to launch; {did_you_mean(words[0], known, 'commands')}"
        )
    return words


def _parse_condition(text: str) -> tuple[str, str]:
    kind, _, name = text.strip().partition(" ")
    name = name.strip()
    alone = kind in {"started", "ended"}
    if alone == bool(name) or not (alone or kind == "port" or kind in KINDS):
        raise ValueError(f"ready = {text!r}: write {_CONDITIONS}")
    for known in KINDS:
        if kind == known:
            check_name(known, name)
    return kind, name


def _parse_port(text: str) -> tuple[str, int]:
    """Return host and port; without a host, this computer."""
    host, _, port = text.rpartition(":")
    if not port.isdecimal() or not 0 < int(port) <= _PORT_MAX:
        raise ValueError(f"ready = 'port {text}': write port HOST:PORT, or port PORT for this computer")
    return host.strip("[]") or "127.0.0.1", int(port)


def _parse_restart(text: str) -> Restart:
    for known in RESTARTS:
        if text == known:
            return known
    raise ValueError(f"restart = {text!r}; {did_you_mean(text, RESTARTS, 'values')}")


def _parse_time(key: str, value: float | str) -> float:
    try:
        seconds = duration(str(value))
    except ValueError as error:
        raise ValueError(f"{key}: {error}") from error
    if not seconds:
        raise ValueError(f"{key} must be greater than 0")
    return seconds


def _check_order(entries: Iterable[Entry]) -> None:
    """Raise ValueError if an entry starts after one that does not exist, or after itself."""
    after = {entry.name: entry.after for entry in entries}
    for name, others in after.items():
        for other in others:
            if other not in after:
                raise ValueError(f"[launch.{name}] after: no entry {other}; {did_you_mean(other, after, 'entries')}")
    try:
        TopologicalSorter(after).prepare()
    except CycleError as error:
        circle = error.args[1]
        raise ValueError(f"entries wait for each other: {' after '.join(reversed(circle))}") from error


def _check_modules(entries: Iterable[Entry], module: str | None) -> None:
    """Raise ValueError if two commands would make modules of the same, default name; `module` is that of the file."""
    unnamed: dict[str, list[str]] = {}
    for entry in entries:
        kind, *options = entry.arguments
        if kind in {"run", "gateway"} and not any(each.startswith(("--module", "--name")) for each in options):
            unnamed.setdefault(module or kind, []).append(entry.name)
    for names in unnamed.values():
        if len(names) > 1:
            raise ValueError(
                f"{' and '.join(names)} would be modules of the same name: add --module NAME to each command"
            )
