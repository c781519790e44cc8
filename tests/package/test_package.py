"""What is published: the wheel, the sdist, and what an index shows of them."""

from __future__ import annotations

import email
import os
import re
import subprocess
import sys
import sysconfig
import tarfile
import venv
import zipfile
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from hatchling.builders.sdist import SdistBuilder
from hatchling.builders.wheel import WheelBuilder
from readme_renderer import markdown

from tests.docs.blocks import ROOT

if TYPE_CHECKING:
    from email.message import Message

CONSUMER = Path(__file__).parent / "consumer"

pytestmark = pytest.mark.xdist_group("package")


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    (path,) = WheelBuilder(str(ROOT)).build(directory=str(tmp_path_factory.mktemp("wheel")), versions=["standard"])
    return Path(path)


@pytest.fixture(scope="module")
def metadata(wheel: Path) -> Message:
    with zipfile.ZipFile(wheel) as archive:
        (name,) = (each for each in archive.namelist() if each.endswith(".dist-info/METADATA"))
        return email.message_from_bytes(archive.read(name))


def test_the_wheel_has_the_package_and_nothing_else(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
    assert {name.partition("/")[0].partition("-")[0] for name in names} == {"r2p"}
    code = {str(each.relative_to(ROOT)) for each in (ROOT / "r2p").rglob("*.py")}
    page = {str(each.relative_to(ROOT)) for each in (ROOT / "r2p/web/page").rglob("*") if each.is_file()}
    assert {*code, *page, "r2p/py.typed"} == {name for name in names if name.startswith("r2p/")}
    assert any(name.endswith(".dist-info/licenses/r2p/web/page/vendor/uplot/LICENSE") for name in names)
    assert {Path(name).name for name in names} > {"entry_points.txt", "LICENSE", "THIRD-PARTY-NOTICES.md"}


def test_the_sdist_has_what_its_makefile_uses(tmp_path: Path) -> None:
    (path,) = SdistBuilder(str(ROOT)).build(directory=str(tmp_path), versions=["standard"])
    with tarfile.open(path) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    files = "CHANGELOG.md CONTRIBUTING.md LICENSE Makefile README.md THIRD-PARTY-NOTICES.md mkdocs.yml pyproject.toml"
    assert names >= {*files.split(), "r2p/py.typed", "tests/package/test_package.py", "docs/index.md", ".ci/run"}
    assert not [name for name in names if name.startswith((".venv", "site/")) or "__pycache__" in name]


def test_the_metadata_is_complete(metadata: Message) -> None:
    assert metadata["Author"] == "The r2p developers"
    assert metadata["License-Expression"] == "BSD-2-Clause AND MIT"
    assert metadata["Requires-Python"] == ">=3.11"
    assert "Typing :: Typed" in metadata.get_all("Classifier", [])
    assert not metadata.get_all("Project-URL")


def test_an_index_shows_the_readme_without_links_that_lead_nowhere(metadata: Message) -> None:
    assert metadata["Description-Content-Type"] == "text/markdown"
    page = markdown.render(str(metadata.get_payload()))
    assert page is not None
    targets = re.findall(r'(?:href|src)="([^"]*)"', page)
    assert [each for each in targets if not each.startswith(("https://", "#"))] == []
    assert not re.search(r"<img|\]\(", page)
    assert {"Install", "Quick start", "Documentation", "License"} <= set(re.findall(r"<h2.*?>([^<>]+)<", page))
    assert "Martino Migliavacca" in page


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The Python of an environment with the wheel; it has the packages of this one, but not r2p's source."""
    folder = tmp_path_factory.mktemp("venv")
    venv.create(folder, symlinks=os.name != "nt")
    site = sysconfig.get_path("purelib", "venv", {"base": str(folder), "platbase": str(folder)})
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(site)
    (Path(site) / "others.pth").write_text(sysconfig.get_path("purelib"))
    return Path(sysconfig.get_path("scripts", "venv", {"base": str(folder), "platbase": str(folder)})) / "python"


def run(*command: str | Path, folder: Path) -> str:
    done = subprocess.run(command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False)
    assert done.returncode == 0, done.stdout
    return done.stdout


@pytest.mark.processes
def test_a_strict_checker_knows_the_types_of_the_installed_package(installed: Path, tmp_path: Path) -> None:
    (tmp_path / "mypy.ini").write_text("[mypy]\nstrict = true\n")
    checked = ("--python-executable", installed, "--cache-dir", tmp_path / "cache", CONSUMER)
    assert run(sys.executable, "-m", "mypy", *checked, folder=tmp_path) == "Success: no issues found in 1 source file\n"


@pytest.mark.processes
def test_the_installed_package_runs(installed: Path, tmp_path: Path) -> None:
    assert re.fullmatch(r"r2p \d+\.\d+\.\d+\n", run(installed, "-m", "r2p", "--version", folder=tmp_path))
