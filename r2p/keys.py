"""Shared keys: the file that holds one, and the HMAC-SHA256 that proves it (PROTOCOL.md 9).

The content of the file is the key, byte by byte: no text, no line end. It must be 32 bytes or more, so that nothing can
guess it, and no other user may read it.
"""

import hmac
import os
import stat
from pathlib import Path

from r2p.errors import Error

KEY_MIN = 32
"""Bytes of the shortest key, and of those that `create` makes."""
KEY_MAX = 4096
"""Bytes of the longest key: a longer file is hardly meant to be one."""
TAG = 16
"""Bytes of a tag: the first ones of an HMAC-SHA256."""

_MODE = 0o600


class SharedKey:
    """A key that modules share. It does not show its bytes: options with keys in them are logged."""

    __slots__ = ("_key", "id")

    def __init__(self, key: bytes) -> None:
        self._key = key
        self.id = int.from_bytes(self.tag(b"r2p key")[:2], "little")
        """A number that distinguishes keys, and that everyone may know."""

    def __repr__(self) -> str:
        return f"SharedKey({self.id:04x})"

    def tag(self, data: bytes) -> bytes:
        """Return the tag of some bytes, which only a holder of the key can make."""
        return hmac.digest(self._key, data, "sha256")[:TAG]

    def made(self, tag: bytes, data: bytes) -> bool:
        """Return whether this is the tag of these bytes, in a time that does not depend on how much of it is right."""
        return hmac.compare_digest(tag, self.tag(data))


def load(path: str) -> SharedKey:
    """Read a key. Raises ValueError, which says what to do, for a file that is missing, too short, or not private."""
    file = Path(path).expanduser()
    try:
        descriptor = os.open(file, os.O_RDONLY | os.O_NONBLOCK)  # a pipe without a writer would block for ever
    except FileNotFoundError:
        raise ValueError(f"there is no such file: make a key with r2p key new {file}, or copy the robot's") from None
    except OSError as error:
        raise ValueError(f"can't read it: {error.strerror}") from None
    try:
        _check_private(file, os.fstat(descriptor))
        key = os.read(descriptor, KEY_MAX + 1)
    finally:
        os.close(descriptor)
    if not KEY_MIN <= len(key) <= KEY_MAX:
        size = f"{len(key)} bytes" if len(key) <= KEY_MAX else f"more than {KEY_MAX} bytes"
        raise ValueError(f"it has {size}, and a key {KEY_MIN} to {KEY_MAX}: make one with r2p key new")
    return SharedKey(key)


def create(path: Path) -> None:
    """Write a new key to a file of this name, which only its owner may read. Raises Error if there is one already."""
    try:
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, _MODE)
    except FileExistsError:
        raise Error(f"{path} exists already, and may be in use: choose another name, or remove it first") from None
    except OSError as error:
        raise Error(f"can't make {path}: {error.strerror}") from None
    try:
        with os.fdopen(descriptor, "wb") as file:
            file.write(os.urandom(KEY_MIN))
            file.flush()
            os.fsync(descriptor)
            _check_private(path, os.fstat(descriptor))  # some file systems have no modes
    except (OSError, ValueError) as error:
        path.unlink(missing_ok=True)
        raise Error(f"can't make {path}: {getattr(error, 'strerror', None) or error}") from None


def _check_private(path: Path, status: os.stat_result) -> None:
    """Raise ValueError if the file is not an ordinary one, belongs to another user, or others may read or write it."""
    if not stat.S_ISREG(status.st_mode):
        raise ValueError("it is not a file with a key in it")
    if status.st_uid not in {0, os.geteuid()} and os.geteuid():
        raise ValueError(f"it belongs to another user, who knows the key: chown it to {os.geteuid()}")
    if status.st_mode & 0o077:
        raise ValueError(f"other users may read or change it: chmod 600 {path}")
