"""The rules of the house that a reader would miss first: class names are unique, files and functions stay short."""

import ast
import functools
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Literal, NamedTuple

import pytest

import r2p

pytestmark = pytest.mark.xdist_group("rules of the house")  # one worker parses all sources

ROOT = Path(r2p.__file__).parent
SOURCES = {path.relative_to(ROOT.parent).as_posix(): path.read_text() for path in ROOT.rglob("*.py")}

FILE_LINES = 600
FUNCTION_LINES = 60


class Definition(NamedTuple):
    """A class or a function; no part of its tree, as the trees of all sources are slow to keep."""

    place: str
    name: str
    lines: int
    kind: Literal["function", "class", "message"]


@functools.cache
def definitions() -> list[Definition]:
    """All classes and functions in the sources: no work for those who only collect this test."""
    return [each for path, source in sorted(SOURCES.items()) for each in _defined(path, ast.parse(source))]


def _defined(path: str, node: ast.AST) -> Iterator[Definition]:
    """Those in the statements under this node: expressions, which are most of a tree, have none."""
    for each in ast.iter_child_nodes(node):
        if isinstance(each, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            lines = (each.end_lineno or each.lineno) - each.lineno + 1
            yield Definition(f"{path}:{each.lineno}", each.name, lines, _kind(path, each))
        if not isinstance(each, ast.expr):
            yield from _defined(path, each)


def _kind(path: str, node: ast.stmt) -> Literal["function", "class", "message"]:
    if not isinstance(node, ast.ClassDef):
        return "function"
    return "message" if is_message(path, node) else "class"


def is_message(path: str, node: ast.ClassDef) -> bool:
    """Whether a class is named by the wire, or by the robots that send it, or is a part of a service."""
    bases = {ast.unparse(base) for base in node.bases}
    if node.name in ("Request", "Response"):
        return "Message" in bases
    return path.startswith(("r2p/msg.py", "r2p/codecs/")) and not bases.isdisjoint({"Message", "msgspec.Struct"})


def test_a_class_name_exists_once() -> None:
    places = defaultdict(list)
    for each in definitions():
        if each.kind == "class":
            places[each.name.lstrip("_")].append(each.place)
    assert {name: where for name, where in places.items() if len(where) > 1} == {}


def test_files_are_short() -> None:
    assert {path: lines for path, source in SOURCES.items() if (lines := source.count("\n")) > FILE_LINES} == {}


def test_functions_are_short() -> None:
    functions = [each for each in definitions() if each.kind == "function"]
    assert {f"{each.place} {each.name}": each.lines for each in functions if each.lines > FUNCTION_LINES} == {}
