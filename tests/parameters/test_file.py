"""The file of saved parameters: what is written and kept, and that a save that is cut off leaves the old or the new."""

from __future__ import annotations

import asyncio
import fcntl
import os
import stat
import tomllib
from typing import TYPE_CHECKING, Any

import pytest

import r2p
from r2p.parameters.file import ParameterFile
from r2p.testing.network import node_in

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

pytestmark = pytest.mark.virtual_time

STEPS = ("open", "unlink", "fchmod", "write", "fsync", "replace")
"""The calls of the system that a save makes; some of them twice."""


BY_HAND = """
format = 1
note = 2026-01-01
[params.PC2.x]
y = 1
[params.PC1.speed]
kp = "fast"
old = true
limits.left = [3, 4]
"""


async def gains(node: r2p.Node) -> None:
    node.parameter("kp", 0.5)
    node.parameter("limits.left", (0, 0))
    name = node.parameter("name", "x")
    async for _ in name.changes():
        pass


def names_in(directory: Path) -> list[str]:
    return [each.name for each in directory.iterdir()]


def contents(path: Path) -> dict[str, Any]:
    return tomllib.loads(path.read_text())


async def test_saves_what_was_set_and_starts_with_it(tmp_path: Path) -> None:
    path = tmp_path / "params.toml"
    async with r2p.Module("PC1", params_file=path) as module, node_in(module, name="speed") as node:
        kp, _left = node.parameter("kp", 0.5), node.parameter("limits.left", (0, 0))
        kp.set(0.7)
        module.parameters.set({("speed", "limits.left"): (1, 2)})
        assert await module.parameters.save() == 2
        (info, _) = module.parameters.infos()
        assert (info.origin, info.saved) == ("program", 0.7)
    assert contents(path) == {"format": 1, "params": {"PC1": {"speed": {"kp": 0.7, "limits.left": [1, 2]}}}}
    assert names_in(tmp_path) == ["params.toml"]
    async with r2p.Module("PC1", params_file=path) as module, node_in(module, name="speed") as node:
        kp, left = node.parameter("kp", 0.5), node.parameter("limits.left", (0, 0))
        assert (kp.value, kp.origin, left.value) == (0.7, "saved file", (1, 2))
        kp.set(0.9)
        module.parameters.reset("speed", ["kp"])
        assert (kp.value, kp.origin, module.parameters.infos()[0].saved) == (0.5, "code", 0.7)
        assert await module.parameters.save() == 1
        assert module.parameters.infos()[0].saved is None
    assert contents(path)["params"]["PC1"]["speed"] == {"limits.left": [1, 2]}


