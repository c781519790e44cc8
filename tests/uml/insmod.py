"""Loads kernel modules, in the given order: few containers have the program `insmod`. Used by init.sh."""

import ctypes
import os
import sys

_FINIT_MODULE = {"x86_64": 313, "i386": 350, "i686": 350}[os.uname().machine]  # what user-mode Linux runs on


def main() -> None:
    libc = ctypes.CDLL(None, use_errno=True)
    for path in sys.argv[1:]:
        file = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
        if libc.syscall(_FINIT_MODULE, file, b"", 0) != 0:
            sys.exit(f"{path}: {os.strerror(ctypes.get_errno())}")
        os.close(file)


if __name__ == "__main__":
    main()
