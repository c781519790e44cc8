"""What a user sees of a recording that is played, and does to it: a line with the position, and keys."""

import asyncio
import contextlib
import logging
import os
import select
import shutil
import sys
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Final

from r2p.recording.pacing import FASTEST, SLOWEST
from r2p.tools.keyboard import on_key
from r2p.units import SECOND

if TYPE_CHECKING:
    from r2p.recording.pacing import Pacer

KEYS: Final = "space pauses, . steps, + - rate"

_PERIOD: Final = 0.2  # s between two updates of the line
_RIGHT: Final = "\x1b[C"  # what a terminal sends for the arrow
_STEPS: Final = (1.0, 2.0, 5.0)  # rates of each decade, for + and -


class Controls:
    """The keys, and at a terminal the line of progress, of what a pacer plays from `start` to `end` (UTC, ns).

    `played` returns how many messages, or frames, were played; `what` is their plural.
    """

    def __init__(self, pacer: "Pacer", start: int, end: int, played: Callable[[], int], what: str) -> None:
        self._pacer = pacer
        self._start = start
        self._end = end
        self._played = played
        self._what = what
        self._has_keys = False
        self._last_keys = ""
        self._shown = False

    @contextlib.contextmanager
    def running(self) -> Iterator[None]:
        """Show the line and heed keys in the block; the terminal is then as before."""
        with contextlib.ExitStack() as ending:
            self._has_keys = ending.enter_context(on_key(self.key))
            if _is_terminal():
                ending.callback(self._clear)
                ending.enter_context(self._before_log_lines())
                task = asyncio.get_running_loop().create_task(self._follow())
                ending.callback(task.cancel)
            yield

    def key(self, key: str) -> None:
        """Do what a key says; the arrow comes as three characters."""
        self._last_keys = (self._last_keys + key)[-len(_RIGHT) :]
        pacer = self._pacer
        if key == " ":
            (pacer.resume if pacer.paused else pacer.pause)()
        elif key == "." or self._last_keys == _RIGHT:
            pacer.step()
        elif key in "+=":
            pacer.rate = next_rate(pacer.rate)
        elif key == "-":
            pacer.rate = previous_rate(pacer.rate)
        else:
            return
        if self._shown:
            self.show()

    @property
    def text(self) -> str:
        """The line of progress."""
        position = (min(self._pacer.position, self._end) - self._start) / SECOND
        whole = (self._end - self._start) / SECOND
        text = f"{max(position, 0.0):.1f} of {whole:.1f} s  {self._pacer.rate:g}x  {self._played()} {self._what}"
        return f"{text}{'  paused' if self._pacer.paused else ''}{f'  ({KEYS})' if self._has_keys else ''}"

    async def _follow(self) -> None:
        while True:
            self.show()
            await asyncio.sleep(_PERIOD)

    def show(self) -> None:
        """Write the line over the last one."""
        self._shown = True
        _write(f"\r{self.text[: shutil.get_terminal_size().columns - 1]}\x1b[K")

    def _clear(self) -> None:
        if self._shown:
            self._shown = False
            _write("\r\x1b[K")

    @contextlib.contextmanager
    def _before_log_lines(self) -> Iterator[None]:
        """Clear the line before each record of the log, which would be written behind it."""
        logger, clearing = logging.getLogger("r2p"), _Clearing(self._clear)
        logger.handlers.insert(0, clearing)
        try:
            yield
        finally:
            logger.removeHandler(clearing)


class _Clearing(logging.Handler):
    def __init__(self, clear: Callable[[], None]) -> None:
        super().__init__()
        self._clear = clear

    def emit(self, record: logging.LogRecord) -> None:
        self._clear()


def next_rate(rate: float) -> float:
    """Return the next higher rate of 1, 2, 5, 10, ..."""
    return min((each for each in _rates() if each > rate * 1.001), default=FASTEST)


def previous_rate(rate: float) -> float:
    """Return the next lower rate of 1, 0.5, 0.2, ..."""
    return max((each for each in _rates() if each < rate * 0.999), default=SLOWEST)


def _rates() -> list[float]:
    return [
        float(f"{step * 10**decade:g}") for decade in range(-3, 5) for step in _STEPS if step * 10**decade <= FASTEST
    ]


def _is_terminal() -> bool:
    try:
        return sys.stderr.isatty()
    except (AttributeError, ValueError):  # closed
        return False


def _write(text: str) -> None:
    """Write to the terminal if that accepts it now: where the user has stopped it, with Ctrl-S, playing goes on."""
    with contextlib.suppress(OSError, ValueError):
        fd = sys.stderr.fileno()
        if any(select.select([], [fd], [], 0)):
            os.write(fd, text.encode(errors="replace"))