async def test_keeps_what_it_does_not_know_and_reports_what_does_not_fit(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Entries of other modules, of other nodes, by hand, and values of another type stay where they are."""
    path = tmp_path / "params.toml"
    path.write_text(BY_HAND)
    async with r2p.Module("PC1", params_file=path) as module:
        module.start(gains, name="speed")
        module.start(gains, name="other")
        await asyncio.sleep(0.1)
        values = {name: each.value for name, each in module.parameters.items()}
        assert values["speed", "kp"] == 0.5
        assert values["speed", "limits.left"] == (3, 4)
        assert "PC1/speed.kp = 'fast': it takes a float, not a str" in caplog.text
        problem = module.parameters.infos("speed")[0].problem
        assert problem.endswith("PC1/speed.kp = 'fast': it takes a float, not a str")
        module.parameters.set({("other", "name"): "z"})
        await module.parameters.save()
    before = tomllib.loads(BY_HAND)
    before["params"]["PC1"]["other"] = {"name": "z"}
    assert contents(path) == before


@pytest.mark.parametrize(
    ("saved", "values", "reason"),
    [
        ("low = 5\nhigh = 6", (5.0, 6.0), ""),
        ("high = 0.5", (1.0, 2.0), "PC1/a.high = 0.5: too low"),
        ("low = 5", (5.0, 2.0), "PC1/a.high = 2.0: too low"),
    ],
)
async def test_a_saved_file_keeps_no_node_from_starting(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, saved: str, values: tuple[float, float], reason: str
) -> None:
    """Also where its values do not go together with each other, or with the defaults of the others."""

    def above(value: float, others: Mapping[str, Any]) -> str | None:
        return None if value > others["low"] else "too low"

    path = tmp_path / "params.toml"
    path.write_text(f"format = 1\n[params.PC1.a]\n{saved}\n")
    async with r2p.Module("PC1", params_file=path) as module, node_in(module, name="a") as node:
        low, high = node.parameter("low", 1.0), node.parameter("high", 2.0, check=above)
        assert (low.value, high.value) == values
        assert bool(caplog.records) == bool(reason)
        assert reason in caplog.text


async def test_reads_the_file_again_on_a_reboot_and_keeps_its_values_if_it_is_broken_then(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "params.toml"
    async with r2p.Module("PC1", params_file=path) as module:
        module.start(gains)
        for text, value in (("format = 1\n[params.PC1.gains]\nkp = 3\n", 3.0), ("what?", 3.0)):
            path.write_text(text)
            await module.reboot()
            await asyncio.sleep(0.1)
            assert module.parameters["gains", "kp"].value == value
    assert "keeps the saved parameters of its start" in caplog.text


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("format = 2\n", "format 2, this version of r2p writes `format = 1`"),
        ("[params.PC1.speed]\nkp = 1\n", "no format number.*: write `format = 1` at its beginning, or .* --params"),
        ("format = 1\n[params.PC1.speed\n", "params.toml: "),
        ("format = 1\n[params.PC1]\nspeed = 3\n", r"write a table \[params.PC1.node\]"),
        ("format = 1\nparams = 3\n", "write a table"),
        ("\udc80", "params.toml: 'utf-8' codec"),
    ],
)
async def test_a_file_that_can_not_be_read_is_an_error_at_the_start(tmp_path: Path, text: str, reason: str) -> None:
    path = tmp_path / "params.toml"
    path.write_bytes(text.encode(errors="surrogateescape"))
    with pytest.raises(r2p.ParameterError, match=reason):
        async with r2p.Module("PC1", params_file=path):
            pass


async def test_a_module_without_a_file_and_a_file_without_a_directory(tmp_path: Path) -> None:
    async with r2p.Module("PC1") as module:
        with pytest.raises(r2p.ParameterError, match=r"PC1 has no file for parameters: start it with .*--params-file"):
            await module.parameters.save()
    with pytest.raises(r2p.ParameterError, match=r"there is no directory .*nowhere"):
        async with r2p.Module("PC1", params_file=tmp_path / "nowhere" / "params.toml"):
            pass
    with pytest.raises(r2p.ParameterError, match=r"can't read parameters from .*aaa: File name too long"):
        async with r2p.Module("PC1", params_file=tmp_path / ("a" * 300)):
            pass


class Cut(BaseException):
    """The process is killed."""


@pytest.mark.parametrize("end", [OSError(28, "No space left on device"), Cut()], ids=["full", "killed"])
@pytest.mark.parametrize("step", STEPS)
@pytest.mark.parametrize("number", [1, 2])
async def test_a_save_that_ends_at_any_step_leaves_the_old_file_or_the_new_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, end: BaseException, step: str, number: int
) -> None:
    path = tmp_path / "params.toml"
    name = ("speed", "kp")
    old, new = {name: 0.5}, {name: 0.7}
    await ParameterFile(path).save("PC1", old)
    calls = dict.fromkeys(STEPS, 0)

    def fails(which: str, call: Any) -> Any:
        def call_or_fail(*args: Any, **options: Any) -> Any:
            calls[which] += 1
            if which == step and calls[which] == number:
                if which == "write":
                    call(args[0], args[1][: len(args[1]) // 2])
                raise end
            return call(*args, **options)

        return call_or_fail

    with monkeypatch.context() as patched:
        for each in STEPS:
            patched.setattr(os, each, fails(each, getattr(os, each)))
        saving = ParameterFile(path)
        try:
            saving._save("PC1", new)
        except (OSError, Cut):
            assert calls[step] == number
    assert await ParameterFile(path).load("PC1") in (old, new)
    assert await ParameterFile(path).save("PC1", new) == new
    assert names_in(tmp_path) == ["params.toml"]


async def test_an_error_of_the_disk_is_told_and_a_later_save_writes_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "params.toml"

    def full(_descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    async with r2p.Module("PC1", params_file=path) as module, node_in(module, name="speed") as node:
        node.parameter("kp", 0.5).set(0.7)
        with monkeypatch.context() as patched:
            patched.setattr(os, "fsync", full)
            with pytest.raises(r2p.ParameterError, match=r"PC1 can't save parameters to .*: No space left on device"):
                await module.parameters.save()
        assert not path.exists()
        assert await module.parameters.save() == 1


async def test_a_read_only_directory_is_reported_at_the_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(os, "access", lambda path, _mode: path != tmp_path)
    async with r2p.Module("PC1", params_file=tmp_path / "params.toml"):
        assert f"module PC1 can't save parameters: {tmp_path} is read-only" in caplog.text


async def test_links_owner_and_permissions_stay(tmp_path: Path) -> None:
    real, link = tmp_path / "data" / "params.toml", tmp_path / "params.toml"
    real.parent.mkdir()
    link.symlink_to(real)
    await ParameterFile(link).save("PC1", {("a", "b"): 1})
    real.chmod(0o640)
    await ParameterFile(link).save("PC1", {("a", "b"): 2})
    assert link.is_symlink()
    assert stat.S_IMODE(real.stat().st_mode) == 0o640
    trap = real.parent / ".params.toml.new"  # what another user left there is not written to
    trap.symlink_to(tmp_path / "victim")
    await ParameterFile(link).save("PC1", {("a", "b"): 3})
    assert not (tmp_path / "victim").exists()
    assert await ParameterFile(link).load("PC1") == {("a", "b"): 3}


async def test_two_processes_save_to_one_file_in_turn(tmp_path: Path) -> None:
    path = tmp_path / "params.toml"
    other = os.open(tmp_path, os.O_RDONLY)
    try:
        fcntl.flock(other, fcntl.LOCK_EX)
        with pytest.raises(r2p.ParameterError, match="another process holds the lock"):
            await ParameterFile(path).save("PC1", {("a", "b"): 1})
    finally:
        os.close(other)
    await ParameterFile(path).save("PC1", {("a", "b"): 1})
    await ParameterFile(path).save("PC2", {("a", "b"): 2})
    assert contents(path)["params"] == {"PC1": {"a": {"b": 1}}, "PC2": {"a": {"b": 2}}}
