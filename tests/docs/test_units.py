"""The units for systemd in the pages: systemd itself finds nothing wrong with them."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.docs.blocks import Block, of_page, pages

INSTALLED = "/opt/robot/.venv/bin/r2p"
UNITS = [block for page in pages() for block in of_page(page) if block.title.endswith(".service")]


@pytest.mark.processes
@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd is not here")
@pytest.mark.parametrize("unit", UNITS, ids=lambda unit: unit.title)
def test_systemd_takes_them(unit: Block, tmp_path: Path) -> None:
    assert INSTALLED in unit.text
    file = tmp_path / unit.title
    file.write_text(unit.text.replace(INSTALLED, sys.executable))
    done = subprocess.run(["systemd-analyze", "verify", file], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (0, "")


def test_there_are_units() -> None:
    assert {unit.title for unit in UNITS} == {"r2p-gateway.service", "robot.service"}
