"""The files by which programs find served buses: names, folders, servers that were killed, and two of one name."""

from __future__ import annotations

import os
import subprocess
import sys
from typing import TYPE_CHECKING

import pytest

from r2p.errors import TransportError
from r2p.sim.buses import rendezvous

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    return tmp_path / "r2p"


def test_a_bus_is_found_while_it_is_served(folder: Path) -> None:
    assert rendezvous.find("lab") is None
    with rendezvous.publish("lab", 1234, bitrate=500_000) as served:
        assert rendezvous.find("lab") == served
        assert rendezvous.served_buses() == [served]
        assert (served.name, served.port, served.pid, served.bitrate) == ("lab", 1234, os.getpid(), 500_000)
        assert len(served.secret) == rendezvous.SECRET_SIZE
        assert rendezvous.find("other") is None
    assert rendezvous.find("lab") is None
    assert not list(folder.iterdir())


def test_only_this_user_can_read_what_is_in_the_folder(folder: Path) -> None:
    with rendezvous.publish("lab", 1, bitrate=1_000_000):
        assert folder.stat().st_mode & 0o777 == 0o700
        assert (folder / "lab.bus").stat().st_mode & 0o777 == 0o600


def test_secrets_differ() -> None:
    with rendezvous.publish("a", 1, bitrate=1_000_000) as a, rendezvous.publish("b", 1, bitrate=1_000_000) as b:
        assert a.secret != b.secret


def test_a_second_server_of_one_name_is_refused() -> None:
    with (
        rendezvous.publish("lab", 1, bitrate=1_000_000) as first,
        pytest.raises(TransportError, match=rf"the bus lab is served by process {os.getpid()}: choose another name"),
        rendezvous.publish("lab", 2, bitrate=1_000_000),
    ):
        pass
    with rendezvous.publish("lab", 2, bitrate=1_000_000) as second:
        assert second.secret != first.secret


@pytest.mark.parametrize("name", ["", "..", ".", "a/b", "../lab", "-x", ".x", "a b", "lab\n", "ü", "x" * 65, "a\0b"])
def test_names_that_are_not(name: str) -> None:
    with (
        pytest.raises(TransportError, match="a bus can't be served as"),
        rendezvous.publish(name, 1, bitrate=1_000_000),
    ):
        pass
    assert rendezvous.find(name) is None


@pytest.mark.parametrize("name", ["lab", "a.b", "_x", "CAN-0", "x" * 64])
def test_names(name: str) -> None:
    with rendezvous.publish(name, 1, bitrate=1_000_000):
        assert rendezvous.find(name) is not None


@pytest.mark.processes
def test_the_next_server_removes_the_file_of_one_that_was_killed() -> None:
    code = """
from r2p.sim.buses import rendezvous
with rendezvous.publish("lab", 1, bitrate=1_000_000):
    print("ready", flush=True)
    input()
"""
    with subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as child:
        assert child.stdout is not None
        child.stdout.readline()
        with (
            pytest.raises(TransportError, match=f"by process {child.pid}"),
            rendezvous.publish("lab", 2, bitrate=1_000_000),
        ):
            pass
        child.kill()
    stale = rendezvous.find("lab")
    assert stale is not None
    assert stale.pid == child.pid
    assert rendezvous.served_buses() == []
    with rendezvous.publish("lab", 2, bitrate=1_000_000) as served:
        assert rendezvous.find("lab") == served
    assert rendezvous.find("lab") is None


def test_a_file_of_another_version_is_none_of_ours(folder: Path) -> None:
    rendezvous.folder()
    (folder / "lab.bus").write_text('{"port": "a word"}')
    assert rendezvous.find("lab") is None
    assert rendezvous.served_buses() == []


def test_a_link_in_the_place_of_a_file_is_refused(folder: Path, tmp_path: Path) -> None:
    rendezvous.folder()
    (folder / "lab.bus").symlink_to(tmp_path / "other")
    with pytest.raises(TransportError, match="can't write"), rendezvous.publish("lab", 1, bitrate=1_000_000):
        pass


def _open_to_others(folder: Path) -> None:
    folder.mkdir()
    folder.chmod(0o755)


def _a_link(folder: Path) -> None:
    (folder.parent / "elsewhere").mkdir()
    folder.symlink_to(folder.parent / "elsewhere")


def _a_file(folder: Path) -> None:
    folder.write_text("")


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (_open_to_others, "other users can read or change .*: chmod 700"),
        (_a_link, "is not a folder of this user"),
        (_a_file, "can't make"),
    ],
)
def test_folders_that_are_not_safe(folder: Path, make: Callable[[Path], None], text: str) -> None:
    make(folder)
    for use in (rendezvous.folder, rendezvous.served_buses, lambda: rendezvous.find("lab")):
        with pytest.raises(TransportError, match=text):
            use()


def test_the_folder_of_another_user(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rendezvous.folder()
    monkeypatch.setattr(os, "getuid", lambda: folder.stat().st_uid + 1)
    with pytest.raises(TransportError, match="is not a folder of this user"):
        rendezvous.folder()


def test_without_a_folder_of_its_own_the_user_has_one_in_that_for_temporary_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    for runtime in ("", str(tmp_path / "missing")):
        monkeypatch.setenv("XDG_RUNTIME_DIR", runtime)
        assert rendezvous.folder() == tmp_path / f"r2p-{os.getuid()}"
