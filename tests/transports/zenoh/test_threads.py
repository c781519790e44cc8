"""Python does not end while a thread is inside of zenoh: that would abort the process."""

from __future__ import annotations

import subprocess
import sys

import pytest

PROGRAM = """
import sys
from r2p.transports.zenoh import threads
threads.start(lambda: print(sys.stdin.read()))
"""


@pytest.mark.processes
def test_the_program_waits_for_its_threads() -> None:
    done = subprocess.run([sys.executable, "-c", PROGRAM], input="heard", capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("heard\n", "")
