"""The notices name each package that r2p asks for, with a licence, and the wheel takes them along."""

import re
import tomllib

from tests.docs.blocks import ROOT

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
NOTICES = "THIRD-PARTY-NOTICES.md"

_NAME = re.compile(r"[A-Za-z0-9-]+")
_ROW = re.compile(r"^\| \[([a-z0-9-]+)\]\(https://[^)]+\) \| ([^|]*\S) \| ([^|]*\S) \|$", re.MULTILINE)


def _packages(requirements: list[str]) -> set[str]:
    return {found[0] for each in requirements if (found := _NAME.match(each)) is not None}


def test_every_dependency_has_a_notice() -> None:
    named = {package: needed for package, _, needed in _ROW.findall((ROOT / NOTICES).read_text())}
    extras = {extra: _packages(each) for extra, each in PROJECT["optional-dependencies"].items() if extra != "all"}
    assert set(named) == _packages(PROJECT["dependencies"]).union(*extras.values())
    assert all(f"`r2p[{extra}]`" in named[package] for extra, packages in extras.items() for package in packages)


def test_the_wheel_takes_them_along() -> None:
    assert PROJECT["license-files"] == ["LICENSE", NOTICES]


def test_every_dependency_has_a_lower_bound() -> None:
    extras = (each for group in PROJECT["optional-dependencies"].values() for each in group)
    requirements = [*PROJECT["dependencies"], *extras]
    assert [each for each in requirements if ">=" not in each and not each.startswith("r2p[")] == []
