"""Threads that wait inside of zenoh. None of them may be there any more when Python ends.

Python ends a thread that wants to run on while it goes down by unwinding its stack; zenoh's code can't be unwound, so
the whole process would be aborted: "FATAL: exception not rethrown".
"""

import atexit
import threading
from collections.abc import Callable
from weakref import WeakSet

_PATIENCE = 2.0
"""Seconds for which the end of the program waits for one of them: who connects to nobody may take longer."""

_threads: "WeakSet[threading.Thread]" = WeakSet()


def start(function: Callable[[], object]) -> None:
    """Run it in a thread of its own, for which nobody waits before the program ends."""
    thread = threading.Thread(target=function, name="r2p zenoh", daemon=True)
    _threads.add(thread)
    thread.start()


@atexit.register
def _join() -> None:
    for thread in list(_threads):
        thread.join(_PATIENCE)
