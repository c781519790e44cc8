"""Lines about what others send: texts from outside neither move a terminal's cursor nor forge a line, and floods are
limited.
"""

import contextlib
import io
import logging
from collections.abc import Iterator

import pytest

import r2p
from r2p import log_lines
from r2p.log_lines import (
    LineFormatter,
    LineLimit,
    StderrHandler,
    default_logging,
    get_logger,
    printable,
    short_traceback,
    wrapped,
)


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


# Output


def _record(name: str, level: int, text: str) -> logging.LogRecord:
    return logging.LogRecord(name, level, "", 0, text, (), None)


def test_a_line_begins_with_its_node_and_may_have_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    info, warning = _record("r2p.PC1.arm", logging.INFO, "up\x1b"), _record("r2p.link", logging.WARNING, "down")
    plain, timed = LineFormatter(), LineFormatter(times=True)
    assert [plain.format(each) for each in (info, warning)] == ["PC1/arm: up\\x1b", "r2p: warning: down"]
    assert [timed.format(each).partition(" ")[2] for each in (info, warning)] == [
        "INFO    PC1/arm: up\\x1b",
        "WARNING r2p: down",
    ]
    other = _record("robot.arm", logging.WARNING, "hot\x1b")
    assert plain.format(other) == "robot.arm: warning: hot\\x1b"
    monkeypatch.setattr("sys.stderr.isatty", lambda: True, raising=False)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.delenv("NO_COLOR", raising=False)
    assert "\x1b[33mWARNING\x1b[0m r2p: down" in timed.format(warning)
    assert "\x1b" not in timed.format(info)
    monkeypatch.setenv("NO_COLOR", "1")
    assert "\x1b" not in timed.format(warning)


def test_arguments_that_do_not_fit_the_format_are_one_line() -> None:
    record = logging.LogRecord("r2p.PC1.arm", logging.INFO, "/robot/arm.py", 7, "speed", (3,), None)
    text = LineFormatter().format(record)
    assert text.startswith("PC1/arm: speed (3,) (these arguments do not fit the format: not all arguments")
    assert text.endswith("; arm.py, line 7)")


def test_an_error_of_r2p_needs_no_frames_of_r2p_and_a_bug_does() -> None:
    for error, frames in ((r2p.Error("what to do"), 0), (ValueError("a bug"), 1)):
        with pytest.raises(type(error)) as caught:
            exec(compile("raise error", log_lines.__file__, "exec"), {"error": error})  # noqa: S102 - the line above
        caught.value.__traceback__ = caught.tb.tb_next  # without that of the test
        assert short_traceback(caught.value).count("File ") == frames


@contextlib.contextmanager
def unconfigured() -> Iterator[logging.Logger]:
    """The logger `r2p` of a program that has configured nothing; within a test, which pytest adds handlers for."""
    logger = logging.getLogger("r2p")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(logging.getLogger(), "handlers", [])
        patch.setattr(logger, "handlers", [])
        patch.delenv("R2P_DEBUG", raising=False)
        yield logger


def _logged(logger: logging.Logger, capsys: pytest.CaptureFixture[str]) -> list[str]:
    with default_logging():
        logger.debug("debug")
        logger.info("info")
        logger.error("error")
    assert not logger.handlers or not isinstance(logger.handlers[0], StderrHandler)
    return [line.split()[-1] for line in capsys.readouterr().err.splitlines()]


