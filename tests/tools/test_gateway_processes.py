"""`r2p gateway` as a process: how it ends, and its errors. test_main_job.py tests its purpose."""

from __future__ import annotations

import signal
from typing import TYPE_CHECKING

import pytest

from tests.tools.rig import PUBLISH, listening, process

if TYPE_CHECKING:
    import subprocess
    from collections.abc import Iterator

pytestmark = pytest.mark.processes


@pytest.fixture
def robot() -> Iterator[subprocess.Popen[str]]:
    with process(*PUBLISH) as child:
        yield child


@pytest.fixture
def gateway(robot: subprocess.Popen[str]) -> Iterator[subprocess.Popen[str]]:
    with process("gateway", "--via", listening(robot), "--via", "tcp-listen:0") as child:
        yield child


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_it_well(gateway: subprocess.Popen[str], number: signal.Signals) -> None:
    listening(gateway)
    gateway.send_signal(number)
    _, err = gateway.communicate()
    assert gateway.returncode == 0
    assert "Traceback" not in err


def test_mistakes() -> None:
    for arguments, code, words in (
        (("--via", "tcp:127.0.0.1:1"), 2, "a gateway needs at least two links"),
        (("--via", "memory:a", "--via", "memory:b", "--allow", "@x"), 2, "write TOPIC, TOPIC@FROM or TOPIC@FROM>TO"),
        (("--via", "memory:a", "--via", "memory:b", "--rate-limit", "leds"), 2, "write it as TOPIC=HZ"),
        (("--via", "memory:a", "--via", "nonsense:b"), 2, "unknown transport"),
        (("--via", "memory:a", "--via", "memory:a"), 2, "the same link is given twice"),
    ):
        with process("gateway", *arguments) as child:
            _, err = child.communicate()
        assert child.returncode == code
        assert words in " ".join(err.replace("│", "").split())
