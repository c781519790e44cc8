"""Runs one program in a user-mode Linux kernel that has CAN.

The program sees this machine's files, may write to a copy of them that is gone afterwards, and is root there. Only the
folder that it is given is the real one.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from tests.uml.packages import Tools

MEMORY = 768
"""MB; the memory that is really used counts."""

_HERE = Path(__file__).parent
_CONSOLE = "console"
_PR_SET_PDEATHSIG = 1
_TAIL = 4000  # characters of the console in a message
_WIDE = "amx_tile"
"""What /proc/cpuinfo says of a processor with more registers than the kernel has room for: see registers.c."""


class KernelFailed(Exception):
    """The program did not come to an end; the text is the end of the console."""


@contextlib.contextmanager
def folder() -> Iterator[Path]:
    """A new folder that both sides see. Its path has no spaces: it goes through the kernel's command line."""
    base = tempfile.gettempdir()
    with tempfile.TemporaryDirectory(prefix="r2p-uml-", dir="/tmp" if " " in base else base) as name:
        yield Path(name).resolve()


def run(
    tools: Tools, shared: Path, command: Sequence[str], *, cwd: Path, environment: Mapping[str, str], limit: float
) -> int:
    """Run it in folder `cwd` and say its exit code. Raises `KernelFailed` after `limit` seconds, or when it crashes."""
    _write(shared / "init", (_HERE / "init.sh").read_text(encoding="utf-8"))
    _write(
        shared / "insmod", f'#!/bin/sh\nexec {shlex.join([sys.executable, "-ISE", str(_HERE / "insmod.py")])} "$@"\n'
    )
    _write(shared / "modules", str(tools.modules))
    _write(shared / "command", _script(tools, command, cwd, environment))
    problem = _boot(tools, shared, limit)
    code = shared / "code"
    if problem or not code.exists():
        raise KernelFailed(f"{problem or 'the kernel ended before the program did'}; {tail(shared)}")
    return int(code.read_text(encoding="ascii"))


def _write(path: Path, text: str) -> None:
    path.write_text(text, encoding="utf-8")
    path.chmod(0o755)


def tail(shared: Path) -> str:
    """The end of what the kernel and the program said."""
    return f"its console:\n{(shared / _CONSOLE).read_text(encoding='utf-8', errors='replace')[-_TAIL:]}"


def _script(tools: Tools, command: Sequence[str], cwd: Path, environment: Mapping[str, str]) -> str:
    path = [*map(str, tools.programs), "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"]
    words = {"PATH": ":".join(path), "HOME": "/root", "LANG": "C.UTF-8", "PYTHONDONTWRITEBYTECODE": "1", **environment}
    if tools.libraries:
        words["LD_LIBRARY_PATH"] = ":".join(map(str, tools.libraries))
    given = [f"{name}={value}" for name, value in words.items()]
    return f"cd {shlex.quote(str(cwd))}\nexec {shlex.join(['env', '-i', *given, *command])}\n"


def _boot(tools: Tools, shared: Path, limit: float) -> str:
    """From power on to power off. What went wrong, or nothing."""
    words = [
        *("root=/dev/root", "rootfstype=hostfs", "rootflags=/", "ro", "quiet", f"mem={MEMORY}M", f"init={shared}/init"),
        *(f"uml_dir={shared}/", "con=null", "con0=fd:0,fd:1"),
    ]
    with (shared / _CONSOLE).open("wb") as output:
        process = subprocess.Popen(
            [tools.kernel, *words],
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            env={**os.environ, "TMPDIR": str(_memory_folder(shared)), **_preloaded(shared)},
            start_new_session=True,  # it is several processes, which end together
            preexec_fn=_end_with_parent,
        )
    try:
        process.wait(limit)
    except subprocess.TimeoutExpired:
        return f"not ready after {limit:.0f} s"
    finally:
        if process.returncode is None:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
    return ""


def _preloaded(shared: Path) -> dict[str, str]:
    """What the kernel needs in its environment to run on this processor. Raises `KernelFailed` without a compiler."""
    if _WIDE not in Path("/proc/cpuinfo").read_text(encoding="ascii").split():
        return {}
    library, compiler = shared / "registers.so", shutil.which("cc")
    if compiler is None:
        raise KernelFailed("this processor has registers that the kernel does not know: install gcc")
    subprocess.run([compiler, "-shared", "-fPIC", "-O2", "-o", library, _HERE / "registers.c"], check=True)
    return {"LD_PRELOAD": str(library)}


def _end_with_parent() -> None:
    """When this pytest is killed, the kernel ends too."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)


def _memory_folder(shared: Path) -> Path:
    """The kernel's memory is a file: best in memory, but containers often have little of that."""
    memory = Path("/dev/shm")
    if os.access(memory, os.W_OK) and shutil.disk_usage(memory).free > MEMORY << 20:
        return memory
    return shared
