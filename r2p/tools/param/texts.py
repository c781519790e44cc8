"""Parameters as people, programs and files read them."""

import math
from typing import Any

import tomli_w

import r2p
from r2p.log_lines import printable
from r2p.tools.output import Output
from r2p.tools.session import UsageError

COLUMNS = ["node", "name", "value", "range", "origin"]
"""The columns of a table for people."""

FIELDS = [
    *("module", "node", "name", "kind", "value", "default", "minimum", "maximum", "unit", "doc", "read_only"),
    *("choices", "origin", "saved", "problem"),
]
"""The keys of a record for programs, in their order."""

_WIDE = 40  # characters of a cell of that table; `info` shows all


def record(info: r2p.ParameterInfo) -> dict[str, Any]:
    """Return a parameter as values for JSON."""
    return {name: plain(getattr(info, name)) for name in FIELDS}


def brief(info: r2p.ParameterInfo) -> dict[str, Any]:
    """Return what names a parameter, as values for JSON."""
    return {"module": info.module, "node": info.node, "name": info.name}


async def put_all(output: Output, rows: list[dict[str, Any]], texts: list[str]) -> None:
    """Write records with the same keys; at a terminal as these texts, which are wrapped."""
    if output.format != "text":
        await output.table(rows, list(rows[0]))
        return
    for record, text in zip(rows, texts, strict=True):
        await output.put(record, text, wrap=True)


def row(info: r2p.ParameterInfo) -> dict[str, Any]:
    """Return a parameter as a row of a table for people."""
    return {
        "node": f"{info.module}/{info.node}",
        "name": info.name,
        "value": _cut(with_unit(info, info.value)),
        "range": _cut(range_text(info)) or None,
        "origin": info.origin,
    }


def _cut(text: str) -> str:
    return text if len(text) <= _WIDE else f"{text[: _WIDE - 4]} ..."


def plain(value: Any) -> Any:
    """Return a value as JSON has it: infinities as texts, as in messages, and tuples as lists."""
    if isinstance(value, tuple):
        return [plain(each) for each in value]
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value


def value_text(value: Any) -> str:
    """Return a value as TOML has it, on one line: the text that files and people read."""
    if isinstance(value, tuple | list):
        return f"[{', '.join(map(value_text, value))}]"
    return tomli_w.dumps({"v": value}).removeprefix("v = ").rstrip("\n")


def shown(info: r2p.ParameterInfo, value: Any) -> str:
    """Return a value of a parameter as people read and write it: as in a file, but names of an enum without quotes."""
    return str(value) if info.choices else value_text(value)


def assignment(info: r2p.ParameterInfo, value: Any) -> str:
    """Return `MODULE/NODE.NAME = VALUE UNIT`, on one line."""
    return f"{printable(info.full_name)} = {with_unit(info, value)}"


def with_unit(info: r2p.ParameterInfo, value: Any) -> str:
    """Return a value with its unit."""
    return printable(f"{shown(info, value)} {info.unit}".rstrip())


def range_text(info: r2p.ParameterInfo) -> str:
    """Return what a parameter takes, in words: limits or names, or that it is read-only; empty for anything."""
    if info.read_only:
        return "read-only"
    if info.choices:
        return ", ".join(info.choices)
    match info.minimum, info.maximum:
        case None, None:
            return ""
        case low, None:
            return f"{low} or more"
        case None, high:
            return f"{high} or less"
        case low, high:
            return f"{low} to {high}"


def details(info: r2p.ParameterInfo) -> str:
    """Return everything about a parameter, for people."""
    saved = "" if info.problem else "no" if info.saved is None else shown(info, info.saved)
    found = {
        "parameter": info.full_name,
        "value": shown(info, info.value),
        "origin": info.origin,
        "saved": saved,
        "default": shown(info, info.default),
        "kind": info.kind,
        "range": range_text(info),
        "unit": info.unit,
        "doc": info.doc,
        "problem": info.problem,
    }
    return "".join(f"{name}: {printable(value)}\n" for name, value in found.items() if value)


def dumped(infos: list[r2p.ParameterInfo]) -> str:
    """Return parameters as a file that --params and `r2p param load` read. Raises UsageError for two robots in one.

    Modules have the names that they have themselves, without the prefix of a gateway.
    """
    lines, table, modules = ["format = 1"], "", dict[str, str]()
    for info in infos:
        module = info.module.rpartition("/")[2]
        if modules.setdefault(module, info.module) != info.module:
            raise UsageError(f"{modules[module]} and {info.module} are both {module} in a file: dump one of them")
        if table != (table := f"[params.{_key(module)}.{_key(info.node)}]"):
            lines += ["", table]
        lines.append(_dumped_line(info))
    return "\n".join(lines) + "\n"


def _key(name: str) -> str:
    """Return a name as a key of TOML, in quotes where it needs them."""
    return tomli_w.dumps({name: 0}).rpartition(" = ")[0]


def _dumped_line(info: r2p.ParameterInfo) -> str:
    about = ", ".join(filter(None, (info.unit, range_text(info))))
    comment = printable(": ".join(filter(None, (about, info.doc))))
    return f"{_key(info.name)} = {value_text(info.value)}" + (f"  # {comment}" if comment else "")
