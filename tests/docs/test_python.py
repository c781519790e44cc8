"""Python in the pages: every block is a program that runs, and that the type checker accepts.

Programs run under virtual time, so that one that blinks for ever ends after LIMIT seconds of its own time, which take
no time. `r2p.run`, `r2p.run_main` and `asyncio.run` are replaced; other transports than `memory:` and `sim:` are
checked, and then left out.
"""

import asyncio
import contextlib
import importlib
import re
import runpy
import subprocess
import sys
from collections.abc import Awaitable, Callable, Coroutine
from pathlib import Path
from typing import Any, TypeVar

import pytest

from r2p import sim
from r2p.transports.link import Transport
from r2p.transports.url import open_transport
from tests.docs.blocks import ROOT, Block, blocks, of_page, pattern

T = TypeVar("T")

LIMIT = 5.0
"""Virtual seconds that a program gets."""

_SNIPPETS = [block for block in blocks("python") if "pytest" not in block.notes]


def run_bounded(main: Callable[[], Awaitable[T]]) -> T | None:
    """Run a program under virtual time; when it has not ended after LIMIT seconds, it is cancelled, as by Ctrl-C."""

    async def bounded() -> T | None:
        program = asyncio.ensure_future(main())
        await asyncio.wait([program], timeout=LIMIT)
        if not program.done():
            program.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await program
            return None
        return program.result()

    return sim.run(bounded)


@pytest.fixture
def programs(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """Where programs run as a user's would, but in virtual time and without a world outside."""

    def open_here(url: str) -> Transport:
        transport = open_transport(url)
        return transport if url.startswith(("memory:", "sim:")) else open_transport("memory:elsewhere")

    def run_coroutine(main: Coroutine[Any, Any, T]) -> T | None:
        return run_bounded(lambda: main)

    monkeypatch.setattr(importlib.import_module("r2p.modules.runner"), "run_main", run_bounded)
    monkeypatch.setattr("r2p.run_main", run_bounded)
    monkeypatch.setattr("r2p.modules.module.open_transport", open_here)
    monkeypatch.setattr(asyncio, "run", run_coroutine)
    monkeypatch.setattr(sys, "argv", ["program"])
    monkeypatch.delenv("R2P_VIA", raising=False)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def _chain(block: Block) -> list[Block]:
    """The blocks that have to run for this one: itself, and those that it continues."""
    chain: list[Block] = []
    for each in of_page(block.page):
        if each.language == "python" and "pytest" not in each.notes and each.line <= block.line:
            chain = [*chain, each] if "continues" in each.notes else [each]
    return chain


_FIXED_PORT = re.compile(r"\bport=[0-9]+")


def _shown_output(block: Block) -> str | None:
    """What the page says that the block prints."""
    page = of_page(block.page)
    after = page[page.index(block) + 1 :][:1]
    return after[0].text if after and "output" in after[0].notes else None


@pytest.mark.parametrize("block", _SNIPPETS, ids=str)
def test_it_runs(block: Block, programs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    names: dict[str, Any] = {}
    for each in _chain(block):
        file = programs / (each.title or f"{each.name}.py")
        file.write_text("\n" * (each.line - 1) + _FIXED_PORT.sub("port=0", each.text))  # the page's may be in use
        capsys.readouterr()
        names = runpy.run_path(str(file), init_globals=names, run_name="__main__")
    shown = _shown_output(block)
    if shown is not None:
        printed = capsys.readouterr().out
        assert pattern(shown).match(printed), f"{block} shows\n{shown}\nand prints\n{printed}"


@pytest.mark.processes
def test_their_tests_pass(tmp_path: Path) -> None:
    """In one process: it starts once."""
    tests = [block for block in blocks("python") if "pytest" in block.notes]
    for block in tests:
        (tmp_path / f"test_{block.name}.py").write_text(block.text)
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "no:randomly", str(tmp_path)]
    ended = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=120, check=False)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    assert f"{len(tests)} passed" in ended.stdout


@pytest.mark.processes
def test_the_type_checker_accepts_it(tmp_path: Path) -> None:
    """Strictly, and all at once: what a reader copies has no errors in his editor."""
    for block in blocks("python"):
        chain = [block] if "pytest" in block.notes else _chain(block)
        (tmp_path / f"{block.name}.py").write_text("\n".join(each.text for each in chain))
    command = [sys.executable, "-m", "mypy", "--config-file", str(ROOT / "pyproject.toml"), str(tmp_path)]
    ended = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120, check=False)
    assert ended.returncode == 0, ended.stdout + ended.stderr
