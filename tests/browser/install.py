"""Chromium and Playwright: `python -m tests.browser.install` gets them, `find` says where Chromium is.

Together they take 600 MB, so they are installed only where CI or PEERS is set: Chromium by root from Debian, Playwright
into the environment of this Python, without the browsers that it would bring along. The tests that need them are
skipped where they are missing, and say so; with CI set that is an error.
"""

from __future__ import annotations

import importlib.util
import os
import platform
import shutil
import subprocess
import sys
from pathlib import Path

from tests import debian

PACKAGES = ("chromium", "fonts-dejavu-core")
"""Debian's packages; without a font the browser draws no text."""

_PROGRAMS = ("chromium", "chromium-browser", "google-chrome")
_ROOT = Path(__file__).parents[2]


def find() -> Path | str:
    """Where Chromium is, or what is missing: one line for those who read that tests are skipped."""
    browser = _browser()
    missing = [] if browser else ["Chromium (apt install chromium)"]
    if importlib.util.find_spec("playwright") is None:
        missing.append("playwright (pip install --group browser)")
    if missing or browser is None:
        return f"the page in a browser needs {' and '.join(missing)}: make test PEERS=1 gets them"
    return browser


def get() -> str:
    """Get what is missing, if it is wanted. Empty, or what is missing still."""
    found = find()
    if isinstance(found, Path):
        return ""
    if not (os.environ.get("CI") or os.environ.get("PEERS")):
        return found
    try:
        _install()
    except subprocess.CalledProcessError as error:
        lines = error.stderr.strip().splitlines() or ["no message"]
        return f"{found} ({' '.join(error.cmd[:4])} failed: {lines[-1]})"
    importlib.invalidate_caches()
    found = find()
    return found if isinstance(found, str) else ""


def _install() -> None:
    if _browser() is None and sys.platform == "linux" and shutil.which("apt-get") and os.geteuid() == 0:
        debian.install(*PACKAGES)
    if importlib.util.find_spec("playwright") is None:
        pip = (sys.executable, "-m", "pip", "install", "--quiet", "--group", "browser")
        subprocess.run(pip, cwd=_ROOT, check=True, capture_output=True, text=True)


def _browser() -> Path | None:
    return next((Path(path) for name in _PROGRAMS if (path := shutil.which(name))), None)


def main() -> None:
    problem = get()
    if problem:
        print(f"{platform.node()}: some tests are skipped. {problem}", file=sys.stderr)  # noqa: T201
        sys.exit(1 if os.environ.get("CI") else 0)


if __name__ == "__main__":
    main()
