"""The Debian packages that tests need: `python -m tests.debian` gets them.

Root installs them. Others unpack them into a cache folder; nothing of them has to be installed to run. Where neither
works, the tests that need them are skipped, and say so; with CI set that is an error. The shells in which completion
is tested work only where they are installed.
"""

from __future__ import annotations

import os
import platform
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from tests.ros.ros1 import packages as ros1
from tests.uml import packages as uml

SHELLS = ("zsh", "fish")
"""Debian's packages of shells, named like their programs."""

_ALL = (*uml.PACKAGES, *ros1.PACKAGES)


def problems() -> str:
    """What is missing, and why that matters; empty if all is there."""
    return "; ".join(found for found in (uml.find(), ros1.find()) if isinstance(found, str))


def get() -> str:
    """Get what is missing. Empty, or why that failed."""
    if sys.platform != "linux":
        return ""
    missing = problems()
    try:
        if shutil.which("apt-get") is None:
            return missing
        if os.geteuid() == 0 and (missing or not all(map(shutil.which, SHELLS))):
            install(*_ALL, *SHELLS)
        elif missing:
            _unpack()
    except subprocess.CalledProcessError as error:
        needed = missing or f"completion is tested in {' and '.join(SHELLS)}"
        return f"{needed} ({' '.join(error.cmd[:2])} failed: {_last_line(error.stderr)})"
    return problems()


def install(*packages: str) -> None:
    """Install packages, as root. Raises CalledProcessError."""
    command = ("apt-get", "install", "--quiet", "--yes", "--no-install-recommends", *packages)
    try:
        _run(*command)
    except subprocess.CalledProcessError:  # most often the lists are old, or were never there
        _run("apt-get", "update", "--quiet")
        _run(*command)


def _unpack() -> None:
    """Download and unpack beside the target first: half of it in the cache would look like all of it."""
    target = uml.cache()
    target.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=target.parent) as name:
        folder = Path(name)
        _download(folder)
        for archive in folder.glob("*.deb"):
            _run("dpkg", "-x", str(archive), str(folder / "root"))
        shutil.rmtree(target, ignore_errors=True)
        (folder / "root").rename(target)


def _download(folder: Path) -> None:
    try:
        _download_missing(folder)
    except subprocess.CalledProcessError:  # the system's lists are root's: fetch our own
        state = folder / "state"
        (state / "lists/partial").mkdir(parents=True)
        own = ("-o", f"Dir::State::lists={state}/lists", "-o", f"Dir::Cache={state}", "-o", "Debug::NoLocking=1")
        _run("apt-get", *own, "update")
        _download_missing(folder, *own)


def _download_missing(folder: Path, *options: str) -> None:
    """The packages, and those that they depend on and that are not installed."""
    plan = _run("apt-get", *options, "install", "--simulate", "--no-install-recommends", *_ALL)
    wanted = [line.split()[1] for line in plan.splitlines() if line.startswith("Inst ")]
    _run("apt-get", *options, "download", *wanted, folder=folder)


def _run(*command: str, folder: Path | None = None) -> str:
    environment = {**os.environ, "DEBIAN_FRONTEND": "noninteractive"}
    done = subprocess.run(command, cwd=folder, env=environment, check=True, capture_output=True, text=True)
    return done.stdout


def _last_line(text: str) -> str:
    lines = text.strip().splitlines()
    return lines[-1] if lines else "no message"


def main() -> None:
    problem = get()
    if problem:
        print(f"{platform.node()}: some tests are skipped. {problem}", file=sys.stderr)  # noqa: T201
        sys.exit(1 if os.environ.get("CI") else 0)


if __name__ == "__main__":
    main()
