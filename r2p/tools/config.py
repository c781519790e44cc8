"""The file of a robot, r2p.toml, and the settings of a command: from options, the environment, the file, or a default.

`read` returns what a file contains, and `settings` what a command works with. Both raise UsageError, which names the
file and the key. A file can name code to run (types of topics, commands to launch), so one that other users can write
is rejected.
"""

import difflib
import os
import re
import socket
import stat
import tomllib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from r2p.codecs.parameters import Name
from r2p.errors import InvalidName
from r2p.names import check_aliases, module_name, module_name_from, topic_name
from r2p.parameters.sources import TABLE, read_tables

T = TypeVar("T", bound=msgspec.Struct)

CONFIG = "r2p.toml"
"""The default name of the file, in the working directory."""
CONFIG_VARIABLE = "R2P_CONFIG"
"""The environment variable that names another file."""
VIA_VARIABLE = "R2P_VIA"

_LOOPBACK = {"": "127.0.0.1", "0.0.0.0": "127.0.0.1", "[::]": "[::1]"}


class UsageError(Exception):
    """The command line asks for something impossible: exit code 2."""


class LaunchTable(msgspec.Struct, kw_only=True):
    """The keys of [launch.NAME]; `r2p.tools.launch` checks them. Times are in seconds, or texts with a unit."""

    command: str | list[str]
    after: str | list[str] | None = None
    ready: str | list[str] = "started"
    restart: str = "never"
    required: bool = False
    env: dict[str, str] = {}
    ready_timeout: float | str = 30.0
    stop_timeout: float | str = 5.0


class ConfigFile(msgspec.Struct):
    """The keys of the file."""

    via: str | list[str] = []
    module: str | None = None
    types: dict[str, str] = {}
    remap: dict[str, str] = {}
    alias: dict[str, str] = {}
    launch: dict[str, LaunchTable] = {}
    params_file: str | None = None
    params: dict[str, dict[Name, Any]] = {}
    """By module, then by (node, parameter)."""


class Settings(msgspec.Struct):
    """Settings of a command. `types`: "package.module:Class" by topic; `aliases` of topics and services, by name."""

    via: list[str] = []
    module: str | None = None
    types: dict[str, str] = {}
    remap: dict[str, str] = {}
    aliases: dict[str, str] = {}
    via_source: str = "--via"
    """Where `via` is from, for errors."""
    params_file: Path | None = None
    params: dict[str, dict[Name, Any]] = {}
    """Values of parameters: by module, then by (node, parameter)."""


class Setting(msgspec.Struct, frozen=True):
    """One value, and its source: an option, an environment variable, the file, or a default."""

    key: str
    value: Any
    source: str


def settings(via: list[str] | None = None, path: Path | None = None, *, tool: bool = False) -> Settings:
    """Return the settings. `via` is the argument, else R2P_VIA, else of the file: `path`, or the one that `find` finds.

    R2P_VIA and the file are shared with the robot's program: where that listens, a `tool` on this machine connects.
    Raises UsageError for a file that can't be read, or that other users can write.
    """
    path = path or find()
    file = read(path) if path else ConfigFile()
    urls, source = _choose_via(via, path, file)
    if tool and source != "--via":
        urls = [_local_peer(url) for url in urls]
    params_file = None if path is None or file.params_file is None else path.parent / file.params_file
    return Settings(urls, file.module, _types(path, file), file.remap, file.alias, source, params_file, file.params)


