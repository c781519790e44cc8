"""Lines about what others send: texts from outside neither move a terminal's cursor nor forge a line, and floods are
limited.
"""

import logging

import pytest

from r2p.log_lines import LineLimit, get_logger, printable


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("plain text, 25 \u00b0C \u65e5\u672c", "plain text, 25 \u00b0C \u65e5\u672c"),
        ("a\u00a0b\u3000c", "a\u00a0b\u3000c"),
        ("\x1b]0;title\x07", r"\x1b]0;title\x07"),
        ("\x9b31mred\x7f", r"\x9b31mred\x7f"),
        ("one\r\ntwo\u2028three\x85", r"one\r\ntwo\u2028three\x85"),
        ("\u202egnp.exe\u200b\ud800\U000e0001", r"\u202egnp.exe\u200b\ud800\U000e0001"),
    ],
)
def test_what_shows_nothing_by_itself_is_an_escape(text: str, shown: str) -> None:
    assert printable(text) == shown


def test_what_is_allowed_stays() -> None:
    assert printable("a\n\tb\x1b", "\n\t") == "a\n\tb\\x1b"


def test_arguments_of_log_records_are_escaped(caplog: pytest.LogCaptureFixture) -> None:
    logger = get_logger("r2p.test_log_lines")
    assert get_logger("r2p.test_log_lines").filters == logger.filters
    logger.warning("%s: %d of %s", "EVIL\x1b[2J", 3, ValueError("bad\nr2p: error: forged"))
    logger.warning("no arguments")
    assert caplog.messages == [r"EVIL\x1b[2J: 3 of bad\nr2p: error: forged", "no arguments"]
    assert caplog.records[0].levelno == logging.WARNING


def test_the_lines_of_a_kind_are_limited_and_the_next_one_says_how_many_were_left_out() -> None:
    limit = LineLimit(2, period=60)
    assert [limit.suffix("a", now) for now in (0, 1, 2, 59)] == ["", "", None, None]
    assert limit.suffix("b", 59) == ""
    assert limit.suffix("a", 60) == " (2 more since the last such line)"
    assert limit.suffix("a", 120) == ""
