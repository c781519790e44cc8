"""The scripts of the page: all of them parse, and those without the DOM do what they say."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest

import r2p.web

PAGE = Path(r2p.web.__file__).parent / "page"
TESTS = Path(__file__).with_name("modules.test.js")
PARSE = """
const { SourceTextModule } = require("node:vm")
for (const path of process.argv.slice(1)) new SourceTextModule(require("node:fs").readFileSync(path, "utf8"))
"""
"""Parses modules in one process; `node --check` takes one for each."""
NODE = shutil.which("node")

pytestmark = [
    pytest.mark.processes,
    pytest.mark.skipif(NODE is None, reason="the page's modules are tested by Node.js: apt install nodejs"),
]


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    assert NODE is not None
    environment = {**os.environ, "R2P_PAGE": PAGE.as_uri()}
    return subprocess.run([NODE, *arguments], capture_output=True, text=True, check=False, env=environment)


def test_modules_do_what_they_say(tmp_path: Path) -> None:
    script = tmp_path / "modules.test.mjs"
    script.write_bytes(TESTS.read_bytes())
    ran = run("--test", str(script))
    assert ran.returncode == 0, ran.stdout + ran.stderr
    assert "# pass 0" not in ran.stdout


def test_scripts_parse_and_are_short() -> None:
    scripts = sorted(PAGE.glob("*.js"))
    assert scripts
    assert {path.name: lines for path in scripts if (lines := path.read_text().count("\n")) > 600} == {}
    ran = run("--experimental-vm-modules", "--no-warnings", "--eval", PARSE, *map(str, scripts))
    assert ran.returncode == 0, ran.stderr