def test_a_program_that_configures_nothing_logs_from_info_up(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    with unconfigured() as logger:
        assert _logged(logger, capsys) == ["info", "error"]
        assert logger.level == logging.NOTSET
        monkeypatch.setenv("R2P_DEBUG", "1")
        assert _logged(logger, capsys) == ["debug", "info", "error"]


def test_what_a_program_has_configured_stays(capsys: pytest.CaptureFixture[str]) -> None:
    with unconfigured() as logger:
        for each in (logging.getLogger(), logger):
            before = each.level
            each.setLevel(logging.ERROR)
            assert _logged(logger, capsys) == ["error"]
            each.setLevel(before)
            each.addHandler(logging.NullHandler())
            assert _logged(logger, capsys) == []
            each.handlers.clear()
        with default_logging():  # and what a node configures later
            logging.getLogger().addHandler(logging.NullHandler())
            logger.error("error")
    assert capsys.readouterr().err == ""


def test_other_loggers_print_readable_lines_from_warning_up(capsys: pytest.CaptureFixture[str]) -> None:
    mine, before = logging.getLogger("test_log_lines.mine"), logging.lastResort
    with unconfigured(), default_logging():
        mine.info("too low")
        mine.warning("warning")
        mine.setLevel(logging.INFO)
        mine.info("info")
    mine.setLevel(logging.NOTSET)
    assert logging.lastResort is before
    lines = [line.partition(" ")[2] for line in capsys.readouterr().err.splitlines()]
    assert lines == ["WARNING test_log_lines.mine: warning", "INFO    test_log_lines.mine: info"]


@pytest.mark.parametrize("level", [logging.INFO, logging.WARNING])
def test_functions_of_the_module_logging_change_no_format(level: int, capsys: pytest.CaptureFixture[str]) -> None:
    """They call `logging.basicConfig()`, even for a record that is not printed."""
    root = logging.getLogger()
    with unconfigured() as logger, default_logging():
        logging.log(level, "root")
        logging.getLogger("r2p.PC1.arm").info("node")
        logger.info("r2p")
        assert root.filters
        lines = [line.partition(" ")[2] for line in capsys.readouterr().err.splitlines()]
    assert lines == ["WARNING root: root"] * (level == logging.WARNING) + ["INFO    PC1/arm: node", "INFO    r2p: r2p"]
    assert not root.filters


def test_a_node_may_configure_logging(capsys: pytest.CaptureFixture[str]) -> None:
    root = logging.getLogger()
    with unconfigured() as logger, default_logging():
        before = root.level
        logging.basicConfig(level=logging.INFO)
        logger.info("once")
        logging.getLogger("test_log_lines.mine").info("mine")
        root.setLevel(before)
    assert capsys.readouterr().err.splitlines() == ["INFO:r2p:once", "INFO:test_log_lines.mine:mine"]


class TerminalStream(io.StringIO):
    """A stream at a terminal."""

    def isatty(self) -> bool:
        return True


def test_lines_at_a_terminal_break_between_words(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "20")
    text = "0 gaps at the publisher, 2 lost\n  on zenoh:tcp/127.0.0.1:7447,scouting=off here\n" + "x" * 20
    assert wrapped(text, io.StringIO()) == text
    assert wrapped(text, TerminalStream()).splitlines() == [
        "0 gaps at the",
        "  publisher, 2 lost",
        "  on",
        "    zenoh:tcp/127.0.0.1:7447,scouting=off",
        "    here",
        "x" * 20,
    ]
    monkeypatch.setenv("COLUMNS", "")  # the stream has no width to ask for either
    assert wrapped(text, TerminalStream()) == text


def test_log_records_at_a_terminal_break_between_words(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stderr", TerminalStream())
    monkeypatch.setenv("COLUMNS", "40")
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.delenv("NO_COLOR", raising=False)
    record = logging.makeLogRecord({"name": "r2p.PC1.wheels", "levelname": "WARNING", "levelno": logging.WARNING})
    record.msg = "a line of more than forty characters, with a traceback"
    record.exc_info, record.exc_text = (
        (ValueError, ValueError(), None),
        "    quoted = code + that + is + longer + than + that",
    )
    assert LineFormatter().format(record).splitlines() == [
        "PC1/wheels: warning: a line of more than",
        "  forty characters, with a traceback",
        "    quoted = code + that + is + longer + than + that",
    ]
    assert "\x1b[33mWARNING\x1b[0m PC1/wheels:" in LineFormatter(times=True).format(record)
