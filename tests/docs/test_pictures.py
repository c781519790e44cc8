"""The pictures that scripts draw are up to date, need nothing from elsewhere, and stand on a page."""

import importlib.util
import re
import sys
import xml.etree.ElementTree as ET
from importlib import metadata
from pathlib import Path

import pytest

from tests.docs.blocks import ROOT, pages

SVG = "{http://www.w3.org/2000/svg}"

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="the pictures show Linux")


@pytest.mark.skipif(int(metadata.version("rich").partition(".")[0]) < 15, reason="rich 15 made tables narrower")
@pytest.mark.parametrize("script", ["draw_diagrams", "draw_screens"])
def test_pictures_are_what_the_code_draws_today(script: str) -> None:
    spec = importlib.util.spec_from_file_location(script, ROOT / "docs" / f"{script}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    drawn: dict[str, str] = module.pictures()
    assert {file.name for file in module.FOLDER.iterdir()} == set(drawn)
    stale = [name for name, text in drawn.items() if (module.FOLDER / name).read_text(encoding="utf-8") != text]
    assert not stale, f"run `python docs/{script}.py`, and look at what changed"


@pytest.mark.parametrize("file", sorted((ROOT / "docs" / "assets").rglob("*.svg")), ids=lambda file: file.name)
def test_a_picture_stands_alone(file: Path) -> None:
    """A page shows it as an image: it gets no fonts, styles or pictures from outside."""
    text = file.read_text(encoding="utf-8")
    assert ET.fromstring(text).tag == f"{SVG}svg"
    assert re.findall(r"https?://(?!www\.w3\.org/)|@import|url\((?!#)|href=", text) == []


def test_each_picture_is_on_a_page() -> None:
    text = "\n".join(page.read_text(encoding="utf-8") for page in [*pages(), ROOT / "mkdocs.yml"])
    assets = [*(ROOT / "docs" / "assets").rglob("*.svg"), *(ROOT / "docs" / "assets").rglob("*.webp")]
    assert [file.name for file in assets if file.relative_to(ROOT / "docs").as_posix() not in text] == []
