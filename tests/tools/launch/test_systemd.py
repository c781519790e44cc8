"""The units that --systemd writes: systemd finds nothing wrong with them, and they say what the file says."""

from __future__ import annotations

import shutil
import subprocess
from typing import TYPE_CHECKING

import pytest

from r2p.tools.config import UsageError, read
from r2p.tools.launch.entries import parse_entries
from r2p.tools.launch.systemd import make_units, write

if TYPE_CHECKING:
    from pathlib import Path

FILE = r"""
via = "tcp:127.0.0.1:2323"

[launch.prepare]
command = "module reboot IMU1"
ready = "ended"

[launch.gateway]
command = "gateway --via rtcan:can0 --via tcp-listen:2323"
ready = ["port 2323", "module GW"]
ready_timeout = 10
required = true
restart = "always"

[launch.planner]
command = ['run', 'the robot.py:plan', '--remap', 'a:=$b"c\d', '--via', 'serial:/dev/tty%1']
restart = "on-failure"
stop_timeout = "2s"
env = {GREETING = "100 % sure\nreally"}
"""


@pytest.fixture
def path(tmp_path: Path) -> Path:
    (path := tmp_path / "my robot.toml").write_text(FILE)
    return path


def make(path: Path) -> dict[str, str]:
    return make_units(path, parse_entries(path, read(path)), ["zenoh:"])


def test_each_entry_is_a_service(path: Path) -> None:
    units = make(path)
    assert list(units) == [
        "my_robot.target",
        "my_robot-prepare.service",
        "my_robot-gateway.service",
        "my_robot-planner.service",
    ]
    target, prepare, gateway, planner = (text.splitlines() for text in units.values())
    assert "BindsTo=my_robot-gateway.service" in target
    assert {"Type=oneshot", "RemainAfterExit=yes", "After=network.target"} <= set(prepare)
    assert {"After=my_robot-prepare.service", "TimeoutStartSec=15", "Restart=always"} <= set(gateway)
    assert any(line.startswith("ExecStartPost=") and line.endswith("-m r2p launch --ready gateway") for line in gateway)
    assert {
        "After=my_robot-gateway.service",
        "Environment=R2P_VIA=zenoh:",
        f'Environment="R2P_CONFIG={path}"',
        r'Environment="GREETING=100 %% sure\nreally"',
        "TimeoutStopSec=2",
    } <= set(planner)
    command = next(line for line in planner if line.startswith("ExecStart="))
    assert command.endswith(r'run "the robot.py:plan" --remap "a:=$$b\"c\\d" --via serial:/dev/tty%%1')


@pytest.mark.processes
@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd is not here")
def test_systemd_accepts_them(path: Path, tmp_path: Path) -> None:
    units = make(path)
    for name, text in units.items():
        (tmp_path / name).write_text(text)
    done = subprocess.run(
        ["systemd-analyze", "verify", *(tmp_path / name for name in units)],
        capture_output=True,
        text=True,
        timeout=60,
        env={"SYSTEMD_UNIT_PATH": f"{tmp_path}:"},
    )
    assert (done.returncode, done.stderr) == (0, "")


def test_only_units_that_r2p_has_written_are_replaced(
    path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    entries = parse_entries(path, read(path))
    for _ in range(2):
        write(path, entries, tmp_path / "units", None)
    assert f"sudo cp {tmp_path}/units/my_robot.target " in capsys.readouterr().err
    (tmp_path / "units" / "my_robot.target").write_text("[Unit]\n")
    with pytest.raises(UsageError, match=r"my_robot.target exists, and r2p has not written it"):
        write(path, entries, tmp_path / "units", None)


def test_units_of_r2p_toml_have_the_name_of_its_directory(tmp_path: Path) -> None:
    (tmp_path / "triskar").mkdir()
    (path := tmp_path / "triskar" / "r2p.toml").write_text("[launch.sim]\ncommand = 'sim'")
    assert list(make(path)) == ["triskar.target", "triskar-sim.service"]
