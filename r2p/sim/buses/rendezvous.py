"""Where programs find the buses that others serve: a file for each bus, in a folder that only this user can read.

    with publish("lab", port, bitrate=1_000_000) as served:     # the server; `served` has the secret
        ...
    served = find("lab")                                        # a client: None, or where to connect

A server holds a lock on its file, which ends with its process, however that ends. So a file without a lock is stale,
and the next server of that name removes it. Clients don't look at locks: at the port of a stale file no program
listens, or one that does not know the secret.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import re
import secrets
import stat
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Final

import msgspec

from r2p.errors import TransportError

if TYPE_CHECKING:
    from collections.abc import Iterator

SECRET_SIZE: Final = 32
"""Bytes: clients send the first half, and servers answer with the second one."""

_SUFFIX: Final = ".bus"
_NAME: Final = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,63}")  # safe as the name of a file
_FILE_MAX: Final = 4096  # bytes
_OTHERS: Final = 0o077  # permissions of everybody else


class ServedBus(msgspec.Struct, frozen=True):
    """The content of a file, as JSON: where a bus is served, and by which process; `secret` as in `SECRET_SIZE`."""

    name: str
    port: int
    pid: int
    secret: bytes
    bitrate: int


def check_name(name: str) -> str:
    """Return the name of a bus that is to be served. Raises TransportError for one that no file can have."""
    if _NAME.fullmatch(name) is None:
        raise TransportError(
            f"a bus can't be served as {name!r}: take up to 64 letters, digits and any of _ . - (not first: . -), "
            "such as lab"
        )
    return name


@contextlib.contextmanager
def publish(name: str, port: int, *, bitrate: int) -> Iterator[ServedBus]:
    """Let others find this bus for as long as the block takes.

    Raises TransportError if a program serves a bus of that name already, or the folder is not safe.
    """
    path = _path(name)
    served = ServedBus(name, port, os.getpid(), secrets.token_bytes(SECRET_SIZE), bitrate)
    file = _locked(path, name)
    try:
        os.write(file, msgspec.json.encode(served))
        try:
            yield served
        finally:
            path.unlink(missing_ok=True)  # before the lock ends: it can't be the file of the next server
    finally:
        os.close(file)


def find(name: str) -> ServedBus | None:
    """Return where the bus of that name is or was served, or None if it is not served or the name can't be one.

    Raises TransportError if the folder is not safe.
    """
    if _NAME.fullmatch(name) is None:
        return None
    try:
        return _read(_path(name))
    except OSError:  # a file that is none, or just removed
        return None


def served_buses() -> list[ServedBus]:
    """Return the buses that programs serve now, as far as can be seen without connecting to them."""
    found = [_read(path) for path in sorted(folder().glob(f"*{_SUFFIX}"))]
    return [each for each in found if each is not None and _runs(each.pid)]


def folder() -> Path:
    """Return the folder of the files, which is made if it does not exist.

    Raises TransportError if another user could read or write it: the files have secrets.
    """
    runtime = os.environ.get("XDG_RUNTIME_DIR", "")
    if runtime and Path(runtime).is_dir():
        path = Path(runtime, "r2p")
    else:  # in the folder of all users; its name shows whose it is
        path = Path(tempfile.gettempdir(), f"r2p-{os.getuid()}")
    try:
        path.mkdir(mode=0o700, exist_ok=True)
        info = path.lstat()
    except OSError as error:
        raise TransportError(f"can't make {path}, where served buses are listed: {error.strerror}") from error
    if not stat.S_ISDIR(info.st_mode) or info.st_uid != os.getuid():
        raise TransportError(f"{path} is not a folder of this user: have it removed, or set XDG_RUNTIME_DIR to one")
    if info.st_mode & _OTHERS:
        raise TransportError(f"other users can read or change {path}, where served buses are listed: chmod 700 {path}")
    return path


def _path(name: str) -> Path:
    return folder() / (check_name(name) + _SUFFIX)


def _read(path: Path) -> ServedBus | None:
    try:
        with path.open("rb") as file:
            return msgspec.json.decode(file.read(_FILE_MAX), type=ServedBus)
    except (FileNotFoundError, msgspec.DecodeError):  # not written yet, or by another version of r2p
        return None


def _locked(path: Path, name: str) -> int:
    """Return a file descriptor of the empty file, with a lock on it."""
    while True:
        try:
            file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o600)
        except OSError as error:
            raise TransportError(f"can't write {path}: {error.strerror}") from error
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if _is_at(path, file):
                if not os.fstat(file).st_size:
                    return file
                path.unlink()  # stale. An empty file has no secret of the past, which a client might still send
        except BlockingIOError:
            os.close(file)
            raise TransportError(_taken(path, name)) from None
        os.close(file)


def _is_at(path: Path, file: int) -> bool:
    """Return whether the path still leads to this open file: another server may have removed it."""
    try:
        return os.path.samestat(path.stat(), os.fstat(file))
    except FileNotFoundError:
        return False


def _taken(path: Path, name: str) -> str:
    other = _read(path)
    by = f" by process {other.pid}" if other else " by another program, which just started"
    return f"the bus {name} is served{by}: choose another name, or end that one"


def _runs(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True
