"""The file r2p.toml, and the settings of commands."""

from __future__ import annotations

import contextlib
import grp
import os
import pwd
import re
import stat
from pathlib import Path

import pytest

import r2p
from r2p.tools.config import (
    ConfigFile,
    LaunchTable,
    Setting,
    Settings,
    UsageError,
    check_owned,
    list_settings,
    settings,
)
from r2p.tools.config_show import _as_in_file
from r2p.tools.run import load_module
from r2p.tools.session import check_urls


@pytest.fixture(autouse=True)
def _no_settings(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A working directory without a file, and nothing in the environment."""
    monkeypatch.delenv("R2P_VIA", raising=False)
    monkeypatch.delenv("R2P_CONFIG", raising=False)
    monkeypatch.chdir(tmp_path)


def test_aliases_of_long_names(tmp_path: Path) -> None:
    file = tmp_path / "r2p.toml"
    file.write_text('[alias]\n"/front_left/wheel/velocity" = "flw_vel"')
    assert settings().aliases == {"front_left/wheel/velocity": "flw_vel"}
    assert ("alias.front_left/wheel/velocity", "flw_vel", "r2p.toml") in [
        (each.key, each.value, each.source) for each in list_settings()
    ]
    file.write_text('[alias]\nfront_left_wheel_velocity = "flw"\nfront_left_wheel_current = "flw"')
    with pytest.raises(UsageError) as caught:
        settings()
    assert str(caught.value) == (
        f"{file}: [alias] 'front_left_wheel_velocity' and 'front_left_wheel_current' have one alias, 'flw': choose "
        "another one for either"
    )


def test_the_command_line_goes_before_the_environment_before_the_file(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    assert settings().via == []
    (tmp_path / "r2p.toml").write_text('via = "tcp:file"')
    assert settings().via == ["tcp:file"]
    monkeypatch.setenv("R2P_VIA", "tcp:a serial:b")
    assert settings().via == ["tcp:a", "serial:b"]
    assert settings(["tcp:c", "tcp:d"]).via == ["tcp:c", "tcp:d"]


@pytest.mark.parametrize(
    ("listens", "connects"),
    [
        ("tcp-listen:2323", "tcp:127.0.0.1:2323"),
        ("tcp-listen:0.0.0.0:2323", "tcp:127.0.0.1:2323"),
        ("tcp-listen:[::]:2323", "tcp:[::1]:2323"),
        ("tcp-listen:10.0.0.5:2323", "tcp:10.0.0.5:2323"),
        ("tcp-listen:2323?gateways=yes,key=robot.key", "tcp:127.0.0.1:2323?key=robot.key"),
        ("serial:/dev/ttyUSB0", "serial:/dev/ttyUSB0"),
    ],
)
def test_a_tool_connects_to_where_the_program_of_the_same_file_listens(
    tmp_path: Path, listens: str, connects: str
) -> None:
    (tmp_path / "r2p.toml").write_text(f'via = "{listens}"')
    assert settings().via == [listens]
    assert settings(tool=True).via == [connects]
    assert settings([listens], tool=True).via == [listens]


@pytest.mark.parametrize(
    ("contents", "text"),
    [
        (f'module = "{"a" * 65}"', "r2p.toml: module name 'a{65}' has 65 characters"),
        ('[remap]\nencoder = "a//c"', "r2p.toml: topic name 'a//c': a part of it is empty"),
        ('[types]\n"my leds" = "Led"', "r2p.toml: topic name 'my leds': ' ' can't be"),
    ],
)
def test_names_that_nothing_can_have(tmp_path: Path, contents: str, text: str) -> None:
    (tmp_path / "r2p.toml").write_text(contents)
    with pytest.raises(UsageError, match=text):
        settings()


def test_an_error_in_a_url_names_where_it_is_from(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "r2p.toml").write_text('via = "tpc:robot"')
    with pytest.raises(UsageError, match=r"^r2p.toml: unknown transport 'tpc'"):
        check_urls(settings().via, settings().via_source)
    monkeypatch.setenv("R2P_VIA", "tcp:")
    with pytest.raises(UsageError, match=r"^R2P_VIA: tcp:: give the other end's address"):
        check_urls(settings().via, settings().via_source)
    with pytest.raises(UsageError, match=r"^transport 'robot': give it as SCHEME:ADDRESS"):
        check_urls(["robot"], settings(["robot"]).via_source)


def test_what_the_file_holds(tmp_path: Path) -> None:
    (tmp_path / "r2p.toml").write_text(
        'via = ["tcp:a", "tcp:b"]\nmodule = "PC1"\n[types]\nleds = "r2p.msg:Led"\n[remap]\nencoder = "enc1"\n'
    )
    types, remap = {"leds": "r2p.msg:Led"}, {"encoder": "enc1"}
    assert settings() == Settings(["tcp:a", "tcp:b"], "PC1", types, remap, via_source="r2p.toml")


@pytest.mark.parametrize(
    "text", ["via = 5", "via", "modul = 'PC1'", "[types]\nleds = 5", f"via = {'[' * 5000}", f"x{'.x' * 1000} = 1"]
)
def test_a_bad_file_is_named(text: str, tmp_path: Path) -> None:
    (tmp_path / "r2p.toml").write_text(text)
    with pytest.raises(UsageError, match=re.escape(str(tmp_path / "r2p.toml"))):
        settings()


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ('vai = "tcp:there"', "unknown key vai; did you mean via?"),
        ("x = 1", "unknown key x; the keys are via, module, types, remap, alias, launch"),
        ("via = 5", "via: expected str | array, got int"),
        ("[launch.a]\ncomand = 'run'", "[launch.a] unknown key comand; did you mean command?"),
        ("[launch.a]\nready = 'started'", "[launch.a] has no command: add one"),
        ("[launch.a]\ncommand = 'run'\nenv = {A = 1}", "[launch.a] env"),
        ("launch = 5", "write a table [launch.NAME]"),
    ],
)
def test_an_error_names_the_table_and_the_key(tmp_path: Path, text: str, problem: str) -> None:
    (tmp_path / "r2p.toml").write_text(text)
    with pytest.raises(UsageError, match=re.escape(problem)):
        settings()


def test_another_file_is_named_by_the_environment(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "robots").mkdir()
    (tmp_path / "robots" / "red.toml").write_text('[types]\nleds = "types.py:Led"\nlog = "r2p.msg:Log"')
    monkeypatch.setenv("R2P_CONFIG", "robots/red.toml")
    assert settings().types == {"leds": f"{tmp_path}/robots/types.py:Led", "log": "r2p.msg:Log"}
    monkeypatch.setenv("R2P_CONFIG", "blue.toml")
    with pytest.raises(UsageError, match=r"no file .*/blue.toml \(R2P_CONFIG names it\)"):
        settings()


def test_each_setting_has_a_source(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def sources(*, via: list[str] | None = None) -> dict[str, tuple[object, str]]:
        return {each.key: (each.value, each.source) for each in list_settings(via)}

    found = sources()
    assert found["file"] == (None, "default: none")
    assert found["via"] == ([], "default: local only")
    assert found["module"][1] == "default: the host name"
    text = 'via = "tcp:file"\nmodule = "PC1"\n[remap]\na = "b"\n[launch.x]\ncommand = "run"\nrestart = "never"'
    (tmp_path / "r2p.toml").write_text(text)
    found = sources()
    assert found["file"] == (str(tmp_path / "r2p.toml"), "working directory")
    assert found["via"] == (["tcp:file"], "r2p.toml")
    assert found["module"] == ("PC1", "r2p.toml")
    assert found["remap.a"] == ("b", "r2p.toml")
    assert found["launch.x.restart"] == ("never", "r2p.toml")
    assert found["launch.x.required"] == (False, "default")
    monkeypatch.setenv("R2P_VIA", "tcp:environment")
    assert sources()["via"] == (["tcp:environment"], "R2P_VIA")
    assert sources(via=["tcp:option"])["via"] == (["tcp:option"], "--via")


def test_the_page_describes_each_key() -> None:
    page = (Path(r2p.__file__).parents[1] / "docs" / "config.md").read_text()
    general, _, launch = page.partition("## [launch.NAME]")
    assert set(re.findall(r"^\| `\[?([a-z_]+)", general, re.MULTILINE)) == set(ConfigFile.__struct_fields__)
    assert set(re.findall(r"^\| `([a-z_]+)`", launch, re.MULTILINE)) == set(LaunchTable.__struct_fields__)


def test_a_working_directory_that_is_gone_has_no_file(tmp_path: Path) -> None:
    (gone := tmp_path / "gone").mkdir()
    os.chdir(gone)
    gone.rmdir()
    try:
        assert settings() == Settings(via_source="default: local only")
        with pytest.raises(UsageError, match="the working directory does not exist any more"):
            load_module("robot")
        with pytest.raises(UsageError, match=re.escape("there is no file robot.py")):
            load_module("robot.py")
    finally:
        os.chdir(tmp_path)


def status(mode: int = 0o644, user: int | None = None, group: int = 4711) -> os.stat_result:
    return os.stat_result((stat.S_IFREG | mode, 1, 1, 1, os.geteuid() if user is None else user, group, 1, 0, 0, 0))


@pytest.mark.parametrize(
    ("file", "refused"),
    [
        (status(), ""),
        (status(user=0), ""),
        (status(user=4711), "belongs to another user and can name code to run: chown it"),
        (status(0o646), "is writable by other users and can name code to run: chmod go-w"),
        (status(0o664), "is writable by other users"),
    ],
)
def test_a_file_that_others_may_write_is_refused(file: os.stat_result, refused: str) -> None:
    with pytest.raises(UsageError, match=refused) if refused else contextlib.nullcontext():
        check_owned(Path("r2p.toml"), file)


def test_the_group_of_its_owner_alone_may_write_it() -> None:
    owner = pwd.getpwuid(os.geteuid())
    group = grp.getgrgid(owner.pw_gid)
    alone = group.gr_name == owner.pw_name and set(group.gr_mem) <= {owner.pw_name}
    with contextlib.nullcontext() if alone else pytest.raises(UsageError):
        check_owned(Path("r2p.toml"), status(0o664, group=owner.pw_gid))


def test_root_by_way_of_sudo_reads_the_file_of_the_caller(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "geteuid", lambda: 0)
    monkeypatch.setenv("SUDO_UID", "4711")
    check_owned(Path("r2p.toml"), status(user=4711))
    with pytest.raises(UsageError):
        check_owned(Path("r2p.toml"), status(user=4712))


def test_the_file_itself_is_looked_at(tmp_path: Path) -> None:
    (tmp_path / "r2p.toml").write_text('via = "tcp:there"')
    (tmp_path / "r2p.toml").chmod(0o666)
    with pytest.raises(UsageError, match="is writable by other users"):
        settings()


def test_values_are_shown_as_in_the_file() -> None:
    values = (True, 30.0, ["port 2350", "node WHEELS/drive"], ["gateway"], "started", None)
    shown = [_as_in_file(Setting("launch.a.b", each, "r2p.toml")) for each in values]
    assert shown == ["true", "30s", '"port 2350", "node WHEELS/drive"', ["gateway"], "started", None]
    assert _as_in_file(Setting("params.PC1.speed.kp", 0.5, "r2p.toml")) == "0.5"


def test_first_values_of_parameters(tmp_path: Path) -> None:
    (tmp_path / "r2p.toml").write_text('params_file = "p.toml"\n[params.PC1.speed]\nkp = 0.5\nlimits.left = [1, 2]')
    found = settings()
    assert found.params_file == tmp_path / "p.toml"
    assert found.params == {"PC1": {("speed", "kp"): 0.5, ("speed", "limits.left"): [1, 2]}}
    listed = [(each.key, each.value) for each in list_settings() if each.key.startswith("params")]
    assert listed == [
        ("params_file", "p.toml"),
        ("params.PC1.speed.kp", 0.5),
        ("params.PC1.speed.limits.left", [1, 2]),
    ]
    for text, reason in (("params = 3", "write a table"), ('[params."a b".c]', "module name 'a b'")):
        (tmp_path / "r2p.toml").write_text(text)
        with pytest.raises(UsageError, match=f"r2p.toml: .*{reason}"):
            settings()
