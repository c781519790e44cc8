"""The file of a key: made once, read only while nobody else can read it."""

import os
import stat
from pathlib import Path

import pytest

import r2p
from r2p import keys
from r2p.transports.url import open_transport


def test_a_new_key_is_private_and_unlike_any_other(tmp_path: Path) -> None:
    old = os.umask(0)
    try:
        for name in ("a", "b"):
            keys.create(tmp_path / name)
    finally:
        os.umask(old)
    assert stat.S_IMODE((tmp_path / "a").stat().st_mode) == 0o600
    assert len((tmp_path / "a").read_bytes()) == 32
    assert keys.load(str(tmp_path / "a")).id != keys.load(str(tmp_path / "b")).id


def test_a_key_is_never_overwritten(tmp_path: Path) -> None:
    keys.create(tmp_path / "key")
    before = (tmp_path / "key").read_bytes()
    with pytest.raises(r2p.Error, match="exists already, and may be in use: choose another name"):
        keys.create(tmp_path / "key")
    assert (tmp_path / "key").read_bytes() == before
    with pytest.raises(r2p.Error, match=r"can't make .*: No such file or directory"):
        keys.create(tmp_path / "missing" / "key")


@pytest.mark.parametrize(
    "scheme", ["memory:lab", "sim:lab", "rtcan:can0", "tcp:host", "tcp-listen:", "serial:/dev/ttyS9"]
)
def test_each_transport_reads_its_key(tmp_path: Path, scheme: str) -> None:
    keys.create(tmp_path / "key")
    open_transport(f"{scheme}?key={tmp_path / 'key'}")
    with pytest.raises(r2p.TransportError, match="there is no such file: make a key with r2p key new"):
        open_transport(f"{scheme}?key={tmp_path / 'none'}")


def test_zenoh_reads_its_key(tmp_path: Path) -> None:
    with pytest.raises(r2p.TransportError, match="there is no such file"):
        open_transport(f"zenoh:?key={tmp_path / 'none'}")


@pytest.mark.parametrize("size", [0, 31, 4097])
def test_a_key_of_another_size_is_refused(tmp_path: Path, size: int) -> None:
    file = tmp_path / "key"
    file.write_bytes(os.urandom(size))
    file.chmod(0o600)
    with pytest.raises(ValueError, match="and a key 32 to 4096: make one with r2p key new"):
        keys.load(str(file))


@pytest.mark.parametrize("mode", [0o640, 0o604, 0o620, 0o602])
def test_a_key_that_others_may_read_or_change_is_refused(tmp_path: Path, mode: int) -> None:
    keys.create(tmp_path / "key")
    (tmp_path / "key").chmod(mode)
    with pytest.raises(ValueError, match=f"other users may read or change it: chmod 600 {tmp_path}/key"):
        keys.load(str(tmp_path / "key"))


def test_what_is_no_file_is_refused_at_once(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe", 0o600)
    for name in ("pipe", "."):
        with pytest.raises(ValueError, match="it is not a file with a key in it"):
            keys.load(str(tmp_path / name))


def test_the_home_directory_may_be_written_as_a_tilde(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    keys.create(tmp_path / "key")
    assert keys.load("~/key").id == keys.load(str(tmp_path / "key")).id


def test_a_key_is_shown_by_its_id_only() -> None:
    assert repr(keys.SharedKey(bytes(32))) == "SharedKey(2eb3)"
