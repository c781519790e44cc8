"""The notices name each package that r2p asks for, with a licence, and the wheel takes them along."""

import re
import tomllib

from tests.docs.blocks import ROOT

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
NOTICES = "THIRD-PARTY-NOTICES.md"

_NAME = re.compile(r"[A-Za-z0-9-]+")
_VERSION = re.compile(r"\(v([0-9.]+)\)")
_ROW = re.compile(r"^\| \[([a-z0-9-]+)\]\(https://[^)]+\) \| ([^|]*\S) \| ([^|]*\S) \|$", re.MULTILINE)


def _packages(requirements: list[str]) -> set[str]:
    return {found[0] for each in requirements if (found := _NAME.match(each)) is not None}


def test_every_dependency_has_a_notice() -> None:
    named = {package: needed for package, _, needed in _ROW.findall((ROOT / NOTICES).read_text())}
    extras = {extra: _packages(each) for extra, each in PROJECT["optional-dependencies"].items() if extra != "all"}
    assert set(named) == _packages(PROJECT["dependencies"]).union(*extras.values())
    assert all(f"`r2p[{extra}]`" in named[package] for extra, packages in extras.items() for package in packages)


def test_the_wheel_takes_them_along() -> None:
    assert PROJECT["license-files"] == ["LICENSE", NOTICES, "r2p/web/page/vendor/*/LICENSE"]


def test_what_the_page_contains_has_its_licence_there() -> None:
    notices = (ROOT / NOTICES).read_text()
    contained = [each for each in (ROOT / "r2p/web/page/vendor").iterdir() if each.is_dir()]
    assert contained
    for folder in contained:
        assert f"`{folder.relative_to(ROOT)}`" in notices
        assert (folder / "LICENSE").read_text().strip() in notices
        versions = {found for each in folder.glob("*.js") for found in _VERSION.findall(each.read_text()[:100])}
        assert [each for each in versions if f"{folder.name} {each}" in notices.lower()] == list(versions) != []


def test_every_dependency_has_a_lower_bound() -> None:
    extras = (each for group in PROJECT["optional-dependencies"].values() for each in group)
    requirements = [*PROJECT["dependencies"], *extras]
    assert [each for each in requirements if ">=" not in each and not each.startswith("r2p[")] == []
