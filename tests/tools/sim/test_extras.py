"""`r2p sim --with`: modules of a robot that start only by name."""

from __future__ import annotations

import pytest
from typer.testing import CliRunner

from r2p.sim.robots.emulated import MODULES, Triskar2
from r2p.sim.robots.tiltone.robot import TiltOne
from r2p.tools.main import app
from r2p.tools.session import UsageError
from r2p.tools.sim.command import started_modules


def test_they_start_only_when_they_are_named() -> None:
    assert started_modules(Triskar2, []) == list(MODULES)
    assert started_modules(Triskar2, ["PROX3", "IMU1", "IMU1"]) == [*MODULES, "IMU1", "PROX3"]
    assert started_modules(Triskar2, ["PS"]) == list(MODULES), "it starts anyway"


def test_another_name_is_refused_with_the_nearest_one() -> None:
    with pytest.raises(UsageError, match="Triskar2 has no module IMU2; did you mean IMU1"):
        started_modules(Triskar2, ["IMU2"])
    with pytest.raises(UsageError, match="tiltOne has no module IO1; it has no extra modules"):
        started_modules(TiltOne, ["IO1"])


def test_the_screen_shows_what_they_have() -> None:
    arguments = ["sim", "--fast", "--duration", "3", "--with", "IMU1", "--with", "IO1", "--seed", "1"]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    assert "Triskar2 starts: 9 modules" in result.output


@pytest.mark.parametrize(("line", "expected"), [("--with I", ["IMU1", "IO1"]), ("--with IMU1 --with I", ["IO1"])])
def test_a_shell_completes_them(line: str, expected: list[str]) -> None:
    environment = {"_R2P_COMPLETE": "complete_bash", "COMP_WORDS": f"r2p sim triskar2 {line}"}
    environment["COMP_CWORD"] = str(len(environment["COMP_WORDS"].split()) - 1)
    result = CliRunner().invoke(app, [], env=environment, prog_name="r2p")
    assert result.output.split() == expected
