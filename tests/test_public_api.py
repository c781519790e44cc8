"""What `import r2p` gives, what it costs, and that all of it is documented."""

from __future__ import annotations

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
    code = "import sys, r2p, r2p.msg; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout.split()
    heavy = {"can", "ctypes", "importlib.metadata", "pytest", "rich", "serial", "typer", "uvloop", "yaml", "zenoh"}
    assert heavy.isdisjoint(loaded)


@pytest.mark.processes
def test_the_version_is_that_of_the_package() -> None:
    from importlib import metadata

    assert metadata.version("r2p") == r2p.__version__
