"""`python -m r2p`: the `r2p` command; and what `r2p launch` starts, which ends when its launcher does."""

import os
import signal
import sys

from r2p.tools.main import LAUNCHER_VARIABLE, main

_PR_SET_PDEATHSIG = 1  # linux/prctl.h


def end_with(launcher: int) -> None:
    """Let this process end in order when its launcher is gone, even by SIGKILL; exit if it is gone already.

    Only Linux can do that.
    """
    if sys.platform == "linux":
        import ctypes

        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM, 0, 0, 0)
        if os.getppid() != launcher:
            raise SystemExit(1)


if __name__ == "__main__":
    _launcher = os.environ.pop(LAUNCHER_VARIABLE, "")  # what this process starts has another parent
    if _launcher:
        end_with(int(_launcher))
    main()
