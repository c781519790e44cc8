"""The environment of rclpy: `python -m tests.ros.rclpy.install` makes it, `find` says where its Python is.

It is 275 MB, so it is made only where CI or PEERS is set, in the cache folder that worktrees share. The tests that
need it are skipped where it is missing, and say so; with CI set that is an error.
"""

from __future__ import annotations

import hashlib
import os
import platform
import shutil
import subprocess
import sys
from pathlib import Path

from tests.uml import packages

VERSION = (3, 11)
"""The Python that the wheels are made for."""

_REQUIREMENTS = Path(__file__).with_name("requirements.txt")
_STAMP = "complete"


def folder() -> Path:
    """Where the environment is, or is to be: a change of the versions makes another one."""
    digest = hashlib.sha256(_REQUIREMENTS.read_bytes()).hexdigest()
    return packages.cache().with_name("rclpy") / digest[:12]


def find() -> Path | str:
    """The environment's Python, or why there is none: one line for whoever reads that tests are skipped."""
    if (folder() / _STAMP).is_file():
        return folder() / "bin" / "python"
    return "rclpy from PyPI (275 MB) is not installed: run make test with PEERS=1"


def make() -> str:
    """Make the environment, if it is wanted and missing. Empty, or why it is not there."""
    found = find()
    if isinstance(found, Path):
        return ""
    if not (os.environ.get("CI") or os.environ.get("PEERS")):
        return found
    if sys.platform != "linux" or platform.machine() != "x86_64":
        return "rclpy from PyPI is made for Linux on x86_64 only"
    python = _python()
    if python is None:
        return "rclpy from PyPI needs Python {}.{}: install that".format(*VERSION)
    try:
        _make(python)
    except subprocess.CalledProcessError as error:
        lines = error.stderr.strip().splitlines() or ["no message"]
        return f"rclpy from PyPI can't be installed: {lines[-1]}"
    return ""


def _make(python: str) -> None:
    target = folder()
    shutil.rmtree(target.parent, ignore_errors=True)  # that of other versions
    _run(python, "-m", "venv", str(target))
    _run(
        str(target / "bin/python"), "-m", "pip", "install", "--quiet", "--no-deps", "--requirement", str(_REQUIREMENTS)
    )
    (target / _STAMP).touch()


def _python() -> str | None:
    """A Python of that version which starts: the name may be that of a shim without one behind it."""
    if sys.version_info[:2] == VERSION:
        return sys.executable
    command = shutil.which("python{}.{}".format(*VERSION))
    if command is None or subprocess.run([command, "--version"], capture_output=True, check=False).returncode:
        return None
    return command


def _run(*command: str) -> None:
    subprocess.run(command, check=True, capture_output=True, text=True)


def main() -> None:
    problem = make()
    if problem:
        print(f"{platform.node()}: some tests are skipped. {problem}", file=sys.stderr)  # noqa: T201
        sys.exit(1 if os.environ.get("CI") else 0)


if __name__ == "__main__":
    main()
