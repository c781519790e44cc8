"""The harness itself, with programs that stand for the kernel: what is said when it can't do its work."""

from __future__ import annotations

import contextlib
import os
import select
import shutil
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from tests.uml import kernel, packages
from tests.uml.packages import Tools

if TYPE_CHECKING:
    from collections.abc import Iterator

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="user-mode Linux runs on Linux")


@pytest.fixture
def shared() -> Iterator[Path]:
    with kernel.folder() as folder:
        yield folder


def program(folder: Path, text: str) -> Tools:
    """Tools whose kernel is this shell script."""
    file = folder / "linux"
    file.write_text(f"#!/bin/sh\n{text}\n", encoding="ascii")
    file.chmod(0o755)
    return Tools(file, folder / "modules", [Path("/opt/can tools")], [])


def run(shared: Path, tools: Tools, limit: float = 30.0) -> int:
    return kernel.run(tools, shared, ["pytest", "a b"], cwd=Path("/"), environment={"CI": "1"}, limit=limit)


def test_the_exit_code_comes_back(shared: Path, tmp_path: Path) -> None:
    assert run(shared, program(tmp_path, f"echo 3 >{shared}/code")) == 3
    command = (shared / "command").read_text(encoding="utf-8")
    assert command.startswith("cd /\nexec env -i 'PATH=/opt/can tools:/usr/local/sbin:")
    assert command.endswith(" CI=1 pytest 'a b'\n")


def test_a_kernel_that_dies(shared: Path, tmp_path: Path) -> None:
    with pytest.raises(kernel.KernelFailed, match=r"(?s)ended before the program did; its console:.*panic"):
        run(shared, program(tmp_path, "echo panic"))


def test_a_kernel_that_hangs_is_ended_with_its_children(shared: Path, tmp_path: Path) -> None:
    tools = program(tmp_path, f"sleep 3600 & echo $! >{shared}/child; echo waiting; wait")
    with pytest.raises(kernel.KernelFailed, match=r"(?s)not ready after 1 s; its console:.*waiting"):
        run(shared, tools, limit=1.0)
    child = int((shared / "child").read_text(encoding="ascii"))
    with contextlib.suppress(ProcessLookupError):  # it is gone altogether
        ended = os.pidfd_open(child)
        try:
            assert select.select([ended], [], [], 30.0)[0]
        finally:
            os.close(ended)


def test_what_is_missing_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(shutil, "which", lambda name, path: None if "can" in name else f"/usr/bin/{name}")
    assert packages.find() == "SocketCAN needs can-utils: apt install can-utils, or run make system"


def test_what_was_unpacked_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    folder = packages.cache() / "usr/bin"
    folder.mkdir(parents=True)
    (packages.cache() / "usr/lib/x86_64-linux-gnu").mkdir(parents=True)
    for name in packages.PACKAGES.values():
        (folder / name).touch(mode=0o755)
    unpacked = packages.cache() / "usr"
    assert packages.find() == Tools(
        folder / "linux.uml", unpacked / "lib/uml/modules", [folder], [unpacked / "lib/x86_64-linux-gnu"]
    )


CONFTEST = """
from tests.can.conftest import pytest_configure, pytest_runtest_protocol

def pytest_collection_modifyitems(items):
    for item in items:
        item.add_marker("can")
"""


@pytest.mark.parametrize(("on_ci", "outcome"), [("", "skipped"), ("1", "errors")])
def test_without_the_packages_tests_are_skipped_in_one_line(
    pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch, on_ci: str, outcome: str
) -> None:
    """On CI that is an error."""
    monkeypatch.setenv("CI", on_ci)
    monkeypatch.setattr(packages, "find", lambda: "SocketCAN needs x")
    pytester.makeini("[pytest]\nmarkers = can: x\n")
    pytester.makeconftest(CONFTEST)
    pytester.makepyfile("def test_a(): pass\ndef test_b(): pass")
    result = pytester.runpytest_inprocess("-rs", "-p", "no:randomly")
    result.assert_outcomes(**{outcome: 2})
    if not on_ci:
        result.stdout.fnmatch_lines(["SKIPPED [[]2] tests/can:1: SocketCAN needs x"])


def _run_here(tools: Tools, shared: Path, command: list[str], **options: Any) -> int:
    """Instead of the kernel."""
    environment = {**os.environ, **options["environment"], "PYTHONPATH": str(Path(__file__).parents[2])}
    done = subprocess.run(command, cwd=options["cwd"], env=environment, check=False, capture_output=True)
    if done.returncode not in (0, 1) or not (shared / "reports").exists():
        raise AssertionError(done)
    raise kernel.KernelFailed("it died")


def test_reports_of_the_second_pytest_are_shown_as_its_own(
    pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """It ends in the middle of the last test."""
    monkeypatch.setattr(packages, "find", lambda: Tools(tmp_path, tmp_path, [], []))
    monkeypatch.setattr(kernel, "run", _run_here)
    pytester.makeini("[pytest]\nmarkers = can: x\n")
    pytester.makeconftest(CONFTEST)
    pytester.makepyfile(
        """
        import os, pytest
        def test_good(): pass
        def test_bad(): assert 1 == 2
        def test_skipped(): pytest.skip("why not")
        def test_deadly(): os._exit(1)
        """
    )
    result = pytester.runpytest_inprocess("-rs", "-p", "no:randomly")
    result.assert_outcomes(passed=1, failed=1, skipped=1, errors=1)
    result.stdout.fnmatch_lines(["it died", "E*assert 1 == 2", "SKIPPED*why not"])
