"""Text from outside on its way to a person: what would move the cursor, or forge a line, is shown as an escape.

Names and texts of other modules may hold anything, sequences for terminals too. What people read goes through
`printable`; what this package logs goes through the filter of `get_logger`, since a log file is read at a terminal.
"""

import logging
import unicodedata


def printable(text: str, allowed: str = "") -> str:
    r"""The text with each character that shows nothing by itself as an escape: `\x1b`, `\n`, `\u202e`.

    Spaces stay, and so does what `allowed` holds.
    """
    return text if text.isprintable() else "".join(_shown(each, allowed) for each in text)


def _shown(character: str, allowed: str) -> str:
    if character.isprintable() or character in allowed or unicodedata.category(character) == "Zs":
        return character
    return character.encode("unicode_escape").decode("ascii")


class _Escape(logging.Filter):
    """Makes the texts that a record is about printable; its format is ours."""

    def filter(self, record: logging.LogRecord) -> bool:
        if isinstance(record.args, tuple):
            record.args = tuple(
                printable(str(each)) if isinstance(each, str | BaseException) else each for each in record.args
            )
        return True


_ESCAPE = _Escape()


def get_logger(name: str) -> logging.Logger:
    """The logger of that name, with arguments that may come from outside: each stays on its line."""
    logger = logging.getLogger(name)
    logger.addFilter(_ESCAPE)  # once, however often it is called
    return logger
