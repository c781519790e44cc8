"""The Debian packages that tests of SocketCAN need, and where they are; `python -m tests.debian` gets them."""

from __future__ import annotations

import os
import shutil
import sys
from pathlib import Path
from typing import NamedTuple

PACKAGES = {"user-mode-linux": "linux.uml", "can-utils": "candump", "socat": "socat", "iproute2": "ip"}
"""Debian's packages for SocketCAN, and a program of each."""

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
