"""The Debian packages that tests need: `python -m tests.uml.packages` gets them, `find` says where SocketCAN's are.

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
from typing import NamedTuple

PACKAGES = {"user-mode-linux": "linux.uml", "can-utils": "candump", "socat": "socat", "iproute2": "ip"}
"""Debian's packages for SocketCAN, and a program of each."""

SHELLS = ("zsh", "fish")
"""Debian's packages of shells, named like their programs."""

_MODULES = "lib/uml/modules"


class Tools(NamedTuple):
    """Where things are: the kernel, its modules by version, folders of programs and of libraries that are unpacked."""

    kernel: Path
    modules: Path
    programs: list[Path]
    libraries: list[Path]


def find() -> Tools | str:
    """The tools, or why they can't be had: one line for whoever reads that tests are skipped."""
    if sys.platform != "linux":
        return "user-mode Linux runs on Linux only"
    unpacked = cache() / "usr"
    folders = [unpacked / "bin"] if unpacked.is_dir() else []
    path = os.pathsep.join([*map(str, folders), os.environ.get("PATH", os.defpath), "/usr/sbin", "/sbin"])
    missing = [package for package, program in PACKAGES.items() if shutil.which(program, path=path) is None]
    if missing:
        return f"SocketCAN needs {' '.join(missing)}: apt install {' '.join(missing)}, or run make system"
    kernel = Path(shutil.which(PACKAGES["user-mode-linux"], path=path) or "").resolve()
    modules = kernel.parent.parent / _MODULES
    return Tools(kernel, modules, folders, sorted((unpacked / "lib").glob("*-linux-gnu")))


def cache() -> Path:
    """Where packages are unpacked that could not be installed."""
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "r2p" / "debian"


def get() -> str:
    """Get what is missing. Empty, or why that failed."""
    if sys.platform != "linux":
        return ""
    found = find()
    missing = found if isinstance(found, str) else ""
    try:
        if shutil.which("apt-get") is None:
            return missing
        if os.geteuid() == 0 and (missing or not all(map(shutil.which, SHELLS))):
            _install()
        elif missing:
            _unpack()
    except subprocess.CalledProcessError as error:
        needed = missing or f"completion is tested in {' and '.join(SHELLS)}"
        return f"{needed} ({' '.join(error.cmd[:2])} failed: {_last_line(error.stderr)})"
    found = find()
    return found if isinstance(found, str) else ""


def _install() -> None:
    command = ("apt-get", "install", "--quiet", "--yes", "--no-install-recommends", *PACKAGES, *SHELLS)
    try:
        _run(*command)
    except subprocess.CalledProcessError:  # most often the lists are old, or were never there
        _run("apt-get", "update", "--quiet")
        _run(*command)


def _unpack() -> None:
    """Download and unpack beside the target first: half of it in the cache would look like all of it."""
    target = cache()
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
    """The packages, and the libraries of theirs that are not installed."""
    plan = _run("apt-get", *options, "install", "--simulate", "--no-install-recommends", *PACKAGES)
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
