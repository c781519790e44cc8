"""Messages for the user: texts of other modules in them can't control a terminal."""

import logging

import pytest

from r2p.tools.output import log_to_stderr, notify
from r2p.tools.session import UsageError, execute

HOSTILE = "EV\x1b[2J\x9b\x07\rIL"


def test_what_is_said(capsys: pytest.CaptureFixture[str]) -> None:
    notify(f"two lines\n\tof {HOSTILE}")
    assert capsys.readouterr().err == "r2p: two lines\n\tof EV\\x1b[2J\\x9b\\x07\\rIL\n"


def test_what_is_logged(capsys: pytest.CaptureFixture[str]) -> None:
    with log_to_stderr(0):
        logging.getLogger("r2p.PC1.node").info("%s", HOSTILE)
        logging.getLogger("r2p.link").warning(HOSTILE)
    shown = r"EV\x1b[2J\x9b\x07\rIL"
    assert capsys.readouterr().err == f"PC1/node: {shown}\nr2p: warning: {shown}\n"


def test_an_error_of_usage() -> None:
    async def main() -> None:
        raise UsageError(HOSTILE)

    with pytest.raises(Exception, match=r"EV\\x1b\[2J") as caught:
        execute(main)
    assert str(caught.value).isprintable()
