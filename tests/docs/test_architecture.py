"""The map of the code is true: the picture is drawn from the imports of today, and the functions on the walks exist."""

import ast
import importlib.util
import re
from types import ModuleType

import pytest

from tests.docs.blocks import ROOT

PAGE = (ROOT / "docs" / "architecture.md").read_text()

_FILE = re.compile(r"`([a-z_/]+(?:\.py|/))`")
_PLACE = re.compile(r"`([a-z_/]+\.py)`, `([A-Za-z_.]+)`")


def _load_script() -> ModuleType:
    spec = importlib.util.spec_from_file_location("draw_architecture", ROOT / "docs" / "draw_architecture.py")
    assert spec is not None
    assert spec.loader is not None
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    return script


@pytest.fixture(scope="module")
def script() -> ModuleType:
    pytest.importorskip("grimp")
    return _load_script()


def test_the_picture_is_that_of_the_code(script: ModuleType) -> None:
    drawn = (ROOT / "docs" / "assets" / "architecture.svg").read_text()
    assert drawn == script.draw(), "run `python docs/draw_architecture.py`"


def test_an_import_that_leads_upwards_is_refused(script: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    upside_down = dict(reversed(script.LAYERS.items()))
    monkeypatch.setattr(script, "LAYERS", upside_down)
    with pytest.raises(script.DrawingError, match="in a layer above its own"):
        script.draw()


def test_a_package_without_a_layer_is_refused(script: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    layers = {label: tuple(each for each in packages if each != "bus") for label, packages in script.LAYERS.items()}
    monkeypatch.setattr(script, "LAYERS", layers)
    with pytest.raises(script.DrawingError, match=r"r2p\.bus is in no layer"):
        script.draw()


@pytest.mark.parametrize("path", sorted(set(_FILE.findall(PAGE))))
def test_each_file_exists(path: str) -> None:
    root = ROOT if path.startswith(("docs/", "tests/")) else ROOT / "r2p"
    assert (root / path).exists()


@pytest.mark.parametrize(("path", "name"), sorted(set(_PLACE.findall(PAGE))))
def test_each_function_exists(path: str, name: str) -> None:
    scope: list[ast.stmt] = ast.parse((ROOT / "r2p" / path).read_text()).body
    for part in name.split("."):
        found = [
            each
            for each in scope
            if isinstance(each, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef) and each.name == part
        ]
        assert found, f"{path} has no {name}"
        scope = found[0].body


def test_the_vocabulary_has_about_forty_entries() -> None:
    words = PAGE.partition("## Vocabulary")[2].count("\n| ") - 2
    assert 35 <= words <= 45