def list_settings(via: list[str] | None = None, path: Path | None = None) -> list[Setting]:
    """Return each setting with its source; the file is `path`, or the one that `find` finds. Raises UsageError."""
    source = "argument" if path else CONFIG_VARIABLE if os.environ.get(CONFIG_VARIABLE) else "working directory"
    path = path or find()
    contents = _load(path) if path else {}
    file, name = _parse(path, contents) if path else ConfigFile(), path.name if path else ""
    own = (file.module, name) if file.module else (module_name_from(socket.gethostname()), "default: the host name")
    return [
        Setting("file", path and str(path.absolute()), source if path else "default: none"),
        Setting("via", *_choose_via(via, path, file)),
        Setting("module", *own),
        *(Setting(f"types.{topic}", text, name) for topic, text in _types(path, file).items()),
        *(Setting(f"remap.{topic}", text, name) for topic, text in file.remap.items()),
        *(Setting(f"alias.{topic}", text, name) for topic, text in file.alias.items()),
        *([Setting("params_file", file.params_file, name)] if file.params_file is not None else []),
        *(
            Setting(f"{TABLE}.{module}.{node}.{parameter}", value, name)
            for module, values in file.params.items()
            for (node, parameter), value in values.items()
        ),
        *(each for entry, table in file.launch.items() for each in _launch_settings(name, entry, table, contents)),
    ]


def find() -> Path | None:
    """Return the file that R2P_CONFIG names, else r2p.toml in the working directory; None without either."""
    named = os.environ.get(CONFIG_VARIABLE)
    try:
        path = Path.cwd() / (named or CONFIG)
    except FileNotFoundError:  # the working directory has been removed
        return None
    return path if named or os.path.lexists(path) else None


def read(path: Path) -> ConfigFile:
    """Return the contents of a file. Raises UsageError if it is missing, not valid, or writable by other users."""
    return _parse(path, _load(path))


def did_you_mean(name: str, known: Iterable[str], what: str) -> str:
    """Return the end of an error about an unknown name: the nearest known one, else all. `what` is their plural."""
    known = list(known)
    close = difflib.get_close_matches(name, known, n=1)
    return f"did you mean {close[0]}?" if close else f"the {what} are {', '.join(known)}"


def _launch_settings(file: str, entry: str, table: LaunchTable, contents: dict[str, Any]) -> Iterator[Setting]:
    given = contents["launch"][entry]
    for key, value in msgspec.structs.asdict(table).items():
        yield Setting(f"launch.{entry}.{key}", value, file if key in given else "default")


def _choose_via(given: list[str] | None, path: Path | None, file: ConfigFile) -> tuple[list[str], str]:
    """Return the URLs that count, and their source."""
    if given:
        return given, "--via"
    from_environment = os.environ.get(VIA_VARIABLE, "").split()
    if from_environment:
        return from_environment, VIA_VARIABLE
    from_file = [file.via] if isinstance(file.via, str) else file.via
    return from_file, path.name if path and from_file else "default: local only"


def _types(path: Path | None, file: ConfigFile) -> dict[str, str]:
    """Return [types], with the names of files as seen from the working directory."""
    if path is None or path.parent == Path.cwd():
        return file.types
    return {topic: _located(text, path.parent) for topic, text in file.types.items()}


def _located(text: str, directory: Path) -> str:
    where, _, name = text.rpartition(":")
    return f"{directory / where}:{name}" if where.endswith(".py") or "/" in where else text


def _local_peer(url: str) -> str:
    """Return the URL by which a tool on the same machine reaches a program that has opened this one."""
    scheme, _, rest = url.partition(":")
    if scheme != "tcp-listen":
        return url
    address, *options = re.split("[?,&]", rest)
    return _loopback(address) + "".join(f"?{each}" for each in options if each.startswith("key="))


def _loopback(address: str) -> str:
    host, colon, port = address.rpartition(":")
    if not colon or not port.isdecimal():  # only a host (and the usual port), or only a port
        return f"tcp:127.0.0.1:{address}" if address.isdecimal() else f"tcp:{_LOOPBACK.get(address, address)}"
    return f"tcp:{_LOOPBACK.get(host, host)}:{port}"


