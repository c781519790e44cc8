"""The file that a module's parameters are saved to: TOML, with the tables of r2p.toml.

    format = 1

    [params.PC1.speed]
    kp = 0.7

A save replaces the file at once: a power cut leaves the old one or the new one. It changes only the entries that are
saved; those of other modules, and whatever else is in there, stay. Modules may share a file: a save locks its
directory.

Steps of a save: lock the directory, read the file, write the new contents to a file next to it, fsync that, rename it,
fsync the directory.
"""

import asyncio
import contextlib
import errno
import os
import stat
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, TypeVar

from r2p.codecs.parameters import Name, Plain
from r2p.errors import ParameterError
from r2p.log_lines import get_logger
from r2p.parameters.sources import TABLE, flatten, read_tables, read_toml

T = TypeVar("T")

logger = get_logger("r2p.module")

FORMAT = 1
"""The number of the format, which the file begins with."""

_UNSUPPORTED = (errno.EBADF, errno.EINVAL, errno.ENOLCK, errno.ENOTSUP)
"""What network file systems answer that neither lock nor flush a directory: a save without is better than none."""

_LOCK_TRIES = 40
_LOCK_PAUSE = 0.05  # seconds between two tries, when another process saves to the directory
_NEW_MODE = 0o666  # of a new file, less the umask
_PERMISSIONS = 0o777
_HEAD = "# Parameters that were saved at run time. r2p writes this file: comments are lost, all else is kept.\n"


class ParameterFile:
    """A file of saved parameters. Its methods do their work in a thread: a disk may take long."""

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path).absolute()
        """The file; a symbolic link stays one, and what it points to is replaced."""

    async def load(self, module: str) -> dict[Name, object]:
        """Return the saved values of a module; without a file, no values. Raises ParameterError.

        Warns if nothing can be saved.
        """
        try:
            if not await _in_thread(self._is_writable):
                logger.warning("module %s can't save parameters: %s is read-only", module, self.path.parent)
            return await _in_thread(lambda: self._load(module))
        except OSError as error:
            raise ParameterError(f"can't read parameters from {self.path}: {error.strerror or error}") from error

    async def save(self, module: str, changes: Mapping[Name, Plain | None]) -> dict[Name, object]:
        """Write changes (None: remove the entry), and return what the file has for the module then.

        Raises ParameterError; the file is the old one then, or, if only its directory could not be flushed, the new.
        """
        for _ in range(_LOCK_TRIES):
            try:
                return await _in_thread(lambda: self._save(module, changes))
            except BlockingIOError:
                await asyncio.sleep(_LOCK_PAUSE)
            except OSError as error:
                raise ParameterError(
                    f"{module} can't save parameters to {self.path}: {error.strerror or error}"
                ) from error
        raise ParameterError(
            f"{module} can't save parameters to {self.path}: another process holds the lock of its directory"
        )

    def _is_writable(self) -> bool:
        """Return whether a file can be made in the directory; True for a missing directory, which is another error."""
        directory = Path(os.path.realpath(self.path)).parent
        return not directory.is_dir() or os.access(directory, os.W_OK | os.X_OK)

    def _load(self, module: str) -> dict[Name, object]:
        if not self.path.exists():
            if not self.path.parent.is_dir():
                raise ParameterError(f"there is no directory {self.path.parent} for the file of parameters: make it")
            return {}
        return self._of_module(self._read(), module)

    def _read(self) -> dict[str, Any]:
        """Return the contents of the file. Raises ParameterError for one that a save would destroy."""
        contents = read_toml(self.path)
        number = contents.get("format")
        if number != FORMAT or isinstance(number, bool):
            if "format" not in contents:
                raise ParameterError(
                    f"{self.path} has no format number, so it was not saved by r2p: write `format = {FORMAT}` at its "
                    "beginning, or give it with --params, which only reads it"
                )
            raise ParameterError(
                f"{self.path} has format {number!r}, this version of r2p writes `format = {FORMAT}`: update r2p, or "
                "name another file"
            )
        return contents

    def _of_module(self, contents: dict[str, Any], module: str) -> dict[Name, object]:
        try:
            return read_tables(contents.get(TABLE, {}), only=module).get(module, {})
        except ParameterError as error:
            raise ParameterError(f"{self.path}: {error}") from None

    def _save(self, module: str, changes: Mapping[Name, Plain | None]) -> dict[Name, object]:
        target = Path(os.path.realpath(self.path))
        with _locked(target.parent) as directory:
            contents = self._read() if target.exists() else {"format": FORMAT}
            before = self._of_module(contents, module)
            after = {name: value for name, value in {**before, **changes}.items() if value is not None}
            if after != before or not target.exists():
                _replace_values(contents, module, changes)
                _write(directory, target, _HEAD + "\n" + _as_toml(contents))
        return after


def _replace_values(contents: dict[str, Any], module: str, changes: Mapping[Name, Plain | None]) -> None:
    nodes = contents.setdefault(TABLE, {}).setdefault(module, {})
    for (node, name), value in changes.items():
        entries: dict[str, Any] = dict(flatten(nodes.get(node, {})))
        if value is None:
            entries.pop(name, None)
        else:
            entries[name] = list(value) if isinstance(value, tuple) else value
        nodes[node] = entries
        if not entries:
            del nodes[node]


def _as_toml(contents: dict[str, Any]) -> str:
    import tomli_w

    return tomli_w.dumps(contents)


@contextlib.contextmanager
def _locked(directory: Path) -> Iterator[int]:
    """Keep other processes from saving to a directory. Raises BlockingIOError if one does."""
    import fcntl

    descriptor = os.open(directory, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno not in _UNSUPPORTED:
                raise
        yield descriptor
    finally:
        os.close(descriptor)


def _write(directory: int, target: Path, text: str) -> None:
    """Replace a file: whatever happens meanwhile, it has the old contents or the new ones."""
    temporary = f".{target.name}.new"  # one name, as the directory is locked: a killed save leaves one file at most
    with contextlib.suppress(FileNotFoundError):
        os.unlink(temporary, dir_fd=directory)
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
    descriptor = os.open(temporary, flags, _NEW_MODE, dir_fd=directory)
    try:
        try:
            _keep_owner(descriptor, target)
            rest = memoryview(text.encode())
            while rest:
                rest = rest[os.write(descriptor, rest) :]
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
        os.replace(temporary, target.name, src_dir_fd=directory, dst_dir_fd=directory)
    except OSError:
        with contextlib.suppress(OSError):
            os.unlink(temporary, dir_fd=directory)
        raise
    try:
        os.fsync(directory)
    except OSError as error:
        if error.errno not in _UNSUPPORTED:
            raise


def _keep_owner(descriptor: int, target: Path) -> None:
    """Give a new file the owner and the permissions of the one that it replaces."""
    try:
        status = target.stat()
    except FileNotFoundError:
        return
    with contextlib.suppress(PermissionError):  # only root can give a file away
        os.fchown(descriptor, status.st_uid, status.st_gid)
    os.fchmod(descriptor, stat.S_IMODE(status.st_mode) & _PERMISSIONS)


async def _in_thread(work: Callable[[], T]) -> T:
    return await asyncio.get_running_loop().run_in_executor(None, work)
