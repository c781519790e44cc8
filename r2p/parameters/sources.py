"""Where the value of a parameter comes from, and which source wins.

From the weakest to the strongest: the code, the saved file, `[params.MODULE.node]` of r2p.toml, `--params FILE`,
`--param kp=0.7`, and what was set at run time.
"""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec

from r2p.codecs.parameters import Name, Origin
from r2p.errors import InvalidName, ParameterError
from r2p.names import module_name, node_name, parameter_name

TABLE = "params"
"""The table of files: `[params.MODULE.node]`."""


class GivenValueError(ParameterError):
    """A parameter refuses a value that was given at the start. The user has to change the value, not the program."""


class ParameterSource(msgspec.Struct, eq=False):
    """Values that were given at the start of a module: by a file, by options, or by the program that made it.

    The keys of `values` are (node, parameter), or a text as users write it: "kp" of any node, or "node.kp". `label`
    names the source in errors. With `texts`, values are texts that the type of the parameter gives a meaning.
    """

    origin: Origin
    label: str
    values: Mapping[Name | str, object]
    texts: bool = False
    used: set[Name | str] = msgspec.field(default_factory=set)
    """Keys that a node has declared a parameter for."""

    def find(self, name: Name) -> Name | str | None:
        """Return the key of a parameter's value, the one that names its node before others; None without one."""
        keys = (name, ".".join(name), name[1])
        found = [key for key in keys if key in self.values]
        self.used.update(found)
        return found[0] if found else None

    def unused(self) -> list[str]:
        """Return the keys that no node has declared a parameter for."""
        return [key if isinstance(key, str) else ".".join(key) for key in self.values if key not in self.used]


GivenParameters = Mapping[str, object] | Mapping[Name, object] | Sequence[ParameterSource] | None
"""What `Module(params=)` takes; commands give sources of several kinds."""


def given(params: GivenParameters) -> list[ParameterSource]:
    """Return the sources that `Module(params=)` stands for, the strongest first.

    Raises ParameterError for a key that names no parameter.
    """
    if params is None:
        return []
    if not isinstance(params, Mapping):
        return sorted(params, key=lambda source: source.origin, reverse=True)
    values: dict[Name | str, object] = {_checked_key(key): value for key, value in params.items()}
    return [ParameterSource(Origin.ARGUMENT, "params=", values)]


def _checked_key(key: object) -> Name | str:
    match key:
        case str():
            for part in key.split("."):
                parameter_name(part)
            return key
        case (str() as node, str() as name):
            return node_name(node), parameter_name(name)
    raise ParameterError(f'params= with the key {key!r}: write "kp", "node.kp" or ("node", "kp")')


def from_options(options: Iterable[str]) -> ParameterSource:
    """Return the source of options `kp=0.7` and `node.kp=0.7`. Raises ParameterError for one that is neither."""
    values: dict[Name | str, object] = {}
    for option in options:
        name, found, text = option.partition("=")
        key = name.strip()
        try:
            if not found:
                raise InvalidName("it has no value")
            for part in key.split("."):
                parameter_name(part)
        except InvalidName as error:
            raise ParameterError(f"--param {option}: write it as NAME=VALUE or NODE.NAME=VALUE ({error})") from None
        values[key] = text
    return ParameterSource(Origin.OPTION, "--param", values, texts=True)


def of_module(module: str, tables: Mapping[str, Mapping[Name, object]], origin: Origin, label: str) -> ParameterSource:
    """Return the source with what a file has for a module."""
    return ParameterSource(origin, label, dict(tables.get(module, {})))


def read_tables(table: object, only: str | None = None) -> dict[str, dict[Name, object]]:
    """Return the values in the tables `[params.MODULE.node]` of a file, by module; tables within are dots of names.

    With `only`, those of other modules are not looked at. Raises ParameterError, which names the table.
    """
    if not isinstance(table, dict):
        raise ParameterError(f"{TABLE}: write a table [{TABLE}.MODULE.node] for each node")
    return {module: dict(_of_nodes(module, nodes)) for module, nodes in table.items() if only in (None, module)}


def _of_nodes(module: str, nodes: object) -> Iterable[tuple[Name, object]]:
    where = f"[{TABLE}.{module}]"
    _check_name(where, module_name, module)
    if not isinstance(nodes, dict):
        raise ParameterError(f"{where}: write a table [{TABLE}.{module}.node] for each node")
    for node, parameters in nodes.items():
        _check_name(f"[{TABLE}.{module}.{node}]", node_name, node)
        if not isinstance(parameters, dict):
            raise ParameterError(f"{where} {node}: write a table [{TABLE}.{module}.node] for each node")
        for name, value in flatten(parameters):
            _check_name(f"[{TABLE}.{module}.{node}]", parameter_name, name)
            yield (node, name), value


def flatten(table: Mapping[str, object], before: str = "") -> Iterable[tuple[str, object]]:
    """Yield names and values; those of tables in the table with a dot: `limits.left = 1` is a table of TOML."""
    for name, value in table.items():
        if isinstance(value, dict):
            yield from flatten(value, f"{before}{name}.")
        else:
            yield f"{before}{name}", value


def _check_name(where: str, check: Any, name: str) -> None:
    try:
        check(name)
    except InvalidName as error:
        raise ParameterError(f"{where}: {error}") from None


def read_file(path: Path, module: str) -> ParameterSource:
    """Return the source with what a file of `--params` has for a module. Raises ParameterError that names the file."""
    contents = read_toml(path)
    if TABLE not in contents:
        raise ParameterError(f"{path} has no parameters: write a table [{TABLE}.MODULE.node] for each node")
    try:
        return of_module(module, read_tables(contents[TABLE]), Origin.FILE, f"--params {path}")
    except ParameterError as error:
        raise ParameterError(f"{path}: {error}") from None


def read_toml(path: Path) -> dict[str, Any]:
    """Return the contents of a file. Raises ParameterError, which names it."""
    import tomllib

    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ParameterError(f"there is no file {path}") from None
    except OSError as error:
        raise ParameterError(f"can't read {path}: {error.strerror}") from error
    except RecursionError:
        raise ParameterError(f"{path} is nested too deeply") from None
    except ValueError as error:  # not TOML, or not UTF-8
        raise ParameterError(f"{path}: {error}") from None