def _load(path: Path) -> dict[str, Any]:
    """Return the tables of a file, unchecked. Raises UsageError if that fails, and if other users can write it."""
    try:
        with path.open(encoding="utf-8") as file:
            check_owned(path, os.fstat(file.fileno()))
            return tomllib.loads(file.read())
    except FileNotFoundError as error:
        named = f" ({CONFIG_VARIABLE} names it)" if os.environ.get(CONFIG_VARIABLE) and path == find() else ""
        raise UsageError(f"there is no file {path}{named}") from error
    except OSError as error:
        raise UsageError(f"can't read {path}: {error.strerror}") from error
    except RecursionError as error:
        raise UsageError(f"{path} is nested too deeply") from error
    except ValueError as error:  # not TOML, or not UTF-8
        raise UsageError(f"{path}: {error}") from error


def _parse(path: Path, contents: dict[str, Any]) -> ConfigFile:
    """Return the tables as a ConfigFile. Raises UsageError, which names the file, the table and the key."""
    try:
        simple = {key: value for key, value in contents.items() if key not in ("launch", TABLE)}
        file = _convert(simple, ConfigFile, "")
        file.launch = dict(_entries(contents.get("launch", {})))
        file.params = read_tables(contents.get(TABLE, {}))
        file.alias = _aliases(file.alias)
        _check_names(file)
    except (ValueError, InvalidName) as error:
        raise UsageError(f"{path}: {error}") from error
    return file


def _check_names(file: ConfigFile) -> None:
    """Raise InvalidName for a name that no module or topic can have."""
    if file.module is not None:
        module_name(file.module)
    for topic in (*file.types, *file.remap, *file.remap.values()):
        topic_name(topic)


def _entries(launch: Any) -> Iterator[tuple[str, LaunchTable]]:
    if not isinstance(launch, dict) or not all(isinstance(table, dict) for table in launch.values()):
        raise ValueError("launch: write a table [launch.NAME] for each command")
    for name, table in launch.items():
        where = f"[launch.{name}] "
        _check_keys(table, LaunchTable, where)
        if "command" not in table:
            raise ValueError(f'{where}has no command: add one, such as command = "run robot.py:blink"')
        yield name, _convert(table, LaunchTable, where)


def _aliases(given: dict[str, str]) -> dict[str, str]:
    try:
        return check_aliases(given)
    except InvalidName as error:
        raise ValueError(f"[alias] {error}") from error


def _convert(table: dict[str, Any], cls: type[T], where: str) -> T:
    _check_keys(table, cls, where)
    try:
        return msgspec.convert(table, cls)
    except msgspec.ValidationError as error:
        problem, _, place = str(error).replace("`", "").partition(" - at $.")
        raise ValueError(f"{where}{place}: {problem[:1].lower()}{problem[1:]}") from error


def _check_keys(table: dict[str, Any], cls: type[msgspec.Struct], where: str) -> None:
    known = cls.__struct_fields__
    for key in table:
        if key not in known:
            raise ValueError(f"{where}unknown key {key}; {did_you_mean(key, known, 'keys')}")


def check_owned(path: Path, status: os.stat_result) -> None:
    """Raise UsageError for a configuration that a user other than root can write: it can name code to run."""
    if os.name != "posix":
        return
    owners = {0, os.geteuid()}
    if os.geteuid() == 0:  # with sudo, the file may belong to the user who called it
        owners.add(int(os.environ.get("SUDO_UID", "0")))
    if status.st_uid not in owners:
        raise UsageError(f"{path} belongs to another user and can name code to run: chown it, or use another directory")
    if status.st_mode & stat.S_IWOTH or (status.st_mode & stat.S_IWGRP and not _is_private(status)):
        raise UsageError(f"{path} is writable by other users and can name code to run: chmod go-w {path}")


def _is_private(status: os.stat_result) -> bool:
    """Return whether the group of a file is its owner's own: it has the same name and no other members."""
    import grp
    import pwd

    try:
        group, owner = grp.getgrgid(status.st_gid), pwd.getpwuid(status.st_uid).pw_name
    except KeyError:
        return False
    return group.gr_name == owner and set(group.gr_mem) <= {owner}
