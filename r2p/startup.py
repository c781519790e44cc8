"""Ctrl-C while the `r2p` command is still importing: it ends at once and in silence, with 130 as always.

Imported before all else, as what follows takes some tenths of a second, in which Python would print a traceback.
Programs that import r2p are left alone: they may catch KeyboardInterrupt.
"""

import os
import signal
import sys
import threading
from types import FrameType

INTERRUPTED = 130
"""The exit code of a command that a signal ended before it was done, as shells have it for SIGINT."""


def _exit(_number: int, _frame: FrameType | None) -> None:
    os._exit(INTERRUPTED)  # nothing has been opened or written yet


def is_command() -> bool:
    """Return whether this program is the `r2p` script, or `python -m r2p`, whose argv[0] is `-m` until it runs."""
    name = os.path.basename(sys.argv[0]) if sys.argv else ""  # noqa: PTH119 - pathlib takes longer to import
    return name in ("r2p", "r2p.exe") or (name == "-m" and "r2p" in sys.orig_argv)


def exit_on_interrupt() -> None:
    """Let Ctrl-C end the command from now on; other programs and their handlers stay as they are."""
    in_main = threading.current_thread() is threading.main_thread()
    if in_main and is_command() and signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # not ignored
        signal.signal(signal.SIGINT, _exit)


def raise_on_interrupt() -> None:
    """Let Ctrl-C raise KeyboardInterrupt again: the command is about to run, and cleans up."""
    if signal.getsignal(signal.SIGINT) is _exit:
        signal.signal(signal.SIGINT, signal.default_int_handler)


exit_on_interrupt()
