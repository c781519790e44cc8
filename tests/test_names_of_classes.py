"""The rules of the house that a reader would miss first: class names are unique, files and functions stay short."""

import ast
import functools
from collections import defaultdict
from pathlib import Path

import pytest

import r2p

pytestmark = pytest.mark.xdist_group("rules of the house")  # one worker parses all sources

ROOT = Path(r2p.__file__).parent
SOURCES = {path.relative_to(ROOT.parent).as_posix(): path.read_text() for path in ROOT.rglob("*.py")}

FILE_LINES = 600
FUNCTION_LINES = 60


@functools.cache
def nodes() -> list[tuple[str, ast.AST]]:
    """Everything in the sources: no work for those who only collect this test."""
    return [(path, node) for path, source in sorted(SOURCES.items()) for node in ast.walk(ast.parse(source))]


def is_message(path: str, node: ast.ClassDef) -> bool:
    """Whether a class is named by the wire, or by the robots that send it, or is a part of a service."""
    bases = {ast.unparse(base) for base in node.bases}
    if node.name in ("Request", "Response"):
        return "Message" in bases
    return path.startswith(("r2p/msg.py", "r2p/codecs/")) and not bases.isdisjoint({"Message", "msgspec.Struct"})


def test_a_class_name_exists_once() -> None:
    places = defaultdict(list)
    for path, node in nodes():
        if isinstance(node, ast.ClassDef) and not is_message(path, node):
            places[node.name.lstrip("_")].append(f"{path}:{node.lineno}")
    assert {name: where for name, where in places.items() if len(where) > 1} == {}


def test_files_are_short() -> None:
    assert {path: lines for path, source in SOURCES.items() if (lines := source.count("\n")) > FILE_LINES} == {}


def test_functions_are_short() -> None:
    long = {}
    for path, node in nodes():
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            lines = (node.end_lineno or node.lineno) - node.lineno + 1
            if lines > FUNCTION_LINES:
                long[f"{path}:{node.lineno} {node.name}"] = lines
    assert long == {}
