"""What `import r2p` gives, what it costs, and that all of it is documented."""

from __future__ import annotations

import ast
import inspect
import subprocess
import sys

import pytest

import r2p

NUMBERS = {"f32", "f64", "i8", "i16", "i32", "i64", "u8", "u16", "u32", "u64"}
UNIONS = {"ModuleEvent", "NodeFunction"}


def test_the_public_names_are_there_and_listed_once() -> None:
    assert len(set(r2p.__all__)) == len(r2p.__all__)
    assert all(hasattr(r2p, name) for name in r2p.__all__)


@pytest.mark.parametrize("name", sorted(set(r2p.__all__) - NUMBERS - UNIONS))
def test_each_public_name_has_a_docstring(name: str) -> None:
    public = getattr(r2p, name)
    assert inspect.getdoc(public), name
    if not inspect.isclass(public):
        return
    for attribute, value in vars(public).items():
        if inspect.isfunction(value) and not attribute.startswith("_") and public.__module__.startswith("r2p"):
            assert inspect.getdoc(getattr(public, attribute)), f"{name}.{attribute}"


@pytest.mark.processes
def test_importing_r2p_is_cheap() -> None:
    """What is not needed at the start is not loaded at the start: the command answers at once."""
    loaded = modules_after("import r2p; [getattr(r2p, name) for name in ('Module', 'Node', 'run', 'msg')]")
    heavy = {"can", "ctypes", "importlib.metadata", "pytest", "rich", "serial", "typer", "uvloop", "yaml", "zenoh"}
    assert heavy.isdisjoint(loaded)


@pytest.mark.processes
def test_a_name_is_imported_when_it_is_used_first() -> None:
    assert not {name for name in modules_after("import r2p") if name.startswith(("r2p.", "asyncio", "msgspec"))} - {
        "r2p.startup",
        "r2p.version",
    }
    assert "asyncio" not in modules_after("from r2p.msg import Led; from r2p import u8, Message")


def modules_after(code: str) -> set[str]:
    """The modules that a new Python has imported after this code."""
    done = [sys.executable, "-c", f"{code}; import sys; print(*sys.modules)"]
    return set(subprocess.run(done, check=True, capture_output=True, text=True).stdout.split())


def test_names_are_imported_from_where_type_checkers_see_them() -> None:
    (block,) = (
        each
        for each in ast.parse(inspect.getsource(r2p)).body
        if isinstance(each, ast.If) and ast.unparse(each.test) == "TYPE_CHECKING"
    )
    seen = {alias.name: each.module for each in block.body if isinstance(each, ast.ImportFrom) for alias in each.names}
    assert seen == r2p._MODULE_OF
    assert seen.keys() | {"__version__"} >= set(r2p.__all__)


def test_a_name_that_does_not_exist() -> None:
    with pytest.raises(AttributeError, match="has no attribute 'Modul'"):
        r2p.Modul  # type: ignore[attr-defined] # noqa: B018
    assert {"Module", "msg"} <= set(dir(r2p))


@pytest.mark.processes
def test_the_version_is_that_of_the_package() -> None:
    from importlib import metadata

    assert metadata.version("r2p") == r2p.__version__
